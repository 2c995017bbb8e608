"""A robot that turns this way and that, seen by two clocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.trajectories.streams import PlanarPoses
from tools.simulator.laser.motion import RobotClock

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Clocks:
    """What to simulate: the robot's clock is ``t + offset + drift (t - middle)``."""

    offset_s: float = 0.237
    drift: float = 1.5e-4
    angle_rad: float = 2.9
    length_s: float = 60.0
    start_s: float = 0.0
    truth_rate_hz: float = 25.0
    truth_sigma_rad: float = 0.0026
    walk: float = 0.003
    jump_at_s: float = float("inf")
    jump_s: float = 0.0
    turns: bool = True


def simulate(clocks: Clocks, seed: int) -> tuple[PlanarPoses, PlanarPoses]:
    """Odometry on the robot's clock and ground truth on its own."""
    rng = np.random.default_rng(seed)
    fine = clocks.start_s + np.arange(-5.0, clocks.length_s + 5.0, 0.002)
    turning = np.zeros_like(fine)
    for _ in range(4 if clocks.turns else 0):
        turning += rng.uniform(0.1, 0.35) * np.sin(
            2 * np.pi * rng.uniform(0.03, 0.2) * fine + rng.uniform(0, 2 * np.pi)
        )
    heading = np.cumsum(turning) * 0.002
    times = clocks.start_s + np.arange(0.0, clocks.length_s, 1.0 / clocks.truth_rate_hz)
    truth = np.interp(times, fine, heading) + rng.normal(0, clocks.truth_sigma_rad, len(times))
    odometry_times = clocks.start_s + np.arange(-3.0, clocks.length_s + 3.0, 0.02)
    own = np.interp(odometry_times, fine, heading)
    turned = np.abs(np.diff(own, prepend=own[0]))
    own += np.cumsum(rng.normal(0, 1, len(own)) * clocks.walk * np.sqrt(turned))
    middle = clocks.start_s + clocks.length_s / 2
    clock = RobotClock(middle, clocks.offset_s, clocks.drift, clocks.jump_at_s, clocks.jump_s)
    return (
        headings_only(clock.robot_times(odometry_times), own - clocks.angle_rad),
        headings_only(times, truth),
    )


def headings_only(times_s: FloatArray, headings: FloatArray) -> PlanarPoses:
    """Poses at the origin, headings wrapped as in real files."""
    wrapped = np.angle(np.exp(1j * headings))
    return PlanarPoses(times_s, np.column_stack([0 * times_s, 0 * times_s, wrapped]))


def joined(parts: list[PlanarPoses]) -> PlanarPoses:
    """Streams one after the other."""
    return PlanarPoses(
        np.concatenate([part.times_s for part in parts]),
        np.concatenate([part.poses for part in parts]),
    )
