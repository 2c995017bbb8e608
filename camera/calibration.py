"""Calibration of a camera by views of a board: from points to intrinsics and how good they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from camera.board import Board
from camera.calibration_adjustment import (
    Adjusted,
    Estimate,
    Points,
    StartError,
    adjust,
    project_estimate,
)
from camera.calibration_checks import demand_different_views, demand_enough, warnings_of
from camera.calibration_model import FREE_COEFFICIENTS, free_span, is_possible, project_points
from camera.calibration_start import best_poses, first_estimate, normals_spread_deg
from camera.errors import CalibrationError
from storage.bounds import ABOVE_0, demand, whole

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_OUTLIER_FACTOR = 3.0
# A point is wrong when it is so many standard deviations off.
_WRONG_POINT = 8.0
_FEWEST_POINTS = 8
_FOLDS = 8
# A coefficient more has to lower the sum of the squared hold-out errors by so many variances.
_WORTH = 4.0
_CIRCLE_ROUNDS = 3
_OUTLINE_POINTS = 32


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board in a picture.

    Attributes
    ----------
    name : str
        The picture's.
    indices : (K,) int64
        Which of the board's points were seen.
    pixels : (K, 2) float64
        Where.
    """

    name: str
    indices: IntArray
    pixels: FloatArray


