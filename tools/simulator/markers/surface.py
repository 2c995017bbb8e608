"""Textured rectangles in space, of which scenes with markers consist, and their textures.

Frame of a surface, as of a marker: origin at its centre, x right, y up, z out of the printed face
towards a viewer; metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from detect.markers.dictionaries import MarkerDictionary
from redetect.array_types import BoolArray, Float32Array, FloatArray

#: Outward face of each side of a box, as the surface's x and y axes in the box's frame.
_SIDES = {
    "front": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "rear": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "left": ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "right": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "top": ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0)),
}


@dataclass(frozen=True, eq=False)
class Texture:
    """What is printed on a surface."""

    values: Float32Array
    """(R, C) Reflectance of each texel, 0 black to 1 white; NaN is a hole. Row 0 is the upper
    edge."""
    smooth: bool = False
    """Whether it is interpolated between the texels' centres; else every texel is a rectangle of
    one value with sharp edges. A smooth texture has no holes."""


def plain(value: float) -> Texture:
    """A texture of one reflectance."""
    return Texture(np.full((1, 1), value, dtype=np.float32))


@dataclass(frozen=True, eq=False)
class Surface:
    """A rectangle with a texture."""

    pose: FloatArray  # (4, 4) parent_from_surface.
    width_m: float  # Its extent along x and y.
    height_m: float
    texture: Texture  # Of its printed face.
    back: float = field(default=np.nan)
    """Reflectance of its other face; NaN where that one cannot be seen, as inside a box."""

    def moved(self, transform: FloatArray) -> Surface:
        """The surface in another frame: `transform` is other_from_parent."""
        return replace(self, pose=transform @ self.pose)

    def corners(self) -> FloatArray:
        """(4, 3) top left, top right, bottom right, bottom left corner in the parent frame."""
        return square_corners(self.width_m, self.height_m) @ self.pose[:3, :3].T + self.pose[:3, 3]


def square_corners(width_m: float, height_m: float | None = None) -> FloatArray:
    """(4, 3) corners in a marker's frame: top left, top right, bottom right, bottom left."""
    x = 0.5 * width_m
    y = x if height_m is None else 0.5 * height_m
    return np.array([[-x, y, 0.0], [x, y, 0.0], [x, -y, 0.0], [-x, -y, 0.0]])


def pose_of(x_axis: ArrayLike, y_axis: ArrayLike, origin: ArrayLike) -> FloatArray:
    """parent_from_surface of a surface whose x and y axes are given as unit vectors."""
    x, y = np.asarray(x_axis, dtype=np.float64), np.asarray(y_axis, dtype=np.float64)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = x, y, np.cross(x, y)
    pose[:3, 3] = origin
    return pose


def box_sides(
    size_m: ArrayLike, textures: dict[str, Texture], pose: FloatArray | None = None
) -> list[Surface]:
    """The sides of a box that stands on the origin. `size_m` (3,); `pose` (4, 4)."""
    length, width, height = np.asarray(size_m, dtype=np.float64)
    parent = np.eye(4) if pose is None else pose
    centre = np.array([0.0, 0.0, 0.5 * height])
    half = 0.5 * np.array([length, width, height])
    result = []
    for side, texture in textures.items():
        x_axis, y_axis = np.array(_SIDES[side][0]), np.array(_SIDES[side][1])
        outward = np.cross(x_axis, y_axis)
        local = pose_of(x_axis, y_axis, centre + outward * half)
        across = 2.0 * float(np.abs(x_axis) @ half)
        upward = 2.0 * float(np.abs(y_axis) @ half)
        result.append(Surface(parent @ local, across, upward, texture))
    return result


def box_against(origin: ArrayLike) -> FloatArray:
    """(4, 4) surface_from_box of a box whose front looks as the surface does.

    `origin` (3,) is the middle of its foot in the surface's frame.
    """
    # The surface's x is the box's y, its z the box's x.
    pose = np.eye(4)
    pose[:3, :3] = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    pose[:3, 3] = origin
    return pose


#: Reflectance of printer's black and of paper.
BLACK, WHITE = 0.05, 0.88

#: A pattern that differs from a marker in fewer cells could rightly be identified as it.
LEAST_DIFFERENCE = 3
_TRIES = 64

# Units per cell in which a texture is compared, and samples per unit.
_FINE = 4


