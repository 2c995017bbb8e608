"""Settings of the estimation of poses, for the command line and library callers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from redetect.groundtruth.errors import GroundTruthError
from redetect.storage.bounds import FINITE, Bounds, NotNegative, Positive, demand_fields, whole

Solver = Literal["sqpnp", "epnp", "iterative", "ippe", "pycolmap"]
Loss = Literal["linear", "huber", "cauchy"]

_ODDS = Bounds("more than 1", 1.0, above=True, below=True)


@dataclass(frozen=True)
class PoseSettings:
    """Settings of the poses."""

    solver: Solver = "sqpnp"  # The solver for the initial pose of least squares.
    loss: Loss = "huber"  # How markers that fit badly are weighted in the least squares.
    loss_scale: Positive = 2.0  # Normalised error of a marker at which its weight begins to fall.
    # A marker in an image is left out, and listed, if its normalised error is larger than this
    # and its residual larger than --outlier-px.
    outlier_sigma: Positive = 5.0
    outlier_px: NotNegative = 1.0  # Root mean square residual of what may be left out (px).
    # Standard deviation added to each corner's own covariance, for errors that a fit to the image
    # does not include: the lens' calibration, the print (px).
    corner_floor_px: NotNegative = 0.01
    # A second solution is ruled out only if the first is this many times likelier.
    ambiguity_odds: Annotated[float, _ODDS] = 1000.0
    floor: bool = False  # Assume that the robot is on the floor: z, roll and pitch are known.
    floor_z_m: Annotated[float, FINITE] = 0.0  # Height of the robot's origin there (m).
    floor_sigma_z_m: Positive = 0.01  # Standard deviation of the height (m).
    floor_sigma_tilt_deg: Positive = 0.5  # Standard deviation of roll and pitch (deg).
    # Images whose times differ by at most this are used together (s).
    time_tolerance_s: NotNegative = 0.005
    # Speed that the robot reaches, when neighbouring frames decide between solutions (m/s).
    speed_m_s: Positive = 1.0
    turn_deg_s: Positive = 90.0  # The same for its turning (deg/s).
    # By how much the robot's height may differ between neighbouring frames (m).
    heave_m: Positive = 0.03
    wobble_deg: Positive = 2.0  # The same for roll and pitch (deg).

    def __post_init__(self) -> None:
        demand_fields(self, GroundTruthError)


@dataclass(frozen=True)
class RigSettings:
    """Settings of the rig's estimation."""

    # A marker belongs to the rig only if this many times, or images, show it with another and agree
    least_support: Annotated[int, whole(1)] = 3
    # A marker in an image is left out, and counted, if its normalised error is larger than this
    # and its residual larger than --outlier-px.
    outlier_sigma: NotNegative = 5.0
    outlier_px: NotNegative = 1.0  # Root mean square residual of what may be left out (px).
    # Standard deviation added to each corner's own covariance (px).
    corner_floor_px: NotNegative = 0.01
    # Images of different cameras whose times differ by at most this are used together (s).
    time_tolerance_s: NotNegative = 0.005

    def __post_init__(self) -> None:
        demand_fields(self, GroundTruthError)


@dataclass(frozen=True)
class NetworkSettings:
    """Settings of the network's estimation.

    Raises
    ------
    GroundTruthError
        If a number is not finite or too small.
    """

    # Standard deviation of a checkerboard's corners (px). Only its ratio to the sigmas of the
    # boards' offset matters: the result's covariance is scaled by the residuals.
    corner_sigma_px: Positive = 0.1
    # A board in an image is left out, and counted, if its normalised error is larger than this and
    # its residual larger than --outlier-px.
    outlier_sigma: Positive = 10.0
    outlier_px: Positive = 1.0  # Root mean square residual of what may be left out (px).

    def __post_init__(self) -> None:
        demand_fields(self, GroundTruthError)
