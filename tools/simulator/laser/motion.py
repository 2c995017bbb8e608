"""The robot's path, and the readings of its odometry and clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from redetect.array_types import FloatArray
from tools.simulator.laser.settings import DrivingLimits, WheelErrors

_GRID_M = 0.002


@dataclass(frozen=True)
class Stop:
    """A place on the route where the robot stops."""

    distance_m: float
    length_s: float


class Route:
    """Poses over time, exact at any time."""

    def __init__(
        self, waypoints: FloatArray, stops: list[Stop], limits: DrivingLimits, start_s: float
    ) -> None:
        curve = Curve(waypoints)
        speed = np.minimum(
            limits.speed_m_s, limits.turn_rad_s / np.maximum(np.abs(curve.bend), 1e-9)
        )
        halts = [0.0, *(stop.distance_m for stop in stops), float(curve.arc_length[-1])]
        speed[np.searchsorted(curve.arc_length, halts).clip(0, len(speed) - 1)] = 0.0
        speed = _reachable(speed, np.diff(curve.arc_length), limits.acceleration_m_s2)
        # Speed changes linearly with time within a cell of the grid; two cells between stops.
        lengths = 2.0 * np.diff(curve.arc_length) / np.maximum(speed[1:] + speed[:-1], 1e-6)
        waits = np.zeros(len(speed))
        for stop in stops:
            waits[np.searchsorted(curve.arc_length, stop.distance_m)] += stop.length_s
        leave = np.concatenate([[0.0], np.cumsum(lengths + waits[1:])]) + start_s
        self._arrive, self._leave = leave - waits, leave
        self._curve, self._speed = curve, speed
        self.start_s, self.end_s = float(start_s), float(leave[-1])
        #: Begin and end of each stop.
        at = [int(np.searchsorted(curve.arc_length, stop.distance_m)) for stop in stops]
        self.stands = [(float(self._arrive[i]), float(self._leave[i])) for i in at]

    def poses(self, times_s: ArrayLike) -> FloatArray:
        """Poses x, y (m), theta (rad, continuous) at times; before and after, the ends'.
        `times_s` (N,); returns (N, 3).
        """
        times = np.clip(np.asarray(times_s, dtype=np.float64), self.start_s, self.end_s)
        cell = np.clip(np.searchsorted(self._leave, times, side="right") - 1, 0, None)
        cell = np.minimum(cell, len(self._leave) - 2)
        length = self._arrive[cell + 1] - self._leave[cell]
        passed = np.clip(times - self._leave[cell], 0.0, length)
        gain = (self._speed[cell + 1] - self._speed[cell]) / length
        distance = self._curve.arc_length[cell] + passed * (self._speed[cell] + 0.5 * gain * passed)
        return self._curve.poses(np.minimum(distance, self._curve.arc_length[cell + 1]))


class Curve:
    """A cubic spline through waypoints; `arc_length` (M,) and `bend` (M,) on a fine grid."""

    def __init__(self, waypoints: FloatArray, grid_m: float = _GRID_M) -> None:
        chords = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(waypoints, axis=0).T))])
        self._spline = CubicSpline(chords, waypoints, bc_type="natural")
        u = np.linspace(0.0, chords[-1], int(np.ceil(chords[-1] / grid_m)) + 1)
        rate = np.hypot(*self._spline(u, 1).T)
        steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(u)
        self._chords = chords
        self._u, self.arc_length = u, np.concatenate([[0.0], np.cumsum(steps)])
        # Straight pieces between the grid's points would make the speed jump.
        self._u_of_arc_length = CubicHermiteSpline(self.arc_length, u, 1.0 / rate)
        d1, d2 = self._spline(u, 1), self._spline(u, 2)
        self.bend = (d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]) / rate**3
        self._heading = np.unwrap(np.arctan2(d1[:, 1], d1[:, 0]))

    def arc_length_at(self, index: int) -> float:
        """Length of the curve from the start to a waypoint (m)."""
        return float(np.interp(self._chords[index], self._u, self.arc_length))

    def poses(self, distance_m: FloatArray) -> FloatArray:
        """(N, 3) poses at distances from the start; theta is the curve's direction, continuous."""
        u = self._u_of_arc_length(distance_m)
        d1 = self._spline(u, 1)
        near = np.interp(distance_m, self.arc_length, self._heading)
        theta = np.arctan2(d1[:, 1], d1[:, 0])
        theta += 2.0 * np.pi * np.rint((near - theta) / (2.0 * np.pi))
        return np.column_stack([self._spline(u), theta])


