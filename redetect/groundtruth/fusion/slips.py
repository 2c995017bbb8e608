"""Slips of odometry while the robot is measured: wheels that spin, a push, small resets.

After a slip the measured poses contradict odometry for good, although they agree with each other.
Without more, a filter rejects them until it gives up. So odometry's variances are increased where
a run of rejections begins, for as long as makes the measurements fit again. A run after which
the measurements return to the path as predicted is one of gross errors of theirs, and is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.groundtruth.fusion.kernels import AFTER_REJECTIONS, Innovations

if TYPE_CHECKING:
    from redetect.groundtruth.fusion.movement import MovementProblem

#: Least duration of a gap without measurements; rejections after a gap are attributed to it.
UNMEASURED_S = 1.5
# Least number and duration (s) of consecutive rejections, and their least number at the end of a
# segment, where it is not known whether the measurements would have returned.
_LEAST_RUN, _LEAST_RUN_S, _LEAST_LAST_RUN = 3, 0.2, 20
# A squared innovation beyond this share of the gate is no return to the predicted path.
_NO_RETURN = 0.6
# Number of measurements until which odometry slips, and its possible rates (m/s, rad/s), as tried,
# with the cost of a measurement: one that contradicts nothing any more costs about as much as a
# rejected one.
_TRIED_LENGTHS, _TRIED_RATES = (1, 2, 4, 8, 16, 32), {1.0: 20.0, 100.0: 50.0}
# The run's squared errors must become smaller by this factor.
_LEAST_GAIN = 0.8
_ROUNDS = 12


def slip_variances(problem: MovementProblem, variances: FloatArray) -> FloatArray:
    """(N, 3) by how much variances (N, 3) of movements to nodes are too small for slips.

    Rejections that begin after a gap without measurements are no sign of slips.
    """
    slips = np.zeros_like(variances)
    nodes, times_s, gate = problem.measured.nodes, problem.measured_s, problem.gate()
    found = problem.forward(variances)
    hopeless: set[int] = set()
    for _ in range(_ROUNDS):
        runs = [
            (begin, end)
            for begin, end in _runs(found, nodes, times_s)
            if begin not in hopeless
            and times_s[begin] - times_s[begin - 1] <= UNMEASURED_S
            and _is_slip(found, times_s, (begin, end), gate)
        ]
        if not runs:
            break
        clipped = np.minimum(found.squared, gate)
        # Where the filter would give up, anything is better.
        least = [
            np.inf if found.accepted[end - 1] else _LEAST_GAIN * float(np.sum(clipped[begin:end]))
            for begin, end in runs
        ]
        chosen: list[_Slip | None] = [None] * len(runs)
        for length, (rate, cost_of_length) in product(_TRIED_LENGTHS, _TRIED_RATES.items()):
            tried = [
                _Slip(int(nodes[begin - 1]), int(nodes[min(begin + length, end) - 1]), rate)
                for begin, end in runs
            ]
            with_them = variances + _added(slips, problem.times_s, tried)
            clipped = np.minimum(problem.forward(with_them).squared, gate)
            for i, (begin, end) in enumerate(runs):
                cost = float(np.sum(clipped[begin:end])) + length * cost_of_length
                if cost < least[i]:
                    least[i], chosen[i] = cost, tried[i]
        hopeless.update(begin for (begin, _), one in zip(runs, chosen) if one is None)
        slips = _added(slips, problem.times_s, [one for one in chosen if one is not None])
        found = problem.forward(variances + slips)
    return slips


class _Slip(NamedTuple):
    """A slip after a node, until another, at a rate (m/s, rad/s)."""

    first: int
    last: int
    rate: float


def _added(slips: FloatArray, times_s: FloatArray, more: Sequence[_Slip]) -> FloatArray:
    """Variances (N, 3) with those of more slips."""
    total = slips.copy()
    for first, last, rate in more:
        passed = np.diff(times_s[first : last + 1])
        usual = (times_s[last] - times_s[first]) / max(len(passed), 1)
        total[first + 1 : last + 1] += (rate**2 * usual * passed)[:, None]
    return total


def slipped_intervals(times_s: FloatArray, slips: FloatArray) -> tuple[tuple[float, float], ...]:
    """Begin and end (s) of the slips; `times_s` (N,) of the nodes, `slips` (N, 3)."""
    stretches = _stretches(slips[:, 0] > 0.0)
    return tuple((float(times_s[max(a - 1, 0)]), float(times_s[b - 1])) for a, b in stretches)


def _stretches(mask: BoolArray) -> list[tuple[int, int]]:
    """Begin and end of the stretches of a mask (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist()))


def _runs(found: Innovations, nodes: IntArray, times_s: FloatArray) -> list[tuple[int, int]]:
    """Begin and end of runs of rejections after an accepted measurement, including the one at
    which the filter restarted.
    """
    rejected = ~found.accepted | (found.restarted[nodes] == AFTER_REJECTIONS)
    return [
        (a, b)
        for a, b in _stretches(rejected)
        if a > 0 and b - a >= _LEAST_RUN and times_s[b - 1] - times_s[a - 1] >= _LEAST_RUN_S
    ]


def _is_slip(found: Innovations, times_s: FloatArray, run: tuple[int, int], gate: float) -> bool:
    """Whether the measurements after a run of rejections do not return to the predicted path."""
    begin, end = run
    if end == len(times_s) or times_s[end] - times_s[end - 1] > UNMEASURED_S:
        return end - begin >= _LEAST_LAST_RUN
    # Where the filter restarted, the last measurement of the run is accepted.
    return bool(found.accepted[end - 1] or found.squared[end] > _NO_RETURN * gate)
