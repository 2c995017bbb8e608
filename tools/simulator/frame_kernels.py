"""Numba kernels that bake the light of a scene, render and smear a frame."""

# Arithmetic on array elements has no static type; Numba finds the types itself.
# mypy: disable-error-code="no-any-return"

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from camera.kernels import brown_shift_point, has_brown, straightened_point
from tools.arrays import Float32Array, FloatArray
from tools.simulator.ray_kernels import (
    CEILING,
    FLOOR,
    NOTHING,
    SKY,
    first_met,
    nearest_quad,
    radiance,
    sees_sun,
)
from tools.simulator.scene import Scene, Texture

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
    if scene.surfaces[met].texture == _WINDOW:
        return min(scene.surfaces[met].emission, 4.0)
    if scene.surfaces[met].emission > 0.0:
        return 0.0  # lamps are dealt with one by one
    return 0.42 * scene.surfaces[met].albedo


@nb.njit(cache=True, error_model="numpy")
def _lamp_light(scene: Scene, lamps: FloatArray, x: float, y: float, z: float) -> float:
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
            found, _ = nearest_quad(scene, x, y, z, dx, dy, dz, 0.99, NOTHING)
            if found < 0:
                area = lamps[k, 3] * lamps[k, 4]
                total += 0.5 * lamps[k, 5] * area * dz * dz / (np.pi * squared * squared)
    return total


