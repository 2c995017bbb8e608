"""Numba kernels that cast rays through a grid of upright and level parallelograms."""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from tools.simulator.scene import SURFACE_TEXTURE, Scene, Texture

_GLASS = float(Texture.WINDOW)
_FAR = 1e30
_NEAR = 1e-6


@nb.njit(cache=True, error_model="numpy")
def nearest_quad(
    scene: Scene,
    ox: float, oy: float, oz: float,
    dx: float, dy: float, dz: float,
    limit: float,
    through_glass: bool,
) -> tuple[int, float]:  # fmt: skip
    """First parallelogram that a ray meets, and where.

    Parameters
    ----------
    scene : Scene
        The world.
    ox, oy, oz : float
        Where the ray begins (m).
    dx, dy, dz : float
        Its direction, of any length.
    limit : float
        The ray ends here, in lengths of its direction.
    through_glass : bool
        Whether windows are let out.

    Returns
    -------
    int, float
        Row of ``scene.quads`` (-1 if none) and distance in lengths of the direction.
    """
    quads = scene.quads
    start, items = scene.quad_start, scene.quad_items
    x0, y0, side = scene.grid[0], scene.grid[1], scene.grid[2]
    columns, rows = int(scene.grid[3]), int(scene.grid[4])
    best, found = limit, -1

    # Clip the ray to the grid.
    enter, leave = 0.0, limit
    for axis in range(2):
        o, d = (ox, dx) if axis == 0 else (oy, dy)
        low = x0 if axis == 0 else y0
        high = low + side * (columns if axis == 0 else rows)
        if abs(d) < 1e-12:
            if o < low or o > high:
                return -1, limit
        else:
            a, b = (low - o) / d, (high - o) / d
            enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    if enter > leave:
        return -1, limit

    px, py = ox + enter * dx, oy + enter * dy
    column = min(max(int((px - x0) / side), 0), columns - 1)
    row = min(max(int((py - y0) / side), 0), rows - 1)
    step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    next_x = _FAR if abs(dx) < 1e-12 else (x0 + side * (column + (dx > 0)) - ox) / dx
    next_y = _FAR if abs(dy) < 1e-12 else (y0 + side * (row + (dy > 0)) - oy) / dy
    per_x = _FAR if abs(dx) < 1e-12 else side / abs(dx)
    per_y = _FAR if abs(dy) < 1e-12 else side / abs(dy)

    while True:
        cell = row * columns + column
        for k in range(start[cell], start[cell + 1]):
            q = items[k]
            across = quads[q, 0] * dx + quads[q, 1] * dy + quads[q, 2] * dz
            if abs(across) < 1e-12:
                continue
            height = quads[q, 0] * ox + quads[q, 1] * oy + quads[q, 2] * oz
            t = (quads[q, 3] - height) / across
            if t <= _NEAR or t >= best:
                continue
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            s = quads[q, 4] * x + quads[q, 5] * y + quads[q, 6] * z - quads[q, 7]
            if s < 0.0 or s > 1.0:
                continue
            r = quads[q, 8] * x + quads[q, 9] * y + quads[q, 10] * z - quads[q, 11]
            if r < 0.0 or r > 1.0:
                continue
            if through_glass and scene.surfaces[q, SURFACE_TEXTURE] == _GLASS:
                continue
            best, found = t, q
        beyond = min(next_x, next_y)
        if best <= beyond or beyond >= leave:
            return found, best
        if next_x < next_y:
            column += step_x
            next_x += per_x
            if column < 0 or column >= columns:
                return found, best
        else:
            row += step_y
            next_y += per_y
            if row < 0 or row >= rows:
                return found, best


@nb.njit(cache=True, error_model="numpy")
def points_visible(
    scene: Scene, eye: NDArray[np.float64], points: NDArray[np.float64], slack_m: float
) -> NDArray[np.bool_]:
    """Which points are seen from a place, nothing standing between.

    Parameters
    ----------
    scene : Scene
        The world.
    eye : (3,) float64
        Where the camera is (m).
    points : (N, 3) float64
        Points (m), none of them below the floor.
    slack_m : float
        Surfaces closer than this to a point do not hide it.

    Returns
    -------
    (N,) bool
    """
    visible = np.empty(points.shape[0], dtype=np.bool_)
    for k in range(points.shape[0]):
        dx = points[k, 0] - eye[0]
        dy = points[k, 1] - eye[1]
        dz = points[k, 2] - eye[2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        limit = max(1.0 - slack_m / max(distance, 1e-9), 0.0)
        found, _ = nearest_quad(scene, eye[0], eye[1], eye[2], dx, dy, dz, limit, False)
        visible[k] = found < 0
    return visible


@nb.njit(cache=True, error_model="numpy")
def raster_index(scene: Scene, x: float, y: float) -> tuple[int, int]:
    """Row and column of the raster element that a place lies in, clipped to the raster."""
    rows, columns = scene.floor_kind.shape
    column = int((x - scene.grid[0]) / scene.raster_m)
    row = int((y - scene.grid[1]) / scene.raster_m)
    return min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)


@nb.njit(cache=True, error_model="numpy")
def sees_sun(scene: Scene, x: float, y: float, z: float) -> bool:
    """Whether the sun reaches a place, be it through windows."""
    dx, dy, dz = scene.sun[0], scene.sun[1], scene.sun[2]
    if dz <= 0.0:
        return False
    if z < scene.ceiling_m:
        t = (scene.ceiling_m - z) / dz
        row, column = raster_index(scene, x + t * dx, y + t * dy)
        if scene.indoors[row, column] == 1:
            return False
    found, _ = nearest_quad(scene, x, y, z, dx, dy, dz, 50.0, True)
    return found < 0
