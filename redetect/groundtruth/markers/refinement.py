"""A robot's pose by weighted least squares over all corners of all markers in all cameras.

The corners' covariances describe the image's noise only. Uncertain poses of markers and cameras
move all corners of a marker, or of a camera, together. So the weight is the inverse of

    S = R + G C G^T

with R the corners' covariances, C that of the calibration and G the corners' derivatives by it.
This is the estimate of pose *and* calibration with C as the calibration's prior, marginalised over
the calibration: its uncertainty is included in the pose's covariance and in the weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.markers.adjustment import (
    UNDETERMINED,
    Chain,
    ChainPoints,
    inverted_information,
    project_chain,
    project_chain_with_jacobians,
)
from redetect.groundtruth.markers.session import Network, Rig, View
from redetect.groundtruth.settings import PoseSettings
from redetect.groundtruth.trajectories import se3
from redetect.landmarks import squared_mahalanobis

#: Residuals of a view: two of each corner.
_ROWS = 8
# Normalised error of a view at which its weight begins to fall.
_HUBER = 2.0
# Negligible steps (m, rad), and the share of the cost that is rounding.
_SMALLEST_STEP, _COST_TOLERANCE, _MOST_STEPS = 1e-10, 1e-15, 200
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-14, 1e12


@dataclass(frozen=True, eq=False)
class PoseProblem:
    """The data on a robot's pose at one time."""

    network: Network
    rig: Rig
    seen: ChainPoints  # Corners: `camera` and `part` point to cameras and markers, `body` is 0
    view: IntArray  # (N,): marker in an image of each corner: four of 0, up to V - 1
    settings: PoseSettings

    @property
    def views(self) -> int:
        """V, the number of markers in images."""
        return int(self.view.max()) + 1 if len(self.view) else 0

    @property
    def robot_points(self) -> FloatArray:
        """(N, 3) corners in the robot's frame (m)."""
        return se3.apply(self.rig.robot_from_marker[self.seen.part], self.seen.points)

    def pixels(self, world_from_robot: FloatArray) -> FloatArray:
        """(N, 2) pixels at which the corners are expected; NaN where they cannot be seen."""
        return project_chain(self.chain(world_from_robot), self.seen)

    def chain(self, world_from_robot: FloatArray) -> Chain:
        """Cameras, robot and markers, the robot at a pose."""
        network, parts = self.network, self.rig.robot_from_marker
        return Chain(network.cameras, network.world_from_camera, world_from_robot[None], parts)

    def extent_px(self, view: int) -> float:
        """Width and height of a marker in an image, together."""
        return float(np.ptp(self.seen.pixels[self.view == view], axis=0).sum())

    def only(self, views: BoolArray) -> PoseProblem:
        """The problem with only those of the V views."""
        chosen = views[self.view]
        view = (np.cumsum(views) - 1)[self.view[chosen]]
        return replace(self, seen=self.seen.only(chosen), view=view)


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A local minimum."""

    world_from_robot: FloatArray  # (4, 4)
    covariance: FloatArray  # (6, 6): of the right perturbation (m, rad), in the robot's axes
    cost: float  # Squared Mahalanobis length of all residuals, without robust weights
    degrees_of_freedom: int
    view_errors: FloatArray  # (V,): rms of each view's normalised residuals: about 1 if right
    view_rms_px: FloatArray  # (V,): root mean square of each view's residuals, per coordinate

    @property
    def rms_px(self) -> float:
        """Root mean square residual per coordinate."""
        return float(np.sqrt(np.mean(self.view_rms_px**2)))


class _Corners(NamedTuple):
    """Residuals of a problem's corners and what decides their weights, at one pose."""

    residuals: FloatArray  # (2 N,)
    jacobian: FloatArray  # (2 N, 6)
    common: FloatArray  # (2 N, 2 N), G C G^T


