"""Numba kernels that bake the light: lamps with shadows, windows, and one bounce."""

# Arithmetic on array elements has no static type; Numba finds the types itself.
# mypy: disable-error-code="no-any-return"

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from tools.simulator.scene import SURFACE_ALBEDO, SURFACE_EMISSION, SURFACE_TEXTURE, Scene, Texture
from tools.simulator.shading.kernels import CEILING, FLOOR, SKY, first_met
from tools.simulator.tracing.kernels import nearest_quad, sees_sun

_WINDOW = float(Texture.WINDOW)
_LAMP_REACH_M = 8.0
_UPRIGHT_HEIGHT_M = 1.2


@nb.njit(cache=True, error_model="numpy")
def _returned(scene: Scene, met: int) -> float:
    """Light that comes back from a thing, roughly: what its own light is is not known yet."""
    if met == SKY:
        return scene.sky
    if met == CEILING:
        return 0.30
    if met == FLOOR:
        return 0.20
    if scene.surfaces[met, SURFACE_TEXTURE] == _WINDOW:
        return min(scene.surfaces[met, SURFACE_EMISSION], 4.0)
    if scene.surfaces[met, SURFACE_EMISSION] > 0.0:
        return 0.0  # lamps are dealt with one by one
    return 0.42 * scene.surfaces[met, SURFACE_ALBEDO]


@nb.njit(cache=True, error_model="numpy")
def _lamp_light(scene: Scene, lamps: NDArray[np.float64], x: float, y: float, z: float) -> float:
    """Light of the lamps on a level surface; two points of each lamp soften the shadows."""
    total = 0.0
    for k in range(lamps.shape[0]):
        if abs(lamps[k, 0] - x) > _LAMP_REACH_M or abs(lamps[k, 1] - y) > _LAMP_REACH_M:
            continue
        for end in range(-1, 2, 2):
            dx = lamps[k, 0] + 0.3 * end * lamps[k, 3] - x
            dy = lamps[k, 1] + 0.3 * end * lamps[k, 4] - y
            dz = lamps[k, 2] - z
            squared = dx * dx + dy * dy + dz * dz
            found, _ = nearest_quad(scene, x, y, z, dx, dy, dz, 0.99, False)
            if found < 0:
                area = lamps[k, 3] * lamps[k, 4]
                total += 0.5 * lamps[k, 5] * area * dz * dz / (np.pi * squared * squared)
    return total


@nb.njit(cache=True, error_model="numpy")
def bake_light(
    scene: Scene, lamps: NDArray[np.float64], floor_rays: NDArray[np.float64], azimuths: int
) -> None:
    """Fill in ``floor_light``, ``side_light`` and ``sun_reach`` of a scene.

    Parameters
    ----------
    scene : Scene
        The world; its light rasters are overwritten.
    lamps : (L, 6) float64
        x, y, z, width, depth (m) and radiance of each lamp.
    floor_rays : (R, 3) float64
        Cosine-distributed directions of the upper half space.
    azimuths : int
        Level directions from which upright surfaces get light.
    """
    rows, columns = scene.floor_kind.shape
    for i in range(rows):
        for j in range(columns):
            x = scene.grid[0] + (j + 0.5) * scene.raster_m
            y = scene.grid[1] + (i + 0.5) * scene.raster_m
            outdoors = scene.indoors[i, j] == 0
            every = 4 if outdoors else 1
            total, count = 0.0, 0
            for k in range(0, floor_rays.shape[0], every):
                met, _ = first_met(
                    scene, x, y, 0.005, floor_rays[k, 0], floor_rays[k, 1], floor_rays[k, 2]
                )
                total += _returned(scene, met)
                count += 1
            direct = 0.0 if outdoors else _lamp_light(scene, lamps, x, y, 0.005)
            scene.floor_light[i, j] = total / count + direct
            # A place the sun misses may still lie beside one that it reaches.
            for k in range(9):
                off_x, off_y = 0.5 * (k % 3 - 1), 0.5 * (k // 3 - 1)
                if sees_sun(scene, x + off_x * scene.raster_m, y + off_y * scene.raster_m, 0.005):
                    scene.sun_reach[i, j] = 1
                    break
            if i % 2 == 1 or j % 2 == 1:
                continue
            mean, along_x, along_y, count = 0.0, 0.0, 0.0, 0
            for a in range(azimuths):
                c, s = np.cos(2.0 * np.pi * a / azimuths), np.sin(2.0 * np.pi * a / azimuths)
                for rise in (-0.4, 0.02, 0.45):
                    met, _ = first_met(scene, x, y, _UPRIGHT_HEIGHT_M, c, s, rise)
                    back = _returned(scene, met)
                    mean += back
                    along_x += c * back
                    along_y += s * back
                    count += 1
            high = 0.0 if outdoors else _lamp_light(scene, lamps, x, y, _UPRIGHT_HEIGHT_M)
            for di in range(2):
                for dj in range(2):
                    if i + di < rows and j + dj < columns:
                        scene.side_light[i + di, j + dj, 0] = mean / count + 0.35 * high
                        scene.side_light[i + di, j + dj, 1] = 1.6 * along_x / count
                        scene.side_light[i + di, j + dj, 2] = 1.6 * along_y / count
