"""What a scanner measures: rays cast, and then everything that goes wrong with readings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.lasers.scanners import Scanner
from redetect.groundtruth.lasers.scans import Scans
from tools.simulator.laser.kernels import cast_on_discs, cast_on_robot, cast_on_walls
from tools.simulator.laser.settings import ReadingErrors

FloatArray = NDArray[np.float64]

_AT_ONCE = 256
_EDGE_M = 0.1


@dataclass(frozen=True, eq=False)
class Scene:
    """What there is to be hit.

    Attributes
    ----------
    walls : (S, 4) float64
        What stands still: x1, y1, x2, y2 (m).
    robot_poses : callable or None
        (N, 3) poses at times (s); None if the robot is not there, or not to be seen.
    sides : (K, 4) float64
        Sides of the robot in its frame (m).
    legs : callable
        (N, D, 3) x, y, radius of discs at times (m).
    """

    walls: FloatArray
    robot_poses: Callable[[FloatArray], FloatArray] | None
    sides: FloatArray
    legs: Callable[[FloatArray], FloatArray]


def true_ranges(
    scanner: Scanner,
    carrier: Callable[[FloatArray], FloatArray] | None,
    times_s: FloatArray,
    scene: Scene,
    sweep_s: float = 0.0,
) -> FloatArray:
    """Exact distances along all beams.

    Parameters
    ----------
    scanner : Scanner
        Its pose is in the world, or in the frame of its carrier.
    carrier : callable or None
        (N, 3) poses at times of what carries the scanner; None if it stands still.
    times_s : (N,) float64
        Times of the scans' middle beams.
    scene : Scene
    sweep_s : float
        From the first beam to the last; legs do not move within a scan.

    Returns
    -------
    (N, readings) float64
        Metres, infinite where nothing is hit.
    """
    readings = scanner.readings
    share = np.arange(readings) / max(readings - 1, 1) - 0.5
    ranges = np.empty((len(times_s), readings))
    for first in range(0, len(times_s), _AT_ONCE):
        times = times_s[first : first + _AT_ONCE]
        count = len(times)
        of_ray = np.repeat(np.arange(count), readings)
        origin = np.tile(scanner.pose, (count * readings, 1))
        if carrier is not None:
            origin = compose(_of_rays(carrier, times, sweep_s, share), origin)
        directions = origin[:, 2] + np.tile(scanner.angles_rad, count)
        origins = np.ascontiguousarray(origin[:, :2])
        distances = np.full(count * readings, np.inf)
        if carrier is None:
            cast_on_walls(origins[:readings], directions[:readings], scene.walls,
                          distances[:readings])  # fmt: skip
            distances = np.tile(distances[:readings], count)
        else:
            cast_on_walls(origins, directions, scene.walls, distances)
        if scene.robot_poses is not None:
            robot = _of_rays(scene.robot_poses, times, sweep_s, share)
            cast_on_robot(origins, directions, robot, scene.sides, distances)
        cast_on_discs(origins, directions, scene.legs(times), of_ray, distances)
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
    between = begin[:, None] * (1.0 - weight) + end[:, None] * weight
    return np.asarray(between.reshape(-1, 3))


def measured(
    times_s: FloatArray,
    ranges_m: FloatArray,
    scanner: Scanner,
    errors: ReadingErrors,
    rng: np.random.Generator,
) -> Scans:
    """Exact distances as the scanner reports them.

    Parameters
    ----------
    times_s : (N,) float64
        Their stamps.
    ranges_m : (N, readings) float64
        Exact distances, infinite for none.
    scanner : Scanner
        Its largest range is where readings end.
    errors : ReadingErrors
    rng : numpy Generator

    Returns
    -------
    Scans
        Without those that are lost.
    """
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


def compose(a: FloatArray, b: FloatArray) -> FloatArray:
    """(N, 3) poses b, given in the frames of poses a, in the frame of a."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack(
        [
            a[:, 0] + c * b[:, 0] - s * b[:, 1],
            a[:, 1] + s * b[:, 0] + c * b[:, 1],
            a[:, 2] + b[:, 2],
        ]
    )
