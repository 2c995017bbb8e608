"""The camera's tilt from the verticals that it sees.

A calibration knows how the camera is mounted on the robot, not how the robot stands: it pitches and
rolls on its springs, and the mounting itself drifts. Real verticals tell. The plane through the
camera's centre and a vertical line contains the vertical, so its normal n, turned by the tilt, is
level:

    (R n)_z = 0,    R = exp([pitch, roll, 0]x)    (robot frame: X left, Y backward, Z up)

R takes directions measured with the calibrated mounting to level ones. (DLR Spatial Cognition data
set report, line detection; the data set's own rows apply the inverse of this rotation.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from detect.errors import DetectError
from storage.bounds import ABOVE_0, demand, from_to, whole

FloatArray = NDArray[np.float64]

#: What compiled code tells of a tilt: pitch, roll, covariance, lines that agree, their share of the
#: votes, and the standard deviation of the lean that verticals should show, where in the image it
#: is largest; NaN for none.
TILT_NUMBERS = 9

#: How often the tilt is estimated anew over the lines that agree with it.
REFINEMENTS = 6
#: Standard deviations from which on a line's pull no longer grows.
SOFTENING = 2.0
#: Half of the edges that are no verticals, but nearly, lean less than this (rad).
STRAY_RAD = math.radians(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class TiltEstimate:
    """Pitch and roll of one frame.

    Attributes
    ----------
    pitch_rad, roll_rad : float
        Rotation vector (pitch, roll, 0) about the robot's X and Y that turns measured directions
        level.
    covariance : (2, 2) float64
        Of (pitch, roll) (rad^2).
    lines : int
        How many verticals agree with it.
    """

    pitch_rad: float
    roll_rad: float
    covariance: FloatArray
    lines: int


def tilt_of_numbers(numbers: FloatArray) -> TiltEstimate | None:
    """The tilt that compiled code tells in `TILT_NUMBERS` numbers; None for none."""
    pitch, roll, *_, lines, _, _ = numbers.tolist()
    if math.isnan(pitch):
        return None
    return TiltEstimate(pitch, roll, numbers[2:6].reshape(2, 2), int(lines))


@dataclass(frozen=True, slots=True)
class ConsensusSettings:
    """How the tilt that most verticals agree with is found.

    Parameters
    ----------
    largest_rad : float
        Largest absolute pitch and roll.
    prior_rad : float
        Standard deviation of the tilt; decides only between tilts that the lines support alike.
    building_rad : float
        Standard deviation of real verticals about the vertical.
    proposers : int
        The tilt is looked for among those that pairs of this many lines, the strongest, agree with.
    least_lines : int
        With fewer lines that agree there is no estimate.
    stray_share : float
        Share of edges that agree and are no verticals. The covariance covers the tilts without any
        one of the edges as far as that one may be such.
    """

    largest_rad: float = np.radians(5.0)
    prior_rad: float = np.radians(2.0)
    building_rad: float = np.radians(0.045)
    proposers: int = 24
    least_lines: int = 3
    stray_share: float = 0.06

    def __post_init__(self) -> None:
        demand(
            self,
            DetectError,
            largest_rad=ABOVE_0,
            prior_rad=ABOVE_0,
            building_rad=ABOVE_0,
            proposers=whole(2, 1000),
            least_lines=whole(2),
            stray_share=from_to(0.0, 0.5),
        )


def consensus(
    normal: FloatArray,
    inclination_variance: FloatArray,
    tolerance: FloatArray,
    weight: FloatArray,
    settings: ConsensusSettings,
) -> tuple[TiltEstimate | None, NDArray[np.bool_]]:
    """Estimate the tilt from the largest consistent set of lines, and tell which belong to it.

    Parameters
    ----------
    normal : (N, 3) float64
        Unit normals, in the calibrated robot frame, of the planes through the camera and each line.
    inclination_variance : (N,) float64
        Variance of the normals' inclinations (rad^2).
    tolerance : (N,) float64
        Largest inclinations that the lines may have and be verticals (rad).
    weight : (N,) float64
        Votes of each line, at least 0.
    settings : ConsensusSettings
        Limits and tolerances.

    Returns
    -------
    tilt : TiltEstimate or None
        None where too few lines agree.
    consistent : (N,) bool
        Lines that are vertical under that tilt; without an estimate, under no tilt.
    """
    from detect.verticals.tilt_kernels import agree_on_tilt

    limit = settings.largest_rad
    pitch, roll, covariance, consistent = agree_on_tilt(
        normal,
        settings.building_rad**2 + inclination_variance,
        tolerance,
        weight,
        np.arange(len(weight)),
        settings.proposers,
        limit,
        settings.prior_rad,
        SOFTENING,
        REFINEMENTS,
        settings.stray_share,
        STRAY_RAD,
    )
    lines = int(np.count_nonzero(consistent))
    if lines < settings.least_lines or abs(pitch) > limit or abs(roll) > limit:
        return None, np.abs(normal[:, 2]) <= tolerance
    return TiltEstimate(pitch, roll, covariance, lines), consistent


def level_rotation(pitch_rad: float, roll_rad: float) -> FloatArray:
    """(3, 3) rotation exp([pitch, roll, 0]x) that turns measured directions level."""
    from detect.verticals.tilt_kernels import level_matrix

    return np.asarray(level_matrix(pitch_rad, roll_rad))


def lean(bearing_rad: ArrayLike, pitch_rad: float, roll_rad: float) -> FloatArray:
    """How a vertical at a bearing leans to the left in the chart of a tilted camera (dX / dZ)."""
    bearing = np.asarray(bearing_rad, dtype=np.float64)
    return np.asarray(pitch_rad * np.sin(bearing) - roll_rad * np.cos(bearing))