@nb.njit(cache=True, error_model="numpy")
def bake_light(scene: Scene, lamps: FloatArray, floor_rays: FloatArray, azimuths: int) -> None:
    """Fill in ``floor_light``, ``side_light`` and ``sun_reach`` of a scene.
    `lamps` (L, 6); `floor_rays` (R, 3).
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


@nb.njit(cache=True, error_model="numpy")
def camera_ray(u: float, v: float, optics: FloatArray, inverse: FloatArray) -> tuple[float, float]:
    """Undistorted x, y of a pixel of the calibrated (field) image.
    `optics` (16,); `inverse` (N,).
    """
    x, y = (u - optics[2]) / optics[0], (v - optics[3]) / optics[1]
    position = min((x * x + y * y) * optics[4], inverse.shape[0] - 1.001)
    node = int(position)
    share = position - node
    factor = inverse[node] * (1.0 - share) + inverse[node + 1] * share
    if optics[12] != 0.0 or optics[13] != 0.0:
        return straightened_point(optics[5:], x, y, x * factor, y * factor)
    return x * factor, y * factor


@nb.njit(cache=True, error_model="numpy")
def _sample(
    scene: Scene,
    u: float,
    v: float,
    optics: FloatArray,
    inverse: FloatArray,
    world_from_camera: FloatArray,
) -> tuple[float, int, float, float]:
    """Radiance, what was met, mirrored share and depth (along the optical axis) of one ray."""
    x, y = camera_ray(u, v, optics, inverse)
    m = world_from_camera
    dx = m[0, 0] * x + m[0, 1] * y + m[0, 2]
    dy = m[1, 0] * x + m[1, 1] * y + m[1, 2]
    dz = m[2, 0] * x + m[2, 1] * y + m[2, 2]
    met, distance = first_met(scene, m[0, 3], m[1, 3], m[2, 3], dx, dy, dz)
    grey, seen, mirrored = radiance(
        scene, m[0, 3], m[1, 3], m[2, 3], dx, dy, dz, met, distance, 1.0 / optics[0]
    )
    return grey, seen, mirrored, distance


@nb.njit(cache=True, error_model="numpy")
def render_radiance(
    scene: Scene,
    optics: FloatArray,
    inverse: FloatArray,
    world_from_camera: FloatArray,
    width: int,
    lines: int,
    offsets: FloatArray,
    contrast: float,
) -> tuple[
    Float32Array, NDArray[np.int32], Float32Array, Float32Array
]:  # fmt: skip
    """Light on each pixel of the full frame; pixels across an edge get more rays.

    `world_from_camera` (3, 4); `offsets` (S, 2); returns `light, seen, mirrored, depth` (lines,
    width).
    """
    light = np.empty((lines, width), dtype=np.float32)
    seen = np.empty((lines, width), dtype=np.int32)
    mirrored = np.empty((lines, width), dtype=np.float32)
    depth = np.empty((lines, width), dtype=np.float32)
    for line in range(lines):
        for u in range(width):
            a, b, c, d = _sample(scene, float(u), 0.5 * line, optics, inverse, world_from_camera)
            light[line, u], seen[line, u], mirrored[line, u], depth[line, u] = a, b, c, d
    across = np.zeros((lines, width), dtype=np.bool_)
    for line in range(lines):
        for u in range(width):
            for k in range(2):
                i, j = (line + 1, u) if k == 0 else (line, u + 1)
                if i >= lines or j >= width:
                    continue
                a, b = light[line, u], light[i, j]
                if seen[line, u] != seen[i, j] or abs(a - b) > contrast * (a + b):
                    across[line, u] = True
                    across[i, j] = True
    count = offsets.shape[0]
    for line in range(lines):
        for u in range(width):
            if not across[line, u]:
                continue
            total, gloss = 0.0, 0.0
            for k in range(count):
                a, _, c, _ = _sample(
                    scene, u + offsets[k, 0], 0.5 * (line + offsets[k, 1]),
                    optics, inverse, world_from_camera,
                )  # fmt: skip
                total += a
                gloss += c
            light[line, u] = total / count
            mirrored[line, u] = gloss / count
    return light, seen, mirrored, depth


@nb.njit(cache=True, error_model="numpy")
def render_mirrored(
    scene: Scene,
    optics: FloatArray,
    inverse: FloatArray,
    world_from_camera: FloatArray,
    mirrored: Float32Array,
    stride: int,
) -> tuple[Float32Array, Float32Array]:
    """What the floor mirrors, on every `stride`-th pixel of the full frame.
    Returns `image, weight` (lines / stride, width / stride).
    """
    lines, width = mirrored.shape
    image = np.zeros((lines // stride, width // stride), dtype=np.float32)
    weight = np.zeros_like(image)
    m = world_from_camera
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            if mirrored[i * stride, j * stride] <= 0.0:
                continue
            x, y = camera_ray(float(j * stride), 0.5 * i * stride, optics, inverse)
            dx = m[0, 0] * x + m[0, 1] * y + m[0, 2]
            dy = m[1, 0] * x + m[1, 1] * y + m[1, 2]
            dz = m[2, 0] * x + m[2, 1] * y + m[2, 2]
            if dz >= 0.0:
                continue
            down = -m[2, 3] / dz
            px, py = m[0, 3] + down * dx, m[1, 3] + down * dy
            met, distance = first_met(scene, px, py, 1e-4, dx, dy, -dz)
            grey, _, _ = radiance(scene, px, py, 1e-4, dx, dy, -dz, met, distance, 8.0 / optics[0])
            image[i, j] = grey
            weight[i, j] = 1.0
    return image, weight


@nb.njit(cache=True, error_model="numpy")
def smear(
    light: Float32Array,
    seen: NDArray[np.int32],
    depth: Float32Array,
    optics: FloatArray,
    inverse: FloatArray,
    later_from_camera: FloatArray,
) -> Float32Array:
    """Motion blur: the mean along each pixel's path during the exposure.
    `light`, `seen`, `depth` (lines, width); `later_from_camera` (3, 4); returns (lines, width).
    """
    lines, width = light.shape
    out = np.empty_like(light)
    coef = optics[5:]
    m = later_from_camera
    for line in range(lines):
        for u in range(width):
            x, y = camera_ray(float(u), 0.5 * line, optics, inverse)
            d = 1e4 if seen[line, u] == SKY else depth[line, u]
            px = m[0, 0] * x * d + m[0, 1] * y * d + m[0, 2] * d + m[0, 3]
            py = m[1, 0] * x * d + m[1, 1] * y * d + m[1, 2] * d + m[1, 3]
            pz = m[2, 0] * x * d + m[2, 1] * y * d + m[2, 2] * d + m[2, 3]
            if pz <= 1e-3:
                out[line, u] = light[line, u]
                continue
            x, y = px / pz, py / pz
            r = np.sqrt(x * x + y * y)
            f = 1.0 + r * (coef[0] + r * coef[1]) / (
                1.0 + r * (coef[2] + r * (coef[3] + r * coef[4]))
            )
            du = optics[0] * x * f + optics[2] - u
            dv = 2.0 * (optics[1] * y * f + optics[3]) - line
            if has_brown(coef[5:10]):
                x_shift, y_shift = brown_shift_point(
                    coef[5], coef[6], coef[7], coef[8], coef[9], x, y
                )
                du += optics[0] * x_shift
                dv += 2.0 * optics[1] * y_shift
            steps = int(np.ceil(2.0 * np.sqrt(du * du + dv * dv)))
            if steps <= 0:
                out[line, u] = light[line, u]
                continue
            total = 0.0
            for k in range(-steps, steps + 1):
                share = k / steps
                a = min(max(line + share * dv, 0.0), lines - 1.001)
                b = min(max(u + share * du, 0.0), width - 1.001)
                i, j = int(a), int(b)
                p, q = a - i, b - j
                top = light[i, j] * (1.0 - q) + light[i, j + 1] * q
                low = light[i + 1, j] * (1.0 - q) + light[i + 1, j + 1] * q
                total += top * (1.0 - p) + low * p
            out[line, u] = total / (2 * steps + 1)
    return out
