"""A robot's pose by weighted least squares over all corners of all markers in all cameras.

The corners' covariances describe the image's noise only. Where markers and cameras are not exactly
known, their uncertainty moves all corners of a marker, or of a camera, together. So the weight is
the inverse of

    S = R + G C G^T

with R the corners' covariances, C that of the calibration and G the corners' derivatives by it.
This is the estimate of pose *and* calibration with C as the calibration's prior, the calibration
marginalised: its uncertainty reaches the pose's covariance, and counts in the weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.geometry.transforms import exp_se3
from redetect.groundtruth.markers.chain import ChainPoints, project_chain_with_jacobians
from redetect.groundtruth.markers.floor import Floor, floor_residuals
from redetect.groundtruth.markers.settings import Loss

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


#: Residuals of a view: two of each corner.
_ROWS = 8
_STEPS = 50
_SMALLEST_STEP = 1e-10
_LARGEST_DAMPING = 1e10


@dataclass(frozen=True, eq=False)
class PoseProblem:
    """The data on a robot's pose at one time.

    Attributes
    ----------
    cameras : C cameras
    world_from_camera : (C, 4, 4) float64
    robot_from_marker : (M, 4, 4) float64
    camera_covariance : (6 C, 6 C) float64
        Of the cameras' right perturbations.
    marker_covariance : (6 M, 6 M) float64
        Of the markers' right perturbations.
    seen : ChainPoints
        Corners: `camera` and `part` point to cameras and markers, `body` is 0.
    view : (N,) int64
        Which marker in which image each corner is of: four of 0, four of 1, up to V - 1.
    floor : Floor or None
    """

    cameras: tuple[Camera, ...]
    world_from_camera: FloatArray
    robot_from_marker: FloatArray
    camera_covariance: FloatArray
    marker_covariance: FloatArray
    seen: ChainPoints
    view: IntArray
    floor: Floor | None = None

    def __post_init__(self) -> None:
        expected = np.repeat(np.arange(self.views), 4)
        if not np.array_equal(self.view, expected) or len(self.view) != len(self.seen):
            raise ValueError("views of a pose problem: expected four corners each, in order")

    @property
    def views(self) -> int:
        """V, the number of markers in images."""
        return int(self.view.max()) + 1 if len(self.view) else 0

    def only(self, views: BoolArray) -> PoseProblem:
        """The problem with only those of the V views."""
        chosen = views[self.view]
        return PoseProblem(
            self.cameras,
            self.world_from_camera,
            self.robot_from_marker,
            self.camera_covariance,
            self.marker_covariance,
            self.seen.only(chosen),
            (np.cumsum(views) - 1)[self.view[chosen]],
            self.floor,
        )


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A local minimum.

    Attributes
    ----------
    world_from_robot : (4, 4) float64
    covariance : (6, 6) float64
        Of the right perturbation: translation (m) and rotation (rad) in the robot's axes.
    cost : float
        Squared Mahalanobis length of all residuals, without robust weights.
    degrees_of_freedom : int
    view_errors : (V,) float64
        Root mean square of each view's normalised residuals: about 1 where all is well.
    view_rms_px : (V,) float64
        Root mean square of each view's residuals, per coordinate.
    """

    world_from_robot: FloatArray
    covariance: FloatArray
    cost: float
    degrees_of_freedom: int
    view_errors: FloatArray
    view_rms_px: FloatArray

    @property
    def rms_px(self) -> float:
        """Root mean square residual per coordinate."""
        return float(np.sqrt(np.mean(self.view_rms_px**2)))


@dataclass(frozen=True, eq=False)
class _Linearised:
    """Residuals and what decides their weights, at one pose."""

    residuals: FloatArray  # (2 N,)
    jacobian: FloatArray  # (2 N, 6)
    common: FloatArray  # (2 N, 2 N), G C G^T


