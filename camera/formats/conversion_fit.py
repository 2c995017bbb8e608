"""Fits one camera model to the projections of another: least squares and minimax."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Deviation (px) up to which a conversion counts as exact: rounding only.
EXACT_PX = 1e-6

# Number of rounds of Lawson's reweighting, which minimises the largest deviation.
_LAWSON_ROUNDS = 25
_STEPS = 60
_LAWSON_STEPS = 5


def least_squares(
    project: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    start: FloatArray,
    span: FloatArray,
    pixels: FloatArray,
    possible: Callable[[FloatArray], bool],
    weights: FloatArray | None = None,
    steps: int = _STEPS,
) -> FloatArray:
    """(P,) parameters of a camera that sees rays nearest to (N, 2) pixels (Levenberg-Marquardt).

    `project` gives from parameters the (N, 2) pixels of the rays and their (N, 2, P) derivatives;
    the columns of `span` are the free directions; steps to parameters that are not `possible` are
    not taken; `weights` are of the squared distances.
    """
    root = np.ones(len(pixels)) if weights is None else np.sqrt(weights)
    parameters, damping = start, 1e-4
    found, jacobian = project(parameters)
    error = root[:, None] * (pixels - found)
    cost = float(np.sum(error**2))
    for _ in range(steps):
        J = (root[:, None, None] * (jacobian @ span)).reshape(-1, span.shape[1])
        scale = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        J = J / scale
        while damping < 1e10:
            stacked = np.vstack([J, np.sqrt(damping) * np.eye(J.shape[1])])
            right = np.concatenate([error.ravel(), np.zeros(J.shape[1])])
            step = span @ (np.linalg.lstsq(stacked, right, rcond=None)[0] / scale)
            trial = parameters + step
            if possible(trial):
                found, trial_jacobian = project(trial)
                trial_error = root[:, None] * (pixels - found)
                trial_cost = float(np.sum(trial_error**2))
                if trial_cost < cost:
                    break
            damping *= 8.0
        else:
            return parameters
        done = cost - trial_cost <= 1e-9 * cost + 1e-24
        parameters, error, cost, jacobian = trial, trial_error, trial_cost, trial_jacobian
        damping = max(damping / 8.0, 1e-14)
        if done:
            return np.asarray(parameters)
    return parameters


def smallest_largest(
    project: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    start: FloatArray,
    span: FloatArray,
    pixels: FloatArray,
    possible: Callable[[FloatArray], bool],
) -> FloatArray:
    """Parameters towards the smallest largest distance: weights grow where it is large.

    Parameters as in `least_squares`.

    References
    ----------
    Lawson, Contributions to the theory of linear least maximum approximation, 1961.
    """
    weights = np.full(len(pixels), 1.0)
    parameters = best = start
    smallest = float("inf")
    for _ in range(_LAWSON_ROUNDS):
        away = np.linalg.norm(project(parameters)[0] - pixels, axis=1)
        worst = float(away.max())
        if not np.isfinite(worst):
            break
        if worst < smallest:
            smallest, best = worst, parameters
        if worst < EXACT_PX:
            break
        weights = weights * (0.05 + away / worst)
        weights /= weights.mean()
        parameters = least_squares(
            project, parameters, span, pixels, possible, weights, _LAWSON_STEPS
        )
    return best
