"""Numba kernels that render the light falling on each pixel, anti-aliased, and smear it."""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from camera.brown_kernels import brown_shift_point, straightened_point
from camera.kernels import has_brown
from tools.simulator.scene import Scene
from tools.simulator.shading.kernels import SKY, first_met, radiance


@nb.njit(cache=True, error_model="numpy")
def camera_ray(
    u: float, v: float, optics: NDArray[np.float64], inverse: NDArray[np.float64]
) -> tuple[float, float]:
    """Undistorted x, y of a pixel of the calibrated (field) image.

    Parameters
    ----------
    u, v : float
        Pixel; need not be whole.
    optics : (16,) float64
        scaleX, scaleY, offsetX, offsetY, nodes of `inverse` per unit of squared radius, and
        `camera.kernels.lens_numbers`.
    inverse : (N,) float64
        Undistorted radius over distorted radius, at equal steps of the squared distorted radius, by
        the radial distortion.
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
    optics: NDArray[np.float64],
    inverse: NDArray[np.float64],
    world_from_camera: NDArray[np.float64],
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
    optics: NDArray[np.float64],
    inverse: NDArray[np.float64],
    world_from_camera: NDArray[np.float64],
    width: int,
    lines: int,
    offsets: NDArray[np.float64],
    contrast: float,
) -> tuple[
    NDArray[np.float32], NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]
]:  # fmt: skip
    """Light on each pixel of the full frame; pixels across an edge get more rays.

    Parameters
    ----------
    scene : Scene
        The world.
    optics, inverse
        As in `camera_ray`; of the field image, whose row v is line 2 v of the full frame.
    world_from_camera : (3, 4) float64
        The camera's pose.
    width, lines : int
        Size of the full frame.
    offsets : (S, 2) float64
        Where in a pixel the further rays of pixels across an edge go, full-frame pixels.
    contrast : float
        Neighbours whose light differs by more than this share are taken for an edge.

    Returns
    -------
    light, seen, mirrored, depth : (lines, width)
        Light without what the floor mirrors; a number for what the pixel's centre sees; the share
        of light that the floor mirrors there; depth along the optical axis (m).
    """
    light = np.empty((lines, width), dtype=np.float32)
    seen = np.empty((lines, width), dtype=np.int32)
    mirrored = np.empty((lines, width), dtype=np.float32)
    depth = np.empty((lines, width), dtype=np.float32)
    for line in range(lines):
        for u in range(width):
            a, b, c, d = _sample(scene, u, 0.5 * line, optics, inverse, world_from_camera)
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
    optics: NDArray[np.float64],
    inverse: NDArray[np.float64],
    world_from_camera: NDArray[np.float64],
    mirrored: NDArray[np.float32],
    stride: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What the floor mirrors, on every `stride`-th pixel of the full frame.

    Returns
    -------
    image, weight : (lines / stride, width / stride) float32
        Light from the mirrored direction, and 1 where there is a mirroring floor.
    """
    lines, width = mirrored.shape
    image = np.zeros((lines // stride, width // stride), dtype=np.float32)
    weight = np.zeros_like(image)
    m = world_from_camera
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            if mirrored[i * stride, j * stride] <= 0.0:
                continue
            x, y = camera_ray(j * stride, 0.5 * i * stride, optics, inverse)
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
    light: NDArray[np.float32],
    seen: NDArray[np.int32],
    depth: NDArray[np.float32],
    optics: NDArray[np.float64],
    inverse: NDArray[np.float64],
    later_from_camera: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Motion blur: the mean along each pixel's path during the exposure.

    Parameters
    ----------
    light, seen, depth : (lines, width)
        From `render_radiance`, at the middle of the exposure.
    optics, inverse
        As in `camera_ray`.
    later_from_camera : (3, 4) float64
        Camera frame at the middle of the exposure -> camera frame at its end.

    Returns
    -------
    (lines, width) float32
    """
    lines, width = light.shape
    out = np.empty_like(light)
    coef = optics[5:]
    m = later_from_camera
    for line in range(lines):
        for u in range(width):
            x, y = camera_ray(u, 0.5 * line, optics, inverse)
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