def refine_pose(
    problem: PoseProblem,
    start: FloatArray,
    *,
    loss: Loss = "linear",
    loss_scale: float = 2.0,
) -> RefinedPose:
    """Go down from a start to the nearest minimum (Levenberg-Marquardt).

    Parameters
    ----------
    problem : PoseProblem
    start : (4, 4) array
        A pose `world_from_robot` in which all corners are in front of their cameras.
    loss : str
        How views that fit badly are weighted: `linear` (least squares), `huber`, `cauchy`. A
        marker's four corners are weighted together.
    loss_scale : float
        Normalised error of a view at which the weights begin to fall.

    Returns
    -------
    RefinedPose

    Raises
    ------
    GeometryError
        If the corners do not determine a pose, or `start` has one behind its camera.
    """
    calibration = _Calibration.of(problem)
    pose = start
    here = _linearise(problem, pose, calibration)
    if here is None:
        raise GeometryError("the start has a corner behind its camera or outside its lens")
    weights = _view_weights(problem, here, loss, loss_scale)
    damping = 1e-6
    for _ in range(_STEPS):
        covariance = _covariance(problem, here, weights)
        cost, gradient, normal = _normal_equations(problem, pose, here, covariance)
        there, step = None, np.zeros(6)
        while damping < _LARGEST_DAMPING:
            step = _solve(normal + damping * np.diag(np.diagonal(normal)), gradient)
            ahead = pose @ exp_se3(step)
            there = _linearise(problem, ahead, calibration)
            if there is not None:
                # Weights stay those of this step: a cost that also changes them is no measure.
                new_cost = _cost(problem, ahead, there, covariance)
                if new_cost <= cost * (1.0 + 1e-12) + 1e-20:
                    break
            there = None
            damping *= 10.0
        if there is None:
            break
        pose, here = ahead, there
        weights = _view_weights(problem, here, loss, loss_scale)
        damping = max(damping * 0.1, 1e-12)
        if np.abs(step).max() < _SMALLEST_STEP:
            break
    return _result(problem, pose, here, weights)


def predicted_errors(
    problem: PoseProblem, pose: FloatArray, pose_covariance: FloatArray
) -> FloatArray:
    """Normalised errors of all views at a pose that was estimated without them.

    Parameters
    ----------
    problem : PoseProblem
    pose : (4, 4) array
    pose_covariance : (6, 6) array
        Of its right perturbation.

    Returns
    -------
    (V,) array
        As `RefinedPose.view_errors`; infinite where a view cannot be seen from there.
    """
    errors = np.full(problem.views, np.inf)
    for view in range(problem.views):
        alone = problem.only(np.arange(problem.views) == view)
        here = _linearise(alone, pose, _Calibration.of(alone))
        if here is not None:
            covariance = _covariance(alone, here, np.ones(1))
            covariance += here.jacobian @ pose_covariance @ here.jacobian.T
            errors[view] = _normalised_rms(here.residuals, covariance)
    return errors


@dataclass(frozen=True, eq=False)
class _Calibration:
    """Cameras and markers in use, and the covariances of their poses."""

    cameras: IntArray
    markers: IntArray
    camera_covariance: FloatArray
    marker_covariance: FloatArray

    @classmethod
    def of(cls, problem: PoseProblem) -> _Calibration:
        cameras, markers = np.unique(problem.seen.camera), np.unique(problem.seen.part)
        return cls(
            cameras,
            markers,
            _block(problem.camera_covariance, cameras),
            _block(problem.marker_covariance, markers),
        )


def _block(covariance: FloatArray, used: IntArray) -> FloatArray:
    """The covariance of those in use; (0, 0) if they are exactly known."""
    index = (6 * used[:, None] + np.arange(6)).ravel()
    block = covariance[np.ix_(index, index)]
    return block if np.any(block) else np.zeros((0, 0))


def _linearise(
    problem: PoseProblem, pose: FloatArray, calibration: _Calibration
) -> _Linearised | None:
    projection = project_chain_with_jacobians(
        problem.cameras,
        problem.world_from_camera,
        pose[None],
        problem.robot_from_marker,
        problem.seen,
    )
    residuals = (problem.seen.pixels - projection.pixels).ravel()
    if not np.all(np.isfinite(residuals)):
        return None
    common = np.zeros((len(residuals), len(residuals)))
    for used, index, covariance, jacobian in (
        (
            calibration.cameras,
            problem.seen.camera,
            calibration.camera_covariance,
            projection.by_camera,
        ),
        (
            calibration.markers,
            problem.seen.part,
            calibration.marker_covariance,
            projection.by_part,
        ),
    ):
        if len(covariance):
            common += _common(jacobian, np.searchsorted(used, index), covariance)
    return _Linearised(residuals, projection.by_body.reshape(-1, 6), common)


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


