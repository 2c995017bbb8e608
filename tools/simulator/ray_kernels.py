"""Numba kernels that cast rays through a scene, shade what they meet, and bake a scene's light.

Rays go through a grid of upright and level parallelograms; textures, marks on the floor and baked
light determine the radiance.
"""

# Arithmetic on array elements has no static type; Numba finds the types itself.
# mypy: disable-error-code="no-any-return"

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from redetect.array_types import BoolArray, Float32Array, FloatArray
from tools.simulator.scene import Flooring, Mark, Scene, Texture

# Textures that a ray may go through. Numba compiles a kernel anew for each integer or truth value
# that is written into a call, but not for each float: so the seeds of textures are floats.
_GLASS, NOTHING = float(Texture.WINDOW), -1.0
_FAR = 1e30
_NEAR = 1e-6


@nb.njit(cache=True, error_model="numpy")
def nearest_quad(
    scene: Scene,
    ox: float, oy: float, oz: float,
    dx: float, dy: float, dz: float,
    limit: float,
    clear: float,
) -> tuple[int, float]:  # fmt: skip
    """First parallelogram that a ray meets, and where; it goes through the texture `clear`."""
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
            if scene.surfaces[q].texture == clear:
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
def points_visible(scene: Scene, eye: FloatArray, points: FloatArray, slack_m: float) -> BoolArray:
    """Which points are seen from a place, nothing standing between.
    `eye` (3,); `points` (N, 3); returns (N,).
    """
    visible = np.empty(points.shape[0], dtype=np.bool_)
    for k in range(points.shape[0]):
        dx = points[k, 0] - eye[0]
        dy = points[k, 1] - eye[1]
        dz = points[k, 2] - eye[2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        limit = max(1.0 - slack_m / max(distance, 1e-9), 0.0)
        found, _ = nearest_quad(scene, eye[0], eye[1], eye[2], dx, dy, dz, limit, NOTHING)
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
    found, _ = nearest_quad(scene, x, y, z, dx, dy, dz, 50.0, _GLASS)
    return found < 0


# Numba takes enumeration members as their numbers only through plain constants.
_WALL, _WOOD, _PHOTOGRAPH = int(Texture.WALL), int(Texture.WOOD), int(Texture.PHOTOGRAPH)
_PAPER, _WINDOW, _FACADE = int(Texture.PAPER), int(Texture.WINDOW), int(Texture.FACADE)
_FOLIAGE, _METAL = int(Texture.FOLIAGE), int(Texture.METAL)
_LINOLEUM, _CARPET, _TILES = int(Flooring.LINOLEUM), int(Flooring.CARPET), int(Flooring.TILES)
_PARQUET, _PAVING = int(Flooring.PARQUET), int(Flooring.PAVING)
_DISC, _RING, _ELLIPSE, _PLATE = int(Mark.DISC), int(Mark.RING), int(Mark.ELLIPSE), int(Mark.PLATE)
_LIGHT_SPOT, _PRINTED = int(Mark.LIGHT_SPOT), int(Mark.PRINTED)

#: Codes for hits on other things than parallelograms, which count from 0.
FLOOR, CEILING, SKY = -1, -2, -3

_HORIZON_LIMIT = 400.0
_CEILING_ALBEDO = 0.80


@nb.njit(cache=True, error_model="numpy")
def _hashed(ix: int, iy: int, seed: float) -> float:
    """A number in [0, 1) that looks random and depends on the arguments only."""
    h = (ix * 374761393 + iy * 668265263 + int(seed) * 974634777) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 2246822519) & 0xFFFFFFFF
    return (h ^ (h >> 15)) / 4294967296.0


@nb.njit(cache=True, error_model="numpy")
def _noise(x: float, y: float, seed: float) -> float:
    """Smooth noise in [-1, 1] with features of size 1."""
    fx, fy = np.floor(x), np.floor(y)
    ix, iy = int(fx), int(fy)
    a, b = x - fx, y - fy
    a, b = a * a * (3.0 - 2.0 * a), b * b * (3.0 - 2.0 * b)
    top = _hashed(ix, iy, seed) * (1.0 - a) + _hashed(ix + 1, iy, seed) * a
    low = _hashed(ix, iy + 1, seed) * (1.0 - a) + _hashed(ix + 1, iy + 1, seed) * a
    return 2.0 * (top * (1.0 - b) + low * b) - 1.0


