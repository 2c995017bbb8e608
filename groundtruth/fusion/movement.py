"""Odometry as control and measured poses: their likelihood together, and the smoothed path."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from groundtruth.errors import GroundTruthError
from groundtruth.fusion.motion_kernels import STATE
from groundtruth.fusion.settings import FuseSettings
from groundtruth.fusion.smoother_kernels import filter_forward, smooth_backward
from groundtruth.geometry.plane import between, log_motion
from groundtruth.trajectories.streams import RAWSEEDS_ROUNDING, PlanarPoses

FloatArray = NDArray[np.float64]

# A robot that stands still may yet be moved a little; without it, standing would make covariances
# that cannot be inverted.
_CREEP_M2_PER_S = (1e-4) ** 2
_CREEP_RAD2_PER_S = (1e-4) ** 2
# A turn is distinct if, from a second before to a second after, odometry turned by more than so
# many of its standard deviations.
_DISTINCT_OVER_S = 1.0
_DISTINCT_SIGMAS = 4.0
_RESTART_AFTER = 40
_RESTART_VARIANCES = np.array([25.0, 25.0, math.pi**2])
# The factors on odometry's deviations that are tried, and over how many nodes.
_NOISE_FACTORS = (0.01, 20.0)
_MOST_NODES_TO_LEARN_FROM = 30_000
_LONGEST_GAP_TO_LEARN_FROM_S = 20.0
_LEARNING_ROUNDS = 2
_RELINEARISATIONS = 1
_RELINEARISATIONS_WHERE_LOST = 3


@dataclass(frozen=True, eq=False)
class MeasurementAccount:
    """What became of the measurements.

    Attributes
    ----------
    squared : (M,) float64
        Squared normalised innovations.
    accepted : (M,) bool
    restarted : (N,) bool
        Nodes at which the filter began anew.
    surprise : float
        Minus twice the logarithm of their likelihood.
    """

    squared: FloatArray
    accepted: NDArray[np.bool_]
    restarted: NDArray[np.bool_]
    surprise: float


@dataclass(frozen=True, eq=False)
class MovementProblem:
    """Odometry and measured poses on common nodes, whatever odometry errs at random.

    Attributes
    ----------
    times_s : (N,) float64
        The nodes.
    controls : (N, 4) float64
        Odometry's movement to each node: way forward, way to the left (m) and turn (rad), each
        summed up in the robot's turning frame; and the turn again where it is a distinct one, else
        0.
    nodes : (M,) int64
        At which node each measurement was made, ascending.
    measured, covariances : (M, 3), (M, 3, 3) float64
        The measured poses.
    streams : tuple of M str
        Whose they are.
    repaired : dict of str to int
        Covariances that had to be raised, by stream.
    settings : FuseSettings
    """

    times_s: FloatArray
    controls: FloatArray
    nodes: NDArray[np.int64]
    measured: FloatArray
    covariances: FloatArray
    streams: tuple[str, ...]
    repaired: dict[str, int]
    settings: FuseSettings

    def shortened(self, count: int) -> MovementProblem:
        """The run of nodes with most measurements among them, of at most so many."""
        if len(self.times_s) <= count:
            return self
        begins = self.nodes[self.nodes + count <= len(self.times_s)]
        if len(begins) == 0:
            begins = np.array([len(self.times_s) - count], dtype=np.int64)
        held = np.searchsorted(self.nodes, begins + count) - np.searchsorted(self.nodes, begins)
        begin = int(begins[int(np.argmax(held))])
        return self._part(begin, begin + count)

    def _part(self, begin: int, end: int) -> MovementProblem:
        here = (self.nodes >= begin) & (self.nodes < end)
        return MovementProblem(
            self.times_s[begin:end],
            self.controls[begin:end],
            self.nodes[here] - begin,
            self.measured[here],
            self.covariances[here],
            tuple(self.streams[i] for i in np.flatnonzero(here)),
            self.repaired,
            self.settings,
        )

    def split(self, longest_s: float) -> list[MovementProblem]:
        """The parts between which nothing was measured for longer than this, without the gaps."""
        at = self.times_s[self.nodes]
        cuts = np.flatnonzero(np.diff(at) > longest_s) + 1
        return [
            self._part(int(self.nodes[own[0]]), int(self.nodes[own[-1]]) + 1)
            for own in np.split(np.arange(len(at)), cuts)
        ]

    def surprise(self, noise: FloatArray) -> float:
        """Minus twice the logarithm of the measurements' likelihood."""
        empty = np.empty((1, STATE)), np.empty((1, STATE, STATE))
        return self._forward(
            noise, empty[0], False, empty[0], empty[1], empty[0], empty[1], empty[1]
        ).surprise

    def smooth(self, noise: FloatArray) -> tuple[FloatArray, FloatArray, MeasurementAccount]:
        """Smoothed states, their covariances, and what became of the measurements."""
        count = len(self.times_s)
        predicted, filtered, smoothed = (np.empty((count, STATE)) for _ in range(3))
        spreads = [np.empty((count, STATE, STATE)) for _ in range(4)]
        points = np.empty((1, STATE))
        # Again, linearised along the smoothed path: where a gap was bridged, the filter alone was
        # too far off on its way for its derivatives to hold.
        passes = 1 + _RELINEARISATIONS
        while passes > 0:
            account = self._forward(
                noise, points, True, predicted, spreads[0], filtered, spreads[1], spreads[2]
            )
            smooth_backward(
                predicted, spreads[0], filtered, spreads[1], spreads[2], smoothed, spreads[3]
            )
            if len(points) == 1 and np.any(account.restarted):
                passes += _RELINEARISATIONS_WHERE_LOST
            points = smoothed.copy()
            passes -= 1
        return smoothed, spreads[3], account

    def _forward(
        self,
        noise: FloatArray,
        points: FloatArray,
        keep: bool,
        predicted: FloatArray,
        predicted_covariance: FloatArray,
        filtered: FloatArray,
        filtered_covariance: FloatArray,
        transitions: FloatArray,
    ) -> MeasurementAccount:
        systematic = (
            self.settings.turn_scale_sigma,
            self.settings.turn_bias_per_metre_sigma,
            self.settings.distance_scale_sigma,
        )
        squared = np.empty(len(self.nodes))
        accepted = np.empty(len(self.nodes), dtype=np.bool_)
        restarted = np.empty(len(self.times_s), dtype=np.bool_)
        surprise = filter_forward(
            self.controls,
            _variances(self.times_s, self.controls, noise),
            np.concatenate([self.measured[0], np.zeros(3)]),
            np.diag(np.concatenate([_RESTART_VARIANCES, np.square(systematic)])),
            self.nodes,
            self.measured,
            self.covariances,
            float(chi2.ppf(self.settings.gate_probability, 3)),
            _RESTART_AFTER,
            _RESTART_VARIANCES,
            points,
            keep,
            predicted,
            predicted_covariance,
            filtered,
            filtered_covariance,
            transitions,
            squared,
            accepted,
            restarted,
        )
        return MeasurementAccount(squared, accepted, restarted, float(surprise))