def refine_pose(problem: PoseProblem, start: FloatArray) -> RefinedPose:
    """Descend from a start to the nearest minimum.

    The weights are those of correlated corners and change with the pose, which the sparse solver
    of `redetect.least_squares` does not handle: this is a loop of its own, of six unknowns.

    A marker's four corners are weighted together, by Huber's loss. `start` (4, 4) is a pose
    `world_from_robot`. Raises `GeometryError` if a corner is behind its camera there, or the
    corners do not determine a pose.
    """
    pose, damping = start, _DAMPING
    now = _linearised(problem, pose)
    for _ in range(_MOST_STEPS):
        added = damping * np.diagonal(now.normal)
        try:
            step = -np.linalg.solve(now.normal + np.diag(added), now.gradient)
        except np.linalg.LinAlgError:
            raise GeometryError(UNDETERMINED) from None
        ahead = pose @ se3.exp(step)
        cost = _cost(problem, ahead, now.covariance)
        gain = float(step @ (added * step - now.gradient))
        settled = np.abs(step).max() < _SMALLEST_STEP or gain <= _COST_TOLERANCE * now.cost
        # Near the minimum rounding decides which cost is lower; such steps are still correct.
        if cost <= now.cost * (1.0 + _COST_TOLERANCE) + 1e-20:
            pose = ahead
            if settled:
                break
            damping = max(0.1 * damping, _LEAST_DAMPING)
            now = _linearised(problem, pose)
        elif settled or damping > _MOST_DAMPING:
            break
        else:
            damping *= 10.0
    here = _corners(problem, pose)
    squares = np.sum(here.residuals.reshape(-1, 2) ** 2, axis=1)
    count = np.bincount(problem.view, minlength=problem.views)
    return RefinedPose(
        pose,
        inverted_information(_linearised(problem, pose).normal),
        _cost(problem, pose, _covariance(problem, here, np.ones(problem.views))),
        len(here.residuals) - 6,
        _view_errors(problem, here),
        np.sqrt(np.bincount(problem.view, squares, problem.views) / (2 * count)),
    )


def refined_poses(problem: PoseProblem, starts: Sequence[FloatArray]) -> list[RefinedPose]:
    """The minima below the starts that have one, the best first."""
    minima = []
    for start in starts:
        with suppress(GeometryError):
            minima.append(refine_pose(problem, start))
    return sorted(minima, key=lambda pose: pose.cost)


class _Linearised(NamedTuple):
    """The squares of a problem about a pose."""

    cost: float
    gradient: FloatArray  # (6,): J'r
    normal: FloatArray  # (6, 6): J'J
    covariance: FloatArray  # For this step: a cost that also changes weights is no measure


def _linearised(problem: PoseProblem, pose: FloatArray) -> _Linearised:
    here = _corners(problem, pose)
    weights = 1.0 / np.maximum(_view_errors(problem, here) / _HUBER, 1.0)
    covariance = _covariance(problem, here, weights)
    stacked = np.concatenate([here.residuals[:, None], -here.jacobian], axis=1)
    products = stacked.T @ np.linalg.solve(covariance, stacked)
    normal = 0.5 * (products[1:, 1:] + products[1:, 1:].T)
    return _Linearised(float(products[0, 0]), products[1:, 0], normal, covariance)


def predicted_errors(
    problem: PoseProblem, pose: FloatArray, pose_covariance: FloatArray
) -> FloatArray:
    """(V,) normalised errors of views at a pose estimated without them; infinite if not visible."""
    errors = np.full(problem.views, np.inf)
    for view in range(problem.views):
        alone = problem.only(np.arange(problem.views) == view)
        with suppress(GeometryError):
            here = _corners(alone, pose)
            covariance = _covariance(alone, here, np.ones(1))
            covariance += here.jacobian @ pose_covariance @ here.jacobian.T
            squared = squared_mahalanobis(here.residuals, covariance)
            errors[view] = np.sqrt(squared / len(here.residuals))
    return errors


def _corners(problem: PoseProblem, pose: FloatArray) -> _Corners:
    """Residuals at a pose; in a descent, only the start may be one that does not see a corner."""
    network, rig, seen = problem.network, problem.rig, problem.seen
    projection = project_chain_with_jacobians(problem.chain(pose), seen)
    residuals = (seen.pixels - projection.pixels).ravel()
    if not np.all(np.isfinite(residuals)):
        raise GeometryError("the start has a corner behind its camera or outside its lens")
    common = np.zeros((len(residuals), len(residuals)))
    for jacobian, index, covariance in (
        (projection.by_camera, seen.camera, network.covariance),
        (projection.by_part, seen.part, rig.covariance),
    ):
        if np.any(covariance):
            common += _common(jacobian, index, covariance)
    return _Corners(residuals, projection.by_body.reshape(-1, 6), common)


