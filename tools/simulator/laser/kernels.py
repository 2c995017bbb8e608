"""Numba kernels of ray casting in the plane: walls, a moving polygon, discs.

Each shortens the ranges it is given to what it adds, so that they are called one after the other.
"""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@nb.njit(cache=True, error_model="numpy")
def _meet(
    ox: float, oy: float, dx: float, dy: float, wall: FloatArray, nearest: np.float64
) -> np.float64:
    """Distance to a wall x1, y1, x2, y2 along a unit direction, if below `nearest`."""
    ex, ey = wall[2] - wall[0], wall[3] - wall[1]
    rx, ry = wall[0] - ox, wall[1] - oy
    across = dx * ey - dy * ex
    beside = rx * dy - ry * dx
    # Both ends on the same side of the ray, or a wall along it, whose end its neighbour shows.
    if beside * (beside - across) > 0.0 or across == 0.0:
        return nearest
    distance = (rx * ey - ry * ex) / across
    if 0.0 < distance < nearest:
        return np.float64(distance)
    return nearest


@nb.njit(cache=True, error_model="numpy")
def cast_on_walls(
    origins: FloatArray, directions: FloatArray, walls: FloatArray, ranges: FloatArray
) -> None:
    """Shorten ranges to the nearest wall.

    Parameters
    ----------
    origins : (B, 2) float64
        Where the rays begin (m).
    directions : (B,) float64
        Where they point (rad).
    walls : (S, 4) float64
        x1, y1, x2, y2 (m).
    ranges : (B,) float64
        Distances to what is known so far (m, infinite for nothing); changed in place.
    """
    for b in range(ranges.size):
        dx, dy = np.cos(directions[b]), np.sin(directions[b])
        nearest = ranges[b]
        for s in range(walls.shape[0]):
            nearest = _meet(origins[b, 0], origins[b, 1], dx, dy, walls[s], nearest)
        ranges[b] = nearest


@nb.njit(cache=True, error_model="numpy")
def cast_on_robot(
    origins: FloatArray,
    directions: FloatArray,
    robot_poses: FloatArray,
    sides: FloatArray,
    ranges: FloatArray,
) -> None:
    """Shorten ranges to a polygon that stands elsewhere for every ray.

    Parameters
    ----------
    origins, directions : (B, 2) and (B,) float64
        As for `cast_on_walls`.
    robot_poses : (B, 3) float64
        x, y, theta of the polygon's frame when the ray is sent (m, rad).
    sides : (K, 4) float64
        Its sides x1, y1, x2, y2 in its own frame (m).
    ranges : (B,) float64
        Changed in place.
    """
    for b in range(ranges.size):
        c, s = np.cos(robot_poses[b, 2]), np.sin(robot_poses[b, 2])
        x, y = origins[b, 0] - robot_poses[b, 0], origins[b, 1] - robot_poses[b, 1]
        ox, oy = c * x + s * y, c * y - s * x
        angle = directions[b] - robot_poses[b, 2]
        dx, dy = np.cos(angle), np.sin(angle)
        nearest = ranges[b]
        for k in range(sides.shape[0]):
            nearest = _meet(ox, oy, dx, dy, sides[k], nearest)
        ranges[b] = nearest


@nb.njit(cache=True, error_model="numpy")
def cast_on_discs(
    origins: FloatArray,
    directions: FloatArray,
    discs: FloatArray,
    of_ray: NDArray[np.int64],
    ranges: FloatArray,
) -> None:
    """Shorten ranges to discs that stand elsewhere from scan to scan.

    Parameters
    ----------
    origins, directions : (B, 2) and (B,) float64
        As for `cast_on_walls`.
    discs : (N, D, 3) float64
        x, y, radius of the discs in each scan (m); a radius of 0 is no disc.
    of_ray : (B,) int64
        Which scan a ray belongs to.
    ranges : (B,) float64
        Changed in place.
    """
    for b in range(ranges.size):
        dx, dy = np.cos(directions[b]), np.sin(directions[b])
        here = discs[of_ray[b]]
        for d in range(here.shape[0]):
            radius = here[d, 2]
            if radius <= 0.0:
                continue
            x, y = here[d, 0] - origins[b, 0], here[d, 1] - origins[b, 1]
            along = x * dx + y * dy
            across = x * dy - y * dx
            deep = radius * radius - across * across
            if deep > 0.0:
                distance = along - np.sqrt(deep)
                if 0.0 < distance < ranges[b]:
                    ranges[b] = distance
