"""Calibration of a camera from views of a board: intrinsics, their uncertainty, and checks."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from camera.boards.board import Board
from camera.calibration.adjustment import Adjusted, Points, residuals_of, with_unfitted_terms
from camera.calibration.choice import choose_lens
from camera.calibration.consensus import (
    ALL_THE_SAME,
    demand_different_views,
    find_consensus,
    listed,
)
from camera.calibration.model import COUNT, CalibrationSettings, FreeLens, corner_radius
from camera.calibration.start import normals_spread_deg
from camera.errors import CalibrationError, CameraError
from camera.model import PARAMETERS, Camera
from camera.uncertainty import UNPOSED, projection_sigma, with_covariance, with_intrinsics
from redetect.array_types import FloatArray, IntArray
from redetect.least_squares.solver import StartError

FEWEST_VIEWS = 3
_LARGEST_RMS_PX, _LARGEST_RMS_WIDTHS = 1.0, 1.0 / 2000.0
# Calibrations are warned about if the usual standard deviation of the projection is above this.
_LARGEST_SIGMA_PX = 0.5
# Residual, in standard deviations, beyond which a point is an outlier.
_WRONG_POINT = 8.0
# Outliers are not excluded if fewer points of a picture remain.
_FEWEST_POINTS = 8
# Pictures that leave the ratio of the scales more uncertain than this leave it open.
_ASPECT_SIGMA = 0.003


def largest_rms_px(width: int) -> float:
    """Largest RMS residual of a good fit: points are accurate to some tenths of a pixel.

    It is larger for large images, which are softer.
    """
    return max(_LARGEST_RMS_PX, _LARGEST_RMS_WIDTHS * width)


def demand_enough(count: int, without: str = "") -> None:
    """Raise an error for too few pictures; `without` states what was excluded."""
    if count < FEWEST_VIEWS:
        raise CalibrationError(
            f"{count} pictures of the board{without}: at least {FEWEST_VIEWS} are needed, and 15 "
            "to 40 are good; take more, from different sides and out to the image's corners"
        )


def warnings_of(fit: Adjusted, points: Points, spread_deg: float) -> list[str]:
    """Warnings about weaknesses of a calibration."""
    warnings = []
    if fit.rms_px > largest_rms_px(points.width):
        warnings.append(
            f"an RMS residual of {fit.rms_px:.2f} px means that the points do not fit: is "
            "the board flat, are --board, --columns and --rows right, and does the lens see less "
            "than 90 deg off its axis in the image's corners?"
        )
    views = len(points.counts)
    if views < 10:
        warnings.append(f"only {views} pictures: 15 to 40 give a more reliable result")
    if spread_deg < 20.0:
        warnings.append(
            f"the boards' normals differ by at most {spread_deg:.0f} deg: tilt the board by 20 to "
            "45 deg in different directions"
        )
    warnings += coverage_warnings(fit.estimate.intrinsics, points)
    with suppress(CameraError):  # an impossible camera is an error elsewhere
        size = {"width": points.width, "height": points.height}
        camera = with_intrinsics(UNPOSED, fit.estimate.intrinsics, **size)
        usual = float(np.median(projection_sigma(camera, fit.covariance)))
        if not usual <= _LARGEST_SIGMA_PX:
            warnings.append(
                f"the projection is uncertain by {usual:.1f} px (median over the image): take more "
                "pictures, with tilted boards, out to the corners; a lens that sees more than 85 "
                "deg off its axis there is not described well"
            )
    return warnings


def coverage(points: Points, columns: int = 8, rows: int = 6) -> IntArray:
    """Number of points in each cell of the image, (rows, columns)."""
    shape, size = np.array([columns, rows]), np.array([points.width, points.height])
    u, v = np.clip(((points.pixels + 0.5) * shape / size).astype(int), 0, shape - 1).T
    return np.bincount(v * columns + u, minlength=rows * columns).reshape(rows, columns)


def coverage_warnings(intrinsics: FloatArray, points: Points) -> list[str]:
    """Parts of the image in which no point was seen."""
    warnings = []
    across, down = ("left", "middle", "right"), ("top", "middle", "bottom")
    empty = [
        f"{down[row]} {across[column]}" if row != 1 or column != 1 else "centre"
        for row, column in np.argwhere(coverage(points, 3, 3) == 0)
    ]
    if empty:
        warnings.append(f"no points in the image's {', '.join(empty)}: hold the board there, too")
    normalised = (points.pixels - intrinsics[2:4]) / intrinsics[:2]
    seen = float(np.hypot(normalised[:, 0], normalised[:, 1]).max())
    share = seen / corner_radius(intrinsics, points.width, points.height)
    if share < 0.9:
        warnings.append(
            f"points reach only {100.0 * share:.0f} % of the way from the centre to the farthest "
            "corner: beyond, the distortion is extrapolated"
        )
    return warnings


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board in a picture."""

    name: str  #: of the picture
    indices: IntArray  #: (K,) indices of the board's points that were found
    pixels: FloatArray  #: (K, 2) their pixels


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated camera."""

    adjusted: Adjusted
    points: Points  #: The fitted points, corrected for the circles' shifts
    names: tuple[str, ...]  #: The views' names
    outliers: tuple[tuple[str, float], ...]  #: Excluded views, with their RMS residuals (px)
    lens: FreeLens  #: Which coefficients of the distortion are free
    #: RMS reprojection error (u and v together) in held-out views, by the lenses that were tried
    cross_validation_px: dict[FreeLens, float]
    warnings: tuple[str, ...] = field(default=())

    @property
    def intrinsics(self) -> FloatArray:
        """(14,) `camera.calibration.model.INTRINSICS`."""
        return self.adjusted.estimate.intrinsics


def calibrate(
    views: Sequence[BoardView], board: Board, size: tuple[int, int], settings: CalibrationSettings
) -> Calibration:
    """Calibrate a camera by views of a board, by the reprojection error.

    Parameters
    ----------
    views : sequence of BoardView
    board : Board
    size : (int, int)
        Width and height of the pictures, pixels.
    settings : CalibrationSettings

    Returns
    -------
    Calibration

    Raises
    ------
    CalibrationError
        If the views are too few or too much alike, or nothing explains them.
    """
    demand_enough(len(views))
    measured = points_of(views, board, size)
    names = tuple(view.name for view in views)
    radius = 0.5 * board.circle_m
    try:
        # With the fullest model: residuals of a simpler one are partly its own.
        consensus = find_consensus(measured, names, settings, radius)
        kept = np.isfinite(consensus.rms_px) if settings.keep_outliers else consensus.agree
        outliers = tuple((names[v], float(consensus.rms_px[v])) for v in np.flatnonzero(~kept))
        demand_enough(len(names) - len(outliers), f" without {listed(names, ~kept)}")
        used = np.flatnonzero(kept)
        start, measured = consensus.estimate.of_views(used), measured.of_views(used)
        wrong = 0
        if settings.robust:
            residuals = residuals_of(start, measured, radius)
            right = np.all(np.abs(residuals) < _WRONG_POINT * consensus.fit.sigma_px, axis=1)
            # A picture with too few remaining points is unchanged: the robust loss handles it.
            right |= (np.bincount(measured.views, right) < _FEWEST_POINTS)[measured.views]
            measured, wrong = measured.where(right), int(np.sum(~right))
        lens, tried = choose_lens(start, measured, settings, radius)
    except (StartError, np.linalg.LinAlgError):
        raise CalibrationError(f"no camera explains the points; {ALL_THE_SAME}") from None
    names = tuple(names[v] for v in used)
    adjusted, points = tried[lens].adjusted, tried[lens].points
    demand_different_views(adjusted)
    adjusted = with_unfitted_terms(adjusted, points, lens, settings)
    warnings = warnings_of(adjusted, points, normals_spread_deg(adjusted.estimate.rotations))
    if wrong:
        warnings.insert(0, f"{wrong} points excluded: they are far from their expected positions")
    holdout = {free: candidate.cross_validation_px for free, candidate in tried.items()}
    return Calibration(adjusted, points, names, outliers, lens, holdout, tuple(warnings))


def calibrated_camera(calibration: Calibration) -> Camera:
    """The calibrated camera with the covariance of its lens, without a pose."""
    size = {"width": calibration.points.width, "height": calibration.points.height}
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    covariance[:COUNT, :COUNT] = calibration.adjusted.covariance
    try:
        return with_covariance(with_intrinsics(UNPOSED, calibration.intrinsics, **size), covariance)
    except CameraError as error:
        raise CalibrationError(
            f"the calibration is not a possible camera: {error}; take pictures that cover the "
            "image's corners, or use fewer --coefficients"
        ) from None


class Aspect(NamedTuple):
    """scaleY / scaleX, and its standard deviation; 0 where it was held fixed."""

    value: float
    sigma: float


def aspect_of(calibration: Calibration) -> Aspect:
    """The ratio of the scales that a calibration found."""
    x, y = (float(value) for value in calibration.intrinsics[:2])
    by_scales = np.array([-y / x**2, 1.0 / x])
    variance = float(by_scales @ calibration.adjusted.covariance[:2, :2] @ by_scales)
    return Aspect(y / x, np.sqrt(variance) if variance > 1e-18 else 0.0)


def calibrate_with_free_aspect(
    views: Sequence[BoardView], board: Board, size: tuple[int, int], settings: CalibrationSettings
) -> Calibration:
    """As `calibrate`, with scales independent of each other if the views determine their ratio.

    Otherwise it is that of the settings, with a warning.
    """
    try:
        free = calibrate(views, board, size, replace(settings, aspect=None))
    except CalibrationError:
        return calibrate(views, board, size, settings)
    sigma = aspect_of(free).sigma
    if settings.aspect is None or sigma <= _ASPECT_SIGMA:
        return free
    fixed = calibrate(views, board, size, settings)
    warning = (
        f"the pictures leave scaleY / scaleX uncertain by {sigma:.2g}: it is assumed to be "
        f"{settings.aspect:g}; hold the board upright and across, and tilt it more"
    )
    return replace(fixed, warnings=(*fixed.warnings, warning))


def points_of(views: Sequence[BoardView], board: Board, size: tuple[int, int]) -> Points:
    """The points of all views, one after the other."""
    return Points(
        board=np.concatenate([board.points[view.indices] for view in views]),
        pixels=np.concatenate([view.pixels for view in views]).astype(np.float64),
        views=np.repeat(np.arange(len(views)), [len(view.indices) for view in views]),
        width=size[0],
        height=size[1],
    )