def marker_texture(dictionary: MarkerDictionary, marker_id: int, quiet_cells: int = 1) -> Texture:
    """A marker as it is printed, on a white card."""
    where = np.flatnonzero(dictionary.ids == marker_id)
    if len(where) == 0:
        raise ValueError(f"marker {marker_id}: not in {dictionary.name}")
    return pattern_texture(dictionary, dictionary.patterns[where[0]], quiet_cells)


def pattern_texture(dictionary: MarkerDictionary, pattern: BoolArray, quiet_cells: int) -> Texture:
    """Any pattern laid out as the dictionary's markers are, on a white card."""
    cells = round(1.0 / dictionary.cell)
    first = dictionary.centres[0] * cells - 0.5
    # The cells of RAWSEEDS lie half a cell off the others' grid.
    per_cell = 1 if abs(first - round(first)) < 1e-9 else 2
    quiet = quiet_cells * per_cell
    side = cells * per_cell + 2 * quiet
    values = np.full((side, side), WHITE, dtype=np.float32)
    values[quiet : side - quiet, quiet : side - quiet] = BLACK
    begin = quiet + round(first * per_cell)
    inner = np.repeat(np.repeat(pattern, per_cell, axis=0), per_cell, axis=1)
    end = begin + len(inner)
    values[begin:end, begin:end][inner] = WHITE
    return Texture(values)


def marker_surface(
    dictionary: MarkerDictionary,
    marker_id: int,
    width_m: float,
    pose: FloatArray,
    quiet_cells: int = 1,
) -> Surface:
    """A marker whose black square is `width_m` wide, as a card in space. `pose` (4, 4)."""
    texture = marker_texture(dictionary, marker_id, quiet_cells)
    card_m = width_m * (1.0 + 2.0 * quiet_cells * dictionary.cell)
    return Surface(pose, card_m, card_m, texture, back=0.3)


def pattern_distance(dictionary: MarkerDictionary, pattern: BoolArray) -> int:
    """In how many cells a pattern differs, in any of its four rotations, from the nearest marker.
    `pattern` (G, G).
    """
    return round(_cells_apart(dictionary, pattern.astype(np.float32)))


def texture_distance(dictionary: MarkerDictionary, texture: Texture) -> float:
    """In how many cells a dark thing on a light ground differs from the nearest marker."""
    dark = texture.values < 0.5 * (BLACK + WHITE)
    if texture.smooth or not dark.any():
        return float("inf")
    rows, columns = np.flatnonzero(dark.any(axis=1)), np.flatnonzero(dark.any(axis=0))
    square = ~dark[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    units = round(1.0 / dictionary.cell) * _FINE
    fine = cv2.resize(
        square.astype(np.float32), (units * _FINE, units * _FINE), interpolation=cv2.INTER_NEAREST
    )
    half = 0.5 * dictionary.cell
    limits = np.rint((dictionary.centres[:, None] + [-half, half]) * len(fine)).astype(int)
    return _cells_apart(
        dictionary, np.array([[fine[a:b, c:d].mean() for c, d in limits] for a, b in limits])
    )


def _cells_apart(dictionary: MarkerDictionary, cells: Float32Array) -> float:
    """Sum of differences from the nearest marker; cells are 0 to 1, in any rotation."""
    known = dictionary.patterns.reshape(len(dictionary), -1)
    turned = (np.rot90(cells, k).ravel() for k in range(4))
    return float(min(np.abs(known - t).sum(axis=1).min() for t in turned))


def near_pattern(dictionary: MarkerDictionary, rng: np.random.Generator) -> BoolArray:
    """(G, G) A pattern laid out as the dictionary's, but of no marker in it.

    Half of the patterns are random, half are markers some of whose cells were changed.
    """
    used = np.asarray(dictionary.patterns.any(axis=0))
    changed = rng.random() < 0.5
    best, most = used, -1.0
    for _ in range(_TRIES):
        if changed:
            pattern = dictionary.patterns[rng.integers(len(dictionary))].copy()
            cells = np.argwhere(used)
            chosen = rng.choice(len(cells), rng.integers(3, 9), replace=False)
            pattern[tuple(cells[chosen].T)] ^= True
        else:
            pattern = (rng.random(used.shape) < rng.uniform(0.3, 0.7)) & used
        distance = pattern_distance(dictionary, pattern)
        if distance > most:
            best, most = pattern, distance
        if most >= LEAST_DIFFERENCE:
            break
    return best
