"""Settings of all estimations; nothing heavy is imported, so that `--help` is quick."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from math import inf
from typing import Annotated, Literal

from redetect.bounds import (
    PROBABILITY,
    Bounded,
    Bounds,
    NotNegative,
    Positive,
    ShareAbove0,
    inside,
    whole,
)
from redetect.groundtruth.errors import GroundTruthError

Solver = Literal["sqpnp", "epnp", "iterative", "ippe", "pycolmap"]

_ODDS = Bounds("more than 1", lambda x: 1.0 < x < inf)
_UP_TO_A_DAY = Bounds("above 0, at most 100000", lambda x: 0.0 < x <= 1e5)


@dataclass(frozen=True)
class _MarkerSettings(Bounded, error=GroundTruthError):
    """Settings of all estimations from markers."""

    # A marker in an image is an outlier, and listed or counted, if its normalised error is larger
    # than this and its residual larger than --outlier-px.
    outlier_sigma: Positive = 5.0
    outlier_px: NotNegative = 1.0  # Least root mean square residual of an outlier (px).
    # Standard deviation added to each corner's own covariance, for errors that a fit to the image
    # does not include: the lens calibration, the print (px).
    corner_floor_px: NotNegative = 0.01
    # Images of different cameras whose times differ by at most this are used together (s).
    time_tolerance_s: NotNegative = 0.005


@dataclass(frozen=True)
class PoseSettings(_MarkerSettings):
    """Settings of the poses."""

    solver: Solver = "sqpnp"  # The solver for the initial pose of least squares.
    # A second solution is ruled out only if the first is this many times more likely.
    ambiguity_odds: Annotated[float, _ODDS] = 1000.0
    # Largest speed of the robot, if neighbouring frames decide between solutions (m/s).
    speed_m_s: Positive = 1.0
    turn_deg_s: Positive = 90.0  # The same for its turn rate (deg/s).
    # Largest difference of the robot's height between neighbouring frames (m).
    heave_m: Positive = 0.03
    wobble_deg: Positive = 2.0  # The same for roll and pitch (deg).

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.solver == "pycolmap" and find_spec("pycolmap") is None:
            raise GroundTruthError(
                "--solver pycolmap needs the package pycolmap, which is not installed; not every "
                "platform has it: choose another solver"
            )


@dataclass(frozen=True)
class RigSettings(_MarkerSettings):
    """Settings of the rig's estimation."""

    # Least number of times, or images, that show a marker of the rig with another one and agree
    least_support: Annotated[int, whole(1)] = 3


@dataclass(frozen=True)
class NetworkSettings(Bounded, error=GroundTruthError):
    """Settings of the network's estimation."""

    # Standard deviation of a checkerboard's corners (px). Only its ratio to the sigmas of the
    # boards' offset matters: the result's covariance is scaled by the residuals.
    corner_sigma_px: Positive = 0.1
    # A board in an image is left out, and counted, if its normalised error is larger than this and
    # its residual larger than --outlier-px.
    outlier_sigma: Positive = 10.0
    outlier_px: Positive = 1.0  # Least root mean square residual of an outlier (px).


@dataclass(frozen=True)
class AlignmentSettings(Bounded, error=GroundTruthError):
    """Settings of the scanners' alignment."""

    # Initial gate for matching readings (m).
    gate_m: Positive = 0.5
    keep: ShareAbove0 = 0.95  # Share of the matches that are used: the best.


@dataclass(frozen=True)
class LaserSettings(Bounded, error=GroundTruthError):
    """Settings of laser tracking."""

    gate_m: Positive = 0.2  # Largest distance of a reading from the robot's outline (m).
    keep: ShareAbove0 = 0.95  # Share of the readings within the gate that the ICP uses: the best.


@dataclass(frozen=True)
class SyncSettings(Bounded, error=GroundTruthError):
    """Settings of the synchronisation of clocks."""

    # Bound of the time offset, either way (s).
    largest_offset_s: Annotated[float, _UP_TO_A_DAY] = 60.0
    # Bound of the drift, the relative difference of the clocks' rates.
    largest_drift: Annotated[float, inside(0.0, 0.5)] = 0.01
    segment_gap_s: Positive = 5.0  # A longer pause in the ground truth begins a new segment (s).

    @property
    def largest(self) -> tuple[float, float]:
        """Bounds of the offset (s) and the drift."""
        return self.largest_offset_s, self.largest_drift


@dataclass(frozen=True)
class FuseSettings(Bounded, error=GroundTruthError):
    """Errors of odometry, and the gate of measurements."""

    # Standard deviation of odometry's distance per square root of a metre driven (m).
    distance_sigma: NotNegative = 0.02
    # Standard deviation of lateral slip per square root of a metre driven (m), without the lateral
    # error due to a wrong heading.
    lateral_sigma: NotNegative = 0.01
    # Standard deviation of odometry's heading per square root of a radian turned (rad).
    turn_sigma: NotNegative = 0.02
    turn_per_metre_sigma: NotNegative = 0.01  # The same per square root of a metre driven (rad).
    # Scale these deviations (distance, lateral slip, and both of the heading together) to maximise
    # the likelihood of the measurements; they are only the start of the search then.
    learn_noise: bool = True
    # Prior standard deviation of the scale error of odometry's turns. Of this and the next two,
    # terms that do not improve predictions are dropped.
    turn_scale_sigma: NotNegative = 0.03
    turn_bias_per_metre_sigma: NotNegative = 0.01  # The same for its turn per metre driven (rad).
    distance_scale_sigma: NotNegative = 0.03  # The same for the scale error of its distances.
    # Share of correct poses that pass the gate.
    gate_probability: Annotated[float, PROBABILITY] = 0.9999
