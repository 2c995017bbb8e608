"""Bundle adjustment of one camera and many views of boards whose points are known.

Views share only the intrinsics; the solver is `redetect.least_squares`. Circles are fitted by the
centroids of their images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from camera.calibration import model
from camera.calibration.model import CalibrationSettings, FreeLens
from camera.distortion import undistorted_radius
from camera.rotations import cross_matrices, rotation_of
from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.least_squares import solver
from redetect.least_squares.covariance import marginal_covariances
from redetect.least_squares.solver import Block, Linear, Loss

#: Huber's constant, in standard deviations: the influence of larger residuals is constant.
HUBER = 2.0

#: Standard deviation of the distortion coefficients' prior, each times its power of the radius at
#: the image's corner: far wider than any lens, but it bounds undetermined coefficients.
PRIOR_SIGMA = 10.0

# Standard deviation of what a term that is not free does in the farthest corner: a share of the
# fitted distortion, and a part of the radius. Terms that do more are seen in most pictures.
_UNFITTED_SHARE, _LEAST_UNFITTED = 0.15, 0.003
# Standard deviation of p1 and p2: lenses are decentred by this much unnoticed.
_TANGENTIAL_SIGMA = 5e-4
_DAMPING = 1e-3

_SMALLEST_DECREASE = 1e-10
_SCALE_ROUNDS = 6
# Rounds in which images of circles' centres are corrected, and points of a circle's outline.
_CIRCLE_ROUNDS = 3
_OUTLINE_POINTS = 32


@dataclass(frozen=True, eq=False)
class Points:
    """Points of boards and their pixels."""

    board: FloatArray  #: (N, 3) points in their board's frame, metres
    pixels: FloatArray  #: (N, 2) measured pixels
    views: IntArray  #: (N,) the view of each, counted from 0; no view is empty
    #: Size of the image, pixels
    width: int
    height: int

    @property
    def counts(self) -> IntArray:
        """(V,) number of points of each view."""
        return np.bincount(self.views)

    def of_views(self, views: IntArray) -> Points:
        """Only the points of some views, ascending, which are renumbered."""
        return self.where(np.isin(self.views, views))

    def where(self, chosen: BoolArray) -> Points:
        """Only some of the points; the remaining views are renumbered."""
        views = np.unique(self.views[chosen], return_inverse=True)[1]
        return replace(self, board=self.board[chosen], pixels=self.pixels[chosen], views=views)


@dataclass(frozen=True, eq=False)
class Estimate:
    """A camera and the poses of the boards it saw."""

    intrinsics: FloatArray  #: (14,)
    #: `camera_from_board` of each view: (V, 3, 3), and (V, 3) in metres
    rotations: FloatArray
    translations: FloatArray

    def of_views(self, views: IntArray) -> Estimate:
        """With the poses of some views only."""
        return Estimate(self.intrinsics, self.rotations[views], self.translations[views])

    def with_poses(self, views: IntArray, other: Estimate) -> Estimate:
        """With the poses of some views replaced by another estimate's."""
        rotations, translations = self.rotations.copy(), self.translations.copy()
        rotations[views], translations[views] = other.rotations, other.translations
        return replace(self, rotations=rotations, translations=translations)


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The best `Estimate`, with residuals and covariances."""

    estimate: Estimate
    sigma_px: float  # noise of a coordinate that the residuals show (robust, by degrees of freedom)
    residuals: FloatArray  # (N, 2): seen less projected, pixels
    weights: FloatArray  # (N, 2): robust weights, 1 where a residual counts in full
    covariance: FloatArray  # (14, 14): of the intrinsics; zero for those held fixed
    # (V, 6, 6): of each view's rotation (perturbed from the left, in the camera frame, rad) and
    # translation (m), the intrinsics' uncertainty included.
    pose_covariances: FloatArray

    @property
    def rms_px(self) -> float:
        """Root of the mean squared distance (u and v together) between seen and projected."""
        return rms(self.residuals)


@dataclass(frozen=True, eq=False)
class _Problem:
    """The reprojection error, and a weak prior of the distortion's coefficients."""

    points: Points
    span: FloatArray
    sigma: float
    loss: Loss

    def cost(self, at: Estimate) -> float:
        if not model.is_possible(at.intrinsics, self.points.width, self.points.height):
            return float("inf")
        with np.errstate(invalid="ignore"):
            seen = residuals_of(at, self.points).reshape(-1, 1) / self.sigma
            return solver.robust_cost([(seen, self.loss), (self._prior(at)[0], Loss())])

    def linear(self, at: Estimate) -> Linear:
        pixels, by_intrinsics, by_pose = project_estimate(at, self.points)
        error = (pixels - self.points.pixels).reshape(-1, 1) / self.sigma
        of_pose = np.repeat(6 * self.points.views, 2)
        by_pose = by_pose.reshape(-1, 1, 6) / self.sigma
        shared = (by_intrinsics @ self.span).reshape(len(error), 1, -1) / self.sigma
        prior, weight = self._prior(at)
        blocks = [
            Block(error, [(of_pose, by_pose)], shared, self.loss),
            Block(prior, [], (weight[:, None] * self.span)[:, None, :]),
        ]
        return solver.stack(blocks, 6 * len(self.points.counts), self.span.shape[1])

    def moved(self, at: Estimate, step: FloatArray, shared: FloatArray) -> Estimate:
        poses = step.reshape(-1, 6)
        turned = rotation_of(poses[:, :3]) @ at.rotations
        return Estimate(at.intrinsics + self.span @ shared, turned, at.translations + poses[:, 3:])

    def _prior(self, at: Estimate) -> tuple[FloatArray, FloatArray]:
        """Residuals (14, 1) of the prior, and their weights (per unit of coefficient)."""
        reach = model.corner_radius(at.intrinsics, self.points.width, self.points.height)
        weight = np.concatenate([np.zeros(4), max(reach, 1e-3) ** model.POWERS / PRIOR_SIGMA])
        return (weight * at.intrinsics)[:, None], weight


