"""Sparse Levenberg-Marquardt that solves for positions exactly while headings move.

With headings given, odometry and discs are linear in all positions. So each step of the headings is
followed by the positions that fit them best (K. Khosoussi, S. Huang, G. Dissanayake, Exploiting the
separable structure of SLAM, RSS 2015; the projection is that of Golub and Pereyra). Without it, a
chain of thousands of poses creeps along a curved valley.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import Estimate, Graph
from redetect.slam.mapping.graph_terms import (
    Layout,
    Linearised,
    Weighting,
    cost,
    layout_of,
    linearise,
)
from redetect.slam.models.mounted_discs import rotation_exp
from redetect.slam.models.mounting import nominal_mounting

FloatArray = NDArray[np.float64]

_FIRST_DAMPING = 1e-6
_LEAST_DAMPING = 1e-12
_LARGEST_DAMPING = 1e10


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a descent ended.

    Attributes
    ----------
    estimate : Estimate
    cost : float
        What was minimised: chi-squared, or less under a robust loss.
    costs : tuple of float
        At the start and after each step.
    """

    estimate: Estimate
    cost: float
    costs: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """J^T J and J^T r, the mounting's unknowns apart because they touch every row.

    Attributes
    ----------
    matrix : (K, K) sparse
    gradient : (K,) float64
    border : (K, 4) or (K, 0) float64
        Between the mounting and the others.
    corner : (4, 4) or (0, 0) float64
    corner_gradient : (4,) or (0,) float64
    """

    matrix: sparse.csc_array
    gradient: FloatArray
    border: FloatArray
    corner: FloatArray
    corner_gradient: FloatArray


def solve(
    graph: Graph,
    start: Estimate,
    weighting: Weighting,
    *,
    tolerance: float = 1e-10,
    most_steps: int = 200,
) -> Solution:
    """Minimise the sum of squared (or robust) whitened errors.

    Parameters
    ----------
    graph : Graph
        The measurements.
    start : Estimate
        Where to begin. Odometry and first sight do for thousands of poses.
    weighting : Weighting
        The cost function and the unknowns.
    tolerance : float
        Stop at a step that lowers the cost by less than this share of it.
    most_steps : int
        Largest number of steps before giving up.

    Returns
    -------
    Solution

    Raises
    ------
    SlamError
        If the start is not finite, or the steps run out.
    """
    estimate = _with_unknowns(graph, start, weighting)
    lowest = cost(graph, estimate, weighting)
    if not np.isfinite(lowest):
        raise SlamError(
            "least squares cannot begin: a disc lies where the camera as mounted cannot see it"
        )
    layout = layout_of(graph, weighting)
    damping = _FIRST_DAMPING
    costs = [lowest]
    for _ in range(most_steps):
        before = lowest
        equations = normal_equations(linearise(graph, estimate, weighting))
        while damping < _LARGEST_DAMPING:
            try:
                step = damped_step(equations, damping)
            except SlamError:
                if 10.0 * damping >= _LARGEST_DAMPING:
                    raise
                damping *= 10.0
                continue
            trial = moved(estimate, layout, *step)
            trial, trial_cost = _with_best_positions(graph, trial, weighting, layout)
            if trial_cost < before:
                estimate, lowest = trial, trial_cost
                damping = max(damping / 10.0, _LEAST_DAMPING)
                break
            damping *= 10.0
        costs.append(lowest)
        if before - lowest <= tolerance * lowest:
            return Solution(estimate, lowest, tuple(costs))
    raise SlamError(
        f"least squares: no minimum within {most_steps} steps: chi-squared is {lowest:.6g} and "
        "falling"
    )


def normal_equations(problem: Linearised) -> NormalEquations:
    """Normal equations of a linear least-squares problem."""
    transposed = problem.jacobian.T
    return NormalEquations(
        matrix=(transposed @ problem.jacobian).tocsc(),
        gradient=np.asarray(transposed @ problem.residual),
        border=np.asarray(transposed @ problem.border),
        corner=problem.border.T @ problem.border,
        corner_gradient=problem.border.T @ problem.residual,
    )


