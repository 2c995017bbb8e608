"""Landmarks measured by range and bearing, as discs; how accurate they are, learned from the run.

A least-squares map of the run shows the errors of its ranges, bearings and steps, and which rows
contradict all others, such as misread barcodes. Variances are those errors over the redundancy
of the map (W. Foerstner, B. P. Wrobel, Photogrammetric Computer Vision, 2016, section 4.2.4).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.landmarks import wrap_angle
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph_terms import Weighting
from redetect.slam.mapping.odometry_check import check_odometry
from redetect.slam.mapping.run_map import MappedRun, map_run
from redetect.slam.models import disc_in_robot
from redetect.slam.recording import ASSUMED, UNKNOWN_ID, CircleRows, Recording

# A landmark that is not seen for this time is out of view, seconds.
_OUT_OF_VIEW_S = 2.5
# Largest factor by which errors may differ from usual ones, and smallest.
_MOST_FACTOR = 20.0
# Larger shares of wrong rows are doubtful, and larger errors than this many times the usual ones.
_MANY_WRONG, _VERY_LARGE = 0.1, 8.0
# Fewest redundant numbers of a run that show its noise.
_FEWEST_NUMBERS = 100
# Maps in which the noise is learned: least squares of the rows that fit a robust map.
_ROUNDS = 5
# How much the lengths of steps vary, and their turns per metre (rad/m).
_LENGTH_SIGMA, _TURN_SIGMA = 0.1, 0.05
# A row is wrong if its squared error is less probable than this; the median of squared errors.
_WRONG, _MEDIAN = float(chdtri(2, 1e-6)), float(chdtri(2, 0.5))


class Sightings(NamedTuple):
    """Landmarks that a robot saw."""

    times: FloatArray  # (N,): of the frames (s), ascending
    frame: IntArray  # (n,): the frame of each measurement, ascending
    range_m: FloatArray  # (n,): from the origin of the robot frame
    bearing_rad: FloatArray  # (n,): 0 forward, positive to the left
    ids: IntArray  # (n,): the landmark


class Noise(NamedTuple):
    """Errors of a run's ranges, bearings and steps; the usual ones of the UTIAS data set."""

    ranges: float = 1.0  # their standard deviation over the stated one
    bearings: float = 1.0
    range_correlation: float = 1.0  # correlation of errors while a landmark is in view
    bearing_correlation: float = 0.0
    steps: float = 1.0  # their standard deviation over the stated one
    outliers: int = 0  # number of rows that contradict the others, and have lost their identifier

    def sentence(self) -> str:
        """Description of the noise."""
        if self == USUAL:
            return "the run does not show how large its errors are: they are taken to be usual ones"
        return (
            f"errors of ranges are {self.ranges:.2f}, of bearings {self.bearings:.2f}, of steps "
            f"{self.steps:.2f} times the usual ones, a landmark's correlated by "
            f"{self.range_correlation:.2f}, {self.bearing_correlation:.2f}; {self.outliers} rows "
            "are wrong"
        )

    def doubt(self, rows: int) -> str | None:
        """What may be wrong if many rows contradict the others, or errors are very large."""
        if self.outliers > _MANY_WRONG * rows:
            found = f"{self.outliers} of {rows} rows contradict the others"
        elif max(self.ranges, self.bearings) > _VERY_LARGE:
            found = f"errors are {max(self.ranges, self.bearings):.0f} times as large as usual"
        else:
            return None
        return f"{found}: are clocks, units and signs those of the data set?"


USUAL = Noise()


