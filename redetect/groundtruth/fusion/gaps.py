"""Bridges gaps at whose ends the filter is lost, from both ends, or cuts them in the middle.

Over a long path without measurements odometry's heading drifts so far that derivatives along the
filter's own path do not hold for the true one. Such gaps are treated separately. The paths before
and after are known from their own measurements. Odometry is placed between them, bent evenly, and
refined to the likeliest path by Gauss-Newton steps (a forward filter and a backward smoother,
linearised along the current path). Headings are known up to whole turns: each possible number of
turns is tried, and the gap is bridged only if one of them explains the other end much better than
all others. Otherwise the two sides are not connected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.groundtruth.fusion.kernels import (
    AFTER_REJECTIONS,
    POSE,
    STATE,
    WHERE_LOST,
    Gating,
    MeasuredPoses,
    Odometry,
    empty_history,
    filter_forward,
    smooth_backward,
)
from redetect.landmarks import wrap_angle

#: Least time without measurements that is a gap: rejections after it are attributed to it.
UNMEASURED_S = 1.0
_MOST_TURNS = 2
_MOST_STEPS = 15
_MOST_LOOSENINGS = 10
_WHERE_NONE_SETTLES = 10.0
_SETTLED_RAD = 1e-3
# Of twice the logarithm of the likelihood: by how much the best number of turns must lead.
_CLEAR_LEAD = 2.0 * math.log(100.0)
_TURN_PER_METRE = 4


@dataclass(frozen=True, eq=False)
class Bridge:
    """The likeliest path over a gap."""

    # (N, 6): states from the gap's begin to its end; headings have no jumps. None if more than one
    # number of whole turns may be, or if none explains the end.
    path: FloatArray | None
    looser: float  # By what factor odometry's variances had to be raised to explain it, 1 or more


def gaps_where_lost(
    nodes: IntArray, accepted: BoolArray, restarted: NDArray[np.int8]
) -> list[tuple[int, int]]:
    """Nodes of the last measurement before, and the first one after, each gap that is too long."""
    good = nodes[accepted]
    return [
        (int(good[np.searchsorted(good, end) - 1]), int(end))
        for end in np.flatnonzero(restarted == WHERE_LOST)
    ]


def ends_that_did_not_fit(
    times_s: FloatArray,
    nodes: IntArray,
    accepted: BoolArray,
    restarted: NDArray[np.int8],
) -> list[int]:
    """Nodes after gaps where those rejections began that made the filter restart."""
    found = []
    for node in np.flatnonzero(restarted == AFTER_REJECTIONS):
        first = int(np.searchsorted(nodes, node))
        while first > 0 and not accepted[first - 1]:
            first -= 1
        if first > 0 and times_s[nodes[first]] - times_s[nodes[first - 1]] > UNMEASURED_S:
            found.append(int(nodes[first]))
    return found


def bridge(
    controls: FloatArray,
    variances: FloatArray,
    forward: FloatArray,
    spread: FloatArray,
    end: FloatArray,
    end_spread: FloatArray,
    gate: float,
) -> Bridge:
    """Find the likeliest path between two known ends.

    `controls` (N, 4) and `variances` (N, 3) are those of the movements to each node; the first are
    not used. `forward` (N - 1, 6) is where odometry leads from the first node, whose covariance is
    `spread` (6, 6). `end` (3,) is the pose at the last node, with `end_spread` (3, 3). Beyond the
    `gate`, a squared normalised distance of the end, odometry is taken to err more in this gap than
    elsewhere.
    """
    looser = 1.0
    for _ in range(_MOST_LOOSENINGS):
        tried = []
        for turns in range(-_MOST_TURNS, _MOST_TURNS + 1):
            start = _bent(controls, forward, end, turns)
            found = _likeliest(controls, looser * variances, start, forward[0], spread, end_spread)
            if found is not None:
                tried.append(found)
        if not tried:
            looser *= _WHERE_NONE_SETTLES
            continue
        tried.sort(key=lambda one: one[0])
        surprise, squared, path = tried[0]
        if squared <= gate:
            clear = len(tried) == 1 or tried[1][0] - surprise >= _CLEAR_LEAD
            return Bridge(path if clear else None, looser)
        looser *= max(squared / POSE, 1.5)
    return Bridge(None, looser)


def _bent(controls: FloatArray, forward: FloatArray, end: FloatArray, turns: int) -> FloatArray:
    """(N, 6) the path of odometry, bent and moved evenly along its way until it meets the end."""
    way = np.hypot(controls[:, 0], controls[:, 1])
    way[0] = 0.0
    # On the spot: by the rows.
    passed = np.cumsum(way) if np.any(way > 0.0) else np.arange(float(len(way)))
    share = passed / passed[-1]
    path = np.vstack([forward, forward[-1:]])
    path[-1, 2] += controls[-1, 2]
    missing = float(wrap_angle(end[2] - path[-1, 2])) + 2.0 * math.pi * turns
    steps = np.diff(path[:, :2], axis=0)
    steps = (steps[:, 0] + 1j * steps[:, 1]) * np.exp(1j * missing * share[1:])
    xy = np.concatenate([[0.0], np.cumsum(steps)]) + complex(path[0, 0], path[0, 1])
    xy += share * (complex(end[0], end[1]) - xy[-1])
    path[:, 0], path[:, 1] = xy.real, xy.imag
    path[:, 2] += missing * share
    return path


def _likeliest(
    controls: FloatArray,
    variances: FloatArray,
    path: FloatArray,
    begin: FloatArray,
    spread: FloatArray,
    end_spread: FloatArray,
) -> tuple[float, float, FloatArray] | None:
    """Surprise, squared distance of the end and states, by Gauss-Newton steps, if they settle."""
    count = len(controls)
    measured = MeasuredPoses(np.array([count - 1]), path[-1:, :POSE].copy(), end_spread[None])
    odometry, history = Odometry(controls, variances), empty_history(count)
    for _ in range(_MOST_STEPS):
        squared, _, _, surprise = filter_forward(
            odometry, begin, spread, measured, _no_gate(count), path, history
        )
        better, _ = smooth_backward(history)
        moved = float(np.max(np.abs(better[:, 2] - path[:, 2])))
        path = better
        if not moved < 10.0 * math.pi:
            return None
        if moved < _SETTLED_RAD:
            return float(surprise), float(squared[0]), path
    return None


def _no_gate(nodes: int) -> Gating:
    """Accept everything."""
    return Gating(math.inf, 1, np.ones(POSE), math.inf, np.zeros(nodes, dtype=np.bool_))


def back_from(
    controls: FloatArray, variances: FloatArray, end: FloatArray, end_spread: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """States (N, 6) and covariances (N, 6, 6) predicted backward by odometry from a gap's end.

    `controls` (N, 4) and `variances` (N, 3) as for `bridge`; `end` (6,) and `end_spread` (6, 6) are
    those at the last node.
    """
    count = len(controls)
    # Driven backward, all rates change their signs; the turn per metre does so by itself.
    mirror = np.ones(STATE)
    mirror[_TURN_PER_METRE] = -1.0
    reverse = np.concatenate([np.zeros((1, 4)), -controls[:0:-1]])
    history = empty_history(count)
    filter_forward(
        Odometry(reverse, np.concatenate([np.zeros((1, 3)), variances[:0:-1]])),
        mirror * end,
        end_spread * mirror * mirror[:, None],
        MeasuredPoses(np.empty(0, dtype=np.int64), np.empty((0, POSE)), np.empty((0, POSE, POSE))),
        _no_gate(count),
        np.empty((1, STATE)),
        history,
    )
    states, spreads = history.filtered * mirror, history.filtered_covariance
    return states[::-1], (spreads * mirror * mirror[:, None])[::-1]
