"""Fusion of odometry with ground truths: Kalman filter forward, smoothing backward (RAWSEEDS D2.1).

Odometry is the control, poses from laser and markers are the measurements. What odometry is off by
systematically (a share of turns and ways, a bend) is estimated along, since it is what decides how
far a gap can be bridged; how much it errs at random is what makes the measurements likeliest. The
nodes are the odometry's times and the measurements' own, between which odometry is interpolated
linearly; so no measurement is interpolated, which would count the same noise twice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from groundtruth.errors import GroundTruthError
from groundtruth.scoring import interpolate_poses, wrapped
from groundtruth.smoother_kernels import STATE, filter_forward, smooth_backward
from groundtruth.streams import RAWSEEDS_ROUNDING, PlanarPoses

FloatArray = NDArray[np.float64]

# A robot that stands still may yet be moved a little; without it, standing would make covariances
# that cannot be inverted.
_CREEP_M2_PER_S = (1e-4) ** 2
_CREEP_RAD2_PER_S = (1e-4) ** 2
_RESTART_AFTER = 40
_RESTART_VARIANCES = np.array([25.0, 25.0, math.pi**2])
# The factors on odometry's deviations that are tried, and over how many nodes.
_NOISE_FACTORS = (0.05, 20.0)
_MOST_NODES_TO_LEARN_FROM = 30_000
_LEARNING_ROUNDS = 2


_DEVIATIONS = (
    "distance_sigma",
    "turn_sigma",
    "turn_per_metre_sigma",
    "turn_scale_sigma",
    "turn_bias_per_metre_sigma",
    "distance_scale_sigma",
)


@dataclass(frozen=True)
class FuseSettings:
    """How odometry errs, and how far a measurement may be off.

    Parameters
    ----------
    distance_sigma : float
        Standard deviation of odometry's distance after a metre (m); it grows with the root.
    turn_sigma : float
        Standard deviation of its heading after turning a radian (rad).
    turn_per_metre_sigma : float
        The same after a metre driven (rad).
    learn_noise : bool
        Scale these deviations (distance's, and both of the heading together) by what makes the
        measurements likeliest; they only begin the search then.
    turn_scale_sigma, turn_bias_per_metre_sigma, distance_scale_sigma : float
        Standard deviations, before anything was measured, of what odometry is off by: the share of
        each turn, the turn per metre (rad), the share of each way.
    gate_probability : float
        Share of right poses that pass the gate.
    covariance_scale : dict of str to float
        Factors on the measurements' covariances, by the stream's name; others count as 1.

    Raises
    ------
    GroundTruthError
        If a number is not finite, negative, or no probability.
    """

    distance_sigma: float = 0.02
    turn_sigma: float = 0.02
    turn_per_metre_sigma: float = 0.01
    learn_noise: bool = True
    turn_scale_sigma: float = 0.03
    turn_bias_per_metre_sigma: float = 0.01
    distance_scale_sigma: float = 0.03
    gate_probability: float = 0.9999
    covariance_scale: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        for name in _DEVIATIONS:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise GroundTruthError(f"{name} is {value}: expected 0 or more")
        if not 0.0 < self.gate_probability < 1.0:
            raise GroundTruthError(
                f"gate_probability is {self.gate_probability}: expected between 0 and 1"
            )
        for name, value in (self.covariance_scale or {}).items():
            if not (math.isfinite(value) and value > 0.0):
                raise GroundTruthError(f"covariance scale of {name} is {value}: expected above 0")


@dataclass(frozen=True)
class Rejected:
    """A measurement that the gate kept out.

    Attributes
    ----------
    stream : str
        Whose it was.
    time_s : float
    squared_innovation : float
        Squared normalised distance from what was expected.
    """

    stream: str
    time_s: float
    squared_innovation: float


@dataclass(frozen=True)
class OdometryErrors:
    """What the measurements say of odometry.

    Attributes
    ----------
    turn_scale, turn_bias_per_metre, distance_scale : float
        By what share turns are longer than odometry says, the turn it misses per metre (rad), by
        what share ways are longer.
    turn_scale_sigma, turn_bias_per_metre_sigma, distance_scale_sigma : float
        Their standard deviations.
    distance_sigma, turn_sigma, turn_per_metre_sigma : float
        Its random errors, as in `FuseSettings`.
    """

    turn_scale: float
    turn_bias_per_metre: float
    distance_scale: float
    turn_scale_sigma: float
    turn_bias_per_metre_sigma: float
    distance_scale_sigma: float
    distance_sigma: float
    turn_sigma: float
    turn_per_metre_sigma: float


@dataclass(frozen=True, eq=False)
class Fusion:
    """The robot's path out of all streams.

    Attributes
    ----------
    poses : PlanarPoses
        At the odometry's times from the first measurement to the last, with covariances; headings
        within +-pi.
    rejected : tuple of Rejected
        In order of time.
    restarts_s : tuple of float
        When the filter began anew, since nothing of what was measured fitted any more.
    used : dict of str to int
        Measurements that went in, by stream.
    odometry : OdometryErrors
        What was learnt of it.
    repaired : dict of str to int
        Covariances that were not positive definite as written, by stream; they were raised by their
        file's rounding.
    """

    poses: PlanarPoses
    rejected: tuple[Rejected, ...]
    restarts_s: tuple[float, ...]
    used: dict[str, int]
    odometry: OdometryErrors
    repaired: dict[str, int]


def fuse(
    odometry: PlanarPoses,
    streams: Mapping[str, PlanarPoses],
    settings: FuseSettings | None = None,
) -> Fusion:
    """Fuse odometry with poses measured by other means.

    Parameters
    ----------
    odometry : PlanarPoses
        The robot's own poses, on the measurements' clock; only movements between them count.
    streams : mapping of str to PlanarPoses
        Measured poses with covariances, by name.
    settings : FuseSettings, optional

    Returns
    -------
    Fusion

    Raises
    ------
    GroundTruthError
        If there is no measurement within the odometry's time, a stream has no covariances, or one
        of them cannot be repaired.
    """
    chosen = settings or FuseSettings()
    names, times, measured, covariances, repaired = _gather(odometry, streams, chosen)
    first, last = float(times[0]), float(times[-1])
    inside = odometry.times_s[(odometry.times_s >= first) & (odometry.times_s <= last)]
    node_times = np.union1d(inside, times)
    path, _ = interpolate_poses(odometry, node_times)
    controls = _controls(path.poses)
    nodes = np.searchsorted(node_times, times).astype(np.int64)
    problem = _Problem(node_times, controls, nodes, measured, covariances, chosen)
    noise = _likeliest_noise(problem) if chosen.learn_noise else _noise_of(chosen)
    smoothed, spread, account = problem.smooth(noise)

    at = np.searchsorted(node_times, inside)
    poses = smoothed[at, :3]
    poses[:, 2] = wrapped(poses[:, 2])
    # Odometry's errors are constants: all that is known of them is known at the end.
    last_spread = np.sqrt(np.maximum(np.diagonal(spread[-1]), 0.0))
    return Fusion(
        poses=PlanarPoses(inside, poses, spread[at][:, :3, :3].copy()),
        rejected=tuple(
            Rejected(names[i], float(times[i]), float(account.squared[i]))
            for i in np.flatnonzero(~account.accepted)
        ),
        restarts_s=tuple(float(time) for time in node_times[account.restarted]),
        used={
            name: int(np.count_nonzero(account.accepted & (np.array(names) == name)))
            for name in streams
        },
        odometry=OdometryErrors(
            *(float(value) for value in smoothed[-1, 3:]),
            *(float(value) for value in last_spread[3:]),
            *(float(value) for value in noise),
        ),
        repaired=repaired,
    )


@dataclass(frozen=True, eq=False)
class _Account:
    """What became of the measurements."""

    squared: FloatArray
    accepted: NDArray[np.bool_]
    restarted: NDArray[np.bool_]
    surprise: float


@dataclass(frozen=True, eq=False)
class _Problem:
    """All that does not depend on how odometry errs at random."""

    times_s: FloatArray
    controls: FloatArray
    nodes: NDArray[np.int64]
    measured: FloatArray
    covariances: FloatArray
    settings: FuseSettings

    def shortened(self, count: int) -> _Problem:
        """The run of nodes with most measurements among them, of at most so many."""
        if len(self.times_s) <= count:
            return self
        begins = self.nodes[self.nodes + count <= len(self.times_s)]
        if len(begins) == 0:
            begins = np.array([len(self.times_s) - count], dtype=np.int64)
        held = np.searchsorted(self.nodes, begins + count) - np.searchsorted(self.nodes, begins)
        begin = int(begins[int(np.argmax(held))])
        here = (self.nodes >= begin) & (self.nodes < begin + count)
        return _Problem(
            self.times_s[begin : begin + count],
            self.controls[begin : begin + count],
            self.nodes[here] - begin,
            self.measured[here],
            self.covariances[here],
            self.settings,
        )

    def surprise(self, noise: FloatArray) -> float:
        """Minus twice the logarithm of the measurements' likelihood."""
        empty = np.empty((1, STATE)), np.empty((1, STATE, STATE))
        return self._forward(
            noise, False, empty[0], empty[1], empty[0], empty[1], empty[1]
        ).surprise

    def smooth(self, noise: FloatArray) -> tuple[FloatArray, FloatArray, _Account]:
        """Smoothed states, their covariances, and what became of the measurements."""
        count = len(self.times_s)
        predicted, filtered, smoothed = (np.empty((count, STATE)) for _ in range(3))
        spreads = [np.empty((count, STATE, STATE)) for _ in range(4)]
        account = self._forward(
            noise, True, predicted, spreads[0], filtered, spreads[1], spreads[2]
        )
        smooth_backward(
            predicted,
            spreads[0],
            filtered,
            spreads[1],
            spreads[2],
            account.restarted,
            smoothed,
            spreads[3],
        )
        return smoothed, spreads[3], account

    def _forward(
        self,
        noise: FloatArray,
        keep: bool,
        predicted: FloatArray,
        predicted_covariance: FloatArray,
        filtered: FloatArray,
        filtered_covariance: FloatArray,
        transitions: FloatArray,
    ) -> _Account:
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
        return _Account(squared, accepted, restarted, float(surprise))


def _noise_of(settings: FuseSettings) -> FloatArray:
    """Odometry's random errors: of a metre (m), of a radian (rad), of a metre (rad)."""
    return np.array([settings.distance_sigma, settings.turn_sigma, settings.turn_per_metre_sigma])


def _likeliest_noise(problem: _Problem) -> FloatArray:
    """Odometry's random errors that make the measurements likeliest, near those given."""
    some = problem.shortened(_MOST_NODES_TO_LEARN_FROM)
    given = _noise_of(problem.settings)
    logarithms = np.zeros(2)
    bounds = tuple(math.log(factor) for factor in _NOISE_FACTORS)

    def scaled(values: FloatArray) -> FloatArray:
        return np.asarray(given * np.exp(values[[0, 1, 1]]))

    for _ in range(_LEARNING_ROUNDS):
        for axis in (1, 0):

            def surprise(value: float, axis: int = axis) -> float:
                tried = logarithms.copy()
                tried[axis] = value
                return some.surprise(scaled(tried))

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


def _controls(path: FloatArray) -> FloatArray:
    """(N, 3) movements between nodes, in the robot's frame of the node before."""
    controls = np.zeros((len(path), 3))
    change = np.diff(path, axis=0)
    cos, sin = np.cos(path[:-1, 2]), np.sin(path[:-1, 2])
    controls[1:, 0] = cos * change[:, 0] + sin * change[:, 1]
    controls[1:, 1] = -sin * change[:, 0] + cos * change[:, 1]
    controls[1:, 2] = wrapped(change[:, 2])
    return controls


def _variances(times_s: FloatArray, controls: FloatArray, noise: FloatArray) -> FloatArray:
    """(N, 3) variances of movements, for odometry's random errors."""
    way = np.hypot(controls[:, 0], controls[:, 1])
    passed = np.concatenate([[0.0], np.diff(times_s)])
    variances = np.empty((len(times_s), 3))
    variances[:, 0] = variances[:, 1] = noise[0] ** 2 * way + _CREEP_M2_PER_S * passed
    variances[:, 2] = (
        noise[1] ** 2 * np.abs(controls[:, 2]) + noise[2] ** 2 * way + _CREEP_RAD2_PER_S * passed
    )
    return variances
