"""Least squares over a whole run: poses, discs, the camera's true mounting, the robot's tilt.

Levenberg-Marquardt on the sparse normal equations. The four unknowns of the mounting touch every
row, so they are kept out of the sparse matrix and solved for through its Schur complement.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from camera import Camera
from tools.reenactment.model import Geometry, rotation_exp
from tools.reenactment.objective import NormalEquations, Weighting, cost, normal_equations
from tools.reenactment.recording import Recording

FloatArray = NDArray[np.float64]

_FIRST_DAMPING = 1e-6
_LEAST_DAMPING = 1e-12
_LARGEST_DAMPING = 1e6


class RefitError(ValueError):
    """A fit that cannot begin, or does not settle."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A geometry that a fit ended at.

    Parameters
    ----------
    geometry : Geometry
        The unknowns' values.
    cost : float
        Sum of (robust) squared errors.
    steps : int
        Steps taken.
    mounting_covariance : (4, 4) float array
        Of the rotation vector (robot x, y, z; radians) and the height (metres); (0, 0) where the
        mounting was no unknown.
    """

    geometry: Geometry
    cost: float
    steps: int
    mounting_covariance: FloatArray


def refit(
    camera: Camera,
    recording: Recording,
    start: Geometry,
    weighting: Weighting,
    *,
    tolerance: float = 1e-9,
    max_steps: int = 300,
) -> Fit:
    """Fit a geometry to a recording.

    Parameters
    ----------
    camera : Camera
        As calibrated: its lens, and the nominal mounting through which the rows were written.
    recording : Recording
        Rows and odometry.
    start : Geometry
        Where to begin.
    weighting : Weighting
        What to minimise.
    tolerance : float
        Stop at a step that lowers the cost by less than this share of it.
    max_steps : int
        Give up after so many.

    Returns
    -------
    Fit

    Raises
    ------
    RefitError
        If least squares starts with a disc out of its camera's sight, or the steps run out.
    """
    geometry = start
    lowest = cost(camera, recording, geometry, weighting)
    if not np.isfinite(lowest):
        raise RefitError(
            "the start has discs where the camera can't see them: expected a robust fit before"
        )
    damping = _FIRST_DAMPING
    for step in range(max_steps):
        before = lowest
        equations = normal_equations(camera, recording, geometry, weighting)
        for trial, trial_damping in _ever_shorter_steps(equations, geometry, damping):
            trial_cost = cost(camera, recording, trial, weighting)
            if trial_cost < before:
                geometry, lowest = trial, trial_cost
                damping = max(trial_damping / 10.0, _LEAST_DAMPING)
                break
        if before - lowest <= tolerance * lowest:
            equations = normal_equations(camera, recording, geometry, weighting)
            return Fit(geometry, lowest, step + 1, _mounting_covariance(equations))
    raise RefitError(f"no minimum within {max_steps} steps: the cost is {lowest:.6g} and falling")


def _ever_shorter_steps(
    equations: NormalEquations, geometry: Geometry, damping: float
) -> Iterator[tuple[Geometry, float]]:
    """Geometries to try next, and the damping that led to each."""
    while damping < _LARGEST_DAMPING:
        yield moved(geometry, *_solve(equations, damping)), damping
        damping *= 10.0


def _factor(matrix: sparse.csc_array, damping: float) -> SuperLU:
    diagonal = matrix.diagonal()
    # A disc that no row in sight shows has nothing to say: it stays where it is.
    idle = diagonal == 0.0
    damped = matrix + sparse.diags_array(damping * diagonal + idle)
    return splu(
        damped.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _solve(equations: NormalEquations, damping: float) -> tuple[FloatArray, FloatArray]:
    """The damped step: of all unknowns but the mounting, and of the mounting."""
    factor = _factor(equations.matrix, damping)
    step = -factor.solve(equations.gradient)
    if equations.corner.size == 0:
        return step, np.zeros(0)
    eliminated = factor.solve(equations.border)
    corner = equations.corner + damping * np.diag(np.diag(equations.corner))
    mounting = np.linalg.solve(
        corner - equations.border.T @ eliminated,
        -equations.border_gradient - equations.border.T @ step,
    )
    return step - eliminated @ mounting, mounting


def _mounting_covariance(equations: NormalEquations) -> FloatArray:
    if equations.corner.size == 0:
        return np.zeros((0, 0))
    eliminated = _factor(equations.matrix, 0.0).solve(equations.border)
    return np.asarray(np.linalg.inv(equations.corner - equations.border.T @ eliminated))


def moved(geometry: Geometry, step: FloatArray, mounting: FloatArray) -> Geometry:
    """A geometry after a step.

    Parameters
    ----------
    geometry : Geometry
        Before.
    step : (3N + 2M,) or (5N + 2M,) float array
        Changes of poses, discs and perhaps tilt.
    mounting : (0,) or (4,) float array
        Rotation vector in the robot frame, applied from the left, and change of height.
    """
    frames, discs = len(geometry.poses), len(geometry.disc_xy)
    poses, disc_xy, tilt = np.split(step, [3 * frames, 3 * frames + 2 * discs])
    after = replace(
        geometry,
        poses=geometry.poses + poses.reshape(frames, 3),
        disc_xy=geometry.disc_xy + disc_xy.reshape(discs, 2),
    )
    if tilt.size:
        after = replace(after, tilt=geometry.tilt + tilt.reshape(frames, 2))
    if mounting.size:
        turn, _ = rotation_exp(mounting[:3])
        after = replace(
            after,
            rotation=turn @ geometry.rotation,
            centre=geometry.centre + np.array([0.0, 0.0, mounting[3]]),
        )
    return after