@nb.njit(cache=True, error_model="numpy")
def _seen(feature_m: float, footprint_m: float) -> float:
    """How much contrast a texture's features keep when a pixel covers `footprint_m`."""
    ratio = footprint_m / feature_m
    return 1.0 / (1.0 + 2.0 * ratio * ratio)


@nb.njit(cache=True, error_model="numpy")
def _grain(x: float, y: float, size: float, seed: float, footprint_m: float) -> float:
    keep = _seen(size, footprint_m)
    return 0.0 if keep < 0.05 else keep * _noise(x / size, y / size, seed)


@nb.njit(cache=True, error_model="numpy")
def _photograph(scene: Scene, layer: int, s: float, t: float, footprint: float) -> float:
    """Grey value of a photograph; s, t in [0, 1], `footprint` as a share of its side."""
    levels, size = scene.photographs.shape[1], scene.photographs.shape[2]
    level = 0
    texels = footprint * size
    while level < levels - 1 and texels > 1.5:
        texels *= 0.5
        level += 1
    side = size >> level
    x = min(max(s, 0.0), 1.0) * (side - 1)
    y = (1.0 - min(max(t, 0.0), 1.0)) * (side - 1)
    ix, iy = min(int(x), side - 2), min(int(y), side - 2)
    a, b = x - ix, y - iy
    image = scene.photographs[layer, level]
    top = image[iy, ix] * (1.0 - a) + image[iy, ix + 1] * a
    low = image[iy + 1, ix] * (1.0 - a) + image[iy + 1, ix + 1] * a
    return top * (1.0 - b) + low * b


@nb.njit(cache=True, error_model="numpy")
def _text(x: float, y: float, seed: float, footprint_m: float) -> float:
    """Share of ink of lines of print; x to the right, y upward, metres."""
    line = np.floor(y / 0.012)
    keep = _seen(0.006, footprint_m)
    if _hashed(int(line), 7, seed) < 0.2:
        return 0.0
    inside = (y / 0.012 - line) < 0.5
    ink = _hashed(int(np.floor(x / 0.006)), int(line), seed) < 0.6
    return keep * (1.0 if inside and ink else 0.0) + (1.0 - keep) * 0.3


@nb.njit(cache=True, error_model="numpy")
def _surface_albedo(scene: Scene, q: int, s: float, t: float, z: float, footprint: float) -> float:
    row = scene.surfaces[q]
    texture, albedo, parameter = int(row.texture), row.albedo, row.parameter  # fmt: skip
    width, height, seed = row.width, row.height, row.seed
    x, y = s * width, t * height
    if texture == _WALL:
        if z < 0.09:  # skirting
            return parameter
        rough = _grain(x, z, 0.9, seed, footprint) * 0.03
        rough += _grain(x, z, 0.12, seed + 1.0, footprint) * 0.025
        scuff = 0.0
        if z < 0.5:
            scuff = 0.10 * max(_grain(x, 3.0 * z, 0.25, seed + 2.0, footprint) - 0.3, 0.0)
        return albedo * (1.0 + rough - scuff)
    if texture == _WOOD:
        rings = _noise(x / 0.035 + 1.2 * _noise(x / 0.2, y / 0.9, seed), y / 0.8, seed + 1.0)
        fine = _grain(x, y / 12.0, 0.008, seed + 2.0, footprint)
        return albedo * (1.0 + 0.14 * rings * _seen(0.02, footprint) + 0.08 * fine)
    if texture == _PHOTOGRAPH:
        border = parameter
        if min(x, y, width - x, height - y) < border:
            return albedo
        u = (x - border) / (width - 2.0 * border)
        v = (y - border) / (height - 2.0 * border)
        layer = int(seed) % scene.photographs.shape[0]
        return 0.04 + 0.85 * _photograph(scene, layer, u, v, footprint / width)
    if texture == _PAPER:
        margin = 0.12 * min(width, height)
        if min(x, y, width - x, height - y) < margin:
            return albedo
        return albedo * (1.0 - 0.8 * _text(x, y, seed, footprint))
    if texture == _FACADE:
        joint = 1.0 if (y / 0.4 - np.floor(y / 0.4)) < 0.05 else 0.0
        joint *= _seen(0.02, footprint)
        return albedo * (1.0 - 0.35 * joint + 0.08 * _grain(x, y, 0.3, seed, footprint))
    if texture == _FOLIAGE:
        leaves = _grain(x, y, 0.05, seed, footprint) + _grain(x, y, 0.17, seed + 1.0, footprint)
        return albedo * max(1.0 + 0.7 * leaves, 0.1)
    if texture == _METAL:
        return albedo * (1.0 + 0.03 * _grain(x, y, 0.4, seed, footprint))
    return albedo * (1.0 + 0.04 * _grain(x, y, 0.3, seed, footprint))