def _common(jacobian: FloatArray, index: IntArray, covariance: FloatArray) -> FloatArray:
    """G C G^T (2 N, 2 N), where corner i depends on the pose `index[i]` only.

    Products of small blocks: G is mostly zeros, and large products would wake BLAS' threads, which
    takes longer than the work.
    """
    count = len(index)
    of_pose = covariance.reshape(-1, 6, len(covariance))
    left = (jacobian @ of_pose[index]).reshape(2 * count, -1, 6)
    blocks = left[:, index].transpose(1, 0, 2) @ jacobian.transpose(0, 2, 1)
    return blocks.transpose(1, 0, 2).reshape(2 * count, 2 * count)


def _covariance(problem: PoseProblem, here: _Corners, weights: FloatArray) -> FloatArray:
    """S (2 N, 2 N), with more noise in views of little weight."""
    count = len(problem.seen)
    noise = np.zeros((count, 2, count, 2))
    corner = np.arange(count)
    noise[corner, :, corner, :] = problem.seen.covariances / weights[problem.view][:, None, None]
    return np.asarray(noise.reshape(2 * count, 2 * count) + here.common)


def _cost(problem: PoseProblem, pose: FloatArray, covariance: FloatArray) -> float:
    """Squared Mahalanobis length of all residuals; infinite where a corner cannot be seen."""
    residuals = (problem.seen.pixels - problem.pixels(pose)).ravel()
    if not np.all(np.isfinite(residuals)):
        return np.inf
    return float(squared_mahalanobis(residuals, covariance))


def _view_errors(problem: PoseProblem, here: _Corners) -> FloatArray:
    covariance = _covariance(problem, here, np.ones(problem.views))
    views = np.arange(problem.views)
    own = covariance.reshape(len(views), _ROWS, len(views), _ROWS)[views, :, views, :]
    residuals = here.residuals.reshape(-1, _ROWS)
    return np.asarray(np.sqrt(squared_mahalanobis(residuals, own) / _ROWS))


def chain_points(views: Sequence[View], rig: Rig, corner_floor_px: float) -> ChainPoints:
    """Corners of views as points of a chain, with body 0 and the rig's markers as parts."""
    cameras = np.repeat([view.frame.camera for view in views], 4).astype(np.int64)
    parts = np.repeat([view.rig_index for view in views], 4).astype(np.int64)
    points = np.zeros((0, 3))
    pixels, covariances = np.zeros((0, 2)), np.zeros((0, 2, 2))
    if views:
        points = np.concatenate([rig.corners[view.rig_index] for view in views])
        corners = [corner for view in views for corner in view.marker.corners]
        pixels = np.array([[c.u, c.v] for c in corners])
        covariances = np.array([[[c.cuu, c.cuv], [c.cuv, c.cvv]] for c in corners])
        covariances += corner_floor_px**2 * np.eye(2)
        determinants = covariances[:, 0, 0] * covariances[:, 1, 1] - covariances[:, 0, 1] ** 2
        wrong = np.flatnonzero(~((covariances[:, 0, 0] > 0.0) & (determinants > 0.0)))
        if wrong.size:
            view = views[int(wrong[0]) // 4]
            raise GroundTruthError(
                f"image {view.frame.prefix}, marker {view.marker.id}: the covariance of a corner "
                "is not positive definite: expected one, or a corner floor above 0"
            )
    body = np.zeros(len(cameras), np.int64)
    return ChainPoints(cameras, body, parts, points, pixels, covariances)


def pose_problem(
    views: Sequence[View], rig: Rig, network: Network, settings: PoseSettings
) -> PoseProblem:
    """The problem of the robot's pose at one time."""
    points = chain_points(views, rig, settings.corner_floor_px)
    return PoseProblem(network, rig, points, np.repeat(np.arange(len(views)), 4), settings)
