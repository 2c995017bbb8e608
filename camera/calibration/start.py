"""Where a calibration begins: poses of boards from homographies, over a range of focal lengths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from camera.calibration.adjustment import (
    Adjusted,
    Estimate,
    Points,
    StartError,
    adjust,
    project_estimate,
)
from camera.calibration.model import COUNT, brown_terms, coefficients, free_span
from camera.distortion import one_to_one_radius, straightened, undistorted_radius

FloatArray = NDArray[np.float64]

# Focal lengths that are tried, in widths of the image: from 130 to 6 degrees across.
_FOCAL_WIDTHS = (0.25, 0.4, 0.6, 0.9, 1.4, 2.2, 4.0, 8.0)
# Number of views used to compare starts.
_FEW_VIEWS = 10
_LOOSE = 1e-4


def first_estimate(points: Points, aspect: float | None) -> Estimate:
    """The best of some focal lengths, with at most one coefficient; it projects all points.

    `aspect` is scaleY / scaleX, None if unknown (then 1 to begin with).
    """
    chosen = np.unique(np.linspace(0, len(points.starts) - 1, _FEW_VIEWS).round().astype(np.int64))
    few = points.of(chosen)
    ratio = 1.0 if aspect is None else aspect
    best: Adjusted | None = None
    for widths in _FOCAL_WIDTHS:
        focal = widths * points.width
        intrinsics = np.array(
            [focal, ratio * focal, 0.5 * (points.width - 1), 0.5 * (points.height - 1), *[0.0] * 10]
        )
        start = Estimate(intrinsics, *board_poses(intrinsics, few))
        try:
            fit = adjust(start, few, free_span(1, ratio), robust=True, tolerance=_LOOSE)
        except (StartError, np.linalg.LinAlgError):
            continue
        if best is None or fit.sigma_px < best.sigma_px:
            best = fit
    if best is None:
        raise StartError("no focal length explains the points")
    intrinsics = best.estimate.intrinsics
    return best_poses(Estimate(intrinsics, *board_poses(intrinsics, points)), points)


def board_poses(intrinsics: FloatArray, points: Points) -> tuple[FloatArray, FloatArray]:
    """`camera_from_board` of each view, (V, 3, 3) and (V, 3), by its homography."""
    normalised = (points.pixels - intrinsics[2:4]) / intrinsics[:2]
    radius = np.hypot(normalised[:, 0], normalised[:, 1])
    coef, brown = coefficients(intrinsics), brown_terms(intrinsics)
    if any(brown):
        r_max = one_to_one_radius(coef, brown)
        straight_xy = straightened(normalised, coef, brown, r_max)
        normalised = np.where(np.isnan(straight_xy), normalised, straight_xy)
    else:
        straight = undistorted_radius(radius, coef)
        # A point past the fold stays where it is: this is but a start.
        straight = np.where(np.isnan(straight), radius, straight)
        normalised = normalised * (straight / np.where(radius > 0.0, radius, 1.0))[:, None]
    poses = [
        _pose_from_homography(points.board[s : s + n], normalised[s : s + n])
        for s, n in zip(points.starts, points.counts)
    ]
    return np.stack([p[0] for p in poses]), np.stack([p[1] for p in poses])


def _pose_from_homography(board: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The pose of a plane from normalised image points (Zhang 2000, section 3.1)."""
    middle = board[:, :2].mean(axis=0)
    size = float(np.sqrt(np.mean((board[:, :2] - middle) ** 2)))
    X = (board[:, :2] - middle) / size
    ones, zeros = np.ones((len(X), 1)), np.zeros((len(X), 3))
    rows = np.hstack([X, ones])
    system = np.vstack(
        [
            np.hstack([rows, zeros, -xy[:, :1] * rows]),
            np.hstack([zeros, rows, -xy[:, 1:] * rows]),
        ]
    )
    H = np.linalg.svd(system)[2][-1].reshape(3, 3)
    H = H * (np.sign(H[2, 2]) or 1.0)
    first, second, third = H.T
    length = 0.5 * (np.linalg.norm(first) + np.linalg.norm(second))
    rotation = np.stack([first, second, np.cross(first, second) / length], axis=1) / length
    U, _, Vt = np.linalg.svd(rotation)
    rotation = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    translation = third / length * size
    return rotation, translation - rotation @ np.array([*middle, 0.0])