@nb.njit(cache=True, error_model="numpy")
def _floor_albedo(scene: Scene, kind: int, x: float, y: float, footprint: float) -> float:
    row = scene.floorings[kind]
    texture, albedo, contrast, pitch = (
        int(row.kind), row.albedo, row.contrast, row.pitch
    )  # fmt: skip
    stains = 0.25 * _grain(x, y, 1.3, 11.0, footprint) + 0.2 * _grain(x, y, 0.31, 12.0, footprint)
    if texture == _LINOLEUM:
        speckle = _grain(x, y, 0.012, 13.0, footprint) + 0.6 * _grain(x, y, 0.05, 14.0, footprint)
        seam = 0.0
        if pitch > 0.0 and abs(x - pitch * np.rint(x / pitch)) < 0.004:
            seam = _seen(0.008, footprint)
        return albedo * (1.0 + contrast * (speckle + stains) - 0.3 * seam)
    if texture == _CARPET:
        pile = _grain(x, y, 0.008, 15.0, footprint) + _grain(x, y, 0.025, 16.0, footprint)
        return albedo * (1.0 + contrast * (1.3 * pile + stains))
    if texture == _PARQUET:
        plank = np.floor(x / pitch)
        end = np.floor(y / (6.0 * pitch) + 0.5 * plank)
        tone = 2.0 * _hashed(int(plank), int(end), 17.0) - 1.0
        grain = _grain(12.0 * x, y, 0.1, 18.0, footprint)
        groove = 1.0 if (x / pitch - plank) * pitch < 0.003 else 0.0
        fine = 0.5 * grain - 1.2 * groove * _seen(0.006, footprint)
        return albedo * (1.0 + contrast * (tone * _seen(pitch, footprint) + fine))
    if texture in (_TILES, _PAVING):
        column, line = np.floor(x / pitch), np.floor(y / pitch)
        tone = 2.0 * _hashed(int(column), int(line), 19.0) - 1.0
        groove = 0.004 if texture == _TILES else 0.008
        near = min(x / pitch - column, y / pitch - line) * pitch
        joint = _seen(2.0 * groove, footprint) if near < groove else 0.0
        grit = _grain(x, y, 0.015, 20.0, footprint)
        fine = 0.4 * tone * _seen(pitch, footprint) + 0.5 * grit + stains - 3.0 * joint
        return max(albedo * (1.0 + contrast * fine), 0.02)
    blades = _grain(x, y, 0.02, 21.0, footprint) + _grain(x, y, 0.09, 22.0, footprint)
    return max(albedo * (1.0 + contrast * (blades + stains)), 0.02)


@nb.njit(cache=True, error_model="numpy")
def _mark_share(scene: Scene, m: int, x: float, y: float) -> tuple[float, float]:
    """How much of the floor a mark hides at a place (0..1), and the albedo it shows there."""
    row = scene.marks[m]
    shape, radius, second = int(row.shape), row.radius, row.second
    dx, dy = x - row.x, y - row.y
    albedo = row.albedo
    distance = np.sqrt(dx * dx + dy * dy)
    if distance > row.reach:
        return 0.0, 0.0
    if shape == _DISC:
        return (1.0 if distance <= radius else 0.0), albedo
    if shape == _RING:
        return (1.0 if second <= distance <= radius else 0.0), albedo
    if shape == _PLATE:  # a raised rim catches the light differently
        if distance > radius:
            return 0.0, 0.0
        return 1.0, albedo * (0.72 if distance > second else 1.0)
    if shape == _LIGHT_SPOT:  # brightens what is below
        q = distance / radius
        return np.exp(-0.5 * q * q), albedo
    c, s = np.cos(row.angle), np.sin(row.angle)
    a, b = c * dx + s * dy, -s * dx + c * dy
    if shape == _ELLIPSE:
        a, b = a / radius, b / second
        return (1.0 if a * a + b * b <= 1.0 else 0.0), albedo
    if abs(a) > radius or abs(b) > second:
        return 0.0, 0.0
    if shape == _PRINTED and abs(a) < 0.85 * radius and abs(b) < 0.9 * second:
        return 1.0, albedo * (1.0 - 0.7 * _text(a, b, float(m), 0.004))
    return 1.0, albedo


