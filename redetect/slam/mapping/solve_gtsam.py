"""The same least squares by GTSAM, a standard solver of the field, and as a check.

GTSAM has no factor for a point of the plane in the robot frame with a full covariance, but
`PlanarProjectionFactor2` is one, exactly: a camera one metre below the robot's centre that looks up
sees a disc at height 0 at the pixel (x, y). (`BetweenFactorPose2` on a disc with an idle heading
is not: its error is the logarithm, which mixes heading into place.) For odometry
`BetweenFactorPose2` serves; its logarithm differs from the report's error in the second order only.
Bearings of several lines in a row, from a camera beside the robot's centre, have no compiled
factor: those rows are of class `CustomFactor`, in Python.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle
from redetect.plane import rotation
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import Estimate, Graph
from redetect.slam.mapping.graph_terms import Weighting, cost
from redetect.slam.mapping.solve import Solution
from redetect.slam.models import bearing_jacobians, bearing_of_vertical

# Called with factor, values and, where derivatives are wanted, a list for them.
ErrorFunction = Callable[[Any, Any, list[FloatArray] | None], FloatArray]

# Discs lie on the floor to a micrometre.
_HEIGHT_ROOT_INFORMATION = 1e6
_TOLERANCE, _MOST_STEPS = 1e-10, 200
_MISSING = "--solver gtsam needs GTSAM, which is not installed: pip install 'redetect[slam]'"


def solve_gtsam(graph: Graph, start: Estimate, weighting: Weighting) -> Solution:
    """Minimise the sum of `redetect.slam.mapping.solve.solve` by GTSAM's Levenberg-Marquardt."""
    gtsam = load_gtsam()
    if weighting.calibrate or weighting.tilt_sigma_rad > 0.0:
        raise SlamError(
            "--solver gtsam: there is no factor for the camera's mounting: expected the other "
            "solver with --calibrate"
        )
    factors, values = gtsam_problem(graph, start, weighting)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_MOST_STEPS)
    parameters.setRelativeErrorTol(_TOLERANCE)
    parameters.setAbsoluteErrorTol(0.0)
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters)
    try:
        found = optimizer.optimize()
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        raise SlamError(f"GTSAM: no least squares: {reason}") from None
    if optimizer.iterations() >= _MOST_STEPS:
        raise SlamError(f"GTSAM: no minimum within {_MOST_STEPS} steps")
    estimate = estimate_of_values(graph, found, start)
    lowest = cost(graph, estimate, weighting)
    begun = cost(graph, start, weighting)
    return Solution(estimate, lowest, (begun, *[lowest] * int(optimizer.iterations())))


def load_gtsam() -> Any:
    """GTSAM; `SlamError` if it is not installed."""
    try:
        import gtsam
    except ImportError:
        raise SlamError(_MISSING) from None
    return gtsam


