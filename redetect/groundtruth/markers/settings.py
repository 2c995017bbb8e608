"""Settings of the estimation of poses, for the command line and library callers."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

from redetect.groundtruth.errors import GroundTruthError
from redetect.storage.bounds import NOT_NEGATIVE, demand, whole

Solver = Literal["sqpnp", "epnp", "iterative", "ippe", "pycolmap"]
Loss = Literal["linear", "huber", "cauchy"]


@dataclass(frozen=True)
class PoseSettings:
    """Settings of the poses.

    Parameters
    ----------
    solver : str
        The solver for the initial pose of least squares.
    loss : str
        How markers that fit badly are weighted in the least squares.
    loss_scale : float
        Normalised error of a marker at which its weight begins to fall.
    outlier_sigma : float
        A marker in an image is left out, and listed, if its normalised error is larger than this
    outlier_px : float
        and its root mean square residual is larger than this (px).
    corner_floor_px : float
        Standard deviation added to each corner's own covariance, for errors that a fit to the image
        does not include: the lens' calibration, the print (px).
    ambiguity_odds : float
        A second solution is ruled out only if the first is this many times likelier.
    floor : bool
        Assume that the robot is on the floor: z, roll and pitch are known.
    floor_z_m : float
        Height of the robot's origin there (m).
    floor_sigma_z_m : float
        Standard deviation of the height (m).
    floor_sigma_tilt_deg : float
        Standard deviation of roll and pitch (deg).
    time_tolerance_s : float
        Images whose times differ by at most this are used together (s).
    speed_m_s : float
        Speed that the robot reaches, when neighbouring frames decide between solutions (m/s).
    turn_deg_s : float
        The same for its turning (deg/s).
    heave_m : float
        By how much the robot's height may differ between neighbouring frames (m).
    wobble_deg : float
        The same for roll and pitch (deg).

    Raises
    ------
    GroundTruthError
        If a number is not finite or not positive.
    """

    solver: Solver = "sqpnp"
    loss: Loss = "huber"
    loss_scale: float = 2.0
    outlier_sigma: float = 5.0
    outlier_px: float = 1.0
    corner_floor_px: float = 0.01
    ambiguity_odds: float = 1000.0
    floor: bool = False
    floor_z_m: float = 0.0
    floor_sigma_z_m: float = 0.01
    floor_sigma_tilt_deg: float = 0.5
    time_tolerance_s: float = 0.005
    speed_m_s: float = 1.0
    turn_deg_s: float = 90.0
    heave_m: float = 0.03
    wobble_deg: float = 2.0

    def __post_init__(self) -> None:
        zero_allowed = {"corner_floor_px", "outlier_px", "time_tolerance_s"}
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            if not math.isfinite(value):
                raise GroundTruthError(f"{entry.name} is {value}: expected a finite number")
            if entry.name == "floor_z_m":
                continue
            if value < 0.0 or (value == 0.0 and entry.name not in zero_allowed):
                least = "0 or more" if entry.name in zero_allowed else "more than 0"
                raise GroundTruthError(f"{entry.name} is {value:g}: expected {least}")
        if self.ambiguity_odds <= 1.0:
            raise GroundTruthError(
                f"ambiguity_odds is {self.ambiguity_odds:g}: expected more than 1"
            )


@dataclass(frozen=True)
class RigSettings:
    """Settings of the rig's estimation.

    Parameters
    ----------
    least_support : int
        A marker belongs to the rig only if this many times, or images, show it with another and
        agree.
    outlier_sigma : float
        A marker in an image is left out, and counted, if its normalised error is larger than this
    outlier_px : float
        and its root mean square residual is larger than this (px).
    corner_floor_px : float
        Standard deviation added to each corner's own covariance (px).
    time_tolerance_s : float
        Images of different cameras whose times differ by at most this are used together (s).

    Raises
    ------
    GroundTruthError
        If a number is not finite or too small.
    """

    least_support: int = 3
    outlier_sigma: float = 5.0
    outlier_px: float = 1.0
    corner_floor_px: float = 0.01
    time_tolerance_s: float = 0.005

    def __post_init__(self) -> None:
        demand(
            self,
            GroundTruthError,
            least_support=whole(1),
            outlier_sigma=NOT_NEGATIVE,
            outlier_px=NOT_NEGATIVE,
            corner_floor_px=NOT_NEGATIVE,
            time_tolerance_s=NOT_NEGATIVE,
        )


@dataclass(frozen=True)
class NetworkSettings:
    """Settings of the network's estimation.

    Parameters
    ----------
    corner_sigma_px : float
        Standard deviation of a checkerboard's corners (px). Only its ratio to the sigmas of the
        boards' offset matters: the result's covariance is scaled by the residuals.
    outlier_sigma : float
        A board in an image is left out, and counted, if its normalised error is larger than this
    outlier_px : float
        and its root mean square residual is larger than this (px).

    Raises
    ------
    GroundTruthError
        If a number is not finite or too small.
    """

    corner_sigma_px: float = 0.1
    outlier_sigma: float = 10.0
    outlier_px: float = 1.0

    def __post_init__(self) -> None:
        for name in ("corner_sigma_px", "outlier_sigma", "outlier_px"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise GroundTruthError(f"{name} is {value:g}: expected more than 0")
