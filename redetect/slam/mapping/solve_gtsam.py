"""The least squares of discs by GTSAM, a standard solver, as a check.

GTSAM has no factor for a planar point in the robot frame with a full covariance, but
`PlanarProjectionFactor2` is equivalent: a camera one metre below the robot's centre that looks up
sees a disc at height 0 at the pixel (x, y). (`BetweenFactorPose2` on a disc with an unused heading
is not: its error is the logarithm, which mixes heading and position.) Odometry uses
`BetweenFactorPose2`, whose logarithm differs from the report's error to second order only. There
are no factors for bearings of several lines in a row, or for the camera's mounting.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from redetect.landmarks import wrap_angle
from redetect.least_squares.solver import Minimum
from redetect.messages import imported_for
from redetect.plane import rotation, with_heading
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import Estimate, Graph
from redetect.slam.mapping.graph_terms import Weighting, cost

# Discs lie on the floor to a micrometre.
_HEIGHT_ROOT_INFORMATION = 1e6
_TOLERANCE, _MOST_STEPS = 1e-10, 200


def solve_gtsam(graph: Graph, start: Estimate, weighting: Weighting) -> Minimum[Estimate]:
    """Minimise the sum of `redetect.slam.mapping.solve.solve` by GTSAM's Levenberg-Marquardt."""
    gtsam = load_gtsam()
    if weighting.calibrate or weighting.loss != "none" or len(graph.line_ids):
        raise SlamError(
            "--solver gtsam: plain least squares of discs only: expected the other solver with "
            "--calibrate, --loss or --lines"
        )
    factors, values = gtsam_problem(graph, start)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_MOST_STEPS)
    parameters.setRelativeErrorTol(_TOLERANCE)
    parameters.setAbsoluteErrorTol(0.0)
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters)
    try:
        found = optimizer.optimize()
    except RuntimeError as error:
        raise SlamError(f"GTSAM: no least squares: {str(error).strip().splitlines()[0]}") from None
    if optimizer.iterations() >= _MOST_STEPS:
        raise SlamError(f"GTSAM: no minimum within {_MOST_STEPS} steps")
    estimate = estimate_of_values(graph, found, start)
    lowest = [cost(graph, estimate, weighting)] * int(optimizer.iterations())
    return Minimum(estimate, (cost(graph, start, weighting), *lowest), True)


def load_gtsam() -> Any:
    """GTSAM; `SlamError` if it is not installed."""
    with imported_for("--solver gtsam needs the package gtsam", "slam", SlamError):
        import gtsam
    return gtsam


def gtsam_problem(graph: Graph, start: Estimate) -> tuple[Any, Any]:
    """GTSAM's graph (`NonlinearFactorGraph`) and initial `Values`: keys of poses, then discs."""
    gtsam = load_gtsam()
    noise = gtsam.noiseModel
    root = noise.Gaussian.SqrtInformation
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    first_disc = len(start.poses)
    for k, pose in enumerate(start.poses):
        values.insert(k, gtsam.Pose2(*pose))
    for j, xy in enumerate(start.disc_xy):
        values.insert(first_disc + j, np.append(xy, 0.0))

    factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*start.poses[0]), noise.Constrained.All(3)))
    turned = with_heading(rotation(graph.steps[:, 2]))
    # This factor's error is in the frame after the step.
    for k, (step, whiten) in enumerate(zip(graph.steps, graph.step_whitening @ turned)):
        factors.add(gtsam.BetweenFactorPose2(k, k + 1, gtsam.Pose2(*step), root(whiten, False)))
    looking_up = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, -1.0]))
    lens = gtsam.Cal3DS2(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for pose, disc, xy, whiten in zip(
        graph.disc_pose.tolist(), graph.disc_index.tolist(), graph.disc_xy, graph.disc_whitening
    ):
        model = root(whiten, False)
        key = first_disc + disc
        factors.add(gtsam.PlanarProjectionFactor2(pose, key, xy, looking_up, lens, model))
    on_floor = root(np.diag([0.0, 0.0, _HEIGHT_ROOT_INFORMATION]), False)
    for j in range(len(graph.disc_ids)):
        factors.add(gtsam.PriorFactorPoint3(first_disc + j, np.zeros(3), on_floor))
    return factors, values


def estimate_of_values(graph: Graph, values: Any, start: Estimate) -> Estimate:
    """GTSAM's values (see `gtsam_problem`) as an estimate; headings near those of the start."""
    first_disc = len(start.poses)
    found = np.array([(p.x(), p.y(), p.theta()) for p in map(values.atPose2, range(first_disc))])
    # GTSAM wraps headings to (-pi, pi]: restore the full turns of odometry.
    found[:, 2] = start.poses[:, 2] + wrap_angle(found[:, 2] - start.poses[:, 2])
    placed = [values.atPoint3(first_disc + j)[:2] for j in range(len(graph.disc_ids))]
    return replace(start, poses=found, disc_xy=np.array(placed).reshape(-1, 2))
