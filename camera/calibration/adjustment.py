"""Bundle adjustment of one camera and many views of boards whose points are known.

Levenberg-Marquardt on the normal equations, with the views' poses eliminated (Schur complement):
views meet only in the intrinsics, so that a step costs a few small solves however many there are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from camera.calibration.model import (
    POWERS,
    corner_radius,
    cross_matrices,
    is_possible,
    project_points,
    rotation_of,
)

FloatArray = NDArray[np.float64]

#: Huber's constant, in standard deviations: beyond it a residual pulls no harder.
HUBER = 2.0

#: Standard deviation of the distortion coefficients' prior, each times the power of the radius at
#: the image's corner that it goes with: far wider than any lens, but it bounds what the points
#: leave open.
PRIOR_SIGMA = 10.0

_STEPS = 200
_SMALLEST_DECREASE = 1e-10
_LARGEST_DAMPING = 1e12
_SCALE_ROUNDS = 6


class StartError(ValueError):
    """A start from which nothing can be adjusted: it does not project all points."""


@dataclass(frozen=True, eq=False)
class Points:
    """Points of boards, where they were seen; all views one after the other.

    Attributes
    ----------
    board : (N, 3) float64
        Points in their board's frame, metres.
    pixels : (N, 2) float64
        Where they were seen.
    starts : (V,) int64
        Index of each view's first point; the first is 0, and no view is empty.
    width, height : int
        Image size.
    """

    board: FloatArray
    pixels: FloatArray
    starts: NDArray[np.int64]
    width: int
    height: int

    @property
    def counts(self) -> NDArray[np.int64]:
        """(V,) number of points of each view."""
        return np.diff(np.append(self.starts, len(self.board)))

    @property
    def views(self) -> NDArray[np.int64]:
        """(N,) view of each point."""
        return np.repeat(np.arange(len(self.starts)), self.counts)

    def of(self, views: NDArray[np.int64]) -> Points:
        """The points of some views only."""
        chosen = [np.arange(self.starts[v], self.starts[v] + self.counts[v]) for v in views]
        index = np.concatenate(chosen)
        starts = np.cumsum([0, *(len(c) for c in chosen[:-1])])
        return replace(self, board=self.board[index], pixels=self.pixels[index], starts=starts)


@dataclass(frozen=True, eq=False)
class Estimate:
    """A camera and the poses of the boards it saw.

    Attributes
    ----------
    intrinsics : (14,) float64
    rotations, translations : (V, 3, 3) and (V, 3) float64
        `camera_from_board` of each view, metres.
    """

    intrinsics: FloatArray
    rotations: FloatArray
    translations: FloatArray


@dataclass(frozen=True, eq=False)
class Adjusted:
    """An `Estimate` that fits best, and how well.

    Attributes
    ----------
    estimate : Estimate
    sigma_px : float
        Noise of a coordinate that the residuals show (robust, by degrees of freedom).
    residuals : (N, 2) float64
        Seen less projected, pixels.
    weights : (N, 2) float64
        Robust weights, 1 where a residual counts in full.
    covariance : (14, 14) float64
        Of the intrinsics; zero for those held fixed.
    pose_covariances : (V, 6, 6) float64
        Of each view's rotation (perturbed from the left, in the camera frame, rad) and translation
        (m), the intrinsics' uncertainty included.
    """

    estimate: Estimate
    sigma_px: float
    residuals: FloatArray
    weights: FloatArray
    covariance: FloatArray
    pose_covariances: FloatArray

    @property
    def rms_px(self) -> float:
        """Root of the mean squared distance (u and v together) between seen and projected."""
        return float(np.sqrt(np.mean(np.sum(self.residuals**2, axis=1))))


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations: intrinsics A (K, K), a (K,); mixed B (V, K, 6); poses C, c."""

    A: FloatArray
    a: FloatArray
    B: FloatArray
    C: FloatArray
    c: FloatArray