@dataclass(frozen=True)
class CalibrationSettings:
    """How to calibrate.

    Attributes
    ----------
    aspect : float or None
        scaleY / scaleX: 1 for square pixels, 0.5 for every second line of them; None if both scales
        are free.
    coefficients : int or None
        Number of free distortion coefficients (0 to 5); None: as many as make the hold-out error
        smaller.
    robust : bool
        Huber's loss; points found wrongly pull less.
    keep_outliers : bool
        Keep pictures whose residuals are far above the others'.
    """

    aspect: float | None = 1.0
    coefficients: int | None = None
    robust: bool = True
    keep_outliers: bool = False

    def __post_init__(self) -> None:
        if self.aspect is not None:
            demand(self, CalibrationError, aspect=ABOVE_0)
        if self.coefficients is not None:
            demand(self, CalibrationError, coefficients=whole(0, 5))


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated camera.

    Attributes
    ----------
    adjusted : Adjusted
    points : Points
        What it was fitted to; circles' shifts are taken off.
    names : tuple of str
        The views' names.
    outliers : tuple of (str, float)
        Views left out, with the RMS of their residuals (px).
    coefficients : int
        Number of free distortion coefficients.
    holdout_px : dict of int to float
        RMS reprojection error (u and v together) in views that the intrinsics were not fitted to,
        by number of coefficients.
    spread_deg : float
        Largest angle between two boards' normals.
    warnings : tuple of str
    """

    adjusted: Adjusted
    points: Points
    names: tuple[str, ...]
    outliers: tuple[tuple[str, float], ...]
    coefficients: int
    holdout_px: dict[int, float]
    spread_deg: float
    warnings: tuple[str, ...] = field(default=())

    @property
    def intrinsics(self) -> FloatArray:
        """(9,) scaleX, scaleY, offsetX, offsetY, a2, a3, b1, b2, b3."""
        return self.adjusted.estimate.intrinsics

    @property
    def view_rms_px(self) -> FloatArray:
        """(V,) RMS residual of each view."""
        squares = np.sum(self.adjusted.residuals**2, axis=1)
        mean = np.add.reduceat(squares, self.points.starts) / self.points.counts
        return np.asarray(np.sqrt(mean))


def calibrate(
    views: Sequence[BoardView],
    board: Board,
    size: tuple[int, int],
    settings: CalibrationSettings | None = None,
) -> Calibration:
    """Calibrate a camera by views of a board, by the reprojection error.

    Parameters
    ----------
    views : sequence of BoardView
    board : Board
    size : (int, int)
        Width and height of the pictures, pixels.
    settings : CalibrationSettings, optional

    Returns
    -------
    Calibration

    Raises
    ------
    CalibrationError
        If the views are too few or too much alike, or nothing explains them.
    """
    settings = settings if settings is not None else CalibrationSettings()
    demand_enough(len(views))
    measured = points_of(views, board, size)
    names = tuple(view.name for view in views)
    try:
        start = first_estimate(measured, settings.aspect)
    except StartError:
        raise CalibrationError(
            "no camera explains the points found: are --columns, --rows and the kind of --board "
            "right, and do all pictures show the same board by the same camera at the same zoom?"
        ) from None
    radius = 0.5 * board.circle_m
    start = _staged(start, measured, settings, radius)

    outliers: tuple[tuple[str, float], ...] = ()
    # What a model lacks is no picture's fault, so outliers are told by the fullest one.
    most = 5 if settings.coefficients is None else settings.coefficients
    for count in range(min(2, most), most + 1):
        first = fit_points(start, measured, settings, count, radius)
        start = first[0].estimate
    rms = _view_rms(*first)
    far = rms > _OUTLIER_FACTOR * np.median(rms)
    if far.any() and not settings.keep_outliers:
        kept = np.flatnonzero(~far)
        outliers = tuple((names[v], float(rms[v])) for v in np.flatnonzero(far))
        demand_enough(len(kept), f" without {', '.join(name for name, _ in outliers)}")
        names = tuple(names[v] for v in kept)
        measured = measured.of(kept)
        start = of_views(start, kept)
    measured, wrong = _without_wrong_points(start, measured, first[0].sigma_px, settings, radius)

    counts = range(6) if settings.coefficients is None else [settings.coefficients]
    fits: dict[int, tuple[Adjusted, Points]] = {}
    holdout: dict[int, float] = {}
    estimate = start
    for count in counts:
        fits[count] = fit_points(estimate, measured, settings, count, radius)
        estimate = fits[count][0].estimate
        holdout[count] = holdout_error(fits[count][0].estimate, fits[count][1], settings, count)
    chosen = _fewest_needed(holdout, measured, fits)
    adjusted, points = fits[chosen]
    spread = normals_spread_deg(adjusted.estimate.rotations)
    demand_different_views(adjusted, spread)
    warnings = warnings_of(adjusted, points, spread)
    if wrong:
        warnings.insert(0, f"{wrong} points left out: they lie far from where the others say")
    return Calibration(adjusted, points, names, outliers, chosen, holdout, spread, tuple(warnings))


def points_of(views: Sequence[BoardView], board: Board, size: tuple[int, int]) -> Points:
    """The points of all views, one after the other."""
    counts = [len(view.indices) for view in views]
    return Points(
        board=np.concatenate([board.points[view.indices] for view in views]),
        pixels=np.concatenate([view.pixels for view in views]).astype(np.float64),
        starts=np.cumsum([0, *counts[:-1]]).astype(np.int64),
        width=size[0],
        height=size[1],
    )


def of_views(estimate: Estimate, views: IntArray) -> Estimate:
    """An estimate with the poses of some views only."""
    return Estimate(estimate.intrinsics, estimate.rotations[views], estimate.translations[views])


def holdout_error(
    estimate: Estimate,
    points: Points,
    settings: CalibrationSettings,
    count: int,
    folds: Sequence[IntArray] | None = None,
) -> float:
    """RMS reprojection error in views that the intrinsics were not fitted to, pixels.

    Of what is held out only the poses are fitted.

    Parameters
    ----------
    estimate : Estimate
        Where each fit begins.
    points : Points
    settings : CalibrationSettings
    count : int
        Number of free coefficients.
    folds : sequence of int64 arrays, optional
        The views that are held out together; each view in one of them. Else every `_FOLDS`-th
        (each on its own where there are few).
    """
    every = np.arange(len(points.starts))
    if folds is None:
        number = min(_FOLDS, len(every))
        folds = [every[every % number == fold] for fold in range(number)]
    squares = 0.0
    span, nothing = free_span(count, settings.aspect), np.zeros((9, 0))
    for out in folds:
        used = np.setdiff1d(every, out)
        fit = adjust(of_views(estimate, used), points.of(used), span, robust=settings.robust)
        held = points.of(out)
        there = replace(of_views(estimate, out), intrinsics=fit.estimate.intrinsics)
        try:
            test = adjust(there, held, nothing, robust=settings.robust, sigma_px=fit.sigma_px)
        except StartError:  # a held-out point lies past this fit's fold
            return float("inf")
        squares += float(np.sum(test.residuals**2))
    return float(np.sqrt(squares / len(points.board)))


def circle_shifts(estimate: Estimate, points: Points, radius_m: float) -> FloatArray:
    """Where the centroids of circles' images lie, seen from the images of their centres.

    Parameters
    ----------
    estimate : Estimate
    points : Points
    radius_m : float
        Radius of the circles.

    Returns
    -------
    (N, 2) array
        Pixels; area centroids of the outlines' images, distortion included.
    """
    angles = np.arange(_OUTLINE_POINTS) * (2.0 * np.pi / _OUTLINE_POINTS)
    ring = radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    view = points.views
    on_board = points.board[:, None, :] + ring
    in_camera = np.einsum("nij,nkj->nki", estimate.rotations[view], on_board)
    in_camera += estimate.translations[view][:, None, :]
    outline = project_points(estimate.intrinsics, in_camera.reshape(-1, 3))[0]
    outline = outline.reshape(len(view), _OUTLINE_POINTS, 2)
    centre = project_estimate(estimate, points)[0]
    relative = outline - centre[:, None, :]
    following = np.roll(relative, -1, axis=1)
    cross = relative[..., 0] * following[..., 1] - following[..., 0] * relative[..., 1]
    moment = np.sum((relative + following) * cross[..., None], axis=1)
    return np.asarray(moment / (3.0 * np.sum(cross, axis=1))[:, None])


def _staged(
    start: Estimate, points: Points, settings: CalibrationSettings, radius_m: float
) -> Estimate:
    """One and then two coefficients, with the poses' second solutions tried in between."""
    for count in (1, min(2, 2 if settings.coefficients is None else settings.coefficients)):
        estimate = fit_points(start, points, settings, count, radius_m)[0].estimate
        start = best_poses(estimate, points)
    return start