def gtsam_problem(graph: Graph, start: Estimate, weighting: Weighting) -> tuple[Any, Any]:
    """GTSAM's graph (`NonlinearFactorGraph`) and initial `Values`.

    Pose k has key k, disc j key N + 1 + j, line j the keys after those.
    """
    gtsam = load_gtsam()
    noise = gtsam.noiseModel
    root = noise.Gaussian.SqrtInformation
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    first_disc = len(start.poses)
    first_line = first_disc + len(graph.disc_ids)
    for k, pose in enumerate(start.poses):
        values.insert(k, gtsam.Pose2(*pose))
    for j, xy in enumerate(start.disc_xy):
        values.insert(first_disc + j, np.append(xy, 0.0))
    for j, xy in enumerate(start.line_xy):
        values.insert(first_line + j, xy)

    fixed = noise.Constrained.All(3)
    factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*start.poses[0]), fixed))
    turned = np.zeros((len(graph.steps), 3, 3))
    turned[:, :2, :2] = rotation(graph.steps[:, 2])
    turned[:, 2, 2] = 1.0
    # This factor's error is in the frame after the step.
    for k, (step, whiten) in enumerate(zip(graph.steps, graph.step_whitening @ turned)):
        factors.add(gtsam.BetweenFactorPose2(k, k + 1, gtsam.Pose2(*step), root(whiten, False)))
    looking_up = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, -1.0]))
    lens = gtsam.Cal3DS2(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for pose, disc, xy, whiten in zip(
        graph.disc_pose.tolist(), graph.disc_index.tolist(), graph.disc_xy, graph.disc_whitening
    ):
        model = _under_loss(gtsam, root(whiten, False), weighting)
        factors.add(
            gtsam.PlanarProjectionFactor2(pose, first_disc + disc, xy, looking_up, lens, model)
        )
    on_floor = root(np.diag([0.0, 0.0, _HEIGHT_ROOT_INFORMATION]), False)
    for j in range(len(graph.disc_ids)):
        factors.add(gtsam.PriorFactorPoint3(first_disc + j, np.zeros(3), on_floor))
    for row in range(len(graph.line_pose)):
        lines = graph.member_line[graph.member_row == row]
        model = _under_loss(
            gtsam, noise.Isotropic.Sigma(1, float(graph.bearing_sigma_rad[row])), weighting
        )
        keys = [int(graph.line_pose[row]), *(int(first_line + j) for j in lines)]
        function = _bearing_function(float(graph.bearing_rad[row]), graph.camera_xy)
        factors.add(gtsam.CustomFactor(model, keys, function))
    return factors, values


def _under_loss(gtsam: Any, model: Any, weighting: Weighting) -> Any:
    if weighting.loss == "none":
        return model
    estimators = {
        "huber": gtsam.noiseModel.mEstimator.Huber,
        "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
        "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
    }
    estimator = estimators[weighting.loss].Create(weighting.loss_scale)
    return gtsam.noiseModel.Robust.Create(estimator, model)


def _bearing_function(measured_rad: float, camera_xy: FloatArray) -> ErrorFunction:
    """Error of a row of lines: the mean of their bearings less the row's."""

    def error(factor: Any, values: Any, jacobians: list[FloatArray] | None) -> FloatArray:
        pose_key, *line_keys = factor.keys()
        pose = values.atPose2(pose_key)
        place = np.array([pose.x(), pose.y(), pose.theta()])
        lines = np.array([values.atPoint2(key) for key in line_keys])
        bearing = bearing_of_vertical(place, lines, camera_xy)
        if jacobians is not None:
            by_pose, by_line = bearing_jacobians(place, lines, camera_xy)
            mean = np.mean(by_pose, axis=0)
            mean[:2] = mean[:2] @ rotation(place[2])
            jacobians[0] = mean[None, :]
            for k, by in enumerate(by_line, 1):
                jacobians[k] = by[None, :] / len(line_keys)
        return np.array([np.mean(wrap_angle(bearing - measured_rad))])

    return error


def estimate_of_values(graph: Graph, values: Any, start: Estimate) -> Estimate:
    """GTSAM's values (see `gtsam_problem`) as an estimate; headings near those of the start."""
    discs, lines = len(graph.disc_ids), len(graph.line_ids)
    first_disc = len(start.poses)
    poses = [values.atPose2(k) for k in range(first_disc)]
    found = np.array([(p.x(), p.y(), p.theta()) for p in poses])
    # GTSAM keeps headings in (-pi, pi]: back to the turns that odometry counted.
    found[:, 2] = start.poses[:, 2] + wrap_angle(found[:, 2] - start.poses[:, 2])
    placed = [values.atPoint3(first_disc + j) for j in range(discs)]
    return replace(
        start,
        poses=found,
        disc_xy=np.array([xyz[:2] for xyz in placed]).reshape(-1, 2),
        line_xy=np.array(
            [values.atPoint2(first_disc + discs + j) for j in range(lines)], dtype=np.float64
        ).reshape(-1, 2),
    )