@nb.njit(cache=True, error_model="numpy")
def _bilinear(image: FloatArray, row: float, column: float) -> float:
    rows, columns = image.shape
    r = min(max(row, 0.0), rows - 1.001)
    c = min(max(column, 0.0), columns - 1.001)
    i, j = int(r), int(c)
    a, b = r - i, c - j
    top = image[i, j] * (1.0 - b) + image[i, j + 1] * b
    low = image[i + 1, j] * (1.0 - b) + image[i + 1, j + 1] * b
    return top * (1.0 - a) + low * a


@nb.njit(cache=True, error_model="numpy")
def _light_from_above(scene: Scene, x: float, y: float) -> float:
    return _bilinear(
        scene.floor_light,
        (y - scene.grid[1]) / scene.raster_m - 0.5,
        (x - scene.grid[0]) / scene.raster_m - 0.5,
    )


@nb.njit(cache=True, error_model="numpy")
def _light_from_sides(scene: Scene, x: float, y: float, z: float, nx: float, ny: float) -> float:
    """Light on an upright surface with the normal (nx, ny), taken a hand's breadth before it."""
    row = (y + 0.25 * ny - scene.grid[1]) / scene.raster_m - 0.5
    column = (x + 0.25 * nx - scene.grid[0]) / scene.raster_m - 0.5
    mean = _bilinear(scene.side_light[:, :, 0], row, column)
    along_x = _bilinear(scene.side_light[:, :, 1], row, column)
    along_y = _bilinear(scene.side_light[:, :, 2], row, column)
    light = max(mean + nx * along_x + ny * along_y, 0.25 * mean)
    return light * (0.8 + 0.1 * z) * (1.0 - 0.3 * np.exp(-z / 0.12))