def fit_points(
    start: Estimate, points: Points, settings: CalibrationSettings, count: int, radius_m: float
) -> tuple[Adjusted, Points]:
    """Adjust intrinsics and poses; of circles, to their centroids.

    Parameters
    ----------
    start : Estimate
    points : Points
    settings : CalibrationSettings
    count : int
        Number of free coefficients.
    radius_m : float
        Radius of the circles; 0 for points.

    Returns
    -------
    fit : Adjusted
    points : Points
        With the circles' shifts taken off (`circle_shifts`).
    """
    span = free_span(count, settings.aspect)
    start = replace(start, intrinsics=_within(start.intrinsics, points, span, settings.aspect))
    fit = adjust(start, points, span, robust=settings.robust)
    if radius_m == 0.0:
        return fit, points
    corrected = points
    for _ in range(_CIRCLE_ROUNDS):
        shifts = circle_shifts(fit.estimate, points, radius_m)
        if not np.all(np.isfinite(shifts)):
            break
        corrected = replace(points, pixels=points.pixels - shifts)
        fit = adjust(fit.estimate, corrected, span, robust=settings.robust)
    return fit, corrected


def _without_wrong_points(
    estimate: Estimate,
    points: Points,
    sigma_px: float,
    settings: CalibrationSettings,
    radius_m: float,
) -> tuple[Points, int]:
    """Leave out points that were found wrongly; the second result says how many."""
    if not settings.robust:
        return points, 0
    seen = points.pixels
    if radius_m > 0.0:
        shifts = circle_shifts(estimate, points, radius_m)
        seen = seen - np.where(np.isfinite(shifts), shifts, 0.0)
    residuals = seen - project_estimate(estimate, points)[0]
    right = np.all(np.abs(residuals) < _WRONG_POINT * sigma_px, axis=1)
    counts = np.add.reduceat(right.astype(np.int64), points.starts)
    # A picture of which too little is left stays as it is: the robust loss deals with it.
    right |= np.repeat(counts < _FEWEST_POINTS, points.counts)
    counts = np.add.reduceat(right.astype(np.int64), points.starts)
    trimmed = replace(
        points,
        board=points.board[right],
        pixels=points.pixels[right],
        starts=np.cumsum([0, *counts[:-1]]).astype(np.int64),
    )
    return trimmed, int(np.sum(~right))


def _within(
    intrinsics: FloatArray, points: Points, span: FloatArray, aspect: float | None
) -> FloatArray:
    """The start with what is not free at its fixed value: no coefficient, the known aspect."""
    free = np.any(span != 0.0, axis=1)
    inside = np.where(free, intrinsics, 0.0)
    if aspect is not None:
        inside[1] = aspect * inside[0]
    return inside if is_possible(inside, points.width, points.height) else intrinsics


def _view_rms(fit: Adjusted, points: Points) -> FloatArray:
    squares = np.sum(fit.residuals**2, axis=1)
    return np.asarray(np.sqrt(np.add.reduceat(squares, points.starts) / points.counts))


def _fewest_needed(
    holdout: dict[int, float], points: Points, fits: dict[int, tuple[Adjusted, Points]]
) -> int:
    best = min(holdout, key=lambda count: holdout[count])
    slack = _WORTH * fits[best][0].sigma_px ** 2 / len(points.board)
    return min(n for n, error in holdout.items() if error**2 <= holdout[best] ** 2 + slack)


def coefficient_names(count: int) -> str:
    """The free coefficients, for people."""
    return " ".join(FREE_COEFFICIENTS[count]) or "none"
