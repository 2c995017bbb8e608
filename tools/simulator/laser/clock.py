"""The robot's clock, and what ptpd would report about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class RobotClock:
    """A clock that is off and goes at another rate, and may be set once.

    ``robot_time = time + offset_s + drift (time - reference_s)``, and from `jump_at_s` on `jump_s`
    more; `time` is that of the ground truth's clock.
    """

    reference_s: float
    offset_s: float
    drift: float
    jump_at_s: float = float("inf")
    jump_s: float = 0.0

    def robot_times(self, times_s: ArrayLike) -> FloatArray:
        """What the clock shows at times of the ground truth's clock."""
        times = np.asarray(times_s, dtype=np.float64)
        shown = times + self.offset_s + self.drift * (times - self.reference_s)
        return np.asarray(shown + np.where(times >= self.jump_at_s, self.jump_s, 0.0))

    def ticks(self, from_s: float, to_s: float, period_s: float, phase: float) -> FloatArray:
        """Times, on the ground truth's clock, of what the robot does in regular intervals.

        Parameters
        ----------
        from_s, to_s : float
            On the ground truth's clock.
        period_s : float
            By the robot's clock.
        phase : float
            When the first one happens, as a share of the period.
        """
        period = period_s / (1.0 + self.drift)
        count = max(int(np.floor((to_s - from_s) / period - phase)) + 1, 0)
        return np.asarray(from_s + period * (phase + np.arange(count)))


def ptpd_lines(
    clock: RobotClock, times_s: FloatArray, sigma_s: float, rng: np.random.Generator
) -> list[str]:
    """Debug messages of ptpd on the robot, with the reports' times.

    Parameters
    ----------
    clock : RobotClock
    times_s : (N,) float64
        When there is a report (ground truth's clock); the lines begin with it.
    sigma_s : float
        Noise of the reported offset (s): the network's delays.
    rng : numpy Generator

    Returns
    -------
    list of str
        ``offset from master`` in seconds and nanoseconds, ``observed drift`` in parts per billion.
    """
    offsets = clock.robot_times(times_s) - times_s + rng.normal(0.0, sigma_s, len(times_s))
    drifts = 1e9 * clock.drift + rng.normal(0.0, 300.0, len(times_s))
    lines = []
    for time, offset, drift in zip(times_s, offsets, drifts):
        nanoseconds = round(abs(offset) * 1e9)
        sign = "-" if offset < 0.0 else ""
        seconds, rest = divmod(nanoseconds, 10**9)
        lines.append(
            f"{time:.6f} (ptpd debug) offset from master: {_signed(sign, seconds):>10}s "
            f"{_signed(sign, rest):>11}ns"
        )
        lines.append(f"{time:.6f} (ptpd debug) observed drift: {round(drift):>10}")
    return lines


def _signed(sign: str, number: int) -> str:
    return f"{sign if number else ''}{number}"
