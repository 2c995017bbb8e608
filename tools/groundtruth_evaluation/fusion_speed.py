"""How long the fusion of a long session takes, in processor time.

python -m tools.groundtruth_evaluation.fusion_speed --hours 1
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import tyro

from redetect.groundtruth.fusion.fuse import fuse
from redetect.groundtruth.trajectories.streams import PlanarPoses


@dataclass(frozen=True)
class FusionSpeed:
    """Fuse a made-up session and print the times.

    Parameters
    ----------
    hours : float
    odometry_hz : float
    laser_hz : float
    rounds : int
        The least of so many times counts; the first compiles.
    seed : int
    """

    hours: float = 1.0
    odometry_hz: float = 50.0
    laser_hz: float = 75.0
    rounds: int = 4
    seed: int = 1


def perform(options: FusionSpeed) -> int:
    """Fuse, and print how long it took."""
    rng = np.random.default_rng(options.seed)
    times = np.arange(0.0, 3600.0 * options.hours, 1.0 / options.odometry_hz)
    heading = np.cumsum(0.3 * np.sin(0.2 * times)) / options.odometry_hz
    step = 0.5 / options.odometry_hz
    path = np.column_stack(
        [np.cumsum(np.cos(heading)) * step, np.cumsum(np.sin(heading)) * step, heading]
    )
    seen = np.arange(0.0, times[-1] - 1.0, 1.0 / options.laser_hz)
    exact = np.column_stack([np.interp(seen, times, path[:, k]) for k in range(3)])
    laser = PlanarPoses(
        seen,
        exact + rng.normal(0.0, 0.01, exact.shape),
        np.broadcast_to(1e-4 * np.eye(3), (len(seen), 3, 3)).copy(),
    )
    spent = []
    for _ in range(options.rounds):
        begun = time.process_time()
        fusion = fuse(PlanarPoses(times, path), {"laser": laser})
        spent.append(time.process_time() - begun)
    print(
        f"{options.hours:g} h: {len(times)} steps of odometry, {len(laser)} poses of the laser, "
        f"{len(fusion.poses)} poses fused: {min(spent[1:] or spent):.2f} s of the processor "
        f"(median {np.median(spent[1:] or spent):.2f} s)"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(perform(tyro.cli(FusionSpeed, description=FusionSpeed.__doc__)))