def _reachable(speed: FloatArray, steps: FloatArray, acceleration: float) -> FloatArray:
    """Reduce speeds until no acceleration is larger than allowed."""
    square = speed**2
    gain = 2.0 * acceleration * np.concatenate([[0.0], np.cumsum(steps)])
    # v_j^2 <= v_i^2 + 2 a |s_j - s_i| for all i: running minima from both sides.
    forward = np.minimum.accumulate(square - gain) + gain
    backward = np.minimum.accumulate((square + gain)[::-1])[::-1] - gain
    return np.asarray(np.sqrt(np.maximum(np.minimum(forward, backward), 0.0)))


def measured_path(poses: FloatArray, errors: WheelErrors, rng: np.random.Generator) -> FloatArray:
    """The path by odometry, beginning at 0, 0, 0. `poses` (N, 3); returns (N, 3)."""
    turn = np.diff(poses[:, 2])
    step = np.diff(poses[:, :2], axis=0)
    middle = poses[:-1, 2] + 0.5 * turn
    distance = np.cos(middle) * step[:, 0] + np.sin(middle) * step[:, 1]
    noise = rng.standard_normal((4, len(distance)))
    driven_m = errors.scale * distance + errors.sigma_m * np.sqrt(np.abs(distance)) * noise[0]
    turn_rad = errors.turn_scale * turn + errors.turn_per_m * distance
    turn_rad += errors.sigma_turn * np.sqrt(np.abs(turn)) * noise[1]
    turn_rad += errors.sigma_turn_per_m * np.sqrt(np.abs(distance)) * noise[2]
    theta = np.concatenate([[0.0], np.cumsum(turn_rad)])
    middle = 0.5 * (theta[1:] + theta[:-1])
    ahead = np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    aside = np.stack([-np.sin(middle), np.cos(middle)], axis=-1)
    side_m = errors.sigma_side_m * np.sqrt(np.abs(distance)) * noise[3]
    xy = np.cumsum(driven_m[:, None] * ahead + side_m[:, None] * aside, axis=0)
    return np.column_stack([np.vstack([np.zeros((1, 2)), xy]), theta])


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
        """Readings of the clock at times of the ground truth's clock."""
        times = np.asarray(times_s, dtype=np.float64)
        shown = times + self.offset_s + self.drift * (times - self.reference_s)
        return np.asarray(shown + np.where(times >= self.jump_at_s, self.jump_s, 0.0))

    def ticks(self, from_s: float, to_s: float, period_s: float, phase: float) -> FloatArray:
        """Times, on the ground truth's clock, of regular intervals of the robot's clock."""
        period = period_s / (1.0 + self.drift)
        count = max(int(np.floor((to_s - from_s) / period - phase)) + 1, 0)
        return np.asarray(from_s + period * (phase + np.arange(count)))


def ptpd_lines(
    clock: RobotClock, times_s: FloatArray, sigma_s: float, rng: np.random.Generator
) -> list[str]:
    """Debug messages of ptpd on the robot, with the reports' times. `times_s` (N,)."""
    offsets = clock.robot_times(times_s) - times_s + rng.normal(0.0, sigma_s, len(times_s))
    drifts = 1e9 * clock.drift + rng.normal(0.0, 300.0, len(times_s))
    lines = []
    for time, offset, drift in zip(times_s, offsets, drifts):
        nanoseconds = round(offset * 1e9)
        seconds = int(nanoseconds / 1e9)
        lines.append(
            f"{time:.6f} (ptpd debug) offset from master: {seconds:>10}s "
            f"{nanoseconds - seconds * 10**9:>11}ns"
        )
        lines.append(f"{time:.6f} (ptpd debug) observed drift: {round(drift):>10}")
    return lines
