"""Numba kernels of the marker renderer: pixels on edges, and the light of every pixel.

A surface is a rectangle of R x C texels. Its row of `from_texel` (3x3) takes (column, row, 1), in
texels from the upper left *corner* of the texture, to a point in the camera frame; the inverse
takes a ray (x, y, 1) to (column, row, 1) / depth.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from camera.kernels import project_direction
from redetect.array_types import ByteArray, Float32Array, FloatArray, IntArray


class SurfaceArrays(NamedTuple):
    """Surfaces as the kernels take them."""

    from_texel: FloatArray  # (S, 3, 3) (column, row, 1) to a point in the camera frame.
    to_texel: FloatArray  # (S, 3, 3) Their inverses.
    sizes: IntArray  # (S, 2) Rows and columns of each texture.
    starts: IntArray  # (S,) Where each texture begins in `texels`.
    texels: Float32Array  # All textures, row by row; NaN is a hole.
    smooth: ByteArray  # (S,) Whether it is interpolated: then only its outline is an edge.
    given: IntArray  # (S,) Index of each surface in the input.


#: Side of the square tiles for which the surfaces that may be seen are gathered, pixels.
TILE = 16

#: A quarter of a pixel whose border comes nearer than this to an edge is taken to be crossed by it,
#: in half pixels, as the step in which edges are followed.
_MARGIN = 0.3
_STEP = 0.5
_NEAREST = 1e-3


@nb.njit(cache=True, error_model="numpy")
def _texel_point(
    numbers: FloatArray, from_texel: FloatArray, a: float, b: float
) -> tuple[float, float]:
    """Pixel of a place on a surface; both NaN where it is not seen."""
    z = from_texel[2, 0] * a + from_texel[2, 1] * b + from_texel[2, 2]
    if z < _NEAREST:
        return math.nan, math.nan
    x = from_texel[0, 0] * a + from_texel[0, 1] * b + from_texel[0, 2]
    y = from_texel[1, 0] * a + from_texel[1, 1] * b + from_texel[1, 2]
    return project_direction(numbers, x, y, z)


@nb.njit(cache=True, error_model="numpy")
def _mark_segment(
    crossed: ByteArray,
    box: IntArray,
    numbers: FloatArray,
    from_texel: FloatArray,
    ends: tuple[float, float, float, float],
    pieces: float,
) -> None:
    """Mark the quarters of pixels that a segment crosses, and widen the box (in pixels) by it.

    `pieces`: their whole number; as a float, so that Numba compiles once for all.
    """
    rows, columns = crossed.shape
    height, width = rows // 2, columns // 2
    a0, b0, a1, b1 = ends
    u0, v0 = _texel_point(numbers, from_texel, a0, b0)
    for piece in range(int(pieces)):
        t = (piece + 1.0) / pieces
        u1, v1 = _texel_point(numbers, from_texel, a0 + t * (a1 - a0), b0 + t * (b1 - b0))
        known0, known1 = not math.isnan(u0), not math.isnan(u1)
        if not (known0 and known1):
            # Part of it is behind the camera: the outline in the image is unknown.
            box[0], box[1], box[2], box[3] = 0, 0, width - 1, height - 1
        if known0 and known1 and max(abs(u0), abs(v0), abs(u1), abs(v1)) < 1e5:
            # On the grid of half pixels the first one's centre is at -0.25.
            p0, q0 = 2.0 * u0 + 0.5, 2.0 * v0 + 0.5
            dp, dq = 2.0 * (u1 - u0), 2.0 * (v1 - v0)
            steps = int(max(abs(dp), abs(dq)) / _STEP) + 1
            box[0] = min(box[0], max(math.floor(min(u0, u1)) - 1, 0))
            box[1] = min(box[1], max(math.floor(min(v0, v1)) - 1, 0))
            box[2] = max(box[2], min(math.ceil(max(u0, u1)) + 1, width - 1))
            box[3] = max(box[3], min(math.ceil(max(v0, v1)) + 1, height - 1))
            for step in range(steps + 1):
                p = p0 + dp * step / steps
                q = q0 + dq * step / steps
                for row in range(
                    max(math.ceil(q - 0.5 - _MARGIN), 0),
                    min(math.floor(q + 0.5 + _MARGIN), rows - 1) + 1,
                ):
                    for column in range(
                        max(math.ceil(p - 0.5 - _MARGIN), 0),
                        min(math.floor(p + 0.5 + _MARGIN), columns - 1) + 1,
                    ):
                        crossed[row, column] = 1
        elif known0 or known1:
            box[0], box[1], box[2], box[3] = 0, 0, width - 1, height - 1
        u0, v0 = u1, v1


@nb.njit(cache=True, error_model="numpy")
def mark_edges(
    crossed: ByteArray, boxes: IntArray, numbers: FloatArray, surfaces: SurfaceArrays
) -> None:
    """Mark where any edge between unequal texels runs; find each surface's box.

    `crossed` (2 H, 2 W) is set to 1 where an edge runs; `boxes` (S, 4) gets the first and last
    columns and rows that may see the surface: u0, v0, u1, v1. `numbers` is the camera.
    """
    height, width = crossed.shape[0] // 2, crossed.shape[1] // 2
    for s in range(len(surfaces.sizes)):
        rows, columns = surfaces.sizes[s, 0], surfaces.sizes[s, 1]
        box, matrix = boxes[s], surfaces.from_texel[s]
        box[0], box[1], box[2], box[3] = width, height, -1, -1
        for k in range(2):
            # Long edges bend under distortion, so they go in pieces.
            across = (0.0, float(k * rows), float(columns), float(k * rows))
            _mark_segment(crossed, box, numbers, matrix, across, 64.0)
            down = (float(k * columns), 0.0, float(k * columns), float(rows))
            _mark_segment(crossed, box, numbers, matrix, down, 64.0)
        if surfaces.smooth[s] or box[2] < box[0] or box[3] < box[1]:
            continue
        start, texels = surfaces.starts[s], surfaces.texels
        for r in range(rows):
            for c in range(columns):
                here = texels[start + r * columns + c]
                hole = math.isnan(here)
                if c + 1 < columns:
                    right = texels[start + r * columns + c + 1]
                    if right != here and not (hole and math.isnan(right)):
                        side = (c + 1.0, float(r), c + 1.0, r + 1.0)
                        _mark_segment(crossed, box, numbers, matrix, side, 4.0)
                if r + 1 < rows:
                    below = texels[start + (r + 1) * columns + c]
                    if below != here and not (hole and math.isnan(below)):
                        side = (float(c), r + 1.0, c + 1.0, r + 1.0)
                        _mark_segment(crossed, box, numbers, matrix, side, 4.0)


@nb.njit(cache=True, error_model="numpy")
def _smooth_texel(
    texels: Float32Array, start: int, rows: int, columns: int, a: float, b: float
) -> float:
    x = min(max(a - 0.5, 0.0), columns - 1.0)
    y = min(max(b - 0.5, 0.0), rows - 1.0)
    c, r = min(int(x), max(columns - 2, 0)), min(int(y), max(rows - 2, 0))
    p, q = x - c, y - r
    c1, r1 = min(c + 1, columns - 1), min(r + 1, rows - 1)
    upper = (1.0 - p) * texels[start + r * columns + c] + p * texels[start + r * columns + c1]
    lower = (1.0 - p) * texels[start + r1 * columns + c] + p * texels[start + r1 * columns + c1]
    return float((1.0 - q) * upper + q * lower)


@nb.njit(cache=True, error_model="numpy", inline="always")
def nearest_surface(
    x: float, y: float, candidates: IntArray, count: int, surfaces: SurfaceArrays
) -> tuple[int, float]:
    """The surface that a ray (x, y, 1) meets first, and its texel's value; -1 and 0 if none."""
    to_texel, sizes = surfaces.to_texel, surfaces.sizes
    best = 0.0
    found = -1
    value = 0.0
    for k in range(count):
        s = candidates[k]
        # Entry by entry: views of an array would be counted, which costs more than the sums.
        inverse_depth = to_texel[s, 2, 0] * x + to_texel[s, 2, 1] * y + to_texel[s, 2, 2]
        if inverse_depth <= best:
            continue
        rows, columns = sizes[s, 0], sizes[s, 1]
        a = to_texel[s, 0, 0] * x + to_texel[s, 0, 1] * y + to_texel[s, 0, 2]
        if not (0.0 <= a < columns * inverse_depth):
            continue
        b = to_texel[s, 1, 0] * x + to_texel[s, 1, 1] * y + to_texel[s, 1, 2]
        if not (0.0 <= b < rows * inverse_depth):
            continue
        # Rounding may reach the texture's end.
        a = min(a / inverse_depth, columns - 1e-9)
        b = min(b / inverse_depth, rows - 1e-9)
        if surfaces.smooth[s]:
            light = _smooth_texel(surfaces.texels, surfaces.starts[s], rows, columns, a, b)
        else:
            light = float(surfaces.texels[surfaces.starts[s] + int(b) * columns + int(a)])
            if math.isnan(light):
                continue
        best = inverse_depth
        found = s
        value = light
    return found, value