# A step of the adjustment asks for the same projection more than once.
@lru_cache(maxsize=4)
def project_estimate(
    estimate: Estimate, points: Points
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels of all points (N, 2), and their derivatives.

    With respect to the intrinsics (N, 2, 14) and to the pose (N, 2, 6).
    """
    view = points.views
    turned = np.einsum("nij,nj->ni", estimate.rotations[view], points.board)
    in_camera = turned + estimate.translations[view]
    pixels, by_intrinsics, by_point = model.project_points(estimate.intrinsics, in_camera)
    by_pose = np.concatenate([-by_point @ cross_matrices(turned), by_point], axis=-1)
    return pixels, by_intrinsics, by_pose


def residuals_of(estimate: Estimate, points: Points, radius_m: float = 0.0) -> FloatArray:
    """(N, 2) seen less projected (px); of circles with a radius, their centroids."""
    residuals = points.pixels - project_estimate(estimate, points)[0]
    if radius_m > 0.0:
        shifts = circle_shifts(estimate, points, radius_m)
        residuals = residuals - np.where(np.isfinite(shifts), shifts, 0.0)
    return residuals


def rms(residuals: FloatArray) -> float:
    """Root of the mean squared length of residuals (N, 2)."""
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))


def adjust(
    start: Estimate,
    points: Points,
    span: FloatArray,
    *,
    robust: bool = True,
    sigma_px: float | None = None,
    tolerance: float = _SMALLEST_DECREASE,
) -> Adjusted:
    """Fit poses, and intrinsics along a (14, K) `span`, by the reprojection error."""
    estimate = start
    loss = Loss("huber", HUBER) if robust else Loss()
    problem = _Problem(points, span, sigma_px or _noise(start, points), loss)
    for _ in range(_SCALE_ROUNDS):
        estimate = solver.minimise(problem, estimate, tolerance=tolerance, damping=_DAMPING).at
        if sigma_px is not None:
            break
        found, before = _noise(estimate, points, span.shape[1]), problem.sigma
        problem = replace(problem, sigma=found)
        if abs(found - before) <= 0.02 * before or not robust:
            break
    return _summary(problem, estimate, sigma_known=sigma_px is not None)


def _noise(estimate: Estimate, points: Points, free: int = 0) -> float:
    """Standard deviation of a coordinate from the median residual, robust against outliers."""
    residuals = residuals_of(estimate, points)
    unknown = free + 6 * len(points.counts)
    share = max(1.0 - unknown / residuals.size, 0.1)
    return max(float(1.4826 * np.median(np.abs(residuals)) / np.sqrt(share)), 1e-9)


def _summary(problem: _Problem, estimate: Estimate, *, sigma_known: bool) -> Adjusted:
    points, span, sigma = problem.points, problem.span, problem.sigma
    residuals = residuals_of(estimate, points)
    _, weights = solver.robust((residuals / sigma) ** 2, problem.loss)
    # The covariance of an M-estimator: mean psi^2 / (mean psi')^2 (Huber, Robust Statistics, 7.6),
    # times the inverse of the unweighted normal matrix.
    psi = weights * residuals / sigma
    unknown = span.shape[1] + 6 * len(points.counts)
    freedom = max(residuals.size - unknown, 1) / residuals.size
    counted = max(float(np.mean(weights == 1.0)), 0.05)
    spread = 1.0 if sigma_known else float(np.mean(psi**2)) / freedom / counted**2
    plain = solver.normal_equations(replace(problem, loss=Loss()).linear(estimate))
    (poses,), free = marginal_covariances(plain, [(6, 6 * np.arange(len(points.counts)))])
    return Adjusted(
        estimate=estimate,
        sigma_px=sigma * float(np.sqrt(spread)),
        residuals=residuals,
        weights=weights,
        covariance=spread * (span @ free @ span.T),
        pose_covariances=spread * poses,
    )


def with_unfitted_terms(
    fit: Adjusted, points: Points, lens: FreeLens, settings: CalibrationSettings
) -> Adjusted:
    """A fit whose covariance includes the terms that its lens leaves out.

    Pictures that do not reach the image's corners, or few pictures, do not show all terms of a
    lens. The fit without a term is as good there, but its covariance would be far too small where
    the distortion is extrapolated. These terms are the powers of the radius from the first one that
    the lens does not have to the sixth, and p1 and p2; those that the settings exclude are 0.

    Terms have a normal prior about 0. One step of Gauss and Newton from the fit, of `span` and
    terms together, gives their posterior; its expected square about the fit is C + d d^T, where C
    is its covariance and d its step.
    """
    sigmas: dict[str, float] = {}
    if settings.coefficients is None:
        corner, distortion = _corner(fit.estimate.intrinsics, points)
        effect = _UNFITTED_SHARE * abs(distortion) + _LEAST_UNFITTED
        # a3 and a3 b2 are r^2 and r^4; more rational terms do not span r^6.
        first = max(lens.polynomial, min(lens.coefficients, len(model.POLYNOMIAL) - 1))
        for power, name in list(enumerate(model.POLYNOMIAL, start=1))[first:]:
            sigmas[name] = effect / corner ** (2 * power)
    if settings.tangential is None and not lens.tangential:
        sigmas |= dict.fromkeys(model.TANGENTIAL, _TANGENTIAL_SIGMA)
    if not sigmas:
        return fit
    span = lens.span(settings.aspect)
    both = np.hstack([span, np.eye(model.COUNT)[:, [*map(model.INTRINSICS.index, sigmas)]]])
    linear = _Problem(points, both, fit.sigma_px, Loss()).linear(fit.estimate)
    # As in `_summary`: psi / mean psi'.
    influence = linear.residual.copy()
    counted = max(float(np.mean(fit.weights == 1.0)), 0.05)
    influence[: fit.weights.size] *= fit.weights.ravel() / counted
    equations = solver.normal_equations(linear._replace(residual=influence))
    of_terms = np.array([*sigmas.values()]) ** -2.0
    prior = np.diag(np.concatenate([np.zeros(span.shape[1]), of_terms]))
    equations = replace(equations, corner=equations.corner + prior)
    _, covariance = marginal_covariances(equations, [])
    step = both @ equations.step(0.0)[1]
    return replace(fit, covariance=both @ covariance @ both.T + np.outer(step, step))


def _corner(intrinsics: FloatArray, points: Points) -> tuple[float, float]:
    """Undistorted normalised radius of the farthest corner, and its relative distortion there."""
    seen = model.corner_radius(intrinsics, points.width, points.height)
    there = float(undistorted_radius(np.array(seen), model.lens_of(intrinsics)))
    # Beyond the fold, if decentring alone moves the corner to before it.
    return (there, seen / there - 1.0) if np.isfinite(there) else (seen, 1.0)


def fit_points(
    start: Estimate, points: Points, settings: CalibrationSettings, lens: FreeLens, radius_m: float
) -> tuple[Adjusted, Points]:
    """Adjust intrinsics and poses to points, or to the centroids of circles of a radius above 0."""
    span = lens.span(settings.aspect)
    # Fixed parameters start at their values: no coefficient, the known aspect.
    begin = np.where(np.any(span != 0.0, axis=1), start.intrinsics, 0.0)
    if settings.aspect is not None:
        begin[1] = settings.aspect * begin[0]
    if model.is_possible(begin, points.width, points.height):
        start = replace(start, intrinsics=begin)
    adjusted = partial(adjust, span=span, robust=settings.robust)
    return fit_to_centres(adjusted, start, points, radius_m)


def fit_to_centres(
    adjusted: Callable[[Estimate, Points], Adjusted],
    start: Estimate,
    points: Points,
    radius_m: float,
) -> tuple[Adjusted, Points]:
    """Fit to points; with circles, repeatedly, corrected for the shifts by the previous fit.

    `adjusted` fits points, starting from an estimate; corrected points are returned, too.
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


def circle_shifts(estimate: Estimate, points: Points, radius_m: float) -> FloatArray:
    """From the images of circles' centres to the area centroids of their images, (N, 2) pixels."""
    angles = np.arange(_OUTLINE_POINTS) * (2.0 * np.pi / _OUTLINE_POINTS)
    ring = radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    view = points.views
    in_camera = np.einsum("nij,nkj->nki", estimate.rotations[view], points.board[:, None, :] + ring)
    in_camera += estimate.translations[view][:, None, :]
    outline = model.pixels_of_points(estimate.intrinsics, in_camera.reshape(-1, 3))
    outline = outline.reshape(len(view), _OUTLINE_POINTS, 2)
    centre = project_estimate(estimate, points)[0]
    relative = outline - centre[:, None, :]
    following = np.roll(relative, -1, axis=1)
    cross = relative[..., 0] * following[..., 1] - following[..., 0] * relative[..., 1]
    moment = np.sum((relative + following) * cross[..., None], axis=1)
    return np.asarray(moment / (3.0 * np.sum(cross, axis=1))[:, None])
