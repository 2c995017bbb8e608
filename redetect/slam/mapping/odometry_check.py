"""Do odometry and landmark rows fit each other? Their errors apart, and what odometry does wrong.

The factor of a map, chi-squared over its expectation, may be near 1 although odometry is far worse
than its covariances state: most numbers are those of rows. So the expectation is divided: that of
odometry is the sum of its redundancies, the share of each number that the others check (W.
Foerstner, B. P. Wrobel, Photogrammetric Computer Vision, 2016, chapter 4). Systematic errors of all
steps, as of a wheel's radius or a unit, are further unknowns, from the minimum without them. They
change with the adjusted steps: the errors of the measured ones would hide them, or look like them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, chdtri

from redetect.array_types import FloatArray
from redetect.least_squares.covariance import by_shared, marginal_covariances
from redetect.least_squares.solver import normal_equations
from redetect.plane import between
from redetect.slam.mapping.graph_terms import errors, linearise
from redetect.slam.mapping.run_map import MappedRun
from redetect.slam.models import between_jacobians

#: Fewest redundant numbers from which a factor is meaningful.
FEWEST_NUMBERS = 10.0
_CHANCE = 1e-6  # Probability of what is taken for impossible by chance.
_MOST_SQUARED = float(chdtri(3, _CHANCE))  # Largest squared error of a step by chance.


@dataclass(frozen=True)
class OdometryCheck:
    """Errors of odometry and of rows, and systematic errors of odometry.

    The latter are corrections by which its steps would fit the rows, with standard deviations; NaN
    if they are not determined, or the camera's mounting is unknown, since its height has the scale
    of odometry.
    """

    odometry_factor: float  # chi-squared of odometry over its expectation; NaN without redundancy
    rows_factor: float  # the same of landmark rows
    length: float  # relative change of the lengths of all steps
    length_sigma: float
    turn_per_metre: float  # additional turn (rad/m)
    turn_per_metre_sigma: float
    lag_frames: float  # how much later odometry is than the frames, in intervals between frames
    lag_frames_sigma: float
    outliers: int  # steps that are wrong beyond any chance: slips, or rows there are wrong
    worst_step: int  # the one with the largest error


def check_odometry(mapped: MappedRun) -> OdometryCheck:
    """Check the odometry of a map.

    Raises `numpy.linalg.LinAlgError` if the measurements do not determine the unknowns.
    """
    graph, estimate, weighting = mapped.graph, mapped.estimate, mapped.weighting
    problem, count = linearise(graph, estimate, weighting), len(graph.steps)
    # Of each pose with the next, without systematic errors; the first pose is known.
    pairs = (6, 3 * np.arange(count - 1, dtype=np.int64))
    first_pose = (3, np.zeros(1, dtype=np.int64))
    found, _ = marginal_covariances(normal_equations(problem), [pairs, first_pose])
    border = np.zeros((len(problem.residual), 3))
    if not weighting.calibrate:
        by_change, along = np.zeros((count, 3, 3)), _adjusted_movements(graph.steps, estimate.poses)
        by_change[:, :2, 0] = -along
        by_change[:, 2, 1] = -np.hypot(*along.T)
        by_change[1:-1, :, 2] = 0.5 * (graph.steps[:-2] - graph.steps[2:])
        border[: 3 * count] = (graph.step_whitening @ by_change).reshape(-1, 3)
        problem = problem._replace(border=border[:, :2])
    jacobians = between_jacobians(estimate.poses[:-1], estimate.poses[1:])
    by_poses = graph.step_whitening @ np.concatenate(jacobians, axis=2)
    first, others = by_poses[:1, :, 3:], by_poses[1:]
    parts = ((others, found[0]), (first, found[1]))
    estimated = sum(float(np.einsum("nij,njk,nik->", by, c, by)) for by, c in parts)
    odometry = 3.0 * count - estimated
    rows = mapped.table.expected - odometry
    error = errors(graph, estimate, weighting)
    squared = [float(np.sum(part**2)) for part in (error.odometry, error.discs, error.lines)]
    of_steps = np.sum(error.odometry**2, axis=1)
    change, variance = np.full(3, math.nan), np.full(3, math.nan)
    if not weighting.calibrate:
        equations = normal_equations(problem)
        with_lag = normal_equations(problem._replace(border=border))
        change = np.append(equations.step(0.0)[1], with_lag.step(0.0)[1][2])
        of_both, of_lag = (by_shared(each)[1] for each in (equations, with_lag))
        variance = np.append(np.diag(of_both), of_lag[2, 2])
    # Without redundancy, the systematic errors are not determined, and nothing else is checked.
    if mapped.table.expected <= 0 or np.any(variance < 0.0):
        odometry = rows = 0.0
        variance[:] = math.nan
    sigma = np.sqrt(np.where(variance > 0.0, variance, math.nan))
    change = np.where(np.isnan(sigma), math.nan, change)
    (length, turn, lag), (length_sigma, turn_sigma, lag_sigma) = change.tolist(), sigma.tolist()
    return OdometryCheck(
        odometry_factor=_factor(squared[0], odometry),
        rows_factor=_factor(sum(squared[1:]), rows),
        length=length,
        length_sigma=length_sigma,
        turn_per_metre=turn,
        turn_per_metre_sigma=turn_sigma,
        lag_frames=lag,
        lag_frames_sigma=lag_sigma,
        outliers=int(np.count_nonzero(of_steps > _MOST_SQUARED)),
        worst_step=int(np.argmax(of_steps)),
    )


def _factor(squared: float, redundant: float) -> float:
    """Squared errors over their expectation; NaN from few numbers, unless it is beyond chance."""
    known = redundant >= FEWEST_NUMBERS or (
        redundant > 0.0 and chdtrc(redundant, squared) < _CHANCE
    )
    return squared / redundant if known else math.nan


def _adjusted_movements(steps: FloatArray, poses: FloatArray) -> FloatArray:
    """(N, 2) movements (m) of odometry's steps (N, 3), with its scale but without random errors:
    those of adjusted `poses` (N + 1, 3) times the scale.
    """
    adjusted = between(poses[:-1], poses[1:])[:, :2]
    squared = float(np.sum(adjusted**2))
    scale = float(np.sum(adjusted * steps[:, :2])) / squared if squared > 0.0 else 0.0
    return scale * adjusted
