"""The plan of an office building: corridors in two loops, rooms along them, the yard beside it.

Two long corridors along x, three short ones along y between them; rooms all round and in the two
blocks between; both long corridors lead out into the yard in the east. Metres, world frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tools.simulator.construction import Construction, flooring, raster_shape, raster_slice
from tools.simulator.scene import FloatArray, Flooring

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
    indoors: NDArray[np.uint8]
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
) -> tuple[NDArray[np.int8], FloatArray, NDArray[np.uint8]]:
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