@nb.njit(cache=True, error_model="numpy")
def first_met(
    scene: Scene, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[int, float]:
    """What a ray meets first (a parallelogram's row, or `FLOOR`, `CEILING`, `SKY`), and where."""
    limit, met = _HORIZON_LIMIT, SKY
    if dz < 0.0:
        down = -oz / dz
        if down < limit:
            limit, met = down, FLOOR
    elif dz > 0.0 and oz < scene.ceiling_m:
        up = (scene.ceiling_m - oz) / dz
        if up < limit:
            row, column = raster_index(scene, ox + up * dx, oy + up * dy)
            if scene.indoors[row, column] == 1:
                limit, met = up, CEILING
    quad, distance = nearest_quad(scene, ox, oy, oz, dx, dy, dz, limit, NOTHING)
    if quad >= 0:
        return quad, distance
    return met, limit


@nb.njit(cache=True, error_model="numpy")
def radiance(
    scene: Scene,
    ox: float, oy: float, oz: float,
    dx: float, dy: float, dz: float,
    met: int, distance: float, pixel_angle: float,
) -> tuple[float, int, float]:  # fmt: skip
    """Radiance along a ray."""
    x, y, z = ox + distance * dx, oy + distance * dy, oz + distance * dz
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    footprint = pixel_angle * distance * length
    if met == SKY:
        return scene.sky * (1.0 + 0.3 * max(dz / length, 0.0)), SKY, 0.0
    if met == CEILING:
        row, column = raster_index(scene, x, y)
        panel = 0.6  # suspended ceiling of square panels
        near = min(x / panel - np.floor(x / panel), y / panel - np.floor(y / panel)) * panel
        joint = 0.35 * _seen(0.012, footprint) if near < 0.012 else 0.0
        return (
            _CEILING_ALBEDO * (1.0 - joint) * 0.8 * scene.side_light[row, column, 0],
            CEILING,
            0.0,
        )
    if met == FLOOR:
        return _floor_radiance(scene, x, y, abs(dz) / length, footprint)
    row = scene.surfaces[met]
    if row.emission > 0.0:
        return row.emission, met, 0.0
    quad = scene.quads[met]
    s = quad[4] * x + quad[5] * y + quad[6] * z - quad[7]
    t = quad[8] * x + quad[9] * y + quad[10] * z - quad[11]
    across = quad[0] * dx + quad[1] * dy + quad[2] * dz
    slant = max(abs(across) / length, 0.15)
    albedo = _surface_albedo(scene, met, s, t, z, footprint / slant)
    facing = -1.0 if across > 0.0 else 1.0
    if abs(quad[2]) > 0.5:
        light = _light_from_above(scene, x, y) * (1.05 if facing * quad[2] > 0.0 else 0.35)
    else:
        light = _light_from_sides(scene, x, y, z, facing * quad[0], facing * quad[1])
    toward_sun = facing * (quad[0] * scene.sun[0] + quad[1] * scene.sun[1] + quad[2] * scene.sun[2])
    if toward_sun > 0.0:
        cell = raster_index(scene, x, y)
        if scene.sun_reach[cell[0], cell[1]] == 1:
            off = 1e-3 * facing
            if sees_sun(scene, x + off * quad[0], y + off * quad[1], z + off * quad[2]):
                light += scene.sun[3] * toward_sun
    return albedo * light, met, 0.0


@nb.njit(cache=True, error_model="numpy")
def _floor_radiance(
    scene: Scene, x: float, y: float, cosine: float, footprint: float
) -> tuple[float, int, float]:
    cell = raster_index(scene, x, y)
    kind = scene.floor_kind[cell[0], cell[1]]
    albedo = _floor_albedo(scene, kind, x, y, footprint / max(cosine, 0.15) ** 0.5)
    gloss = scene.floorings[kind].gloss
    light = _light_from_above(scene, x, y)
    seen = FLOOR
    side = scene.grid[2]
    column, line = int((x - scene.grid[0]) / side), int((y - scene.grid[1]) / side)
    if 0 <= column < int(scene.grid[3]) and 0 <= line < int(scene.grid[4]):
        index = line * int(scene.grid[3]) + column
        for k in range(scene.mark_start[index], scene.mark_start[index + 1]):
            mark = scene.mark_items[k]
            share, shown = _mark_share(scene, mark, x, y)
            if share <= 0.0:
                continue
            if int(scene.marks[mark].shape) == _LIGHT_SPOT:
                light += share * shown
            else:
                albedo = shown * (1.0 + 0.03 * _grain(x, y, 0.05, float(mark), footprint))
                gloss = scene.marks[mark].gloss
                seen = -10 - mark
    if scene.sun_reach[cell[0], cell[1]] == 1 and sees_sun(scene, x, y, 1e-3):
        light += scene.sun[3] * scene.sun[2]
    mirrored = gloss * (0.04 + 0.96 * (1.0 - cosine) ** 5)
    return albedo * light, seen, mirrored


@nb.njit(cache=True, error_model="numpy")
def light_along(
    scene: Scene, origins: FloatArray, directions: FloatArray, pixel_angle: float
) -> tuple[Float32Array, NDArray[np.int32], Float32Array, Float32Array]:
    """What comes back along rays: light, what they met, its mirrored share, and how far it is.

    `origins`, `directions` (N, 3), the lengths of which are the unit of the distances;
    `pixel_angle`: of what a ray stands for (rad). Returns four arrays (N,).
    """
    count = len(directions)
    light = np.empty(count, dtype=np.float32)
    seen = np.empty(count, dtype=np.int32)
    mirrored = np.empty(count, dtype=np.float32)
    distance = np.empty(count, dtype=np.float32)
    for k in range(count):
        ox, oy, oz = origins[k, 0], origins[k, 1], origins[k, 2]
        dx, dy, dz = directions[k, 0], directions[k, 1], directions[k, 2]
        met, far = first_met(scene, ox, oy, oz, dx, dy, dz)
        light[k], seen[k], mirrored[k] = radiance(
            scene, ox, oy, oz, dx, dy, dz, met, far, pixel_angle
        )
        distance[k] = far
    return light, seen, mirrored, distance


_LAMP_REACH_M = 8.0
_UPRIGHT_HEIGHT_M = 1.2


@nb.njit(cache=True, error_model="numpy")
def _returned(scene: Scene, met: int) -> float:
    """Approximate radiance of a surface, before its own illumination is known."""
    if met == SKY:
        return scene.sky
    if met == CEILING:
        return 0.30
    if met == FLOOR:
        return 0.20
    if scene.surfaces[met].texture == _GLASS:
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
