"""Readings of a scanner: rays cast in the plane, and their errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba as nb
import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.groundtruth.lasers.scanners import Scanner, Scans
from redetect.plane import between, compose
from tools.simulator.laser.settings import ReadingErrors


@nb.njit(cache=True, error_model="numpy")
def cast_on_walls(rays: FloatArray, walls: FloatArray, ranges: FloatArray) -> None:
    """Shorten the ranges (B,) of rays x, y, direction (B, 3) to the nearest wall.
    `walls` (S, 4) are x1, y1, x2, y2.
    """
    for b in range(ranges.size):
        dx, dy = np.cos(rays[b, 2]), np.sin(rays[b, 2])
        for s in range(walls.shape[0]):
            ex, ey = walls[s, 2] - walls[s, 0], walls[s, 3] - walls[s, 1]
            rx, ry = walls[s, 0] - rays[b, 0], walls[s, 1] - rays[b, 1]
            across = dx * ey - dy * ex
            beside = rx * dy - ry * dx
            # Both ends are on the same side of the ray, or the wall is along it: then the ray
            # meets the neighbouring wall.
            if beside * (beside - across) > 0.0 or across == 0.0:
                continue
            distance = (rx * ey - ry * ex) / across
            if 0.0 < distance < ranges[b]:
                ranges[b] = distance


@nb.njit(cache=True, error_model="numpy")
def cast_on_discs(
    rays: FloatArray, discs: FloatArray, of_ray: IntArray, ranges: FloatArray
) -> None:
    """Shorten the ranges (B,) of rays (B, 3) to discs that move from scan to scan.
    `discs` (N, D, 3) are x, y, radius; `of_ray` (B,) is each ray's scan.
    """
    for b in range(ranges.size):
        dx, dy = np.cos(rays[b, 2]), np.sin(rays[b, 2])
        here = discs[of_ray[b]]
        for d in range(here.shape[0]):
            radius = here[d, 2]
            if radius <= 0.0:
                continue
            x, y = here[d, 0] - rays[b, 0], here[d, 1] - rays[b, 1]
            along = x * dx + y * dy
            across = x * dy - y * dx
            deep = radius * radius - across * across
            if deep > 0.0:
                distance = along - np.sqrt(deep)
                if 0.0 < distance < ranges[b]:
                    ranges[b] = distance


_AT_ONCE = 256
_EDGE_M = 0.1


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that a ray may meet."""

    walls: FloatArray  # (S, 4) Things at rest: x1, y1, x2, y2 (m).
    robot_poses: Callable[[FloatArray], FloatArray] | None
    """(N, 3) poses at times (s); None if the robot is absent or invisible."""
    sides: FloatArray  # (K, 4) Sides of the robot in its frame (m).
    legs: Callable[[FloatArray], FloatArray]  # (N, D, 3) x, y, radius of discs at times (m).


def true_ranges(
    scanner: Scanner,
    carrier: Callable[[FloatArray], FloatArray] | None,
    times_s: FloatArray,
    scene: Scene,
    sweep_s: float = 0.0,
) -> FloatArray:
    """Exact distances along all beams. `times_s` (N,); returns (N, readings)."""
    readings = scanner.readings
    share = np.arange(readings) / max(readings - 1, 1) - 0.5
    ranges = np.empty((len(times_s), readings))
    for first in range(0, len(times_s), _AT_ONCE):
        times = times_s[first : first + _AT_ONCE]
        count = len(times)
        of_ray = np.repeat(np.arange(count), readings)
        rays = np.tile(scanner.pose, (count * readings, 1))
        if carrier is not None:
            rays = compose(_of_rays(carrier, times, sweep_s, share), rays)
        rays[:, 2] += np.tile(scanner.angles_rad, count)
        distances = np.full(count * readings, np.inf)
        if carrier is None:
            cast_on_walls(rays[:readings], scene.walls, distances[:readings])
            distances = np.tile(distances[:readings], count)
        else:
            cast_on_walls(rays, scene.walls, distances)
        if scene.robot_poses is not None:
            robot = _of_rays(scene.robot_poses, times, sweep_s, share)
            cast_on_walls(between(robot, rays), scene.sides, distances)
        cast_on_discs(rays, scene.legs(times), of_ray, distances)
        ranges[first : first + count] = distances.reshape(count, readings)
    return ranges


def _of_rays(
    poses: Callable[[FloatArray], FloatArray], times: FloatArray, sweep_s: float, share: FloatArray
) -> FloatArray:
    """(N readings, 3) poses when each ray is sent, straight from the sweep's begin to its end."""
    if sweep_s == 0.0:
        return np.repeat(poses(times), len(share), axis=0)
    begin, end = poses(times - 0.5 * sweep_s), poses(times + 0.5 * sweep_s)
    weight = (share + 0.5)[:, None]
    each = begin[:, None] * (1.0 - weight) + end[:, None] * weight
    return np.asarray(each.reshape(-1, 3))


def measured(
    times_s: FloatArray,
    ranges_m: FloatArray,
    scanner: Scanner,
    errors: ReadingErrors,
    rng: np.random.Generator,
) -> Scans:
    """Exact distances as the scanner reports them. `times_s` (N,); `ranges_m` (N, readings)."""
    noisy = ranges_m.copy()
    near, far = ranges_m[:, :-1], ranges_m[:, 1:]
    with np.errstate(invalid="ignore"):
        edges = np.isfinite(near) & np.isfinite(far) & (np.abs(far - near) > _EDGE_M)
    mixed = edges & (rng.random(edges.shape) < errors.mixed)
    row, column = np.nonzero(mixed)
    weight = rng.random(len(row))
    beside = column + rng.integers(0, 2, len(row))
    noisy[row, beside] = (1.0 - weight) * near[mixed] + weight * far[mixed]
    noisy += rng.normal(0.0, errors.sigma_m, noisy.shape)
    noisy = errors.quantum_m * np.rint(noisy / errors.quantum_m)
    lost = rng.random(noisy.shape) < errors.dropouts
    none = (
        lost | ~(ranges_m < scanner.max_range_m) | ~(noisy > 0.0) | (noisy >= scanner.max_range_m)
    )
    ranges_mm = np.rint(1e3 * np.where(none, 0.0, noisy)).astype(np.uint16)
    kept = rng.random(len(times_s)) >= errors.lost_scans
    return Scans(times_s[kept], ranges_mm[kept])
