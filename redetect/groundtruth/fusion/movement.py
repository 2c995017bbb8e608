"""Odometry as control and measured poses: their joint likelihood, and the smoothed path.

Over a long path without measurements odometry's heading drifts so far that derivatives along the
filter's own path are invalid for the true one. So filter and smoother are repeated, linearised
along the smoothed path, until it converges (Gauss-Newton steps). Headings are known up to full
turns: if odometry could have drifted by that much, or does not explain the other end of a gap, the
two sides are not connected. Such a gap is cut in the middle, and each half follows odometry from
its own end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.fusion import inputs, kernels
from redetect.groundtruth.fusion.slips import UNMEASURED_S, slip_variances
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses, last_of_each_time
from redetect.plane import pose_differences

# Predictions of odometry over seconds are between measurements this far apart, or farther.
_SPACING_S = 2.0
_TURN_PER_METRE = 4
# The filter restarts with these variances.
_RESTART_VARIANCES = np.array([25.0, 25.0, math.pi**2])
# Variance of the heading (rad^2) beyond which another number of full turns is possible.
_LOST_VARIANCE = 1.0
# Most linearisations of the smoother, and largest change of the headings at which they end.
_MOST_STEPS = 5
_SETTLED_RAD = 1e-3


def predicted_backward(
    odometry: kernels.Odometry, end: FloatArray, end_spread: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """States (N, 6) and covariances (N, 6, 6) predicted backward by odometry, from the last of N
    nodes with `end` (6,) and `end_spread` (6, 6).
    """
    controls, variances = odometry
    count = len(controls)
    # Backward in time, all rates change their signs; the turn per metre does so by itself.
    mirror = np.ones(kernels.STATE)
    mirror[_TURN_PER_METRE] = -1.0
    reverse = np.concatenate([np.zeros((1, 4)), -controls[:0:-1]])
    history = kernels.empty_history(count)
    uncut = np.zeros(count, dtype=np.bool_)
    kernels.filter_forward(
        kernels.Odometry(reverse, np.concatenate([np.zeros((1, 3)), variances[:0:-1]])),
        mirror * end,
        end_spread * mirror * mirror[:, None],
        kernels.MeasuredPoses(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3))),
        kernels.Gating(math.inf, 1, np.ones(kernels.POSE), math.inf, uncut),
        np.empty((1, kernels.STATE)),
        history,
    )
    states, spreads = history.filtered * mirror, history.filtered_covariance
    return states[::-1], (spreads * mirror * mirror[:, None])[::-1]


class Smoothed(NamedTuple):
    """The smoothed path of a movement problem with N nodes."""

    states: FloatArray  # (N, 6)
    covariances: FloatArray  # (N, 6, 6)
    innovations: kernels.Innovations


def _follow_from_end(
    smoothed: Smoothed, odometry: kernels.Odometry, begin: int, kidnapped: bool
) -> None:
    """In the second half of a gap that was cut, follow odometry from the measurements after it.

    In place; `odometry` is that of the gap's nodes from `begin` on. A robot that was `kidnapped`
    in the gap may have been anywhere along its path then, so covariances include the other end's
    path as a possibility.
    """
    count = len(odometry.controls)
    states, covariances = (v[begin : begin + count] for v in smoothed[:2])
    back, spreads = predicted_backward(odometry, states[-1], covariances[-1])
    driven = np.cumsum(np.hypot(odometry.controls[:, 0], odometry.controls[:, 1]))
    driven -= driven[0]
    half = int(np.searchsorted(driven, 0.5 * driven[-1])) + 1
    apart = pose_differences(back[1:-1, : kernels.POSE], states[1:-1, : kernels.POSE])
    states[half:-1], covariances[half:-1] = back[half:-1], spreads[half:-1]
    if kidnapped:
        share = np.minimum(driven, driven[-1] - driven)[1:-1] / max(driven[-1], 1e-9)
        other = share[:, None, None] * apart[:, :, None] * apart[:, None]
        covariances[1:-1, : kernels.POSE, : kernels.POSE] += other


@dataclass(frozen=True, eq=False)
class MovementProblem:
    """Odometry and measured poses on common nodes, independent of odometry's random errors."""

    times_s: FloatArray  # (N,): the nodes
    # (N, 4): odometry's movement to each node: distance forward, distance to the left (m) and turn
    # (rad), each accumulated in the robot's turning frame; and the turn again if it is a distinct
    # one, else 0.
    controls: FloatArray
    # (N, 4): more distance (m) and turn (rad) that pauses may hide, and, of a movement to a
    # measurement within a pause, additional variances (m^2, rad^2)
    unseen: FloatArray
    slips: FloatArray  # (N, 3): variances that are added to movements where odometry slipped
    measured: kernels.MeasuredPoses
    streams: NDArray[np.str_]  # (M,): their streams
    settings: FuseSettings
    restart_after: int = 40  # consecutive rejections after which the filter restarts

    @property
    def measured_s(self) -> FloatArray:
        """(M,) times of the measurements."""
        return self.times_s[self.measured.nodes]

    def shortened(self, count: int) -> MovementProblem:
        """The contiguous nodes, at most `count`, with the most measurements."""
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
            slips=self.slips[begin:end],
            measured=some.measured._replace(nodes=some.measured.nodes - begin),
        )

    def split(self, longest_s: float) -> list[MovementProblem]:
        """The parts between slips and gaps in the measurements longer than this, without these."""
        slipped = np.diff(np.cumsum(self.slips[:, 0])[self.measured.nodes]) > 0.0
        cuts = np.flatnonzero(slipped | (np.diff(self.measured_s) > longest_s)) + 1
        parts = np.split(self.measured.nodes, cuts)
        return [self._part(int(own[0]), int(own[-1]) + 1) for own in parts]

    def innovations(
        self, noise: FloatArray, systematic: tuple[FloatArray, FloatArray] | None = None
    ) -> kernels.Innovations:
        """Innovations of the measurements in a forward filter.

        `systematic`: initial means and deviations of systematic errors; by default the settings'.
        """
        return self.forward(self._variances(noise), systematic=systematic)

    def thinned(self) -> MovementProblem:
        """The problem with measurements two seconds apart, or farther."""
        kept, last = np.zeros(len(self.streams), dtype=np.bool_), -np.inf
        for i, time in enumerate(self.measured_s):
            if time - last >= _SPACING_S:
                kept[i] = True
                last = time
        return self.with_only(kept)

    def with_only(self, kept: BoolArray) -> MovementProblem:
        """The problem with some of its measurements."""
        nodes, poses, covariances = self.measured
        measured = kernels.MeasuredPoses(nodes[kept], poses[kept], covariances[kept])
        return replace(self, measured=measured, streams=self.streams[kept])

    def with_covariances(self, covariances: FloatArray) -> MovementProblem:
        """The problem with other covariances of its measurements."""
        return replace(self, measured=self.measured._replace(covariances=covariances))

    def with_slips(self, noise: FloatArray) -> MovementProblem:
        """The problem with the slips that are found with odometry's random errors `noise` (4,)."""
        return replace(self, slips=self.slips + slip_variances(self, self._variances(noise)))

    def filtered(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States (N, 6) and covariances (N, 6, 6) of the forward filter alone."""
        history = kernels.empty_history(len(self.times_s))
        self.forward(self._variances(noise), history=history)
        return history.filtered, history.filtered_covariance

    def smooth(self, noise: FloatArray, looser_in_gaps: float = 1.0) -> Smoothed:
        """Smoothed states, their covariances, and the use of the measurements.

        `noise` (4,): odometry's random errors, see `redetect.groundtruth.fusion.inputs.noise_of`.
        `looser_in_gaps`: factor on their variances where nothing is measured.
        """
        variances = self._variances(noise)
        nodes = self.measured.nodes
        after = np.flatnonzero(np.diff(self.measured_s) > UNMEASURED_S)
        for begin, end in zip(nodes[after], nodes[after + 1]):
            variances[begin + 1 : end + 1] *= looser_in_gaps
        history = kernels.empty_history(len(self.times_s))
        innovations, kidnapped = self._filtered_with_cuts(variances, history)
        states, covariances = kernels.smooth_backward(history)
        good = nodes[innovations.accepted]
        # The nodes of the last measurement before and the first one after each gap that was cut.
        gaps = [
            (int(good[np.searchsorted(good, end) - 1]), int(end))
            for end in np.flatnonzero(innovations.restarted == kernels.WHERE_LOST)
        ]
        cuts = kidnapped.copy()
        cuts[[end for _, end in gaps]] = True
        for _ in range(_MOST_STEPS):
            before = states
            innovations = self.forward(variances, before, cuts, history)
            states, covariances = kernels.smooth_backward(history)
            if np.max(np.abs(states[:, 2] - before[:, 2])) < _SETTLED_RAD:
                break
        smoothed = Smoothed(states, covariances, innovations)
        for begin, end in gaps:
            odometry = kernels.Odometry(self.controls[begin : end + 1], variances[begin : end + 1])
            _follow_from_end(smoothed, odometry, begin, bool(kidnapped[end]))
        return smoothed

    def _filtered_with_cuts(
        self, variances: FloatArray, history: kernels.FilterHistory
    ) -> tuple[kernels.Innovations, BoolArray]:
        """Filter forward, and where (N,) the robot was kidnapped: the path is cut there."""
        kidnapped = np.zeros(len(self.times_s), dtype=np.bool_)
        while True:
            innovations = self.forward(variances, cuts=kidnapped, history=history)
            unfit = self._ends_that_did_not_fit(innovations)
            if not unfit:
                return innovations, kidnapped
            kidnapped[unfit] = True

    def _ends_that_did_not_fit(self, innovations: kernels.Innovations) -> list[int]:
        """Nodes after gaps at which the rejections began that made the filter restart."""
        nodes, times_s = self.measured.nodes, self.measured_s
        found = []
        for node in np.flatnonzero(innovations.restarted == kernels.AFTER_REJECTIONS):
            first = int(np.searchsorted(nodes, node))
            while first > 0 and not innovations.accepted[first - 1]:
                first -= 1
            if first > 0 and times_s[first] - times_s[first - 1] > UNMEASURED_S:
                found.append(int(nodes[first]))
        return found

    def gate(self) -> float:
        """Largest squared normalised innovation."""
        return float(chdtri(kernels.POSE, 1.0 - self.settings.gate_probability))

    def _variances(self, noise: FloatArray) -> FloatArray:
        """(N, 3) noise of movements to nodes: along the path, across it (m^2), of the turn (rad^2).

        `noise` (4,): see `redetect.groundtruth.fusion.inputs.noise_of`. All of it is proportional
        to distance, turn and time, so that it adds up over parts of a movement, except in pauses:
        there odometry's systematic bend acts on an unknown path, and the lateral error of a wrong
        heading is assumed to be that of a path out and back.
        """
        along, across, by_turn, by_distance = np.square(noise)
        forward, left, turn = np.abs(self.controls[:, :3].T)
        distance = np.hypot(forward, left)
        passed = np.concatenate([[0.0], np.diff(self.times_s)])
        hidden_distance, hidden_turn, anywhere, any_turn = self.unseen.T
        bend = np.square(self.settings.turn_bias_per_metre_sigma * hidden_distance)
        hidden = by_turn * hidden_turn + by_distance * hidden_distance + bend
        aside = hidden * hidden_distance**2 / 12.0 + anywhere + inputs.CREEP_M2_PER_S * passed
        rest = by_turn * turn + by_distance * distance + hidden + inputs.CREEP_RAD2_PER_S * passed
        rest += any_turn
        distance = distance + hidden_distance
        return (
            np.column_stack([along * distance + aside, across * distance + aside, rest])
            + self.slips
        )

    def forward(
        self,
        variances: FloatArray,
        points: FloatArray | None = None,
        cuts: BoolArray | None = None,
        history: kernels.FilterHistory | None = None,
        systematic: tuple[FloatArray, FloatArray] | None = None,
    ) -> kernels.Innovations:
        """Innovations of a forward filter with variances (N, 3) of the movements to nodes."""
        means, deviations = systematic or (np.zeros(3), inputs.systematic_sigmas(self.settings))
        return kernels.filter_forward(
            kernels.Odometry(self.controls, variances),
            np.concatenate([self.measured.poses[0], means]),
            np.diag(np.concatenate([_RESTART_VARIANCES, np.square(deviations)])),
            self.measured,
            kernels.Gating(
                self.gate(),
                self.restart_after,
                _RESTART_VARIANCES,
                _LOST_VARIANCE if points is None else math.inf,
                np.zeros(len(self.times_s), dtype=np.bool_) if cuts is None else cuts,
            ),
            np.empty((1, kernels.STATE)) if points is None else points,
            kernels.empty_history(0) if history is None else history,
        )


def movement_problem(
    odometry: PlanarPoses,
    streams: Mapping[str, PlanarPoses],
    settings: FuseSettings,
    times_s: FloatArray | None = None,
) -> MovementProblem:
    """Combine odometry and measured poses with covariances on common nodes, from the first
    measurement within the odometry's time to the last.

    Odometry's nodes are at its own times, or at `times_s` (K,), which it covers.
    """
    found, names = inputs.measured_poses(odometry, streams)
    assert found.covariances is not None
    odometry = last_of_each_time(odometry)
    own_s = odometry.times_s if times_s is None else times_s
    inside = own_s[(own_s >= found.times_s[0]) & (own_s <= found.times_s[-1])]
    node_times = np.union1d(inside, found.times_s)
    controls, unseen = inputs.movements(odometry, node_times)
    nodes = np.searchsorted(node_times, found.times_s)
    return MovementProblem(
        times_s=node_times,
        controls=controls,
        unseen=unseen,
        slips=np.zeros((len(node_times), 3)),
        measured=kernels.MeasuredPoses(nodes, found.poses, found.covariances),
        streams=names,
        settings=settings,
    )
