"""The plan of an office building: corridors in two loops, rooms, a yard; walls and openings.

Two long corridors along x, three short ones along y between them; rooms all round and in the two
blocks between; both long corridors lead out into the yard in the east. Metres, world frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tools.arrays import ByteArray, FloatArray
from tools.simulator.scene import (
    CEILING_M,
    Construction,
    Flooring,
    Look,
    Texture,
    flooring,
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
    """The building, its rooms and where there is a roof or which floor."""

    building: Construction
    rooms: list[Room]
    floor_kind: NDArray[np.int8]
    floorings: FloatArray
    indoors: ByteArray
    free_spans: list[tuple[FloatArray, FloatArray, FloatArray, float]] = field(default_factory=list)


def plan_rooms(rng: np.random.Generator) -> list[Room]:
    low, high = LONG_CORRIDORS_Y
    rooms: list[Room] = []

    def row(x0: float, x1: float, y0: float, y1: float, wall: str, windows: str) -> None:
        """Split a row of rooms along x."""
        borders = _split(x0, x1, rng)
        for a, b in pairwise(borders):
            rooms.append(Room(a, y0, b, y1, wall, (windows,) if windows else ()))

    def column(x0: float, x1: float, y0: float, y1: float, wall: str, windows: str) -> None:
        borders = _split(y0, y1, rng)
        for a, b in pairwise(borders):
            rooms.append(Room(x0, a, x1, b, wall, (windows,)))

    row(0.0, WIDTH_M, 0.0, low - HALF_CORRIDOR_M, "north", "south")
    row(0.0, WIDTH_M, high + HALF_CORRIDOR_M, DEPTH_M, "south", "north")
    column(
        0.0,
        SHORT_CORRIDORS_X[0] - HALF_CORRIDOR_M,
        low + HALF_CORRIDOR_M,
        high - HALF_CORRIDOR_M,
        "east",
        "west",
    )
    column(
        SHORT_CORRIDORS_X[2] + HALF_CORRIDOR_M,
        WIDTH_M,
        low + HALF_CORRIDOR_M,
        high - HALF_CORRIDOR_M,
        "west",
        "east",
    )
    middle = 0.5 * (low + high)
    for k in range(2):
        x0, x1 = SHORT_CORRIDORS_X[k] + HALF_CORRIDOR_M, SHORT_CORRIDORS_X[k + 1] - HALF_CORRIDOR_M
        row(x0, x1, low + HALF_CORRIDOR_M, middle, "south", "")
        row(x0, x1, middle, high - HALF_CORRIDOR_M, "north", "")
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
        flooring(Flooring.LINOLEUM, float(rng.uniform(0.24, 0.34)), 0.10, 1.0, 2.0),
        flooring(Flooring.PAVING, 0.30, 0.12, 0.05, 0.5),
        flooring(Flooring.GRASS, 0.16, 0.5, 0.0),
        flooring(Flooring.CARPET, 0.14, 0.25, 0.0),
        flooring(Flooring.PARQUET, 0.32, 0.15, 0.7, 0.07),
        flooring(Flooring.LINOLEUM, 0.22, 0.12, 0.8),
        flooring(Flooring.TILES, 0.40, 0.10, 1.2, 0.3),
        flooring(Flooring.CARPET, 0.24, 0.2, 0.0),
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
    building: Construction,
    start: tuple[float, float],
    end: tuple[float, float],
    openings: list[Opening],
    left: Look,
    right: Look,
    extend: tuple[bool, bool] = (True, True),
) -> None:
    """Add a wall. `start`, `end` (x, y)."""
    p, q = np.array(start), np.array(end)
    length = float(np.linalg.norm(q - p))
    e = (q - p) / length
    n = np.array([-e[1], e[0]])
    half = 0.5 * WALL_THICKNESS_M
    first = -half if extend[0] else 0.0
    last = length + half if extend[1] else length
    ordered = sorted(openings, key=lambda o: o.begin)
    for side, look in ((1.0, left), (-1.0, right)):
        face = p + side * half * n
        building.faces.append((face + first * e, face + last * e))
        at = first
        for hole in ordered:
            a, b = face + hole.begin * e, face + hole.end * e
            building.upright(face + at * e, a, 0.0, CEILING_M, look)
            building.upright(a, b, 0.0, hole.sill, look)
            building.upright(a, b, hole.head, CEILING_M, look)
            at = hole.end
        building.upright(face + at * e, face + last * e, 0.0, CEILING_M, look)
    for s in (first, last):  # the ends are seen only where the wall stands free
        building.upright(p + s * e - half * n, p + s * e + half * n, 0.0, CEILING_M, left)
    for hole in ordered:
        _add_reveal(building, p, e, n, hole, left)
        if isinstance(hole, Door):
            _add_door(building, p, e, n, hole)
        elif isinstance(hole, Window):
            _add_window(building, p, e, n, hole)


def _add_reveal(
    building: Construction, p: FloatArray, e: FloatArray, n: FloatArray, hole: Opening, look: Look
) -> None:
    half = 0.5 * WALL_THICKNESS_M
    inner = Look(Texture.PLAIN, look.albedo)
    if isinstance(hole, Door):
        inner = hole.casing
    for s in (hole.begin, hole.end):
        building.upright(
            p + s * e - half * n, p + s * e + half * n, hole.sill, hole.head, inner, "reveal"
        )
    corner = p + hole.begin * e - half * n
    across = (hole.end - hole.begin) * e
    building.level(corner, across, 2.0 * half * n, hole.head, inner)
    if hole.sill > 0.0:
        building.level(corner, across, 2.0 * half * n, hole.sill, inner)


def _add_door(
    building: Construction, p: FloatArray, e: FloatArray, n: FloatArray, door: Door
) -> None:
    half = 0.5 * WALL_THICKNESS_M
    for side in (1.0, -1.0):
        off = side * (half + 0.5 * _CASING_DEPTH_M) * n
        for s in (door.begin - 0.5 * _CASING_M, door.end + 0.5 * _CASING_M):
            building.box(
                p + s * e + off, _CASING_M, _CASING_DEPTH_M, 0.0, door.head + _CASING_M,
                door.casing, "door casing", e,
            )  # fmt: skip
        middle = p + 0.5 * (door.begin + door.end) * e + off
        building.box(
            middle, door.end - door.begin, _CASING_DEPTH_M, door.head, door.head + _CASING_M,
            door.casing, "", e,
        )  # fmt: skip
    if door.leaf_deg is None:
        return
    width = door.end - door.begin - 0.01
    hinge_s, sense = (door.end - 0.005, -1.0) if door.hinge_at_end else (door.begin + 0.005, 1.0)
    inward = float(door.inward)
    hinge = p + hinge_s * e + inward * (half - 0.5 * _LEAF_THICKNESS_M) * n
    angle = np.radians(door.leaf_deg)
    along = np.cos(angle) * sense * e + np.sin(angle) * inward * n
    building.box(
        hinge + 0.5 * width * along, width, _LEAF_THICKNESS_M, 0.01, door.head - 0.01,
        door.leaf, "door leaf", along,
    )  # fmt: skip
    across = np.array([-along[1], along[0]])
    for side in (1.0, -1.0):
        knob = hinge + (width - 0.07) * along + side * (0.5 * _LEAF_THICKNESS_M + 0.02) * across
        building.box(knob, 0.13, 0.03, 1.02, 1.05, Look(Texture.METAL, 0.6), "", along)


def _add_window(
    building: Construction, p: FloatArray, e: FloatArray, n: FloatArray, window: Window
) -> None:
    inside = float(window.inside) * n
    a, b = p + window.begin * e, p + window.end * e
    glass_out = -0.03 * inside
    building.upright(
        a, b, window.sill, window.head, Look(Texture.WINDOW, 0.1, emission=window.radiance)
    )
    building.upright(
        a + glass_out, b + glass_out, window.sill, window.head, Look(Texture.WINDOW, 0.08)
    )
    bar = 0.05
    width = window.end - window.begin
    for k in range(window.panes + 1):
        s = window.begin + 0.5 * bar + (width - bar) * k / window.panes
        building.box(
            p + s * e + 0.02 * inside, bar, 0.05, window.sill, window.head, window.frame,
            "window frame", e,
        )  # fmt: skip
    middle = p + 0.5 * (window.begin + window.end) * e + 0.02 * inside
    for z in (window.sill, window.head - bar):
        building.box(middle, width, 0.05, z, z + bar, window.frame, "", e)
    if window.blind > 0.0:
        z = window.head - window.blind * (window.head - window.sill)
        off = 0.05 * inside
        building.upright(a + off, b + off, z, window.head, Look(albedo=0.8, emission=0.75))
    board = 0.5 * WALL_THICKNESS_M + 0.10
    building.box(
        p + 0.5 * (window.begin + window.end) * e + board * inside,
        width + 0.1, 0.22, window.sill - 0.03, window.sill, window.frame, "", e,
    )  # fmt: skip
