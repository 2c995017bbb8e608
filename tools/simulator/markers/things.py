"""Things that resemble markers, and backgrounds."""

from __future__ import annotations

import string
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from detect.markers.dictionaries import MarkerDictionary
from redetect.array_types import ByteArray, Float32Array, FloatArray
from tools.simulator.markers.surface import (
    BLACK,
    LEAST_DIFFERENCE,
    WHITE,
    Texture,
    near_pattern,
    pattern_texture,
    texture_distance,
)

_TRIES = 32


def checkerboard(columns: int, rows: int) -> Texture:
    """A board of columns x rows squares, the upper left one black, with a white rim."""
    r, c = np.mgrid[0 : rows + 2, 0 : columns + 2]
    values = np.where((r + c) % 2 == 0, BLACK, WHITE).astype(np.float32)
    values[[0, -1], :] = WHITE
    values[:, [0, -1]] = WHITE
    return Texture(values)


def window(rng: np.random.Generator) -> Texture:
    """Panes in a frame: light outside or dark, the frame the other way round."""
    across, down = rng.integers(1, 4), rng.integers(1, 4)
    pane, bar, rim = rng.integers(4, 10), 1, int(rng.integers(1, 4))
    rows = down * pane + (down - 1) * bar + 2 * rim
    columns = across * pane + (across - 1) * bar + 2 * rim
    dark, light = rng.uniform(0.03, 0.25), rng.uniform(0.6, 1.1)
    frame, glass = (dark, light) if rng.random() < 0.7 else (light, dark)
    values = np.full((rows, columns), frame, dtype=np.float32)
    for i in range(down):
        for j in range(across):
            top, left = rim + i * (pane + bar), rim + j * (pane + bar)
            shade = glass * rng.uniform(0.9, 1.05)
            values[top : top + pane, left : left + pane] = shade
            if rng.random() < 0.2:  # something stands on the sill
                values[top + pane // 2 :, left : left + pane // 3] = frame
    return Texture(values)


def text(rng: np.random.Generator) -> Texture:
    """Lines of letters."""
    height, width = 160, int(rng.integers(160, 320))
    dark_on_light = rng.random() < 0.75
    page, ink = (225, 20) if dark_on_light else (20, 215)
    image = np.full((height, width), page, dtype=np.uint8)
    size = rng.uniform(0.4, 2.2)
    letters = list(string.ascii_uppercase + string.digits + "OB8DQ0#")
    y = int(28 * size) + 4
    while y < height:
        line = "".join(rng.choice(letters, 24))
        cv2.putText(
            image, line, (6, y), int(rng.choice([0, 2, 3, 4])), size, int(ink),
            max(1, round(2.5 * size)), cv2.LINE_AA,
        )  # fmt: skip
        y += int(34 * size)
    return _smooth(image)


def poster(rng: np.random.Generator) -> Texture:
    """A picture, a heading and columns of small print."""
    height, width = 256, 192
    page = int(rng.integers(120, 245))
    image = np.full((height, width), page, dtype=np.uint8)
    left, right = 10, width - 10
    top, bottom = int(rng.integers(34, 60)), int(rng.integers(120, 190))
    picture = blotches(rng, (bottom - top, right - left), octaves=3)
    image[top:bottom, left:right] = np.clip(255 * picture, 0, 255).astype(np.uint8)
    for _ in range(int(rng.integers(1, 6))):
        centre = int(rng.integers(left, right)), int(rng.integers(top, bottom))
        shade = int(rng.integers(0, 256))
        if rng.random() < 0.5:
            cv2.circle(image, centre, int(rng.integers(5, 40)), shade, -1, cv2.LINE_AA)
        else:
            corner = centre[0] + int(rng.integers(10, 60)), centre[1] + int(rng.integers(10, 60))
            cv2.rectangle(image, centre, corner, shade, -1)
    ink = 20 if page > 90 else 230
    heading = "".join(rng.choice(list(string.ascii_uppercase), 9))
    cv2.putText(image, heading, (10, 27), 3, 0.95, ink, 2, cv2.LINE_AA)
    for y in range(bottom + 8, height - 8, 7):
        for x in range(left, right, 62):
            cv2.line(image, (x, y), (x + int(rng.integers(30, 56)), y), ink, 2)
    if rng.random() < 0.4:  # a dark frame round it
        cv2.rectangle(image, (0, 0), (width - 1, height - 1), int(rng.integers(0, 60)), 14)
    return _smooth(image)


def barcode(rng: np.random.Generator) -> Texture:
    """Upright bars of random widths on white."""
    bars = np.where(rng.random(40) < 0.5, BLACK, WHITE).astype(np.float32)
    values = np.full((12, 46), WHITE, dtype=np.float32)
    values[1:-1, 3:-3] = bars
    return Texture(values)


def matrix_code(rng: np.random.Generator) -> Texture:
    """A code of 21 x 21 cells with three nested squares in its corners."""
    values = np.where(rng.random((21, 21)) < 0.5, BLACK, WHITE).astype(np.float32)
    finder = np.full((8, 8), WHITE, dtype=np.float32)
    finder[:7, :7] = BLACK
    finder[1:6, 1:6] = WHITE
    finder[2:5, 2:5] = BLACK
    values[:8, :8] = finder
    values[:8, -8:] = finder[:, ::-1]
    values[-8:, :8] = finder[::-1]
    return Texture(np.pad(values, 2, constant_values=np.float32(WHITE)))


def frames_in_frames(rng: np.random.Generator) -> Texture:
    """Nested squares, or a black square with one hole: a marker's outline and no more."""
    side = int(rng.integers(8, 15))
    values = np.full((side, side), WHITE, dtype=np.float32)
    values[1:-1, 1:-1] = BLACK
    if rng.random() < 0.4:
        inset = 2
        white = True
        while side - 2 * inset >= 2:
            values[inset:-inset, inset:-inset] = WHITE if white else BLACK
            white = not white
            inset += int(rng.integers(1, 4))
    else:
        top, left = rng.integers(2, side - 3, 2)
        values[top : min(top + rng.integers(1, 5), side - 2), left : side - 2] = WHITE
    return Texture(values)


def hole_grid(rng: np.random.Generator) -> Texture:
    """Regular holes in a dark plate, as keyboards, grilles and lamps have them."""
    across, down = rng.integers(2, 9, 2)
    pitch = int(rng.integers(2, 4))
    values = np.full((down * pitch + 1, across * pitch + 1), BLACK, dtype=np.float32)
    for r in range(1, len(values), pitch):
        for c in range(1, values.shape[1], pitch):
            values[r : r + pitch - 1, c : c + pitch - 1] = WHITE
    values = np.pad(values, int(rng.integers(0, 3)), constant_values=np.float32(BLACK))
    return Texture(np.pad(values, 1, constant_values=np.float32(rng.uniform(0.4, 0.9))))


def near_marker(rng: np.random.Generator, dictionary: MarkerDictionary) -> Texture:
    """A black square laid out as a marker of the dictionary, but of no marker in it."""
    return pattern_texture(dictionary, near_pattern(dictionary, rng), int(rng.integers(1, 3)))


def board(rng: np.random.Generator) -> Texture:
    """A checkerboard of any size."""
    columns, rows = rng.integers(2, 10, 2)
    return checkerboard(int(columns), int(rows))


#: Things that need no dictionary.
THINGS: tuple[Callable[[np.random.Generator], Texture], ...] = (
    window, text, poster, barcode, matrix_code, frames_in_frames, hole_grid, board,
)  # fmt: skip


def thing(rng: np.random.Generator, dictionary: MarkerDictionary) -> tuple[str, Texture]:
    """A random one of `THINGS` that does not happen to be a marker: its name and texture."""
    for _ in range(_TRIES):
        kind = THINGS[rng.integers(len(THINGS))]
        texture = kind(rng)
        if texture_distance(dictionary, texture) >= LEAST_DIFFERENCE:
            return kind.__name__, texture
    return text.__name__, text(rng)


def blotches(rng: np.random.Generator, shape: tuple[int, int], octaves: int = 4) -> Float32Array:
    """Smooth noise of several scales, some 0 to 1. `shape` (rows, columns)."""
    rows, columns = shape
    result = np.full(shape, 0.5, dtype=np.float32)
    strength = 0.25
    across = 3
    for _ in range(octaves):
        down = max(2, round(across * rows / columns))
        coarse = (strength * rng.standard_normal((down, across))).astype(np.float32)
        result += cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_CUBIC)
        across *= 2
        strength *= 0.6
    return result


