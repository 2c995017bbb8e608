"""Where on the floor two sets of rows put the same discs, and figures of errors.

Differences over distance, and the one tilt and height of the camera that explains them. Figures are
None where there is nothing to compute them from.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import approx_fprime, least_squares
from scipy.special import chdtri

from camera import Camera
from detect.comparison.result import (
    CommonLean,
    DiscPairs,
    FloorDifference,
    NormalisedError,
)
from detect.seen import image_positions, level_seen
from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import is_positive_definite, squared_mahalanobis


def quantile(values: FloatArray, q: float = 0.5) -> float | None:
    """Quantile of `values`, interpolated linearly; by default the median."""
    return float(np.quantile(values, q)) if len(values) else None


def normalised_error(offset: FloatArray, covariance: FloatArray) -> NormalisedError:
    """Mean of squared normalised errors (N, n), with the central 95 % of chi-square.

    Errors whose covariance (N, n, n) is not positive definite are left out.
    """
    usable = is_positive_definite(covariance)
    left_out = int((~usable).sum())
    dof = offset[usable].size
    if dof == 0:
        return NormalisedError(per_dof=None, dof=0, band=None, left_out=left_out)
    squared = squared_mahalanobis(offset[usable], covariance[usable])
    low, high = (float(chdtri(dof, 1.0 - p)) / dof for p in (0.025, 0.975))
    return NormalisedError(float(squared.sum()) / dof, dof, (low, high), left_out)


#: Huber's constant: 95 % efficient where errors are normal.
_HUBER = 1.345
_LEAST_PAIRS = 4
#: With fewer frames, their scatter does not determine the uncertainty of the lean.
_LEAST_FRAMES = 10
_LARGEST_CONDITION = 1e10


def common_lean(
    camera: Camera,
    reference_xy: FloatArray,
    detected_xy: FloatArray,
    frame: IntArray,
) -> tuple[FloatArray, FloatArray] | None:
    """Fit the lean to matched rows: robust least squares of their differences in the image.

    There all rows are known about equally well; on the floor, far ones would outweigh all others.
    `frame` (N,) says which frame each pair (N, 2) is of: standard deviations come from how frames
    differ, as errors within one may be common to its rows.

    Returns pitch, roll (rad) and height (m) that turn reference into detected positions, and their
    standard deviations; None if the rows are too few or do not determine them.
    """
    seen = image_positions(camera, reference_xy)
    usable = np.isfinite(seen + image_positions(camera, detected_xy)).all(axis=1)
    if usable.sum() < _LEAST_PAIRS:
        return None
    seen, detected_xy, frame = seen[usable], detected_xy[usable], frame[usable]

    def differences(lean: FloatArray) -> FloatArray:
        again = image_positions(camera, detected_xy, (lean[0], lean[1]), lean[2])
        return np.nan_to_num(again - seen, nan=1e3).ravel()

    start = least_squares(differences, np.zeros(3), loss="soft_l1", x_scale=0.01)
    scale = _HUBER * max(1.4826 * float(np.median(np.abs(start.fun))), 1e-3)
    lean = least_squares(differences, start.x, loss="huber", f_scale=scale, x_scale=0.01).x
    residual, jacobian = differences(lean), approx_fprime(lean, differences, 1e-7)
    weight = np.minimum(1.0, scale / np.maximum(np.abs(residual), 1e-12))
    normal = jacobian.T @ (weight[:, None] * jacobian)
    if not np.linalg.cond(normal) < _LARGEST_CONDITION:
        return None
    inverse = np.linalg.inv(normal)
    _, of = np.unique(frame, return_inverse=True)
    frames = int(of.max()) + 1
    if frames >= _LEAST_FRAMES:
        pull = np.zeros((frames, 3))
        np.add.at(pull, np.repeat(of, 2), (weight * residual)[:, None] * jacobian)
        covariance = inverse @ (pull.T @ pull) @ inverse * frames / (frames - 1)
    else:
        covariance = inverse * (weight * residual**2).sum() / max(len(residual) - 3, 1)
    return lean, np.sqrt(np.diag(covariance))


def floor_pairs(
    camera: Camera | None,
    reference_xy: FloatArray,
    detected_xy: FloatArray,
    covariance: FloatArray,
    frame: IntArray,
) -> tuple[CommonLean | None, DiscPairs]:
    """Matched rows on the floor, before and after their common lean (None without a camera).

    Parameters as of `common_lean`; `covariance` (N, 2, 2) is what errors are measured in, m^2.
    """
    offset = detected_xy - reference_xy
    away = reference_xy - (np.zeros(2) if camera is None else camera.centre[:2])
    away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    lean = None if camera is None else common_lean(camera, reference_xy, detected_xy, frame)
    if camera is None or lean is None:
        return None, DiscPairs(reference_xy, offset, offset, covariance, away)
    value, sigma = lean
    left = detected_xy - level_seen(camera, reference_xy, (value[0], value[1]), value[2])
    seen = np.isfinite(left).all(axis=1)
    common = CommonLean(
        pitch_deg=float(np.degrees(value[0])),
        pitch_sigma_deg=float(np.degrees(sigma[0])),
        roll_deg=float(np.degrees(value[1])),
        roll_sigma_deg=float(np.degrees(sigma[1])),
        raised_m=float(value[2]),
        raised_sigma_m=float(sigma[2]),
        left=floor_difference(left, away),
        normalised_error=normalised_error(left[seen], covariance[seen]),
    )
    return common, DiscPairs(reference_xy, offset, left, covariance, away)


def floor_difference(offset: FloatArray, away: FloatArray) -> FloorDifference:
    """Figures of differences (N, 2) on the floor (m), seen along unit vectors `away` (N, 2)."""
    seen = np.isfinite(offset).all(axis=1)
    offset, away = offset[seen], away[seen]
    size = np.asarray(np.linalg.norm(offset, axis=1))
    return FloorDifference(
        pairs=len(offset),
        median_m=quantile(size),
        most_m=quantile(size, 0.95),
        along_m=quantile((offset * away).sum(axis=1)),
        # Forward is -Y and left is X: left of a direction is it turned from -Y to X.
        across_m=quantile(away[:, 0] * offset[:, 1] - away[:, 1] * offset[:, 0]),
    )
