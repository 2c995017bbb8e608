"""A room, a robot and scanners whose rays are cast exactly, for tests of the laser's parts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.lasers.acquisition import fixed_scanners
from redetect.groundtruth.lasers.scanners import Robot, Scanner, Scans, write_scanners
from redetect.groundtruth.lasers.tracking_kernels import FixedScanners
from redetect.plane import apply
from tools.simulator.laser.measuring import cast_on_walls
from tools.simulator.laser.session_files import write_robot, write_scans

FloatArray = NDArray[np.float64]

ROOM = np.array(
    [
        [0.0, 0.0, 8.0, 0.0],
        [8.0, 0.0, 8.0, 6.0],
        [8.0, 6.0, 5.0, 6.0],
        [5.0, 6.0, 5.0, 5.5],
        [5.0, 5.5, 3.5, 5.5],
        [3.5, 5.5, 3.5, 6.0],
        [3.5, 6.0, 0.0, 6.0],
        [0.0, 6.0, 0.0, 0.0],
    ]
)

#: Box with cut front corners, and a plain one.
FRONTED = np.array([[-0.4, 0.3], [-0.4, -0.3], [0.2, -0.3], [0.3, -0.2], [0.3, 0.2], [0.2, 0.3]])
PLAIN = np.array([[-0.4, 0.3], [-0.4, -0.3], [0.3, -0.3], [0.3, 0.3]])

POSES = ((1.0, 0.1, 90.0), (7.9, 1.5, 180.0), (6.8, 5.9, -90.0), (0.1, 4.5, 0.0))


def scanner(
    name: str, pose: FloatArray, sigma_m: float = 0.01, max_range_m: float = 20.0
) -> Scanner:
    """181 beams over half a turn."""
    return Scanner(
        name, np.array(pose, dtype=np.float64), np.zeros((3, 3)), -np.pi / 2, np.pi / 180, 181,
        max_range_m, sigma_m,
    )  # fmt: skip


def four_scanners(sigma_m: float = 0.01) -> tuple[Scanner, ...]:
    """One at each wall."""
    return tuple(
        scanner(f"fixed{i}", np.array([x, y, np.radians(d)]), sigma_m)
        for i, (x, y, d) in enumerate(POSES)
    )


def sides(outline: FloatArray, pose: FloatArray) -> FloatArray:
    """(k, 4) sides of an outline at a pose."""
    corners = apply(pose, outline)
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


def cast(pose: FloatArray, angles_rad: FloatArray, segments: FloatArray) -> FloatArray:
    """Exact distances (m) along beams from a pose, infinite where no segment is met."""
    rays = np.column_stack([np.tile(pose[:2], (len(angles_rad), 1)), pose[2] + angles_rad])
    ranges = np.full(len(rays), np.inf)
    cast_on_walls(rays, segments, ranges)
    return ranges


def ranges_mm(
    one: Scanner, segments: FloatArray, rng: np.random.Generator | None = None,
    drop_outs: float = 0.0,
) -> NDArray[np.uint16]:  # fmt: skip
    """One scan of segments; with a generator, with the scanner's noise."""
    exact = cast(one.pose, one.angles_rad, segments)
    if rng is not None:
        exact = exact + rng.normal(0.0, one.sigma_m, exact.shape)
        exact = np.where(rng.random(exact.shape) < drop_outs, np.inf, exact)
    return np.where(exact < one.max_range_m, np.rint(1e3 * exact), 0.0).astype(np.uint16)


def record(
    scanners: tuple[Scanner, ...],
    path: Callable[[float], FloatArray | None],
    span_s: tuple[float, float],
    outline: FloatArray,
    seed: int,
    others: Callable[[float], FloatArray] | None = None,
    rate_hz: float = 75.0,
) -> list[Scans]:
    """Scans, each scanner with a phase of its own, of a robot on a path.

    `path` gives None where the robot is away; `others` gives segments of what else moves.
    """
    rng = np.random.default_rng(seed)
    scans = []
    for k, one in enumerate(scanners):
        times = np.arange(span_s[0] + 0.225 * k / rate_hz, span_s[1], 1.0 / rate_hz)
        rows = []
        for t in times.tolist():
            pose = path(t)
            things = [ROOM]
            if pose is not None:
                things.append(sides(outline, pose))
            if others is not None:
                things.append(others(t))
            rows.append(ranges_mm(one, np.vstack(things), rng, 0.005))
        scans.append(Scans(times, np.stack(rows)))
    return scans


def scans_of(
    one: Scanner, segments: FloatArray, rng: np.random.Generator, count: int = 50,
    drop_outs: float = 0.0,
) -> Scans:  # fmt: skip
    """Scans of segments at rest."""
    ranges = np.stack([ranges_mm(one, segments, rng, drop_outs) for _ in range(count)])
    return Scans(np.arange(count) / 75.0, ranges)


def empty_scans(scanners: tuple[Scanner, ...], seed: int, count: int = 150) -> list[Scans]:
    """Scans of the empty room."""
    rng = np.random.default_rng(seed)
    return [scans_of(one, ROOM, rng, count, 0.005) for one in scanners]


def tables_of(scanners: tuple[Scanner, ...]) -> FixedScanners:
    """What tracking needs of scanners that saw the empty room."""
    return fixed_scanners(scanners, empty_scans(scanners, 7))


def circle(t: float) -> FloatArray:
    """A pose on a circle of 1 m, driven forward at 0.5 m/s."""
    angle = 0.5 * t
    return np.array(
        [4.0 + np.cos(angle), 2.8 + np.sin(angle), (angle + np.pi) % (2 * np.pi) - 0.5 * np.pi]
    )


def write_session(
    folder: Path, scanners: tuple[Scanner, ...], scans: list[Scans], outline: FloatArray
) -> None:
    """The files that the commands read."""
    (folder / "empty").mkdir()
    write_scanners(folder / "scanners.json", scanners)
    write_robot(folder / "robot.json", Robot(outline, 1.0, 1.0))
    for one, seen, empty in zip(scanners, scans, empty_scans(scanners, 7)):
        write_scans(folder / f"{one.name}.scans.npz", seen)
        write_scans(folder / "empty" / f"{one.name}.scans.npz", empty)
