"""Least squares of a map, with exact positions for each iterate of the headings.

Given the headings, odometry and discs are linear in all positions. So after each step of the
headings, the positions that fit best are computed (K. Khosoussi, S. Huang, G. Dissanayake,
Exploiting the separable structure of SLAM, RSS 2015; variable projection of Golub and Pereyra).
Otherwise, a chain of thousands of poses converges slowly along a curved valley.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from redetect.array_types import FloatArray
from redetect.least_squares import solver
from redetect.least_squares.covariance import joint_marginal_covariance, marginal_covariances
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import Estimate, Graph
from redetect.slam.mapping.graph_terms import MOUNTING, Weighting, cost, linearise

_MOST_STEPS = 200
_ROBUST_ADVICE = "; if some identifiers are wrong, --loss geman-mcclure leaves their rows out"


@dataclass(frozen=True, eq=False)
class Marginals:
    """Marginal covariance of each unknown."""

    poses: FloatArray  # (N + 1, 3, 3): zero for the first, which is given
    discs: FloatArray  # (M, 2, 2)
    lines: FloatArray  # (K, 2, 2)
    mounting: FloatArray | None  # (6, 6): of rotation vector (rad) and position (m); 0 if known


@dataclass(frozen=True, eq=False)
class _MapProblem:
    """A graph as input of `redetect.least_squares.solver.minimise`."""

    graph: Graph
    weighting: Weighting

    def cost(self, at: Estimate) -> float:
        return cost(self.graph, at, self.weighting)

    def linear(self, at: Estimate) -> solver.Linear:
        return linearise(self.graph, at, self.weighting)

    def moved(self, at: Estimate, step: FloatArray, shared: FloatArray) -> Estimate:
        change = np.zeros(MOUNTING)
        change[self.weighting.unknown_mounting] = shared
        return moved(self.graph, at, step, change)

    def with_best_positions(self, trial: Estimate, reached: float) -> tuple[Estimate, float]:
        """A trial with positions fitted to its headings, if that lowers the cost, and its cost."""
        problem = self.linear(trial)
        free = np.ones(self.graph.unknowns, dtype=bool)
        free[2 : self.graph.first_disc : 3] = False
        jacobian = problem.jacobian.tocsc()[:, np.flatnonzero(free)]
        step = np.zeros(len(free))
        try:
            normal = solver.factor((jacobian.T @ jacobian).tocsc())
        except np.linalg.LinAlgError:
            return trial, reached
        step[free] = -normal.solve(jacobian.T @ problem.residual)
        fitted = moved(self.graph, trial, step, np.zeros(MOUNTING))
        fitted_cost = self.cost(fitted)
        return (fitted, fitted_cost) if fitted_cost < reached else (trial, reached)


def solve(
    graph: Graph, start: Estimate, weighting: Weighting, *, tolerance: float = 1e-10
) -> solver.Minimum[Estimate]:
    """Minimise the sum of squared (or robust) whitened errors.

    Odometry and first sight are a sufficient start for thousands of poses. The iteration ends at a
    relative decrease of the cost below `tolerance`. Raises `SlamError` if the start is not finite,
    the number of steps is exceeded, or the measurements do not determine the unknowns.
    """
    if not weighting.calibrate:
        start = replace(start, mounting=None)
    elif start.mounting is None:
        assert graph.camera is not None
        start = replace(start, mounting=np.array(graph.camera.robot_from_camera))
    problem = _MapProblem(graph, weighting)
    try:
        with _determined("least squares"):
            found = solver.minimise(
                problem,
                start,
                tolerance=tolerance,
                most_steps=_MOST_STEPS,
                refined=problem.with_best_positions,
            )
    except solver.StartError:
        raise SlamError(
            "least squares cannot begin: the camera as mounted could not see one of the discs"
        ) from None
    if not found.converged:
        raise SlamError(
            f"least squares: no minimum within {_MOST_STEPS} steps: chi-squared is "
            f"{found.costs[-1]:.6g} and falling{_ROBUST_ADVICE}"
        )
    return found


@contextmanager
def _determined(what: str) -> Iterator[None]:
    """Raise `SlamError` if the measurements do not determine the unknowns."""
    try:
        yield
    except np.linalg.LinAlgError:
        raise SlamError(
            f"{what}: the measurements do not determine all poses and landmarks{_ROBUST_ADVICE}"
        ) from None


def equations_at(graph: Graph, estimate: Estimate, weighting: Weighting) -> solver.NormalEquations:
    """Normal equations of a map near an estimate, with the considered tilt of all frames."""
    if weighting.calibrate or not graph.common_tilt_variance:
        return solver.normal_equations(linearise(graph, estimate, weighting))
    found = solver.normal_equations(linearise(graph, estimate, weighting, by_tilt=True))
    return replace(found, considered=graph.common_tilt_variance * np.eye(2))


def marginals(graph: Graph, estimate: Estimate, weighting: Weighting) -> Marginals:
    """Covariances of all poses and landmarks at a minimum of `solve`.

    With a robust loss, the information of rows is multiplied by their weights. Raises `SlamError`
    if the measurements do not determine the unknowns.
    """
    blocks = [
        (3, np.arange(0, graph.first_disc, 3)),
        (2, np.arange(graph.first_disc, graph.first_line, 2)),
        (2, np.arange(graph.first_line, graph.unknowns, 2)),
    ]
    with _determined("covariances"):
        found, shared = marginal_covariances(equations_at(graph, estimate, weighting), blocks)
    mounting = None
    if weighting.calibrate:
        mounting = np.zeros((MOUNTING, MOUNTING))
        mounting[np.ix_(weighting.unknown_mounting, weighting.unknown_mounting)] = shared
    return Marginals(np.concatenate([np.zeros((1, 3, 3)), found[0]]), found[1], found[2], mounting)


def joint_covariance(graph: Graph, estimate: Estimate, weighting: Weighting) -> FloatArray:
    """Joint covariance of all landmarks at a minimum of `solve`; see `marginals`.

    Returns (2 M, 2 M): discs, then lines (m^2).
    """
    landmarks = np.arange(graph.first_disc, graph.unknowns)
    with _determined("covariances"):
        return joint_marginal_covariance(equations_at(graph, estimate, weighting), landmarks)


def moved(graph: Graph, estimate: Estimate, step: FloatArray, mounting: FloatArray) -> Estimate:
    """An estimate after a step (K,) of all unknowns except the mounting, and (6,) of that."""
    poses, discs, lines = np.split(step, [graph.first_disc, graph.first_line])
    after = replace(
        estimate,
        poses=estimate.poses + np.concatenate([np.zeros((1, 3)), poses.reshape(-1, 3)]),
        disc_xy=estimate.disc_xy + discs.reshape(-1, 2),
        line_xy=estimate.line_xy + lines.reshape(-1, 2),
    )
    if estimate.mounting is not None:
        turn = Rotation.from_rotvec(mounting[:3]).as_matrix()
        place = estimate.mounting[:, 3] + mounting[3:]
        after = replace(after, mounting=np.column_stack([turn @ estimate.mounting[:, :3], place]))
    return after