def _smooth(image: ByteArray) -> Texture:
    return Texture(image.astype(np.float32) / np.float32(255.0), smooth=True)


_PHOTOGRAPHS = (".jpg", ".jpeg", ".png")
_CACHED_PHOTOGRAPHS = 64


def shapes_background(rng: np.random.Generator, width: int, height: int) -> Float32Array:
    """Noise with polygons, discs, bars and a grid or two on it, as a messy room has them.
    Returns (height, width).
    """
    base = 0.15 + 0.6 * rng.random() + 0.35 * (blotches(rng, (height // 4, width // 4)) - 0.5)
    image = np.clip(255.0 * base, 8, 250).astype(np.uint8)
    image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR))
    for _ in range(int(rng.integers(3, 22))):
        shade = int(rng.integers(5, 250))
        centre = rng.uniform(0.0, 1.0, 2) * (width, height)
        kind = rng.random()
        if kind < 0.45:  # the side of some furniture
            size = rng.uniform(10, 160, 2)
            angle = rng.choice([0.0, rng.uniform(-90, 90)])
            corners = cv2.boxPoints((tuple(centre), tuple(size), float(angle)))
            skewed = corners + rng.normal(0.0, 0.06 * size.mean(), (4, 2))
            _fill(image, np.asarray(skewed, dtype=np.float64), shade)
        elif kind < 0.6:
            axes = int(rng.integers(4, 70)), int(rng.integers(4, 70))
            point = int(centre[0]), int(centre[1])
            cv2.ellipse(
                image, point, axes, float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA
            )
        elif kind < 0.8:  # edges of walls, cables, legs
            end = centre + rng.normal(0.0, 200.0, 2)
            cv2.line(
                image, (int(centre[0]), int(centre[1])), (int(end[0]), int(end[1])), shade,
                int(rng.integers(1, 9)), cv2.LINE_AA,
            )  # fmt: skip
        else:  # a shelf or a keyboard: equal rectangles in rows
            step = rng.uniform(8, 30, 2)
            gap = rng.uniform(0.15, 0.5)
            for i in range(int(rng.integers(2, 6))):
                for j in range(int(rng.integers(2, 8))):
                    corner = centre + step * (j, i)
                    far = corner + (1.0 - gap) * step
                    _fill(
                        image,
                        np.array([corner, [far[0], corner[1]], far, [corner[0], far[1]]]),
                        shade,
                    )
    return image.astype(np.float32) / np.float32(255.0)


def _fill(image: ByteArray, corners: FloatArray, shade: int) -> None:
    points = np.rint(16.0 * corners).astype(np.int32)
    cv2.fillConvexPoly(image, cv2.convexHull(points), shade, cv2.LINE_AA, shift=4)


def photograph_files(folder: Path) -> tuple[Path, ...]:
    """The photographs below a folder, in an order that does not depend on the file system."""
    files = tuple(sorted(p for p in folder.rglob("*") if p.suffix.lower() in _PHOTOGRAPHS))
    if not files:
        raise ValueError(f"{folder}: holds no photographs (.jpg, .png)")
    return files


def photograph_background(
    rng: np.random.Generator, width: int, height: int, files: tuple[Path, ...]
) -> Float32Array:
    """A part of a photograph, enlarged or reduced; parameters as in `shapes_background`."""
    photograph = photograph_of(files[rng.integers(len(files))])
    rows, columns = photograph.shape
    scale = rng.uniform(0.4, 1.0) * min(columns / width, rows / height)
    across, down = max(2, int(scale * width)), max(2, int(scale * height))
    left, top = rng.integers(0, columns - across + 1), rng.integers(0, rows - down + 1)
    part = photograph[top : top + down, left : left + across]
    if rng.random() < 0.5:
        part = part[:, ::-1]
    reduced = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(reduced).astype(np.float32) / np.float32(255.0)


@lru_cache(maxsize=_CACHED_PHOTOGRAPHS)
def photograph_of(path: Path) -> ByteArray:
    """Grey values of a photograph, (H, W)."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ValueError(f"{path}: cannot be decoded: expected an image")
    return np.asarray(image, dtype=np.uint8)