def movement_problem(
    odometry: PlanarPoses, streams: Mapping[str, PlanarPoses], settings: FuseSettings
) -> MovementProblem:
    """Bring odometry and measured poses to common nodes.

    Parameters
    ----------
    odometry : PlanarPoses
        On the measurements' clock.
    streams : mapping of str to PlanarPoses
        Measured poses with covariances, by name.
    settings : FuseSettings

    Returns
    -------
    MovementProblem
        From the first measurement within the odometry's time to the last.

    Raises
    ------
    GroundTruthError
        If there is no measurement within the odometry's time, a stream has no covariances, or one
        of them cannot be repaired.
    """
    names, times, measured, covariances, repaired = _gather(odometry, streams, settings)
    inside = odometry.times_s[(odometry.times_s >= times[0]) & (odometry.times_s <= times[-1])]
    node_times = np.union1d(inside, times)
    return MovementProblem(
        times_s=node_times,
        controls=_controls(odometry, node_times, settings),
        nodes=np.searchsorted(node_times, times).astype(np.int64),
        measured=measured,
        covariances=covariances,
        streams=tuple(names),
        repaired=repaired,
        settings=settings,
    )


def noise_of(settings: FuseSettings) -> FloatArray:
    """Odometry's random errors: along a metre, across it (m), of a radian, of a metre (rad)."""
    return np.array(
        [
            settings.distance_sigma,
            settings.lateral_sigma,
            settings.turn_sigma,
            settings.turn_per_metre_sigma,
        ]
    )


def likeliest_noise(problem: MovementProblem) -> FloatArray:
    """Odometry's random errors that make the measurements likeliest, near those given.

    Long gaps are left out: by their ends a filter that is linearised may be lost, and then no noise
    is likelier than another for what odometry did.
    """
    some = problem.shortened(_MOST_NODES_TO_LEARN_FROM).split(_LONGEST_GAP_TO_LEARN_FROM_S)
    given = noise_of(problem.settings)
    logarithms = np.zeros(3)
    bounds = tuple(math.log(factor) for factor in _NOISE_FACTORS)

    def scaled(values: FloatArray) -> FloatArray:
        return np.asarray(given * np.exp(values[[0, 1, 2, 2]]))

    for _ in range(_LEARNING_ROUNDS):
        for axis in (2, 0, 1):

            def surprise(value: float, axis: int = axis) -> float:
                tried = logarithms.copy()
                tried[axis] = value
                return sum(part.surprise(scaled(tried)) for part in some)

            found = minimize_scalar(
                surprise, bounds=bounds, method="bounded", options={"xatol": 0.05}
            )
            logarithms[axis] = float(found.x)
    return scaled(logarithms)


