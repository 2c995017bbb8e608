"""Logs of a robot's motion, and runs made from them and from what was seen meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks.axes import covariance_from_dataset, to_dataset
from redetect.plane import between, chain_steps, compose
from redetect.slam.errors import SlamError
from redetect.slam.recording import ASSUMED, CircleRows, LineRows, Recording

# A log has a gap if nothing is logged for this many of its usual intervals, and this time.
_GAP_INTERVALS, _LEAST_GAP_S = 10.0, 0.5
#: Standard deviations of uncalibrated ranges (m) and bearings (rad).
RAW_SIGMA_M, RAW_SIGMA_RAD = 0.1, 0.03


class MotionLog(NamedTuple):
    """What a robot logged of its motion; each row holds until the next."""

    times: FloatArray  # (k,): of the rows (s), ascending
    #: Movements (n, 3), X forward, by rows (n,) that hold for some seconds (n,)
    along: Callable[[IntArray, FloatArray], FloatArray]
    late_s: float = 0.0  # standard deviation of the time at which the motion changes

    def poses(self, times: FloatArray) -> FloatArray:
        """Dead reckoning (n, 3) at some times (n,): the first row's pose is the origin."""
        rows, since = self._held(times)
        interval = np.diff(self.times)
        poses = chain_steps(self.along(np.arange(len(interval)), interval))
        return compose(poses[rows], self.along(rows, since))

    def steps(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Movements (N, 3) between times (N + 1,).

        Those in gaps of the log, before and after it, or with a change of motion, are more
        uncertain than odometry is assumed to be and have a covariance (N, 3, 3); others zero.
        """
        poses, (rows, since) = self.poses(times), self._held(times)
        steps = between(poses[:-1], poses[1:])
        interval = np.append(np.diff(self.times), math.inf)
        gap = interval > max(_GAP_INTERVALS * float(np.median(interval)), _LEAST_GAP_S)
        silence_s = np.concatenate([[0.0], np.cumsum(np.where(gap, interval, 0.0)[:-1])])
        early_s = np.minimum(times - self.times[0] + _LEAST_GAP_S, 0.0)
        silent_s = np.diff(early_s + silence_s[rows] + since * gap[rows])[:, None]
        rates = self.along(np.arange(len(gap)), np.ones(len(gap)))
        # Before the first row there is no motion.
        late = self.late_s * np.diff(rates[rows] * (times >= self.times[0])[:, None], axis=0)
        more = silent_s**2 * np.var(rates, axis=0) + late**2
        usual = ASSUMED.covariance(steps)
        stated = np.any(more > np.diagonal(usual, axis1=1, axis2=2), axis=1)
        return steps, (usual + more[:, None] * np.eye(3)) * stated[:, None, None]

    def _held(self, times: FloatArray) -> tuple[IntArray, FloatArray]:
        """The rows (n,) that hold at some times, and since how many seconds; 0 before the first."""
        rows = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, None)
        return rows, np.maximum(times - self.times[rows], 0.0)


def names_of(times: FloatArray) -> tuple[str, ...]:
    """Names of frames: their times (s)."""
    return tuple(f"{time:.3f}" for time in times)


def run_of(
    times: FloatArray, steps: FloatArray, covariance: FloatArray, rows: CircleRows
) -> Recording:
    """A run of movements (N, 3), X forward, before frames at some times (N,)."""
    spread = covariance_from_dataset(covariance, back=True)
    return Recording(names_of(times), to_dataset(steps), spread, rows, LineRows.of())


def demand_order(path: Path, times: FloatArray, slack: float = 0.0) -> None:
    """Raise `SlamError` if times go back by more than some slack."""
    for k in np.flatnonzero(np.diff(times) < -slack)[:1]:
        found = f"{times[k + 1]:.3f} follows {times[k]:.3f}"
        raise SlamError(f"{path}: {found}: expected ascending times")


def demand_common_times(one: Path, first: FloatArray, other: Path, second: FloatArray) -> None:
    """Raise `SlamError` unless the times in two files, in order, overlap."""
    parts = [f"{t[0]:.3f} to {t[-1]:.3f}" if len(t) else "none" for t in (first, second)]
    if "none" in parts or max(first[0], second[0]) > min(first[-1], second[-1]):
        raise SlamError(f"{one}: times {parts[0]}, {other.name}: {parts[1]}: expected common ones")
