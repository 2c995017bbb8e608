"""Initial values of a calibration: poses of planes without a start, for many focal lengths."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from camera.calibration.adjustment import Adjusted, Estimate, Points, adjust, residuals_of
from camera.calibration.model import COUNT, FreeLens, lens_of
from camera.distortion import undistort
from camera.rotations import rotation_of
from redetect.array_types import FloatArray, IntArray
from redetect.least_squares.solver import StartError

# Focal lengths that are tried, in widths of the image: from 130 to 6 degrees across.
_FOCAL_WIDTHS = (0.25, 0.4, 0.6, 0.9, 1.4, 2.2, 4.0, 8.0)
_FISHEYE_WIDTHS = (0.25, 0.4, 0.6)
# The coefficients of nearly r f(r) = arctan(r): from a pinhole, or one coefficient, which folds
# where such a lens still sees, no descent leads to a fisheye lens.
_FISHEYE = (0.0, -1.0 / 3.0, 0.0, 0.6, 0.0)
# Number of views used to compare starts.
_FEW_VIEWS = 10
_LOOSE = 1e-4


def initial_estimate(points: Points, aspect: float | None) -> Estimate:
    """The best of some focal lengths, with at most one coefficient, or those of a fisheye lens.

    `aspect` is scaleY / scaleX, None if unknown (then 1 to begin with). Views that contradict the
    others may be left with a pose from which their points are not seen.
    """
    chosen = np.unique(np.linspace(0, len(points.counts) - 1, _FEW_VIEWS).round().astype(np.int64))
    few = points.of_views(chosen)
    ratio = 1.0 if aspect is None else aspect
    best, lowest = None, (np.inf, 0)
    starts = [(widths, (0.0,) * 5, FreeLens(1)) for widths in _FOCAL_WIDTHS]
    starts += [(widths, _FISHEYE, FreeLens(0)) for widths in _FISHEYE_WIDTHS]
    for widths, coef, lens in starts:
        focal = widths * points.width
        middle = 0.5 * (points.width - 1), 0.5 * (points.height - 1)
        intrinsics = np.array([focal, ratio * focal, *middle, *coef, *[0.0] * 5])
        found = _fitted_where_seen(board_poses(intrinsics, few)[0], few, lens.span(ratio))
        if found is None:
            continue
        fit, seen = found
        # Over all points, so that a focal length gains nothing from views it cannot explain.
        errors = np.full(few.pixels.size, np.inf)
        errors[: fit.residuals.size] = np.abs(fit.residuals).ravel()
        error = float(np.median(errors)), -len(seen)
        if error < lowest:
            best, lowest = fit.estimate.intrinsics, error
    if best is None:
        raise StartError("no focal length explains the points")
    return best_poses(board_poses(best, points)[0], points)


def board_poses(intrinsics: FloatArray, points: Points) -> tuple[Estimate, Estimate]:
    """Both possible poses of each view of a plane, the more likely one first, without a start.

    From afar, a board and its mirror image in depth look almost alike (T. Collins, A. Bartoli,
    Infinitesimal plane-based pose estimation, IJCV 109, 2014; OpenCV's solver).
    """
    normalised = (points.pixels - intrinsics[2:4]) / intrinsics[:2]
    straight = undistort(normalised, lens_of(intrinsics))
    # A point beyond the fold is not changed, which is sufficient for a start.
    straight = np.where(np.isnan(straight), normalised, straight)
    found = []
    for view in range(len(points.counts)):
        rows = points.views == view
        _, vectors, places, _ = cv2.solvePnPGeneric(
            points.board[rows], straight[rows], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
        found.append(np.array([np.concatenate(pair) for pair in zip(vectors, places)])[[0, -1]])
    poses = np.array(found, dtype=np.float64)[..., 0]  # views, both poses, six numbers
    likelier, other = (
        Estimate(intrinsics, rotation_of(poses[:, k, :3]), poses[:, k, 3:]) for k in (0, 1)
    )
    return likelier, other


def best_poses(estimate: Estimate, points: Points) -> Estimate:
    """Each pose refined, from its start and from both of `board_poses`."""
    fits = []
    for start in (estimate, *board_poses(estimate.intrinsics, points)):
        # Poses from which not all points are seen stay as they are.
        found = _fitted_where_seen(start, points, np.zeros((COUNT, 0)))
        fits.append(start if found is None else start.with_poses(found[1], found[0].estimate))
    errors = np.stack([view_errors(fit, points) for fit in fits])
    best, views = np.argmin(errors, axis=0), np.arange(errors.shape[1])
    rotations = np.stack([fit.rotations for fit in fits])[best, views]
    translations = np.stack([fit.translations for fit in fits])[best, views]
    return Estimate(estimate.intrinsics, rotations, translations)


def _fitted_where_seen(
    start: Estimate, points: Points, span: FloatArray
) -> tuple[Adjusted, IntArray] | None:
    """A fit to the views in which all points are seen, and which these are; None without one."""
    seen = np.flatnonzero(np.isfinite(view_errors(start, points)))
    if not len(seen):
        return None
    try:
        return adjust(start.of_views(seen), points.of_views(seen), span, tolerance=_LOOSE), seen
    except (StartError, np.linalg.LinAlgError):
        return None


def view_errors(estimate: Estimate, points: Points) -> FloatArray:
    """(V,) mean absolute residual (px); infinite where a view is not projected."""
    error = np.abs(residuals_of(estimate, points)).sum(axis=1)
    error = np.where(np.isnan(error), np.inf, error)
    return np.asarray(np.bincount(points.views, error) / points.counts)


def normals_spread_deg(rotations: Sequence[FloatArray] | FloatArray) -> float:
    """Largest angle between the normals of any two boards, degrees."""
    normals = np.asarray(rotations)[:, :, 2]
    cosine = np.clip(np.abs(normals @ normals.T), 0.0, 1.0)
    return float(np.degrees(np.arccos(cosine.min())))