def discs_of_ranges(
    range_m: ArrayLike,
    bearing_rad: ArrayLike,
    sigma_m: ArrayLike,
    sigma_rad: ArrayLike,
    linearised_at: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Landmarks measured by range and bearing, as positions in the robot frame.

    Takes `range_m, bearing_rad` (n,) and their standard deviations, (n,) or one each; returns `xy`
    (n, 2), `covariance` (n, 2, 2). The model is `linearised_at` (n, 2), or as measured by default
    and at NaN: then bearings seem to fit better the nearer a landmark is, which shrinks a map of
    vague ranges by the square of their relative error.
    """
    distance, angle = np.asarray(range_m, np.float64), np.asarray(bearing_rad, np.float64)
    far, at = distance, angle
    if linearised_at is not None:
        known = np.isfinite(linearised_at).all(axis=1)
        far = np.where(known, np.hypot(*linearised_at.T), distance)
        at = np.where(known, np.arctan2(linearised_at[:, 0], -linearised_at[:, 1]), angle)
    direction = np.stack([np.sin(at), -np.cos(at)], axis=-1)
    across = far[..., None] * np.stack([np.cos(at), np.sin(at)], axis=-1)
    spread = np.asarray(sigma_rad, np.float64)[..., None] * across
    root = np.stack([np.asarray(sigma_m)[..., None] * direction, spread], axis=-1)
    xy = distance[..., None] * direction + wrap_angle(angle - at)[..., None] * across
    return xy, root @ np.swapaxes(root, -1, -2)


def with_noise(
    run: Recording,
    seen: Sightings,
    sigma: FloatArray,
    noise: Noise = USUAL,
    inliers: BoolArray | None = None,
    linearised_at: FloatArray | None = None,
) -> Recording:
    """A run with rows of some noise, by default the usual one; parameters as in `estimate_noise`.

    The n rows of a visit, with a correlation c, have the weight of n / (1 + (n - 1) c). Those that
    are not `inliers` (n,) lose their identifiers; for the others see `discs_of_ranges`.
    """
    visits = _visits(seen)
    others = np.bincount(visits)[visits, None] - 1.0
    together = 1.0 + others * [noise.range_correlation, noise.bearing_correlation]
    sigma_m, sigma_rad = (sigma * [noise.ranges, noise.bearings] * np.sqrt(together)).T
    ids = seen.ids if inliers is None else np.where(inliers, seen.ids, UNKNOWN_ID)
    if linearised_at is not None and inliers is not None:
        linearised_at = np.where(inliers[:, None], linearised_at, np.nan)
    rows = discs_of_ranges(seen.range_m, seen.bearing_rad, sigma_m, sigma_rad, linearised_at)
    return replace(run, circles=CircleRows(seen.frame, *rows, ids))


def estimate_noise(run: Recording, seen: Sightings, sigma: FloatArray) -> tuple[Recording, Noise]:
    """A run with covariances as large as its errors, and without identifiers that are wrong.

    Steps become longer or shorter, and turn more or less in each metre, as fits the rows best.

    Takes a run whose n rows of discs are those seen, and the stated standard deviations (n, 2) of
    ranges (m) and bearings (rad), apart from factors. Covariances of its rows are not used, zero
    ones of steps become the assumed ones. The noise is the usual one if the run shows too little of
    its own, or no map of it is found.
    """
    assumed = ASSUMED.covariance(run.steps)
    stated = np.any(run.step_covariance, axis=(1, 2))[:, None, None]
    further = np.where(stated, run.step_covariance - assumed, 0.0)
    run = with_noise(replace(run, step_covariance=assumed + further), seen, sigma)
    try:
        return _with_own_noise(run, seen, sigma, further)
    except SlamError:  # also: no minimum, undetermined poses, or no row with an identifier
        return run, USUAL


def _with_own_noise(
    run: Recording, seen: Sightings, sigma: FloatArray, further: FloatArray
) -> tuple[Recording, Noise]:
    """`estimate_noise` of a run with the usual noise, and `further` covariances (N, 3, 3) of steps;
    `SlamError` if it does not show its own.
    """
    _demand_shown(2 * (len(seen.ids) - len(np.unique(seen.ids))) >= _FEWEST_NUMBERS)
    noise, visits, steps, longer, turn = USUAL, _visits(seen), run.steps, 0.0, 0.0
    predicted = _predicted(map_run(run, weighting=Weighting(loss="geman-mcclure")), seen)
    error = _errors(predicted, seen) / sigma
    squared = np.sum(error**2, axis=1)
    inliers = squared <= max(1.0, float(np.nanmedian(squared)) / _MEDIAN) * _WRONG
    run = with_noise(run, seen, sigma, noise, inliers, predicted)
    for _ in range(_ROUNDS):
        mapped = map_run(run)
        predicted = _predicted(mapped, seen)
        error = _errors(predicted, seen) / sigma
        inliers = np.sum((error / [noise.ranges, noise.bearings]) ** 2, axis=1) <= _WRONG
        table, check = mapped.table, check_odometry(mapped)
        # Factors are NaN if there are too few numbers.
        _demand_shown(inliers.any() and check.rows_factor > 0.0 and check.odometry_factor > 0.0)
        # The share of the numbers of rows that the others check.
        redundant = table.discs / check.rows_factor / (2.0 * table.measurements)
        variance = np.mean(error[inliers] ** 2, axis=0) / redundant
        of_steps = max(noise.steps * math.sqrt(check.odometry_factor), 1.0 / _MOST_FACTOR)
        factors = np.append(np.sqrt(variance), of_steps)
        _demand_shown(np.all((factors >= 1.0 / _MOST_FACTOR) & (factors < _MOST_FACTOR)))
        alike = np.clip(_products(error[inliers], visits[inliers]) / variance, 0.0, 1.0)
        outliers = int(np.count_nonzero(~inliers))
        noise = Noise._make([*factors[:2].tolist(), *alike.tolist(), of_steps, outliers])
        longer = (1.0 + longer) * (1.0 + check.length) - 1.0
        longer /= 1.0 + (check.length_sigma / _LENGTH_SIGMA) ** 2
        turn += check.turn_per_metre
        turn /= 1.0 + (check.turn_per_metre_sigma / _TURN_SIGMA) ** 2
        corrected = steps * [1.0 + longer, 1.0 + longer, 1.0]
        corrected[:, 2] += turn * np.hypot(steps[:, 0], steps[:, 1])
        spread = noise.steps**2 * ASSUMED.covariance(steps) + further
        run = replace(run, steps=corrected, step_covariance=spread)
        run = with_noise(run, seen, sigma, noise, inliers, predicted)
    return run, noise


def _demand_shown(shown: bool | np.bool_) -> None:
    if not shown:
        raise SlamError("the run does not show its noise")


def _predicted(mapped: MappedRun, seen: Sightings) -> FloatArray:
    """(n, 2) positions in the robot frame by a map; NaN if a landmark is not in it."""
    place = places_of(seen.ids, mapped.graph.disc_ids, mapped.estimate.disc_xy)
    return np.asarray(disc_in_robot(mapped.estimate.poses[seen.frame + 1], place))


def _errors(predicted: FloatArray, seen: Sightings) -> FloatArray:
    """(n, 2) errors of ranges (m) and bearings (rad) for predicted positions (n, 2)."""
    x, y = predicted.T
    off = wrap_angle(seen.bearing_rad - np.arctan2(x, -y))
    return np.stack([seen.range_m - np.hypot(x, y), off], axis=1)


def _visits(seen: Sightings) -> IntArray:
    """(n,) the visit that each sighting belongs to: a landmark stays in view during it."""
    time = seen.times[seen.frame]
    order = np.lexsort((time, seen.ids))
    begins = (np.diff(seen.ids[order]) != 0) | (np.diff(time[order]) > _OUT_OF_VIEW_S)
    visits = np.empty(len(order), np.int64)
    visits[order] = np.append(0, np.cumsum(begins))
    return visits


def _products(error: FloatArray, visits: IntArray) -> FloatArray:
    """(k,) mean product of two of (n, k) errors in one visit (n,)."""
    sums, squares = np.zeros((2, visits.max() + 1, error.shape[1]))
    np.add.at(sums, visits, error)
    np.add.at(squares, visits, error**2)
    count = np.bincount(visits)
    return np.asarray(np.sum(sums**2 - squares, axis=0) / max(np.sum(count * (count - 1.0)), 1.0))


def places_of(ids: IntArray, known: IntArray, xy: FloatArray) -> FloatArray:
    """Places (n, 2) of landmarks (n,), of `known` (m,), ascending, at `xy` (m, 2); else NaN."""
    index = np.minimum(np.searchsorted(known, ids), len(known) - 1)
    return np.where((known[index] == ids)[:, None], xy[index], np.nan)
