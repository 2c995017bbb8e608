"""Whether the robot's clock was set within a segment, and when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from redetect.groundtruth.clocks.heading_pair import HeadingPair, without_turns
from redetect.groundtruth.clocks.wandering import Wandering, estimate_wandering

FloatArray = NDArray[np.float64]

_PLACES = 60
# By how much a step must reduce the squared error, more than the best of `_PLACES` would by chance:
# in addition to the drift, and instead of it (100 draws without a jump reached 13 and 11).
_BEYOND_DRIFT = 20.0
_INSTEAD_OF_DRIFT = 15.0
_LEAST_JUMP_S = 0.004
# A jump changes the differences slowly and must not be mistaken for a random walk.
_SHORT_LAGS = (1, 2, 3, 4)
_RELOCATIONS = 4
_FEWEST_PER_SIDE = 5
_SEARCH_S = 1.0


def find_jump(pair: HeadingPair, offset_s: float, drift: float) -> float | None:
    """When the clock was set, if it was.

    A step of the offset at each of many places is compared with the drift: there was a jump if a
    step explains the headings better than the drift does, or much that the drift leaves over.

    Parameters
    ----------
    pair : HeadingPair
    offset_s, drift : float
        The best without a jump.

    Returns
    -------
    float or None
        The time on the ground truth's clock.
    """
    jacobian = pair.sensitivities(offset_s, drift)
    information = np.cumsum(jacobian[:, 0] ** 2)
    if not information[-1] > 0.0 or len(information) < 4 * _FEWEST_PER_SIDE:
        return None
    differences = without_turns(pair.differences(offset_s, drift))
    wandering = estimate_wandering(pair.times_s, differences, pair.systematic, _SHORT_LAGS)
    places = np.clip(
        np.interp(np.linspace(0.05, 0.95, _PLACES) * information[-1], information, pair.times_s),
        pair.times_s[_FEWEST_PER_SIDE],
        pair.times_s[-_FEWEST_PER_SIDE],
    )
    steps = np.where(pair.times_s[:, None] >= places, jacobian[:, :1], 0.0)
    # To first order, the differences with the offset alone.
    without_drift = differences - jacobian[:, 1] * drift
    instead, _ = _gains(without_drift, steps, jacobian[:, :1], wandering)
    beside, size = _gains(without_drift, steps, jacobian, wandering)
    best = int(np.argmax(instead))
    split = _relocate(pair, wandering, places, best, offset_s)
    gained = wandering.squared(differences) - split.squared_error
    if gained < _INSTEAD_OF_DRIFT or abs(split.jump_s) < _LEAST_JUMP_S:
        best = int(np.argmax(beside))
        if beside[best] < _BEYOND_DRIFT or abs(size[best]) < _LEAST_JUMP_S:
            return None
        split = _relocate(pair, wandering, places, best, offset_s)
    return split.time_s if pair.sign > 0 else split.time_s - offset_s


def _gains(
    residual: FloatArray, columns: FloatArray, known: FloatArray, wandering: Wandering
) -> tuple[FloatArray, FloatArray]:
    """By how much each of (N, k) columns lowers the squared error, and its size."""
    whitened = wandering.whiten(known)
    normal = known.T @ whitened
    apart = columns - known @ np.linalg.solve(normal, whitened.T @ columns)
    left = residual - known @ np.linalg.solve(normal, whitened.T @ residual)
    weighted = wandering.whiten(apart)
    power = np.einsum("np,np->p", apart, weighted)
    size = -(weighted.T @ left) / np.where(power > 0.0, power, np.inf)
    return size**2 * power, size


@dataclass(frozen=True)
class _Split:
    """Two offsets, one before and one after a time of the pair's clock."""

    time_s: float
    jump_s: float
    squared_error: float


def _relocate(
    pair: HeadingPair, wandering: Wandering, places: FloatArray, best: int, near_s: float
) -> _Split:
    """The place that fits best if each side has its own offset, without drift."""
    split = None
    for _ in range(_RELOCATIONS):
        before = pair.times_s < places[best]
        sides = [_side_offset(pair.kept(which), wandering, near_s) for which in (before, ~before)]
        first, second = (without_turns(pair.differences(offset, 0.0)) for offset in sides)
        errors = [
            wandering.squared(np.where(pair.times_s < place, first, second)) for place in places
        ]
        moved = int(np.argmin(errors))
        split = _Split(float(places[moved]), sides[1] - sides[0], errors[moved])
        if moved == best:
            break
        best = moved
    assert split is not None
    return split


def _side_offset(side: HeadingPair, wandering: Wandering, near_s: float) -> float:
    """Offset of one side of a jump, without drift."""
    own = Wandering(side.times_s, wandering.sigma, wandering.rate, side.systematic)

    def error(offset_s: float) -> float:
        return own.squared(without_turns(side.differences(offset_s, 0.0)))

    coarse = near_s + np.linspace(-_SEARCH_S, _SEARCH_S, 81)
    begin = float(coarse[int(np.argmin([error(offset) for offset in coarse]))])
    spacing = float(coarse[1] - coarse[0])
    found = minimize_scalar(
        error, bounds=(begin - spacing, begin + spacing), method="bounded", options={"xatol": 1e-5}
    )
    return float(found.x)