@nb.njit(cache=True, error_model="numpy")
def _shift(row: int, column: int) -> tuple[float, float]:
    """Two numbers in [0, 1) that differ from cell to cell without a pattern."""
    h = np.uint64(row) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(column) * np.uint64(
        0xC2B2AE3D27D4EB4F
    )
    h ^= h >> np.uint64(29)
    h *= np.uint64(0xBF58476D1CE4E5B9)
    h ^= h >> np.uint64(32)
    mask = np.uint64(0xFFFF)
    return float(h & mask) / 65536.0, float((h >> np.uint64(16)) & mask) / 65536.0


@nb.njit(cache=True, error_model="numpy")
def shade(
    light: Float32Array,
    weight: float,
    crossed: ByteArray,
    rays: FloatArray,
    boxes: IntArray,
    surfaces: SurfaceArrays,
    samples: int,
    background: Float32Array,
) -> None:
    """Let the surfaces of one exposure take the background's place.

    Surfaces may touch but should not pass through each other: where they do, the border between
    them is no edge, and may be found up to a tile's width beside its place.

    `light` (2 H, 2 W) or (H, W) is at first the background, and becomes the mean reflectance of
    what each quarter of a pixel, or each pixel, sees; the weights of all exposures add up to 1.
    `samples`, a power of two, rays are cast where `crossed` (2 H, 2 W) is 1. `rays` (H, W, 6): x, y
    through the pixel's centre, and dx/du, dx/dv, dy/du, dy/dv. `boxes` as from `mark_edges`.
    """
    height, width = background.shape
    coarse = light.shape[0] == height
    if coarse:
        weight *= 0.25
    total_surfaces = len(surfaces.sizes)
    candidates = np.empty(total_surfaces, np.int64)
    here = np.empty(total_surfaces, np.int64)
    # Hammersley's points: equally spaced in either direction.
    point_x, point_y = np.empty(samples), np.empty(samples)
    for k in range(samples):
        reverse, bit, rest = 0.0, 0.5, k
        while rest > 0:
            reverse += bit * (rest & 1)
            rest >>= 1
            bit *= 0.5
        point_x[k], point_y[k] = k / samples, reverse
    for top in range(0, height, TILE):
        bottom = min(top + TILE, height)
        for left in range(0, width, TILE):
            right = min(left + TILE, width)
            count = 0
            for s in range(total_surfaces):
                across = boxes[s, 0] < right and boxes[s, 2] >= left
                if across and boxes[s, 1] < bottom and boxes[s, 3] >= top:
                    candidates[count] = s
                    count += 1
            if count == 0:
                continue
            for row in range(top, bottom):
                # Between two edges nothing changes: one ray is enough.
                known = False
                found, value = -1, 0.0
                for column in range(left, right):
                    a, b = 2 * row, 2 * column
                    behind = background[row, column]
                    on_edge = (
                        crossed[a, b]
                        | crossed[a, b + 1]
                        | crossed[a + 1, b]
                        | crossed[a + 1, b + 1]
                    )
                    if not on_edge and not known:
                        found, value = nearest_surface(
                            rays[row, column, 0], rays[row, column, 1],
                            candidates, count, surfaces,
                        )  # fmt: skip
                        known = True
                    if on_edge:
                        known = False
                    elif found < 0:
                        continue
                    elif not surfaces.smooth[found]:
                        change = np.float32(weight * (value - behind))
                        if coarse:
                            light[row, column] += np.float32(4.0) * change
                        else:
                            light[a, b] += change
                            light[a, b + 1] += change
                            light[a + 1, b] += change
                            light[a + 1, b + 1] += change
                        continue
                    near = 0
                    if on_edge:
                        for k in range(count):
                            s = candidates[k]
                            across = boxes[s, 0] <= column and boxes[s, 2] >= column
                            if across and boxes[s, 1] <= row and boxes[s, 3] >= row:
                                here[near] = s
                                near += 1
                    else:
                        here[0] = found
                        near = 1
                    x, y = rays[row, column, 0], rays[row, column, 1]
                    xu, xv = rays[row, column, 2], rays[row, column, 3]
                    yu, yv = rays[row, column, 4], rays[row, column, 5]
                    for i in range(2):
                        for j in range(2):
                            r, c = 2 * row + i, 2 * column + j
                            total = 0.0
                            cast = samples if crossed[r, c] else 1
                            shift_x, shift_y = 0.0, 0.0
                            if cast > 1:
                                shift_x, shift_y = _shift(r, c)
                            for k in range(cast):
                                du = 0.5 * j - 0.25
                                dv = 0.5 * i - 0.25
                                if cast > 1:
                                    # Turned round the quarter, so that no direction is favoured.
                                    p, q = point_x[k] + shift_x, point_y[k] + shift_y
                                    du += 0.5 * (p - int(p)) - 0.25
                                    dv += 0.5 * (q - int(q)) - 0.25
                                hit, seen = nearest_surface(
                                    x + xu * du + xv * dv, y + yu * du + yv * dv,
                                    here, near, surfaces,
                                )  # fmt: skip
                                if hit >= 0:
                                    total += seen - behind
                            change = np.float32(weight * total / cast)
                            if coarse:
                                light[row, column] += change
                            else:
                                light[r, c] += change


@nb.njit(cache=True, error_model="numpy")
def count_visible(x: FloatArray, y: FloatArray, surface: int, surfaces: SurfaceArrays) -> int:
    """How many of the rays (x, y, 1) meet the given surface before any other."""
    candidates = np.arange(len(surfaces.sizes))
    seen = 0
    for k in range(len(x)):
        found, _ = nearest_surface(x[k], y[k], candidates, len(candidates), surfaces)
        if found == surface:
            seen += 1
    return seen
