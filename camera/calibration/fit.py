"""Fitting a camera to boards: to points, or to circles by where their images' middles are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from camera.calibration.adjustment import Adjusted, Estimate, Points, adjust, project_estimate
from camera.calibration.model import is_possible, project_points
from camera.calibration.settings import CalibrationSettings, FreeLens

FloatArray = NDArray[np.float64]

_CIRCLE_ROUNDS = 3
_OUTLINE_POINTS = 32


def fit_points(
    start: Estimate, points: Points, settings: CalibrationSettings, lens: FreeLens, radius_m: float
) -> tuple[Adjusted, Points]:
    """Adjust intrinsics and poses to points, or to the centroids of circles of a radius above 0."""
    span = lens.span(settings.aspect)
    start = replace(start, intrinsics=_within(start.intrinsics, points, span, settings.aspect))

    def adjusted(start: Estimate, points: Points) -> Adjusted:
        return adjust(start, points, span, robust=settings.robust)

    return fit_to_centres(adjusted, start, points, radius_m)


def fit_to_centres(
    adjusted: Callable[[Estimate, Points], Adjusted],
    start: Estimate,
    points: Points,
    radius_m: float,
) -> tuple[Adjusted, Points]:
    """Fit to points; with circles, repeatedly, corrected for the shifts by the previous fit.

    `adjusted` fits points from an estimate to begin with. Also returned are the points as corrected
    (`circle_shifts`).
    """
    fit = adjusted(start, points)
    corrected = points
    for _ in range(_CIRCLE_ROUNDS if radius_m > 0.0 else 0):
        shifts = circle_shifts(fit.estimate, points, radius_m)
        if not np.all(np.isfinite(shifts)):
            break
        corrected = replace(points, pixels=points.pixels - shifts)
        fit = adjusted(fit.estimate, corrected)
    return fit, corrected


def _within(
    intrinsics: FloatArray, points: Points, span: FloatArray, aspect: float | None
) -> FloatArray:
    """The start with fixed parameters at their values: no coefficient, the known aspect."""
    free = np.any(span != 0.0, axis=1)
    inside = np.where(free, intrinsics, 0.0)
    if aspect is not None:
        inside[1] = aspect * inside[0]
    return inside if is_possible(inside, points.width, points.height) else intrinsics


def circle_shifts(estimate: Estimate, points: Points, radius_m: float) -> FloatArray:
    """From the images of circles' centres to the area centroids of their images, (N, 2) pixels."""
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
