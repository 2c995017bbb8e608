"""Tilt consensus: the camera's tilt from the verticals that it sees.

A calibration gives the mounting of the camera on the robot, not the robot's tilt: the robot pitches
and rolls on its springs, and the mounting itself drifts. Real verticals show the tilt. The plane
through the camera's centre and a vertical line contains the vertical, so its normal n, rotated by
the tilt, is level:

    (R n)_z = 0,    R = exp([pitch, roll, 0]x)    (robot frame: X left, Y backward, Z up)

R takes directions measured with the calibrated mounting to level ones. (DLR Spatial Cognition data
set report, line detection; the data set's own rows apply the inverse of this rotation.) The tilt is
the one on which most lines agree, refined by least squares with Cauchy's weights; its error is
estimated in `detect.verticals.tilt_error`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.verticals.tilt_error import descending, error_of_tilt

FloatArray = NDArray[np.float64]

#: How often the tilt is estimated again from the lines that agree with it.
REFINEMENTS = 6
#: Standard deviations from which on a line's pull no longer grows.
SOFTENING = 2.0
#: Columns from one to the next at which the lean is predicted.
_LEAN_SPACING = 16


class TiltEstimate(NamedTuple):
    """Pitch and roll of one frame.

    Attributes
    ----------
    pitch_rad, roll_rad : float
        Rotation vector (pitch, roll, 0) about the robot's X and Y that turns measured directions
        level. Compiled code has NaN for none.
    covariance : (2, 2) float64
        Of (pitch, roll) (rad^2).
    lines : int
        How many verticals agree with it.
    votes : float
        Their share of all votes.
    lean_rad : float
        Standard deviation, due to that of the tilt, of the lean that verticals should show, where
        in the image it is largest.
    """

    pitch_rad: float
    roll_rad: float
    covariance: FloatArray
    lines: int
    votes: float = math.nan
    lean_rad: float = math.nan


class ConsensusSettings(NamedTuple):
    """How the tilt that most verticals agree with is found.

    Attributes
    ----------
    largest_rad : float
        Largest absolute pitch and roll.
    prior_rad : float
        Standard deviation of the tilt; decides only between tilts that the lines support alike.
    proposers : int
        Candidates for the tilt come from pairs of this many lines, the strongest.
    least_lines : int
        With fewer lines that agree there is no estimate.
    stray_share : float
        Share of lines that are no verticals: the covariance is then the mean square error of
        `detect.verticals.tilt_error`; 0 for that of least squares.
    """

    largest_rad: float = math.radians(5.0)
    prior_rad: float = math.radians(2.0)
    proposers: int = 24
    least_lines: int = 3
    stray_share: float = 0.15


class Verticals(NamedTuple):
    """Constraints of the tilt by lines that may be verticals.

    Attributes
    ----------
    normal : (N, 3) float64
        Unit normals, in the calibrated robot frame, of the planes through the camera and each line.
    variance : (N,) float64
        Of the normals' inclinations that verticals show (rad^2).
    tolerance : (N,) float64
        Largest inclinations that the lines may have and be verticals (rad).
    weight : (N,) float64
        Votes of each line, at least 0.
    """

    normal: FloatArray
    variance: FloatArray
    tolerance: FloatArray
    weight: FloatArray


def consensus(
    lines: Verticals, settings: ConsensusSettings
) -> tuple[TiltEstimate | None, NDArray[np.bool_]]:
    """Estimate the tilt from the largest consistent set of lines; returns the set as well.

    Parameters
    ----------
    lines : Verticals
        The lines, each an edge of its own.
    settings : ConsensusSettings
        Limits and tolerances.

    Returns
    -------
    tilt : TiltEstimate or None
        None where too few lines agree.
    consistent : (N,) bool
        Lines that are vertical under that tilt; without an estimate, under no tilt.
    """
    tilt, consistent = agreed_tilt(lines, np.empty(0), settings)
    edge = np.arange(len(lines.weight))
    return known(with_error(tilt, lines, edge, settings)), consistent


def known(tilt: TiltEstimate) -> TiltEstimate | None:
    """None where compiled code has NaN."""
    return None if math.isnan(tilt.pitch_rad) else tilt


@njit(cache=True, error_model="numpy")
def no_tilt() -> TiltEstimate:
    """The value in compiled code for no estimate."""
    return TiltEstimate(np.nan, np.nan, np.full((2, 2), np.nan), 0, np.nan, np.nan)


@njit(cache=True, error_model="numpy")
def agreed_tilt(
    lines: Verticals, bearing: FloatArray, settings: ConsensusSettings
) -> tuple[TiltEstimate, NDArray[np.bool_]]:
    """The tilt that most lines agree with, if they are enough.

    Parameters
    ----------
    lines, settings
        As for `consensus`.
    bearing : (W,) float64
        Bearings at which the lean of verticals is of interest.

    Returns
    -------
    tilt : TiltEstimate
        NaN where too few lines agree; its covariance is that of least squares.
    agrees : (N,) bool
        Lines that agree with it; where there is none, with no tilt.
    """
    weight, limit = lines.weight, settings.largest_rad
    pitch, roll, covariance, agrees = agree_on_tilt(lines, settings)
    count = 0
    votes = 0.0
    total = 0.0
    for k in range(len(weight)):
        total += weight[k]
        if agrees[k]:
            count += 1
            votes += weight[k]
    if count < settings.least_lines or abs(pitch) > limit or abs(roll) > limit:
        for k in range(len(weight)):
            agrees[k] = abs(lines.normal[k, 2]) <= lines.tolerance[k]
        return no_tilt(), agrees
    lean = _largest_lean_deviation(bearing, covariance)
    return TiltEstimate(pitch, roll, covariance, count, votes / total, lean), agrees


@njit(cache=True, error_model="numpy")
def with_error(
    tilt: TiltEstimate, lines: Verticals, edge: NDArray[np.int64], settings: ConsensusSettings
) -> TiltEstimate:
    """The tilt with its mean square error as covariance, unless settings leave that out.

    `edge` is one of the lines for each, the same for all of an edge.
    """
    if np.isnan(tilt.pitch_rad) or not settings.stray_share > 0.0:
        return tilt
    pitch, roll = tilt.pitch_rad, tilt.roll_rad
    covariance = error_of_tilt(
        lines.normal, lines.variance, lines.weight, edge, (pitch, roll), settings.prior_rad,
        settings.stray_share,
    )  # fmt: skip
    return TiltEstimate(pitch, roll, covariance, tilt.lines, tilt.votes, tilt.lean_rad)


@njit(cache=True, error_model="numpy")
def _largest_lean_deviation(bearing: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    """Standard deviation of the lean of a vertical due to that of the tilt, where it is largest."""
    largest = 0.0
    for c in range(0, len(bearing), _LEAN_SPACING):
        if math.isfinite(bearing[c]):
            sine = math.sin(bearing[c])
            cosine = math.cos(bearing[c])
            variance = (
                sine * sine * covariance[0, 0]
                - 2.0 * sine * cosine * covariance[0, 1]
                + cosine * cosine * covariance[1, 1]
            )
            largest = max(largest, variance)
    return math.sqrt(largest)


@njit(cache=True, error_model="numpy")
def largest_lean(bearing: NDArray[np.float64], pitch: float, roll: float) -> float:
    """How far a vertical leans in a camera of some tilt, where that is most (rad)."""
    largest = 0.0
    for c in range(0, len(bearing), _LEAN_SPACING):
        if math.isfinite(bearing[c]):
            lean = pitch * math.sin(bearing[c]) - roll * math.cos(bearing[c])
            largest = max(largest, abs(lean))
    return largest


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"}, forceinline=True)
def _votes(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    weight: NDArray[np.float64],
    pitch: float,
    roll: float,
) -> float:
    """Votes of lines, whose normals are given in units of their tolerances, for a tilt."""
    votes = 0.0
    for line in range(len(weight)):
        off = z[line] + pitch * y[line] - roll * x[line]
        votes += weight[line] * max(1.0 - off * off, 0.0)
    return votes


@njit(cache=True, error_model="numpy")
def vote_for_tilt(lines: Verticals, settings: ConsensusSettings) -> tuple[float, float]:
    """Pitch and roll that the largest weight of lines agrees with.

    Each pair of proposers gives the tilt that makes both vertical; a line votes for it with its
    weight, less the farther it is from vertical. A tilt t loses t^2 / (2 prior^2) votes. No tilt is
    tried as well.

    Returns
    -------
    pitch, roll : float
        The tilt (rad); the first of those with the most votes.
    """
    normal, tolerance, weight = lines.normal, lines.tolerance, lines.weight
    limit, prior = settings.largest_rad, settings.prior_rad
    proposer = descending(weight)[: settings.proposers]
    best_pitch = 0.0
    best_roll = 0.0
    best = -math.inf
    x = normal[:, 0] / tolerance
    y = normal[:, 1] / tolerance
    z = normal[:, 2] / tolerance
    for i in range(-1, len(proposer)):
        for k in range(i + 1, len(proposer) if i >= 0 else 1):
            pitch = 0.0
            roll = 0.0
            if i >= 0:
                m = proposer[i]
                n = proposer[k]
                # n_z + pitch n_y - roll n_x = 0 for both.
                determinant = normal[m, 0] * normal[n, 1] - normal[m, 1] * normal[n, 0]
                if determinant == 0.0:
                    continue
                pitch = (normal[m, 2] * normal[n, 0] - normal[m, 0] * normal[n, 2]) / determinant
                roll = (normal[m, 2] * normal[n, 1] - normal[m, 1] * normal[n, 2]) / determinant
                if not (abs(pitch) <= limit and abs(roll) <= limit):
                    continue
            votes = -0.5 * (pitch * pitch + roll * roll) / (prior * prior)
            votes += _votes(x, y, z, weight, pitch, roll)
            if votes > best:
                best = votes
                best_pitch = pitch
                best_roll = roll
    return best_pitch, best_roll


@njit(cache=True, error_model="numpy")
def level_matrix(pitch: float, roll: float) -> NDArray[np.float64]:
    """(3, 3) rotation exp([pitch, roll, 0]x)."""
    squared = pitch * pitch + roll * roll
    angle = math.sqrt(squared)
    # sin(x) / x and (1 - cos(x)) / x^2.
    first = 1.0 - squared / 6.0
    second = 0.5 - squared / 24.0
    if angle > 1e-3:
        first = math.sin(angle) / angle
        second = 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    rotation = np.empty((3, 3))
    rotation[0, 0] = 1.0 - second * roll * roll
    rotation[0, 1] = second * pitch * roll
    rotation[0, 2] = first * roll
    rotation[1, 0] = second * pitch * roll
    rotation[1, 1] = 1.0 - second * pitch * pitch
    rotation[1, 2] = -first * pitch
    rotation[2, 0] = -first * roll
    rotation[2, 1] = first * pitch
    rotation[2, 2] = 1.0 - second * squared
    return rotation


@njit(cache=True, error_model="numpy")
def refine_tilt(
    lines: Verticals, pitch: float, roll: float, prior: float
) -> tuple[float, float, FloatArray, NDArray[np.bool_]]:
    """Least squares of a tilt over the lines that agree with it, repeated.

    Parameters
    ----------
    lines
        See `Verticals`.
    pitch, roll : float
        To begin with (rad).
    prior : float
        Standard deviation of the tilt (rad).

    Returns
    -------
    pitch, roll : float
        The tilt (rad).
    covariance : (2, 2) float64
        Of it (rad^2), if lines err one by one (else `detect.verticals.tilt_error`).
    agrees : (N,) bool
        Lines that are vertical under it.
    """
    normal, variance, tolerance = lines.normal, lines.variance, lines.tolerance
    count = len(variance)
    covariance = np.zeros((2, 2))
    covariance[0, 0] = prior * prior
    covariance[1, 1] = prior * prior
    agrees = np.empty(count, np.bool_)
    for repetition in range(REFINEMENTS + 1):
        rotation = level_matrix(pitch, roll)
        pp = 1.0 / (prior * prior)
        pr = 0.0
        rr = pp
        gradient_p = pitch / (prior * prior)
        gradient_r = roll / (prior * prior)
        for i in range(count):
            x = 0.0
            y = 0.0
            z = 0.0
            for k in range(3):
                x += rotation[0, k] * normal[i, k]
                y += rotation[1, k] * normal[i, k]
                z += rotation[2, k] * normal[i, k]
            agrees[i] = abs(z) <= tolerance[i]
            if agrees[i]:
                # A line of furniture or a shadow among few lines must not pull.
                weight = 1.0 / (variance[i] + (z / SOFTENING) ** 2)
                pp += weight * y * y
                pr -= weight * y * x
                rr += weight * x * x
                gradient_p += weight * y * z
                gradient_r -= weight * x * z
        if repetition == REFINEMENTS:
            break
        determinant = pp * rr - pr * pr
        covariance[0, 0] = rr / determinant
        covariance[0, 1] = -pr / determinant
        covariance[1, 0] = -pr / determinant
        covariance[1, 1] = pp / determinant
        pitch -= covariance[0, 0] * gradient_p + covariance[0, 1] * gradient_r
        roll -= covariance[1, 0] * gradient_p + covariance[1, 1] * gradient_r
    return pitch, roll, covariance, agrees


@njit(cache=True, error_model="numpy")
def agree_on_tilt(
    lines: Verticals, settings: ConsensusSettings
) -> tuple[float, float, FloatArray, NDArray[np.bool_]]:
    """The tilt that most lines vote for, refined; results as of `refine_tilt`."""
    pitch, roll = vote_for_tilt(lines, settings)
    return refine_tilt(lines, pitch, roll, settings.prior_rad)
