"""The plan of an office building: corridors in two loops, rooms, a yard; walls and openings.

Two long corridors along x, three short ones along y between them; rooms all round and in the two
blocks between; both long corridors lead out into the yard in the east. Metres, world frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from redetect.array_types import ByteArray, FloatArray
from tools.simulator.scene import (
    CEILING_M,
    Construction,
    Face,
    Flooring,
    Look,
    Texture,
    raster_shape,
    raster_slice,
)

WIDTH_M, DEPTH_M = 66.0, 27.0
EXTENT = (-4.0, -4.0, 80.0, 31.0)
LONG_CORRIDORS_Y = (6.5, 20.5)
SHORT_CORRIDORS_X = (7.0, 33.0, 59.0)
CORRIDOR_M = 2.4
YARD_X = 71.0

HALF_CORRIDOR_M = 0.5 * CORRIDOR_M
_FLOOR_CORRIDOR, _FLOOR_YARD, _FLOOR_LAWN, _FLOOR_ROOMS = 0, 1, 2, 3


@dataclass
class Room:
    """A room (m, world frame) and its door.
    `door_wall` is the side of the door: "south", "north", "west" or "east".
    """

    x0: float
    y0: float
    x1: float
    y1: float
    door_wall: str
    windows: tuple[str, ...] = ()
    door_at: float = 0.0
    enterable: bool = True
    floor: int = 0

    @property
    def centre(self) -> FloatArray:
        """The middle of the room."""
        return np.array([0.5 * (self.x0 + self.x1), 0.5 * (self.y0 + self.y1)])

    @property
    def door(self) -> FloatArray:
        """The middle of the doorway."""
        if self.door_wall in ("south", "north"):
            return np.array([self.door_at, self.y0 if self.door_wall == "south" else self.y1])
        return np.array([self.x0 if self.door_wall == "west" else self.x1, self.door_at])

    @property
    def inward(self) -> FloatArray:
        """Unit vector through the door into the room."""
        return np.array(_INWARD[self.door_wall])


_INWARD = {"south": (0.0, 1.0), "north": (0.0, -1.0), "west": (1.0, 0.0), "east": (-1.0, 0.0)}


@dataclass
class Office:
    """The building, its rooms, and rasters of roofs and kinds of floor."""

    building: Construction
    rooms: list[Room]
    floor_kind: NDArray[np.int8]
    floorings: FloatArray
    indoors: ByteArray
    free_spans: list[tuple[Face, float]] = field(default_factory=list)
    """Stretches of corridor walls without doors: where they begin, and their lengths (m)."""


def plan_rooms(rng: np.random.Generator) -> list[Room]:
    low, high = LONG_CORRIDORS_Y
    west, middle, east = SHORT_CORRIDORS_X
    half = HALF_CORRIDOR_M
    rooms: list[Room] = []

    def row(x: tuple[float, float], y: tuple[float, float], wall: str, *windows: str) -> None:
        """Split a row of rooms along the corridor on which their doors are."""
        along_x = wall in ("south", "north")
        for a, b in pairwise(_split(*(x if along_x else y), rng)):
            across, up = ((a, b), y) if along_x else (x, (a, b))
            rooms.append(Room(across[0], up[0], across[1], up[1], wall, windows))

    row((0.0, WIDTH_M), (0.0, low - half), "north", "south")
    row((0.0, WIDTH_M), (high + half, DEPTH_M), "south", "north")
    row((0.0, west - half), (low + half, high - half), "east", "west")
    row((east + half, WIDTH_M), (low + half, high - half), "west", "east")
    halfway = 0.5 * (low + high)
    for begin, end in ((west, middle), (middle, east)):
        row((begin + half, end - half), (low + half, halfway), "south")
        row((begin + half, end - half), (halfway, high - half), "north")
    for room in rooms:
        along = (room.x0, room.x1) if room.door_wall in ("south", "north") else (room.y0, room.y1)
        margin = 0.95
        room.door_at = float(rng.uniform(along[0] + margin, along[1] - margin))
        room.enterable = bool(rng.random() < 0.6)
    return rooms


def _split(begin: float, end: float, rng: np.random.Generator) -> FloatArray:
    count = max(round((end - begin) / 4.6), 1)
    borders = np.linspace(begin, end, count + 1)
    borders[1:-1] += rng.uniform(-0.6, 0.6, count - 1)
    return borders


def lay_floors(
    rooms: list[Room], rng: np.random.Generator
) -> tuple[NDArray[np.int8], FloatArray, ByteArray]:
    floorings = np.array([
        [Flooring.LINOLEUM, float(rng.uniform(0.24, 0.34)), 0.10, 1.0, 2.0],
        [Flooring.PAVING, 0.30, 0.12, 0.05, 0.5],
        [Flooring.GRASS, 0.16, 0.5, 0.0, 0.0],
        [Flooring.CARPET, 0.14, 0.25, 0.0, 0.0],
        [Flooring.PARQUET, 0.32, 0.15, 0.7, 0.07],
        [Flooring.LINOLEUM, 0.22, 0.12, 0.8, 0.0],
        [Flooring.TILES, 0.40, 0.10, 1.2, 0.3],
        [Flooring.CARPET, 0.24, 0.2, 0.0, 0.0],
    ])  # fmt: skip
    kind = np.full(raster_shape(EXTENT), _FLOOR_LAWN, dtype=np.int8)
    kind[raster_slice(EXTENT, WIDTH_M, 2.0, YARD_X + 2.5, DEPTH_M - 2.0)] = _FLOOR_YARD
    kind[raster_slice(EXTENT, 0.0, 0.0, WIDTH_M, DEPTH_M)] = _FLOOR_CORRIDOR
    for room in rooms:
        room.floor = int(rng.integers(_FLOOR_ROOMS, len(floorings)))
        kind[raster_slice(EXTENT, room.x0, room.y0, room.x1, room.y1)] = room.floor
    indoors = np.zeros(kind.shape, dtype=np.uint8)
    indoors[raster_slice(EXTENT, 0.0, 0.0, WIDTH_M, DEPTH_M)] = 1
    return kind, floorings, indoors


WALL_THICKNESS_M = 0.14
DOOR_HEIGHT_M = 2.05

_CASING_M = 0.07
_CASING_DEPTH_M = 0.022
_LEAF_THICKNESS_M = 0.04


@dataclass(frozen=True)
class Opening:
    """A hole in a wall, from `begin` to `end` along it and from `sill` to `head` (m)."""

    begin: float
    end: float
    sill: float
    head: float


@dataclass(frozen=True)
class Door(Opening):
    """A framed opening; `leaf_deg` is how far its leaf stands open (None: it has none)."""

    leaf_deg: float | None = None
    inward: int = 1  # side of the wall into which the leaf opens: +1 is left of its direction
    hinge_at_end: bool = False
    casing: Look = field(default=Look(albedo=0.25))
    leaf: Look = field(default=Look(Texture.WOOD, 0.45))


@dataclass(frozen=True)
class Window(Opening):
    """A glazed opening: `panes` of them side by side."""

    inside: int = 1  # side of the wall that is indoors: +1 is left of its direction
    panes: int = 2
    radiance: float = 5.0
    blind: float = 0.0  # share of its height that a blind covers, from the top
    frame: Look = field(default=Look(albedo=0.8))


def add_wall(
    building: Construction, start: tuple[float, float], end: tuple[float, float],
    openings: list[Opening], left: Look, right: Look, extend: tuple[bool, bool] = (True, True),
) -> None:  # fmt: skip
    """Add a wall. `start`, `end` (x, y)."""
    p, q = np.array(start), np.array(end)
    length = float(np.linalg.norm(q - p))
    e = (q - p) / length
    wall = Face(p, e, np.array([-e[1], e[0]]))
    half = 0.5 * WALL_THICKNESS_M
    first = -half if extend[0] else 0.0
    last = length + half if extend[1] else length
    ordered = sorted(openings, key=lambda o: o.begin)
    for side, look in ((1.0, left), (-1.0, right)):
        face = wall.moved(0.0, side * half)
        building.faces.append((face.point(first), face.point(last)))
        at = first
        for hole in ordered:
            building.panel(face, (at, hole.begin), (0.0, CEILING_M), look)
            building.panel(face, (hole.begin, hole.end), (0.0, hole.sill), look)
            building.panel(face, (hole.begin, hole.end), (hole.head, CEILING_M), look)
            at = hole.end
        building.panel(face, (at, last), (0.0, CEILING_M), look)
    for s in (first, last):  # the ends are seen only where the wall stands free
        building.upright(wall.point(s, -half), wall.point(s, half), 0.0, CEILING_M, left)
    for hole in ordered:
        _add_reveal(building, wall, hole, left)
        if isinstance(hole, Door):
            _add_door(building, wall, hole)
        elif isinstance(hole, Window):
            _add_window(building, wall, hole)


def _add_reveal(building: Construction, wall: Face, hole: Opening, look: Look) -> None:
    half = 0.5 * WALL_THICKNESS_M
    inner = hole.casing if isinstance(hole, Door) else Look(Texture.PLAIN, look.albedo)
    for s in (hole.begin, hole.end):
        ends = wall.point(s, -half), wall.point(s, half)
        building.upright(*ends, hole.sill, hole.head, inner, "reveal")
    across = (hole.end - hole.begin) * wall.along, 2.0 * half * wall.out
    building.level(wall.point(hole.begin, -half), *across, hole.head, inner)
    if hole.sill > 0.0:
        building.level(wall.point(hole.begin, -half), *across, hole.sill, inner)


def _add_door(building: Construction, wall: Face, door: Door) -> None:
    half = 0.5 * WALL_THICKNESS_M
    for side in (1.0, -1.0):
        off = side * (half + 0.5 * _CASING_DEPTH_M)
        top = door.head + _CASING_M
        for s in (door.begin - 0.5 * _CASING_M, door.end + 0.5 * _CASING_M):
            size = _CASING_M, _CASING_DEPTH_M
            building.block(wall.moved(s, off), size, (0.0, top), door.casing, "door casing")
        middle = wall.moved(0.5 * (door.begin + door.end), off)
        size = door.end - door.begin, _CASING_DEPTH_M
        building.block(middle, size, (door.head, top), door.casing)
    if door.leaf_deg is None:
        return
    width = door.end - door.begin - 0.01
    hinge_s, sense = (door.end - 0.005, -1.0) if door.hinge_at_end else (door.begin + 0.005, 1.0)
    inward = float(door.inward)
    angle = np.radians(door.leaf_deg)
    along = np.cos(angle) * sense * wall.along + np.sin(angle) * inward * wall.out
    hinge = wall.point(hinge_s, inward * (half - 0.5 * _LEAF_THICKNESS_M))
    leaf = Face(hinge, along, np.array([-along[1], along[0]]))
    heights = 0.01, door.head - 0.01
    middle = leaf.moved(0.5 * width)
    building.block(middle, (width, _LEAF_THICKNESS_M), heights, door.leaf, "door leaf")
    for side in (1.0, -1.0):
        knob = leaf.moved(width - 0.07, side * (0.5 * _LEAF_THICKNESS_M + 0.02))
        building.block(knob, (0.13, 0.03), (1.02, 1.05), Look(Texture.METAL, 0.6))


def _add_window(building: Construction, wall: Face, window: Window) -> None:
    inside = float(window.inside)
    span, heights = (window.begin, window.end), (window.sill, window.head)
    glass = Look(Texture.WINDOW, 0.1, emission=window.radiance)
    building.panel(wall, span, heights, glass)
    outer = [wall.point(at, -0.03 * inside) for at in span]
    building.upright(outer[0], outer[1], *heights, Look(Texture.WINDOW, 0.08))
    bar = 0.05
    width = window.end - window.begin
    for k in range(window.panes + 1):
        s = window.begin + 0.5 * bar + (width - bar) * k / window.panes
        upright = wall.moved(s, 0.02 * inside)
        building.block(upright, (bar, 0.05), heights, window.frame, "window frame")
    middle = 0.5 * (window.begin + window.end)
    for z in (window.sill, window.head - bar):
        building.block(wall.moved(middle, 0.02 * inside), (width, 0.05), (z, z + bar), window.frame)
    if window.blind > 0.0:
        z = window.head - window.blind * (window.head - window.sill)
        ends = [wall.point(at, 0.05 * inside) for at in span]
        building.upright(ends[0], ends[1], z, window.head, Look(albedo=0.8, emission=0.75))
    board = wall.moved(middle, (0.5 * WALL_THICKNESS_M + 0.10) * inside)
    building.block(board, (width + 0.1, 0.22), (window.sill - 0.03, window.sill), window.frame)