def _covariance(problem: PoseProblem, here: _Linearised, weights: FloatArray) -> FloatArray:
    """S (2 N, 2 N), with more noise in views of little weight."""
    count = len(problem.seen)
    noise = np.zeros((count, 2, count, 2))
    corner = np.arange(count)
    noise[corner, :, corner, :] = problem.seen.covariances / weights[problem.view][:, None, None]
    return np.asarray(noise.reshape(2 * count, 2 * count) + here.common)


def _normal_equations(
    problem: PoseProblem, pose: FloatArray, here: _Linearised, covariance: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Cost, gradient (6,) and normal matrix (6, 6)."""
    stacked = np.concatenate([here.residuals[:, None], here.jacobian], axis=1)
    products = stacked.T @ np.linalg.solve(covariance, stacked)
    if problem.floor is not None:
        missing, by_pose = floor_residuals(pose, problem.floor)
        of_floor = np.concatenate([missing[:, None], by_pose], axis=1)
        products += of_floor.T @ of_floor
    return float(products[0, 0]), products[1:, 0], 0.5 * (products[1:, 1:] + products[1:, 1:].T)


def _cost(
    problem: PoseProblem, pose: FloatArray, here: _Linearised, covariance: FloatArray
) -> float:
    cost = float(here.residuals @ np.linalg.solve(covariance, here.residuals))
    if problem.floor is not None:
        cost += float(np.sum(floor_residuals(pose, problem.floor)[0] ** 2))
    return cost


def _normalised_rms(residuals: FloatArray, covariance: FloatArray) -> float:
    return float(np.sqrt(residuals @ np.linalg.solve(covariance, residuals) / len(residuals)))


def _view_errors(problem: PoseProblem, here: _Linearised) -> FloatArray:
    covariance = _covariance(problem, here, np.ones(problem.views))
    views = np.arange(problem.views)
    own = covariance.reshape(len(views), _ROWS, len(views), _ROWS)[views, :, views, :]
    residuals = here.residuals.reshape(-1, _ROWS)
    weighted = np.linalg.solve(own, residuals[..., None])[..., 0]
    return np.asarray(np.sqrt(np.sum(residuals * weighted, axis=1) / _ROWS))


def _view_weights(
    problem: PoseProblem, here: _Linearised, loss: Loss, loss_scale: float
) -> FloatArray:
    if loss == "linear":
        return np.ones(problem.views)
    relative = _view_errors(problem, here) / loss_scale
    if loss == "huber":
        return np.asarray(1.0 / np.maximum(relative, 1.0))
    return np.asarray(1.0 / (1.0 + relative**2))


def _solve(normal: FloatArray, gradient: FloatArray) -> FloatArray:
    try:
        return np.asarray(np.linalg.solve(normal, gradient), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise GeometryError("the corners do not determine a pose") from None


def _result(
    problem: PoseProblem, pose: FloatArray, here: _Linearised, weights: FloatArray
) -> RefinedPose:
    _, _, normal = _normal_equations(problem, pose, here, _covariance(problem, here, weights))
    unweighted = _covariance(problem, here, np.ones(problem.views))
    try:
        covariance = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        raise GeometryError("the corners do not determine a pose") from None
    squares = np.sum(here.residuals.reshape(-1, 2) ** 2, axis=1)
    count = np.bincount(problem.view, minlength=problem.views)
    return RefinedPose(
        pose,
        np.asarray(0.5 * (covariance + covariance.T)),
        _cost(problem, pose, here, unweighted),
        len(here.residuals) + (0 if problem.floor is None else 3) - 6,
        _view_errors(problem, here),
        np.sqrt(np.bincount(problem.view, squares, problem.views) / (2 * count)),
    )
