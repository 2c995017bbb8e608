"""The inputs of a fusion: settings, odometry as movements between nodes, measured poses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.plane import between, log_motion

#: Noise of a robot at rest, without which covariances would be singular.
CREEP_M2_PER_S = (1e-4) ** 2
CREEP_RAD2_PER_S = (1e-4) ** 2
# The turn scale applies to distinct turns only: more than this (rad) from a second before to a
# second after, some four standard deviations of wheels at 1 m/s. Smaller ones may be random errors
# of odometry, which measured headings contradict, so that the scale would be biased towards -1
# (regression dilution).
_DISTINCT_OVER_S = 1.0
_DISTINCT_RAD = 0.06
# Odometry pauses if samples are farther apart than both, in seconds and in usual intervals.
_PAUSE_S = 1.0
_PAUSE_INTERVALS = 10.0
# Possible motion in a pause: at this quantile of the rates over a second.
_USUAL_RATES_OVER_S = 1.0
_USUAL_RATES_QUANTILE = 0.9


def systematic_sigmas(settings: FuseSettings) -> FloatArray:
    """(3,) prior standard deviations of turn scale, turn per metre (rad) and distance scale."""
    s = settings
    return np.array([s.turn_scale_sigma, s.turn_bias_per_metre_sigma, s.distance_scale_sigma])


def noise_of(settings: FuseSettings) -> FloatArray:
    """Odometry's random errors: along a metre, across it (m), of a radian, of a metre (rad)."""
    s = settings
    return np.array([s.distance_sigma, s.lateral_sigma, s.turn_sigma, s.turn_per_metre_sigma])


def pauses_of(odometry: PlanarPoses) -> list[tuple[float, float]]:
    """Pauses of odometry, as the times of the samples before and after each.

    Only their total movement is known, not the path. No two samples may have the same time.
    """
    times = odometry.times_s
    return [(float(times[i]), float(times[i + 1])) for i in np.flatnonzero(_paused(times))]


def _paused(times_s: FloatArray) -> BoolArray:
    interval = np.diff(times_s)
    if len(interval) == 0:
        return np.zeros(0, dtype=np.bool_)
    return np.asarray(interval > max(_PAUSE_S, _PAUSE_INTERVALS * float(np.median(interval))))