def project_estimate(
    estimate: Estimate, points: Points
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels of all points, and their derivatives.

    Returns
    -------
    pixels : (N, 2) array
    by_intrinsics : (N, 2, 14) array
    by_pose : (N, 2, 6) array
        By the rotation (from the left, about the board's origin) and the translation of the
        point's own view.
    """
    view = points.views
    turned = np.einsum("nij,nj->ni", estimate.rotations[view], points.board)
    pixels, by_intrinsics, by_point = project_points(
        estimate.intrinsics, turned + estimate.translations[view]
    )
    by_pose = np.concatenate([-by_point @ cross_matrices(turned), by_point], axis=-1)
    return pixels, by_intrinsics, by_pose


def adjust(
    start: Estimate,
    points: Points,
    span: FloatArray,
    *,
    robust: bool = True,
    sigma_px: float | None = None,
    tolerance: float = _SMALLEST_DECREASE,
) -> Adjusted:
    """Fit intrinsics and poses by the reprojection error.

    Parameters
    ----------
    start : Estimate
        Must project all points.
    points : Points
    span : (14, K) array
        Directions in which the intrinsics may change (`free_span`); K = 0 fits poses alone.
    robust : bool
        Huber's loss per coordinate, at `HUBER` standard deviations.
    sigma_px : float, optional
        Noise of a coordinate, if it is known; else it is found from the residuals.
    tolerance : float
        Relative decrease of the cost at which a fit ends.

    Returns
    -------
    Adjusted
    """
    estimate = start
    huber = HUBER if robust else np.inf
    sigma = sigma_px if sigma_px is not None else _noise(points.pixels, estimate, points)
    for _ in range(_SCALE_ROUNDS if sigma_px is None else 1):
        estimate = _minimise(estimate, points, span, sigma, huber, tolerance)
        if sigma_px is not None:
            break
        found = _noise(points.pixels, estimate, points, span.shape[1])
        done = abs(found - sigma) <= 0.02 * sigma
        sigma = found
        if done or not robust:
            break
    return _summary(estimate, points, span, sigma, huber, sigma_known=sigma_px is not None)


def _noise(seen: FloatArray, estimate: Estimate, points: Points, free: int = 0) -> float:
    """Standard deviation of a coordinate by the median of the residuals, which outliers spare."""
    residuals = seen - project_estimate(estimate, points)[0]
    unknown = free + 6 * len(points.starts)
    share = max(1.0 - unknown / residuals.size, 0.1)
    return max(float(1.4826 * np.median(np.abs(residuals)) / np.sqrt(share)), 1e-9)


def _minimise(
    estimate: Estimate,
    points: Points,
    span: FloatArray,
    sigma: float,
    huber: float,
    tolerance: float,
) -> Estimate:
    damping = 1e-3
    cost = _cost(estimate, points, sigma, huber)
    if not np.isfinite(cost):
        raise StartError("the adjustment's start does not project all points")
    for _ in range(_STEPS):
        normal = _normal_equations(estimate, points, span, sigma, huber)[0]
        while damping < _LARGEST_DAMPING:
            trial = _stepped(estimate, span, *_solve(normal, damping))
            trial_cost = _cost(trial, points, sigma, huber)
            if trial_cost < cost:
                break
            damping *= 8.0
        else:
            return estimate
        decrease = cost - trial_cost
        estimate, cost = trial, trial_cost
        damping = max(damping / 6.0, 1e-12)
        if decrease <= tolerance * cost + 1e-18:
            return estimate
    return estimate


def _prior(intrinsics: FloatArray, points: Points) -> tuple[FloatArray, FloatArray]:
    """Residuals of the coefficients' prior and their weights (per unit of coefficient)."""
    reach = max(corner_radius(intrinsics, points.width, points.height), 1e-3)
    weight = np.concatenate([np.zeros(4), reach**POWERS / PRIOR_SIGMA])
    return weight * intrinsics, weight


def _cost(estimate: Estimate, points: Points, sigma: float, huber: float) -> float:
    if not is_possible(estimate.intrinsics, points.width, points.height):
        return float("inf")
    pixels = project_estimate(estimate, points)[0]
    if np.any(np.isnan(pixels)):
        return float("inf")
    error = np.abs(points.pixels - pixels) / sigma
    with np.errstate(invalid="ignore"):
        loss = np.where(error <= huber, 0.5 * error**2, huber * (error - 0.5 * huber))
    return float(np.sum(loss) + 0.5 * np.sum(_prior(estimate.intrinsics, points)[0] ** 2))


def _normal_equations(
    estimate: Estimate, points: Points, span: FloatArray, sigma: float, huber: float
) -> tuple[_Normal, FloatArray, FloatArray]:
    """Normal equations, the residuals (N, 2) in pixels and their weights (N, 2)."""
    pixels, by_intrinsics, by_pose = project_estimate(estimate, points)
    residuals = points.pixels - pixels
    error = np.abs(residuals) / sigma
    weights = np.minimum(1.0, huber / np.maximum(error, 1e-300))
    root = (np.sqrt(weights) / sigma)[:, :, None]
    J, P = root * (by_intrinsics @ span), root * by_pose
    e = root[:, :, 0] * residuals
    prior, prior_weight = _prior(estimate.intrinsics, points)
    scaled = prior_weight[:, None] * span

    def per_view(first: FloatArray, second: FloatArray) -> FloatArray:
        products = first.swapaxes(1, 2) @ second
        return np.asarray(np.add.reduceat(products, points.starts, axis=0))

    flat = J.reshape(2 * len(J), J.shape[2])
    normal = _Normal(
        A=flat.T @ flat + scaled.T @ scaled,
        a=flat.T @ e.ravel() - scaled.T @ prior,
        B=per_view(J, P),
        C=per_view(P, P),
        c=per_view(P, e[:, :, None])[:, :, 0],
    )
    return normal, residuals, weights


def _solve(normal: _Normal, damping: float) -> tuple[FloatArray, FloatArray]:
    """Step of the free intrinsics (K,) and of the poses (V, 6)."""
    six = np.arange(6)
    C = normal.C.copy()
    C[:, six, six] *= 1.0 + damping
    inverse = np.linalg.inv(C)
    A = normal.A.copy()
    A[np.diag_indices_from(A)] *= 1.0 + damping
    W = normal.B @ inverse
    reduced = A - np.einsum("vik,vjk->ij", W, normal.B)
    step = np.zeros(len(normal.a))
    if len(step):
        right = normal.a - np.einsum("vik,vk->i", W, normal.c)
        step = _inverse(reduced) @ right
    poses = np.einsum("vij,vj->vi", inverse, normal.c - np.einsum("vki,k->vi", normal.B, step))
    return step, poses


def _inverse(matrix: FloatArray) -> FloatArray:
    """Pseudo-inverse of a positive semi-definite matrix whose parameters differ much in scale."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    both = np.outer(scale, scale)
    return np.asarray(np.linalg.pinv(matrix / both, 1e-14, hermitian=True) / both)


def _stepped(estimate: Estimate, span: FloatArray, step: FloatArray, poses: FloatArray) -> Estimate:
    return Estimate(
        estimate.intrinsics + span @ step,
        rotation_of(poses[:, :3]) @ estimate.rotations,
        estimate.translations + poses[:, 3:],
    )


def _summary(
    estimate: Estimate,
    points: Points,
    span: FloatArray,
    sigma: float,
    huber: float,
    *,
    sigma_known: bool,
) -> Adjusted:
    _, residuals, weights = _normal_equations(estimate, points, span, sigma, huber)
    # The covariance of an M-estimator: mean psi^2 / (mean psi')^2 (Huber, Robust Statistics, 7.6),
    # times the inverse of the unweighted normal matrix.
    plain = _normal_equations(estimate, points, span, sigma, np.inf)[0]
    psi = weights * residuals / sigma
    unknown = span.shape[1] + 6 * len(points.starts)
    freedom = max(residuals.size - unknown, 1) / residuals.size
    counted = max(float(np.mean(weights == 1.0)), 0.05)
    spread = 1.0 if sigma_known else float(np.mean(psi**2)) / freedom / counted**2
    inverse = np.linalg.inv(plain.C)
    W = plain.B @ inverse
    free = _inverse(plain.A - np.einsum("vik,vjk->ij", W, plain.B))
    shared = np.einsum("vki,kl,vlj->vij", W, free, W)
    return Adjusted(
        estimate=estimate,
        sigma_px=sigma * float(np.sqrt(spread)),
        residuals=residuals,
        weights=weights,
        covariance=spread * (span @ free @ span.T),
        pose_covariances=spread * (inverse + shared),
    )