def _gather(
    odometry: PlanarPoses, streams: Mapping[str, PlanarPoses], settings: FuseSettings
) -> tuple[list[str], FloatArray, FloatArray, FloatArray, dict[str, int]]:
    """All measurements within the odometry's time, in order, with covariances that can be used."""
    names: list[str] = []
    times, poses, covariances = [], [], []
    repaired = {}
    for name, stream in streams.items():
        if stream.covariances is None:
            raise GroundTruthError(f"{name}: no covariances: expected t, x, y, theta and 9 more")
        inside = (stream.times_s >= odometry.times_s[0]) & (stream.times_s <= odometry.times_s[-1])
        usable, repaired[name] = _usable(name, stream.covariances[inside])
        scale = (settings.covariance_scale or {}).get(name, 1.0)
        names += [name] * int(np.count_nonzero(inside))
        times.append(stream.times_s[inside])
        poses.append(stream.poses[inside])
        covariances.append(usable * scale)
    if not names:
        raise GroundTruthError(
            "no measured pose within the odometry's time "
            f"({odometry.times_s[0]:.3f} s to {odometry.times_s[-1]:.3f} s)"
        )
    all_times = np.concatenate(times)
    order = np.argsort(all_times, kind="stable")
    return (
        [names[i] for i in order],
        all_times[order],
        np.concatenate(poses)[order],
        np.concatenate(covariances)[order],
        repaired,
    )


def _usable(name: str, covariances: FloatArray) -> tuple[FloatArray, int]:
    """Covariances made symmetric, and raised where a file's rounding made them singular."""
    symmetric = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    smallest = np.linalg.eigvalsh(symmetric)[:, 0]
    worst = float(smallest.min(initial=0.0))
    # Three entries of a row may each be off by the rounding.
    if worst < -3.0 * RAWSEEDS_ROUNDING:
        at = int(np.argmin(smallest))
        raise GroundTruthError(
            f"{name}: pose {at + 1} has a covariance with eigenvalue {worst:.3g}: expected none "
            "below what rounding to six decimals makes of 0"
        )
    weak = smallest <= RAWSEEDS_ROUNDING * 0.1
    symmetric[weak] += np.eye(3) * (
        RAWSEEDS_ROUNDING + np.maximum(0.0, -smallest[weak])[:, None, None]
    )
    return symmetric, int(np.count_nonzero(weak))


def _controls(
    odometry: PlanarPoses, node_times_s: FloatArray, settings: FuseSettings
) -> FloatArray:
    """(N, 4) movements between nodes: each a share of an arc between two samples of odometry."""
    arcs = log_motion(between(odometry.poses[:-1], odometry.poses[1:]))
    arcs = np.column_stack([arcs, np.where(_distinct(odometry, arcs, settings), arcs[:, 2], 0.0)])
    last = len(odometry) - 2
    at = np.clip(np.searchsorted(odometry.times_s, node_times_s[:-1], side="right") - 1, 0, last)
    share = np.diff(node_times_s) / (odometry.times_s[at + 1] - odometry.times_s[at])
    return np.concatenate([np.zeros((1, 4)), share[:, None] * arcs[at]])


def _distinct(odometry: PlanarPoses, arcs: FloatArray, settings: FuseSettings) -> NDArray[np.bool_]:
    """Between which samples the robot turned by more than odometry's random errors explain.

    Only there its turns tell by what share they are too long. Elsewhere, what looks like turns are
    those errors; and since they are just what measured headings contradict, the share would be
    drawn towards -1, whatever it is (regression dilution).
    """
    from_s = np.maximum(odometry.times_s[:-1] - _DISTINCT_OVER_S, odometry.times_s[0])
    to_s = np.minimum(odometry.times_s[1:] + _DISTINCT_OVER_S, odometry.times_s[-1])

    def within(steps: FloatArray) -> FloatArray:
        total = np.concatenate([[0.0], np.cumsum(steps)])
        ends = (np.interp(at, odometry.times_s, total) for at in (to_s, from_s))
        return np.asarray(np.subtract(*ends))

    turn = within(arcs[:, 2])
    variance = (
        settings.turn_sigma**2 * np.abs(turn)
        + settings.turn_per_metre_sigma**2 * within(np.hypot(arcs[:, 0], arcs[:, 1]))
        + _CREEP_RAD2_PER_S * (to_s - from_s)
    )
    return np.asarray(turn**2 > _DISTINCT_SIGMAS**2 * variance)


def _variances(times_s: FloatArray, controls: FloatArray, noise: FloatArray) -> FloatArray:
    """(N, 3) noise of movements, summed up: along the way, across it (m^2), of the turn (rad^2).

    All of it is proportional to way, turn and time, so that it adds up over parts of a movement.
    """
    along, across, by_turn, by_way = np.square(noise)
    way = np.hypot(controls[:, 0], controls[:, 1])
    passed = np.concatenate([[0.0], np.diff(times_s)])
    return np.column_stack(
        [
            along * way + _CREEP_M2_PER_S * passed,
            across * way + _CREEP_M2_PER_S * passed,
            by_turn * np.abs(controls[:, 2]) + by_way * way + _CREEP_RAD2_PER_S * passed,
        ]
    )