def factor(matrix: sparse.csc_array, damping: float = 0.0) -> SuperLU:
    """Factorise a positive definite matrix, its diagonal raised by a share of it."""
    if damping > 0.0:
        matrix = (matrix + sparse.diags_array(damping * matrix.diagonal())).tocsc()
    return splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def damped_step(equations: NormalEquations, damping: float) -> tuple[FloatArray, FloatArray]:
    """Change of all unknowns but the mounting, and of the mounting.

    Raises
    ------
    SlamError
        If the measurements do not determine the unknowns.
    """
    try:
        factored = factor(equations.matrix, damping)
    except RuntimeError:
        raise SlamError(
            "least squares: the measurements do not determine all poses and landmarks"
        ) from None
    step = -factored.solve(equations.gradient)
    if equations.corner.size == 0:
        return step, np.zeros(0)
    eliminated = factored.solve(equations.border)
    corner = equations.corner + damping * np.diag(np.diag(equations.corner))
    mounting = np.linalg.solve(
        corner - equations.border.T @ eliminated,
        -equations.corner_gradient - equations.border.T @ step,
    )
    return step - eliminated @ mounting, mounting


def moved(estimate: Estimate, layout: Layout, step: FloatArray, mounting: FloatArray) -> Estimate:
    """An estimate after a step.

    Parameters
    ----------
    estimate : Estimate
        Before.
    layout : Layout
        Layout of the step.
    step : (K,) float64
        Changes of all unknowns but the mounting.
    mounting : (0,) or (4,) float64
        Rotation vector in the robot frame, applied from the left, and change of height.
    """
    poses, tilt, discs, lines = np.split(
        step, [layout.first_tilt, layout.first_disc, layout.first_line]
    )
    after = replace(
        estimate,
        poses=estimate.poses + np.concatenate([np.zeros((1, 3)), poses.reshape(-1, 3)]),
        disc_xy=estimate.disc_xy + discs.reshape(-1, 2),
        line_xy=estimate.line_xy + lines.reshape(-1, 2),
    )
    if layout.tilted and estimate.tilt is not None:
        turned = np.concatenate([np.zeros((1, 2)), tilt.reshape(-1, 2)])
        after = replace(after, tilt=estimate.tilt + turned)
    if mounting.size and estimate.mounting is not None:
        turn, _ = rotation_exp(mounting[:3])
        changed = np.concatenate([turn @ estimate.mounting[:, :3], estimate.mounting[:, 3:]], 1)
        changed[2, 3] += mounting[3]
        after = replace(after, mounting=changed)
    return after


def _with_unknowns(graph: Graph, start: Estimate, weighting: Weighting) -> Estimate:
    """A start that has all that is unknown: mounting as calibrated, no tilt."""
    if not weighting.calibrate and weighting.tilt_sigma_rad == 0.0:
        return replace(start, mounting=None, tilt=None)
    if graph.camera is None:
        raise SlamError("the mounting cannot be estimated without a calibration: expected a .cam")
    if weighting.calibrate and start.mounting is None:
        start = replace(start, mounting=nominal_mounting(graph.camera))
    if weighting.tilt_sigma_rad > 0.0:
        if weighting.calibrate and weighting.row_errors != "recorded":
            raise SlamError("a separate tilt for each pose: expected row errors as recorded")
        if start.tilt is None:
            start = replace(start, tilt=np.zeros((len(start.poses), 2)))
    return start


def _with_best_positions(
    graph: Graph, trial: Estimate, weighting: Weighting, layout: Layout
) -> tuple[Estimate, float]:
    """A trial with positions fitted to its headings, if that lowers the cost, and its cost."""
    reached = cost(graph, trial, weighting)
    if not np.isfinite(reached):
        return trial, reached
    problem = linearise(graph, trial, weighting)
    free = np.ones(layout.size, dtype=bool)
    free[2 : layout.first_tilt : 3] = False
    free[layout.first_tilt : layout.first_disc] = False
    jacobian = problem.jacobian.tocsc()[:, np.flatnonzero(free)]
    transposed = jacobian.T
    try:
        positions = -factor((transposed @ jacobian).tocsc()).solve(transposed @ problem.residual)
    except RuntimeError:
        return trial, reached
    step = np.zeros(layout.size)
    step[free] = positions
    fitted = moved(trial, layout, step, np.zeros(0))
    fitted_cost = cost(graph, fitted, weighting)
    return (fitted, fitted_cost) if fitted_cost < reached else (trial, reached)
