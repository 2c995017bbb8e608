"""Fits one camera model to the projections of another: least squares and minimax."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from redetect.least_squares.solver import (
    Block,
    Linear,
    Loss,
    StartError,
    minimise,
    robust_cost,
    stack,
)

FloatArray = NDArray[np.float64]
Projection = Callable[[FloatArray], tuple[FloatArray, FloatArray]]

#: Deviation (px) up to which a conversion counts as exact: rounding only.
EXACT_PX = 1e-6

# Number of rounds of Lawson's reweighting, which minimises the largest deviation.
_LAWSON_ROUNDS = 25
_STEPS = 60
_LAWSON_STEPS = 5


class CameraFit(NamedTuple):
    """Parameters of a camera that sees rays nearest to pixels; as the solver takes it."""

    project: Projection  # from parameters to the (N, 2) pixels of the rays, and (N, 2, P) Jacobians
    span: FloatArray  # (P, K) free directions
    pixels: FloatArray  # (N, 2)
    possible: Callable[[FloatArray], bool]
    weights: FloatArray | None = None  # (N,) of the squared distances

    def fitted(self, start: FloatArray, steps: int = _STEPS) -> FloatArray:
        """(P,) parameters, from a start on; all steps lead to possible ones."""
        try:
            return minimise(self, start, tolerance=1e-9, most_steps=steps, damping=1e-4).at
        except StartError:
            return start

    def cost(self, at: FloatArray) -> float:
        if not self.possible(at):
            return float("inf")
        return robust_cost([(self._root() * (self.project(at)[0] - self.pixels), Loss())])

    def linear(self, at: FloatArray) -> Linear:
        found, jacobian = self.project(at)
        by = self._root()[:, :, None] * (jacobian @ self.span)
        every = np.zeros(len(found), dtype=np.int64)
        block = Block(self._root() * (found - self.pixels), [(every, by)])
        return stack([block], self.span.shape[1], 0)

    def moved(self, at: FloatArray, step: FloatArray, shared: FloatArray) -> FloatArray:
        return np.asarray(at + self.span @ step)

    def _root(self) -> FloatArray:
        weights = np.ones(len(self.pixels)) if self.weights is None else self.weights
        return np.sqrt(weights)[:, None]


def smallest_largest(fit: CameraFit, start: FloatArray) -> FloatArray:
    """Parameters towards the smallest largest distance: weights grow where it is large.

    References
    ----------
    Lawson, Contributions to the theory of linear least maximum approximation, 1961.
    """
    weights = np.ones(len(fit.pixels))
    parameters = best = start
    smallest = float("inf")
    for _ in range(_LAWSON_ROUNDS):
        away = np.linalg.norm(fit.project(parameters)[0] - fit.pixels, axis=1)
        worst = float(away.max())
        if not np.isfinite(worst):
            break
        if worst < smallest:
            smallest, best = worst, parameters
        if worst < EXACT_PX:
            break
        weights = weights * (0.05 + away / worst)
        weights /= weights.mean()
        parameters = fit._replace(weights=weights).fitted(parameters, _LAWSON_STEPS)
    return best
