"""Odometry as control and measured poses: their likelihood together, and the smoothed path.

Over a long path without measurements odometry's heading drifts so far that derivatives along the
filter's own path do not hold for the true one. Such gaps, at whose ends the filter is lost, are
treated separately. The paths before and after are known from their own measurements. Odometry is
placed between them, bent evenly, and refined to the likeliest path by Gauss-Newton steps (a forward
filter and a backward smoother, linearised along the current path). Headings are known up to whole
turns: each possible number of turns is tried, and the gap is bridged only if one of them explains
the other end much better than all others. Otherwise the two sides are not connected: the gap is cut
in the middle.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.fusion.inputs import (
    CREEP_M2_PER_S,
    CREEP_RAD2_PER_S,
    gather,
    movements,
    systematic_sigmas,
)
from redetect.groundtruth.fusion.kernels import (
    AFTER_REJECTIONS,
    POSE,
    STATE,
    WHERE_LOST,
    FilterHistory,
    Gating,
    MeasuredPoses,
    MeasurementAccount,
    Odometry,
    empty_history,
    filter_forward,
    smooth_backward,
)
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses, last_of_each_time
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


def bridge(
    odometry: Odometry,
    forward: FloatArray,
    spread: FloatArray,
    end: FloatArray,
    end_spread: FloatArray,
    gate: float,
) -> tuple[FloatArray | None, float]:
    """Find the likeliest path between two known ends.

    `odometry` leads to the N nodes of the gap. `forward` (N - 1, 6) is where it leads from the
    first node, whose covariance is `spread` (6, 6). `end` (3,) is the pose at the last node, with
    `end_spread` (3, 3). Beyond the `gate`, a squared normalised distance of the end, odometry is
    taken to err more in this gap than elsewhere.

    Returns states (N, 6) from the gap's begin to its end, whose headings have no jumps, or None if
    more than one number of whole turns may be, or none explains the end; and by how much odometry's
    variances had to be raised to explain it, 1 or more.
    """
    looser = 1.0
    for _ in range(_MOST_LOOSENINGS):
        tried = []
        for turns in range(-_MOST_TURNS, _MOST_TURNS + 1):
            start = _bent(odometry.controls, forward, end, turns)
            loose = odometry._replace(variances=looser * odometry.variances)
            found = _likeliest(loose, start, forward[0], spread, end_spread)
            if found is not None:
                tried.append(found)
        if not tried:
            looser *= _WHERE_NONE_SETTLES
            continue
        tried.sort(key=lambda one: one[0])
        surprise, squared, path = tried[0]
        if squared <= gate:
            clear = len(tried) == 1 or tried[1][0] - surprise >= _CLEAR_LEAD
            return (path if clear else None), looser
        looser *= max(squared / POSE, 1.5)
    return None, looser


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
    odometry: Odometry,
    path: FloatArray,
    begin: FloatArray,
    spread: FloatArray,
    end_spread: FloatArray,
) -> tuple[float, float, FloatArray] | None:
    """Surprise, squared distance of the end and states, by Gauss-Newton steps, if they settle."""
    count = len(path)
    measured = MeasuredPoses(
        np.array([count - 1]), path[-1:, :POSE].copy(), end_spread[None].copy()
    )
    history = empty_history(count)
    for _ in range(_MOST_STEPS):
        account = filter_forward(odometry, begin, spread, measured, _no_gate(count), path, history)
        better, _ = smooth_backward(history)
        moved = float(np.max(np.abs(better[:, 2] - path[:, 2])))
        path = better
        if not moved < 10.0 * math.pi:
            return None
        if moved < _SETTLED_RAD:
            return account.surprise, float(account.squared[0]), path
    return None


def _no_gate(nodes: int) -> Gating:
    """Accept everything."""
    return Gating(math.inf, 1, np.ones(POSE), math.inf, np.zeros(nodes, dtype=np.bool_))


def back_from(
    odometry: Odometry, end: FloatArray, end_spread: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """States (N, 6) and covariances (N, 6, 6) predicted backward by odometry from a gap's end.

    `end` (6,) and `end_spread` (6, 6) are those at the last of the N nodes.
    """
    controls, variances = odometry
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


_RESTART_AFTER = 40
_RESTART_VARIANCES = np.array([25.0, 25.0, math.pi**2])
# Of the heading (rad^2): beyond it, derivatives at the heading expected say nothing of others.
_LOST_VARIANCE = 0.5**2
_RELINEARISATIONS = 1
_RELINEARISATIONS_WHERE_LOST = 3


@dataclass(frozen=True, eq=False)
class MovementProblem:
    """Odometry and measured poses on common nodes, whatever odometry errs at random."""

    times_s: FloatArray  # (N,): the nodes
    # (N, 4): odometry's movement to each node: way forward, way to the left (m) and turn (rad),
    # each summed up in the robot's turning frame; and the turn again where it is a distinct one,
    # else 0.
    controls: FloatArray
    # (N, 2): way (m) and turn (rad) that it may have made besides, where odometry pauses
    unseen: FloatArray
    measured: MeasuredPoses
    streams: NDArray[np.str_]  # (M,): their streams
    repaired: dict[str, int]  # Covariances that had to be raised, by stream
    settings: FuseSettings

    @property
    def measured_s(self) -> FloatArray:
        """(M,) times of the measurements."""
        return self.times_s[self.measured.nodes]

    def shortened(self, count: int) -> MovementProblem:
        """The contiguous nodes, at most `count`, that have the most measurements."""
        if len(self.times_s) <= count:
            return self
        nodes = self.measured.nodes
        begins = nodes[nodes + count <= len(self.times_s)]
        if len(begins) == 0:
            begins = np.array([len(self.times_s) - count], dtype=np.int64)
        held = np.searchsorted(nodes, begins + count) - np.searchsorted(nodes, begins)
        begin = int(begins[int(np.argmax(held))])
        return self._part(begin, begin + count)

    def _part(self, begin: int, end: int) -> MovementProblem:
        nodes = self.measured.nodes
        some = self.with_only((nodes >= begin) & (nodes < end))
        return replace(
            some,
            times_s=self.times_s[begin:end],
            controls=self.controls[begin:end],
            unseen=self.unseen[begin:end],
            measured=some.measured._replace(nodes=some.measured.nodes - begin),
        )

    def split(self, longest_s: float) -> list[MovementProblem]:
        """The parts between which nothing was measured for longer than this, without the gaps."""
        cuts = np.flatnonzero(np.diff(self.measured_s) > longest_s) + 1
        return [
            self._part(int(own[0]), int(own[-1]) + 1) for own in np.split(self.measured.nodes, cuts)
        ]

    def account(
        self, noise: FloatArray, systematic: tuple[FloatArray, FloatArray] | None = None
    ) -> MeasurementAccount:
        """How a forward-only filter uses the measurements.

        It begins with the given means and deviations of odometry's systematic errors, by default
        with those of the settings.
        """
        return self._forward(self._variances(noise), systematic=systematic)

    def thinned(self, spacing_s: float) -> MovementProblem:
        """With no measurement sooner than this after the one before."""
        kept = np.zeros(len(self.streams), dtype=np.bool_)
        last = -np.inf
        for i, time in enumerate(self.measured_s):
            if time - last >= spacing_s:
                kept[i] = True
                last = time
        return self.with_only(kept)

    def with_only(self, kept: BoolArray) -> MovementProblem:
        """With some of its measurements."""
        nodes, poses, covariances = self.measured
        measured = MeasuredPoses(nodes[kept], poses[kept], covariances[kept])
        return replace(self, measured=measured, streams=self.streams[kept])

    def filtered(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States (N, 6) and covariances (N, 6, 6) by the filter alone: from what was before."""
        history = empty_history(len(self.times_s))
        self._forward(self._variances(noise), history=history)
        return history.filtered, history.filtered_covariance

    def smooth(
        self, noise: FloatArray, looser_in_gaps: float = 1.0
    ) -> tuple[FloatArray, FloatArray, MeasurementAccount]:
        """Smoothed states, their covariances, and what became of the measurements.

        `noise` (4,): odometry's random errors, see `redetect.groundtruth.fusion.inputs.noise_of`.
        `looser_in_gaps`: factor on the variances they make where nothing is measured. Returns
        `states`, `covariances` (N, 6), (N, 6, 6).
        """
        variances = self._variances(noise)
        as_sampled = variances.copy()
        nodes = self.measured.nodes
        after = np.flatnonzero(np.diff(self.measured_s) > UNMEASURED_S)
        for begin, end in zip(nodes[after], nodes[after + 1]):
            variances[begin + 1 : end + 1] *= looser_in_gaps
        history = empty_history(len(self.times_s))
        cuts = np.zeros(len(self.times_s), dtype=np.bool_)
        while True:
            account = self._forward(variances, cuts=cuts, history=history)
            unfit = self._ends_that_did_not_fit(account)
            if not unfit:
                break
            cuts[unfit] = True
        states, covariances = smooth_backward(history)
        good = nodes[account.accepted]
        # The nodes of the last measurement before, and the first one after, gaps that are too long.
        gaps = [
            (int(good[np.searchsorted(good, end) - 1]), int(end))
            for end in np.flatnonzero(account.restarted == WHERE_LOST)
        ]
        points = states.copy()
        cuts[:] = False
        for begin, end in gaps:
            cuts[end], looser = self._bridge(begin, end, as_sampled, points, covariances)
            variances[begin + 1 : end + 1] *= max(1.0, looser / looser_in_gaps)
        # Again, linearised along the smoothed path: where a gap was bridged, the filter alone was
        # too far off on its way for its derivatives to hold.
        for _ in range(_RELINEARISATIONS + (_RELINEARISATIONS_WHERE_LOST if gaps else 0)):
            account = self._forward(variances, points, cuts, history)
            states, covariances = smooth_backward(history)
            points = states.copy()
        for begin, end in gaps:
            if cuts[end]:
                self._anchor(begin, end, variances, states, covariances)
        return states, covariances, account

    def _ends_that_did_not_fit(self, account: MeasurementAccount) -> list[int]:
        """Nodes after gaps where those rejections began that made the filter restart."""
        nodes, times_s = self.measured.nodes, self.measured_s
        found = []
        for node in np.flatnonzero(account.restarted == AFTER_REJECTIONS):
            first = int(np.searchsorted(nodes, node))
            while first > 0 and not account.accepted[first - 1]:
                first -= 1
            if first > 0 and times_s[first] - times_s[first - 1] > UNMEASURED_S:
                found.append(int(nodes[first]))
        return found

    def _bridge(
        self,
        begin: int,
        end: int,
        variances: FloatArray,
        points: FloatArray,
        covariances: FloatArray,
    ) -> tuple[bool, float]:
        """Bridge a gap that was cut with points, if possible; else it stays cut.

        The number of whole turns by which headings differ is that with the least noise. Returns
        whether it stays cut, and by how much odometry's variances are to be raised in it.
        """
        gap = slice(begin, end + 1)
        path, looser = bridge(
            Odometry(self.controls[gap], variances[gap]),
            points[begin:end],
            covariances[begin],
            points[end, :POSE],
            covariances[end, :POSE, :POSE],
            self.gate(),
        )
        if path is None:
            return True, looser
        points[begin:end] = path[:-1]
        # Whole turns, so that headings continue without a jump.
        turns = np.round((path[-1, 2] - points[end, 2]) / (2.0 * math.pi))
        points[end:, 2] += 2.0 * math.pi * turns
        return False, looser

    def _anchor(
        self,
        begin: int,
        end: int,
        variances: FloatArray,
        states: FloatArray,
        covariances: FloatArray,
    ) -> None:
        """Determine the second half of a gap that was cut from the measurements after it."""
        gap = slice(begin, end + 1)
        back, spreads = back_from(
            Odometry(self.controls[gap], variances[gap]), states[end], covariances[end]
        )
        way = np.cumsum(np.hypot(self.controls[gap, 0], self.controls[gap, 1]))
        half = int(np.searchsorted(way, 0.5 * (way[0] + way[-1]))) + 1
        states[begin + half : end] = back[half:-1]
        covariances[begin + half : end] = spreads[half:-1]

    def gate(self) -> float:
        """Largest squared normalised innovation."""
        return float(chdtri(POSE, 1.0 - self.settings.gate_probability))

    def _variances(self, noise: FloatArray) -> FloatArray:
        """(N, 3) noise of movements to nodes: along the way, across it (m^2), of the turn (rad^2).

        `noise` (4,): see `redetect.groundtruth.fusion.inputs.noise_of`. All of it is proportional
        to way, turn and time, so that it adds up over parts of a movement; but for what pauses
        hide: there odometry's systematic bend has a way to act on that is not known, and what a
        wrong heading leads aside is taken to be that of a way out and back.
        """
        along, across, by_turn, by_way = np.square(noise)
        way, turn = np.hypot(self.controls[:, 0], self.controls[:, 1]), np.abs(self.controls[:, 2])
        passed = np.concatenate([[0.0], np.diff(self.times_s)])
        hidden_way, hidden_turn = self.unseen.T
        bend = np.square(self.settings.turn_bias_per_metre_sigma * hidden_way)
        hidden = by_turn * hidden_turn + by_way * hidden_way + bend
        aside = hidden * hidden_way**2 / 12.0 + CREEP_M2_PER_S * passed
        rest = by_turn * turn + by_way * way + hidden + CREEP_RAD2_PER_S * passed
        way = way + hidden_way
        return np.column_stack([along * way + aside, across * way + aside, rest])

    def _forward(
        self,
        variances: FloatArray,
        points: FloatArray | None = None,
        cuts: BoolArray | None = None,
        history: FilterHistory | None = None,
        systematic: tuple[FloatArray, FloatArray] | None = None,
    ) -> MeasurementAccount:
        means, deviations = systematic or (np.zeros(3), systematic_sigmas(self.settings))
        return filter_forward(
            Odometry(self.controls, variances),
            np.concatenate([self.measured.poses[0], means]),
            np.diag(np.concatenate([_RESTART_VARIANCES, np.square(deviations)])),
            self.measured,
            Gating(
                self.gate(),
                _RESTART_AFTER,
                _RESTART_VARIANCES,
                _LOST_VARIANCE if points is None else math.inf,
                np.zeros(len(self.times_s), dtype=np.bool_) if cuts is None else cuts,
            ),
            np.empty((1, STATE)) if points is None else points,
            empty_history(0) if history is None else history,
        )


def movement_problem(
    odometry: PlanarPoses, streams: Mapping[str, PlanarPoses], settings: FuseSettings
) -> MovementProblem:
    """Bring odometry and measured poses with covariances to common nodes.

    From the first measurement within the odometry's time to the last, on the measurements' clock.
    """
    names, times, measured, covariances, repaired = gather(odometry, streams)
    odometry = last_of_each_time(odometry)
    inside = odometry.times_s[odometry.during(times[0], times[-1])]
    node_times = np.union1d(inside, times)
    controls, unseen = movements(odometry, node_times, settings)
    return MovementProblem(
        times_s=node_times,
        controls=controls,
        unseen=unseen,
        measured=MeasuredPoses(
            np.searchsorted(node_times, times).astype(np.int64), measured, covariances
        ),
        streams=names,
        repaired=repaired,
        settings=settings,
    )