def movements(odometry: PlanarPoses, node_times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Movements between nodes, each a share of an arc between two samples of odometry.

    `odometry` has two or more samples at distinct times; (N,) node times ascend within its time.
    Returns the controls (N, 4) of a `MovementProblem`, and its motion (N, 4) that is possible in
    pauses of odometry, at the robot's usual rates.
    """
    arcs = log_motion(between(odometry.poses[:-1], odometry.poses[1:]))
    distance, turn = np.hypot(arcs[:, 0], arcs[:, 1]), arcs[:, 2]
    turned, _ = _within(odometry.times_s, turn, _DISTINCT_OVER_S)
    distinct = np.where(np.abs(turned) > _DISTINCT_RAD, turn, 0.0)
    controls = np.column_stack([arcs, distinct])
    hidden = _unseen(odometry.times_s, distance, turn)
    last = len(odometry) - 2
    at = np.clip(np.searchsorted(odometry.times_s, node_times_s[:-1], side="right") - 1, 0, last)
    share = np.diff(node_times_s) / (odometry.times_s[at + 1] - odometry.times_s[at])
    share, first = share[:, None], np.zeros((1, 4))
    unseen = share * hidden[at]
    # What is not of the usual movement in a part of a pause is in the rest of it.
    unseen[:, 2:] = np.square(np.minimum(share, 1.0 - share) * hidden[at, 2:])
    return np.concatenate([first, share * controls[at]]), np.concatenate([first, unseen])


def with_interpolation_error(poses: PlanarPoses, odometry: PlanarPoses) -> PlanarPoses:
    """Measured poses with the error of interpolating odometry by arcs in their covariances.

    Between two samples it is that of a parabola, as speeds before and after them differ.
    `odometry` has two or more samples at distinct times; in its pauses nothing is added.
    """
    if poses.covariances is None or len(odometry) < 3:
        return poses
    passed = np.diff(odometry.times_s)
    rates = log_motion(between(odometry.poses[:-1], odometry.poses[1:])) / passed[:, None]
    changes = np.pad(np.square(np.diff(rates, axis=0)), ((1, 1), (0, 0)), mode="edge")
    # Squared deviations in the middle of each arc: along the path, across it, of the turn.
    middle = (0.125 * passed)[:, None] ** 2 * 0.5 * (changes[1:] + changes[:-1])
    middle[_paused(odometry.times_s)] = 0.0
    last = len(passed) - 1
    at = np.clip(np.searchsorted(odometry.times_s, poses.times_s, side="right") - 1, 0, last)
    share = np.clip((poses.times_s - odometry.times_s[at]) / passed[at], 0.0, 1.0)
    along, across, turn = (np.square(4.0 * share * (1.0 - share))[:, None] * middle[at]).T
    covariances = poses.covariances.copy()
    variances = np.column_stack([along + across, along + across, turn])
    np.einsum("kii->ki", covariances)[:] += variances  # in x and y alike: in any direction
    return PlanarPoses(poses.times_s, poses.poses, covariances)


def _within(times_s: FloatArray, steps: FloatArray, margin_s: float) -> tuple[FloatArray, ...]:
    """Sums of steps from a margin before each to a margin after it, and their durations."""
    from_s = np.maximum(times_s[:-1] - margin_s, times_s[0])
    to_s = np.minimum(times_s[1:] + margin_s, times_s[-1])
    total = np.concatenate([[0.0], np.cumsum(steps)])
    ends = (np.interp(at, times_s, total) for at in (to_s, from_s))
    return np.asarray(np.subtract(*ends)), to_s - from_s


def usual_rate(times_s: FloatArray, steps: FloatArray) -> float:
    """A robot's usual rate of steps (N - 1,) between samples, over a second, outside pauses."""
    total, passed = _within(times_s, steps, 0.5 * _USUAL_RATES_OVER_S)
    rates = (np.abs(total) / passed)[~_paused(times_s)]
    return float(np.quantile(rates, _USUAL_RATES_QUANTILE))


def _unseen(times_s: FloatArray, distance: FloatArray, turn: FloatArray) -> FloatArray:
    """(N - 1, 4) distance and turn that pauses may hide beyond the arcs over them; usual ones."""
    paused = _paused(times_s)
    hidden = np.zeros((len(distance), 4))
    if not np.any(paused) or np.all(paused):
        return hidden
    passed = np.diff(times_s)[paused]
    for column, steps in enumerate((distance, turn)):
        rate = usual_rate(times_s, steps)
        hidden[paused, column] = np.maximum(rate * passed - np.abs(steps[paused]), 0.0)
        hidden[paused, 2 + column] = rate * passed
    # Some odometry is written on change only: if all digits are equal, the robot was at rest.
    hidden[(distance == 0.0) & (turn == 0.0)] = 0.0
    return hidden


def measured_poses(
    odometry: PlanarPoses, streams: Mapping[str, PlanarPoses]
) -> tuple[PlanarPoses, NDArray[np.str_]]:
    """All measurements within the odometry's time, in order, and the stream of each (M,)."""
    found = []
    for name, stream in streams.items():
        inside = stream.only(stream.during(odometry.times_s[0], odometry.times_s[-1]))
        found.append((np.full(len(inside), name), inside.times_s, inside.poses, inside.covariances))
    names, times, poses, covariances = (np.concatenate(parts) for parts in zip(*found))
    if not len(names):
        raise GroundTruthError(
            "no measured pose within the odometry's time "
            f"({odometry.times_s[0]:.3f} s to {odometry.times_s[-1]:.3f} s)"
        )
    order = np.argsort(times, kind="stable")
    return PlanarPoses(times[order], poses[order], covariances[order]), names[order]
