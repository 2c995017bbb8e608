"""The world as the ray caster takes it: flat arrays, nothing but numbers.

World frame: the building's floor plan in x and y, z up, the floor at z = 0; metres. The robot frame
turns into it by a rotation about z and a shift: a robot at heading 0 looks along -y.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class Texture(IntEnum):
    """How the albedo of a surface varies over it."""

    PLAIN = 0
    WALL = 1
    WOOD = 2
    PHOTOGRAPH = 3
    PAPER = 4
    WINDOW = 5
    FACADE = 6
    FOLIAGE = 7
    METAL = 8


class Flooring(IntEnum):
    """How the albedo of the floor varies over it."""

    LINOLEUM = 0
    CARPET = 1
    TILES = 2
    PARQUET = 3
    PAVING = 4
    GRASS = 5


class Mark(IntEnum):
    """Shapes lying flat on the floor."""

    DISC = 0
    RING = 1
    ELLIPSE = 2
    PLATE = 3
    RECTANGLE = 4
    LIGHT_SPOT = 5
    PRINTED = 6


#: Columns of `Scene.surfaces`.
(
    SURFACE_TEXTURE,
    SURFACE_ALBEDO,
    SURFACE_PARAMETER,
    SURFACE_EMISSION,
    SURFACE_WIDTH,
    SURFACE_HEIGHT,
    SURFACE_SEED,
) = range(7)

#: Columns of `Scene.marks`.
(
    MARK_SHAPE,
    MARK_X,
    MARK_Y,
    MARK_RADIUS,
    MARK_SECOND,
    MARK_ANGLE,
    MARK_ALBEDO,
    MARK_GLOSS,
    MARK_REACH,
) = range(9)

#: Columns of `Scene.floorings`.
(
    FLOORING_KIND,
    FLOORING_ALBEDO,
    FLOORING_CONTRAST,
    FLOORING_GLOSS,
    FLOORING_PITCH,
) = range(5)


class Scene(NamedTuple):
    """A world made ready for rays."""

    quads: FloatArray
    """(Q, 12) parallelograms: normal, offset; dual vector and offset of the first edge; the same of
    the second. A point p of the plane has the coordinates ``s = dual . p - offset`` in [0, 1]."""
    surfaces: FloatArray
    """(Q, 7) what the parallelograms look like (`SURFACE_...`)."""
    quad_start: IntArray
    """(cells + 1,) where each grid cell's parallelograms begin in `quad_items`."""
    quad_items: IntArray
    marks: FloatArray
    """(M, 9) shapes on the floor (`MARK_...`), later ones on top of earlier ones."""
    mark_start: IntArray
    mark_items: IntArray
    grid: FloatArray
    """x and y of the grid's corner, side of a cell, cells along x, cells along y."""
    floor_kind: NDArray[np.int8]
    """(Ny, Nx) row of `floorings` on a finer raster of the same extent."""
    floorings: FloatArray
    """(F, 5) floor coverings (`FLOORING_...`)."""
    indoors: NDArray[np.uint8]
    """(Ny, Nx) 1 below a ceiling."""
    sun_reach: NDArray[np.uint8]
    """(Ny, Nx) 1 where the sun may reach the floor through a window."""
    floor_light: FloatArray
    """(Ny, Nx) light on the floor; 1 makes a white surface white."""
    side_light: FloatArray
    """(Ny, Nx, 3) light on upright surfaces: mean, and its change with the normal's x and y."""
    raster_m: float
    """Side of a raster element."""
    ceiling_m: float
    """Height of the ceiling."""
    sun: FloatArray
    """(4,) direction to the sun (unit vector) and its light on a surface facing it."""
    sky: float
    """Radiance of the sky."""
    photographs: NDArray[np.float32]
    """(P, L, S, S) photographs and their halved versions, 0..1."""