def best_poses(estimate: Estimate, points: Points) -> Estimate:
    """Each pose refined, from its start and from the same board tilted the other way.

    From afar a board and its mirror image in depth look almost alike, so that a start can be
    in the wrong minimum (Schweighofer and Pinz 2006).
    """
    candidates = [estimate, Estimate(estimate.intrinsics, *_mirrored(estimate, points))]
    fits = [_poses_alone(candidate, points) for candidate in candidates]
    errors = np.stack([_errors(fit, points) for fit in fits])
    use = np.argmin(errors, axis=0)
    every = np.arange(len(points.starts))
    rotations = np.stack([fit.rotations for fit in fits])[use, every]
    translations = np.stack([fit.translations for fit in fits])[use, every]
    return Estimate(estimate.intrinsics, rotations, translations)


def _poses_alone(estimate: Estimate, points: Points) -> Estimate:
    """Refine poses, all at once or, where one has no start, one by one; that one stays as it is."""
    nothing = np.zeros((COUNT, 0))
    try:
        return adjust(estimate, points, nothing, tolerance=_LOOSE).estimate
    except (StartError, np.linalg.LinAlgError):
        pass
    rotations, translations = estimate.rotations.copy(), estimate.translations.copy()
    for view in range(len(points.starts)):
        one = Estimate(estimate.intrinsics, rotations[[view]], translations[[view]])
        try:
            fit = adjust(one, points.of(np.array([view])), nothing, tolerance=_LOOSE).estimate
        except (StartError, np.linalg.LinAlgError):
            continue
        rotations[view], translations[view] = fit.rotations[0], fit.translations[0]
    return Estimate(estimate.intrinsics, rotations, translations)


def _errors(estimate: Estimate, points: Points) -> FloatArray:
    """(V,) mean absolute residual; infinity where a view is not projected."""
    error = np.abs(points.pixels - project_estimate(estimate, points)[0]).sum(axis=1)
    error = np.where(np.isnan(error), np.inf, error)
    return np.asarray(np.add.reduceat(error, points.starts) / points.counts)


def _mirrored(estimate: Estimate, points: Points) -> tuple[FloatArray, FloatArray]:
    """Poses with the board's normal mirrored at the ray to the board's middle."""
    sums = np.add.reduceat(points.board, points.starts, axis=0)
    middles = sums / points.counts[:, None]
    turned = np.einsum("vij,vj->vi", estimate.rotations, middles)
    centres = turned + estimate.translations
    rays = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    normals = estimate.rotations[:, :, 2]
    along = np.einsum("vi,vi->v", normals, rays)[:, None] * rays
    mirrored = 2.0 * along - normals
    rotations = np.stack(
        [_rotation_between(a, b) @ R for a, b, R in zip(normals, mirrored, estimate.rotations)]
    )
    return rotations, centres - np.einsum("vij,vj->vi", rotations, middles)


def _rotation_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """The smallest rotation that turns unit vector a into b."""
    v, c = np.cross(a, b), float(a @ b)
    K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + K + K @ K / max(1.0 + c, 1e-6))


def normals_spread_deg(rotations: Sequence[FloatArray] | FloatArray) -> float:
    """Largest angle between the normals of any two boards, degrees."""
    normals = np.asarray(rotations)[:, :, 2]
    cosine = np.clip(np.abs(normals @ normals.T), 0.0, 1.0)
    return float(np.degrees(np.arccos(cosine.min())))
