"""An office building: corridors in two loops, rooms along them, and the yard beside it.

Plan (metres): two long corridors along x, three short ones along y between them; rooms all round
and in the two blocks between; both long corridors lead out into the yard in the east.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tools.simulator import furniture
from tools.simulator.construction import (
    Construction,
    Look,
    flooring,
    raster_shape,
    raster_slice,
)
from tools.simulator.scene import FloatArray, Flooring, Texture
from tools.simulator.walls import (
    DOOR_HEIGHT_M,
    WALL_THICKNESS_M,
    Door,
    Opening,
    Window,
    add_wall,
)

WIDTH_M, DEPTH_M = 66.0, 27.0
EXTENT = (-4.0, -4.0, 80.0, 31.0)
LONG_CORRIDORS_Y = (6.5, 20.5)
SHORT_CORRIDORS_X = (7.0, 33.0, 59.0)
CORRIDOR_M = 2.4
YARD_X = 71.0

_HALF = 0.5 * CORRIDOR_M
_DOOR_M = 0.96
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


def build_office(rng: np.random.Generator) -> Office:
    """Build the office; doors, furniture, pictures, lamps and floors are drawn by `rng`."""
    building = Construction()
    rooms = _plan_rooms(rng)
    paint = Look(Texture.WALL, float(rng.uniform(0.62, 0.75)), float(rng.uniform(0.10, 0.25)))
    room_paint = Look(Texture.WALL, float(rng.uniform(0.68, 0.8)), 0.3)
    office = Office(building, rooms, *_floors(rooms, rng))
    _add_walls(office, paint, room_paint, rng)
    building.add_crossing_edges()
    for room in rooms:
        _furnish_room(building, room, rng)
    _furnish_corridors(office, rng)
    _add_lamps(building, rooms, rng)
    _add_yard(building, rng)
    return office


# -- plan -----------------------------------------------------------------------------------


def _plan_rooms(rng: np.random.Generator) -> list[Room]:
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

    row(0.0, WIDTH_M, 0.0, low - _HALF, "north", "south")
    row(0.0, WIDTH_M, high + _HALF, DEPTH_M, "south", "north")
    column(0.0, SHORT_CORRIDORS_X[0] - _HALF, low + _HALF, high - _HALF, "east", "west")
    column(SHORT_CORRIDORS_X[2] + _HALF, WIDTH_M, low + _HALF, high - _HALF, "west", "east")
    middle = 0.5 * (low + high)
    for k in range(2):
        x0, x1 = SHORT_CORRIDORS_X[k] + _HALF, SHORT_CORRIDORS_X[k + 1] - _HALF
        row(x0, x1, low + _HALF, middle, "south", "")
        row(x0, x1, middle, high - _HALF, "north", "")
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


def _floors(
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


# -- walls ----------------------------------------------------------------------------------


def _add_walls(office: Office, paint: Look, room_paint: Look, rng: np.random.Generator) -> None:
    building, rooms = office.building, office.rooms
    low, high = LONG_CORRIDORS_Y
    leaves = [Look(Texture.WOOD, 0.42), Look(Texture.WOOD, 0.55), Look(Texture.PLAIN, 0.68)]
    casing = Look(albedo=float(rng.choice([0.12, 0.2, 0.8])))
    leaf = leaves[int(rng.integers(len(leaves)))]

    def doors(wall: str, line: float, begin: float, end: float, inward: int) -> list[Opening]:
        """Doors of the rooms that lie along a corridor wall."""
        found: list[Opening] = []
        for room in rooms:
            across = room.door[1] if wall in ("south", "north") else room.door[0]
            if room.door_wall != wall or abs(across - line) > 1e-6:
                continue
            if not begin <= room.door_at <= end:
                continue
            opened: float | None = 0.0
            if room.enterable:
                opened = float(rng.choice([80.0, 92.0, 105.0])) if rng.random() < 0.85 else None
            s = room.door_at - begin
            found.append(
                Door(
                    s - 0.5 * _DOOR_M, s + 0.5 * _DOOR_M, 0.0, DOOR_HEIGHT_M, leaf_deg=opened,
                    inward=inward, hinge_at_end=bool(rng.random() < 0.5), casing=casing, leaf=leaf,
                )
            )  # fmt: skip
        return found

    def corridor_wall(
        start: tuple[float, float], end: tuple[float, float], openings: list[Opening],
        corridor_is_left: bool, extend: tuple[bool, bool],
    ) -> None:  # fmt: skip
        left, right = (paint, room_paint) if corridor_is_left else (room_paint, paint)
        add_wall(building, start, end, openings, left, right, extend)
        p, q = np.array(start), np.array(end)
        e = (q - p) / np.linalg.norm(q - p)
        n = np.array([-e[1], e[0]]) * (1.0 if corridor_is_left else -1.0)
        at = 0.15
        for hole in [*sorted(openings, key=lambda o: o.begin), None]:
            until = float(np.linalg.norm(q - p)) - 0.15 if hole is None else hole.begin - 0.12
            if until - at > 0.5:
                office.free_spans.append(
                    (p + at * e + 0.5 * WALL_THICKNESS_M * n, e, n, until - at)
                )
            at = until if hole is None else hole.end + 0.12

    # The rows of rooms south and north; their doors open into the rooms.
    y = low - _HALF
    corridor_wall((0.0, y), (WIDTH_M, y), doors("north", y, 0.0, WIDTH_M, -1), True,
                  (False, False))  # fmt: skip
    y = high + _HALF
    corridor_wall((0.0, y), (WIDTH_M, y), doors("south", y, 0.0, WIDTH_M, 1), False,
                  (False, False))  # fmt: skip
    # The blocks between the corridors.
    pieces = [
        (0.0, SHORT_CORRIDORS_X[0] - _HALF),
        (SHORT_CORRIDORS_X[0] + _HALF, SHORT_CORRIDORS_X[1] - _HALF),
        (SHORT_CORRIDORS_X[1] + _HALF, SHORT_CORRIDORS_X[2] - _HALF),
        (SHORT_CORRIDORS_X[2] + _HALF, WIDTH_M),
    ]
    for x0, x1 in pieces:
        extend = (x0 > 0.0, x1 < WIDTH_M)
        y = low + _HALF
        corridor_wall((x0, y), (x1, y), doors("south", y, x0, x1, 1), False, extend)
        y = high - _HALF
        corridor_wall((x0, y), (x1, y), doors("north", y, x0, x1, -1), True, extend)
    y0, y1 = low + _HALF, high - _HALF
    for k, x in enumerate(SHORT_CORRIDORS_X):
        corridor_wall((x - _HALF, y0), (x - _HALF, y1),
                      doors("east", x - _HALF, y0, y1, 1) if k == 0 else [], False,
                      (True, True))  # fmt: skip
        corridor_wall((x + _HALF, y0), (x + _HALF, y1),
                      doors("west", x + _HALF, y0, y1, -1) if k == 2 else [], True,
                      (True, True))  # fmt: skip
    _add_partitions(building, rooms, room_paint)
    _add_outer_walls(building, rooms, room_paint, rng)


def _add_partitions(building: Construction, rooms: list[Room], paint: Look) -> None:
    """Walls between rooms."""
    inner = [room for room in rooms if not room.windows]
    done: set[tuple[float, float, float, float]] = set()
    for room in rooms:
        for x in (room.x0, room.x1) if room.door_wall in ("south", "north") else ():
            key = (x, room.y0, x, room.y1)
            blocked = any(abs(x - c) < _HALF + 0.01 for c in SHORT_CORRIDORS_X) and room in inner
            if key not in done and 0.0 < x < WIDTH_M and not blocked:
                done.add(key)
                add_wall(building, (x, room.y0), (x, room.y1), [], paint, paint, (False, False))
        for y in (room.y0, room.y1) if room.door_wall in ("west", "east") else ():
            key = (room.x0, y, room.x1, y)
            if key not in done and all(abs(y - c) > _HALF + 0.01 for c in LONG_CORRIDORS_Y):
                done.add(key)
                add_wall(building, (room.x0, y), (room.x1, y), [], paint, paint, (False, False))
    middle = 0.5 * sum(LONG_CORRIDORS_Y)
    for k in range(2):
        x0, x1 = SHORT_CORRIDORS_X[k] + _HALF, SHORT_CORRIDORS_X[k + 1] - _HALF
        add_wall(building, (x0, middle), (x1, middle), [], paint, paint, (False, False))


def _add_outer_walls(
    building: Construction, rooms: list[Room], paint: Look, rng: np.random.Generator
) -> None:
    facade = Look(Texture.FACADE, 0.5)
    frame = Look(albedo=float(rng.choice([0.15, 0.8])))

    def windows(wall: str, inside: int) -> list[Opening]:
        found: list[Opening] = []
        for room in rooms:
            if wall not in room.windows:
                continue
            a, b = (room.x0, room.x1) if wall in ("south", "north") else (room.y0, room.y1)
            count = 2 if b - a > 4.4 else 1
            for k in range(count):
                middle = a + (b - a) * (k + 0.5) / count
                half = float(rng.uniform(0.65, 0.9))
                blind = float(rng.choice([0.0, 0.0, 0.35, 0.7]))
                found.append(
                    Window(
                        middle - half, middle + half, 0.92, 2.25, inside=inside,
                        panes=int(rng.integers(1, 3)), radiance=float(rng.uniform(4.0, 7.0)),
                        blind=blind, frame=frame,
                    )
                )  # fmt: skip
        return found

    low, high = LONG_CORRIDORS_Y
    add_wall(building, (0.0, 0.0), (WIDTH_M, 0.0), windows("south", 1), paint, facade)
    add_wall(building, (0.0, DEPTH_M), (WIDTH_M, DEPTH_M), windows("north", -1), facade, paint)
    ends: list[Opening] = [
        Window(y - 0.75, y + 0.75, 0.9, 2.3, inside=-1, panes=2, radiance=6.0, frame=frame)
        for y in (low, high)
    ]
    add_wall(building, (0.0, 0.0), (0.0, DEPTH_M), [*windows("west", -1), *ends], facade, paint)
    dark = Look(albedo=0.1)
    exits: list[Opening] = [
        Door(y - 0.9, y + 0.9, 0.0, 2.25, leaf_deg=None, casing=dark) for y in (low, high)
    ]
    add_wall(
        building, (WIDTH_M, 0.0), (WIDTH_M, DEPTH_M), [*windows("east", 1), *exits], paint, facade
    )


# -- furnishing -----------------------------------------------------------------------------


def _furnish_room(building: Construction, room: Room, rng: np.random.Generator) -> None:
    """Furniture along the walls; the way from the door to the middle stays free."""
    half = 0.5 * WALL_THICKNESS_M
    sides = {
        "south": ((room.x0, room.y0 + half), (1.0, 0.0), (0.0, 1.0), room.x1 - room.x0),
        "north": ((room.x0, room.y1 - half), (1.0, 0.0), (0.0, -1.0), room.x1 - room.x0),
        "west": ((room.x0 + half, room.y0), (0.0, 1.0), (1.0, 0.0), room.y1 - room.y0),
        "east": ((room.x1 - half, room.y0), (0.0, 1.0), (-1.0, 0.0), room.y1 - room.y0),
    }
    for wall, (corner, along, out, length) in sides.items():
        if wall == room.door_wall:
            continue
        p, e, n = np.array(corner), np.array(along), np.array(out)
        if wall in room.windows:
            count = 2 if length > 4.4 else 1
            for k in range(count):
                at = p + length * (k + 0.5) / count * e
                furniture.add_radiator(building, at, e, n, 1.2)
            _add_desk(building, p + 0.3 * length * e + 0.75 * n, e, rng)
            continue
        _fill_wall(building, p, e, n, length, rng)


def _add_desk(
    building: Construction, centre: FloatArray, e: FloatArray, rng: np.random.Generator
) -> None:
    n = np.array([-e[1], e[0]])
    top = Look(Texture.WOOD, float(rng.uniform(0.4, 0.65)))
    furniture.add_table(building, centre, e, 1.5, 0.75, top)
    furniture.add_monitor(building, centre + rng.uniform(-0.3, 0.3) * e, e)
    away = 1.0 if rng.random() < 0.5 else -1.0
    spot = centre + 0.62 * n * away + rng.uniform(-0.3, 0.3) * e
    furniture.add_chair(building, spot, e * away, float(rng.choice([0.05, 0.12, 0.4])))


def _fill_wall(
    building: Construction,
    p: FloatArray,
    e: FloatArray,
    n: FloatArray,
    length: float,
    rng: np.random.Generator,
) -> None:
    """Cupboards, shelves and pictures along a wall of a room."""
    at = 0.35
    while at < length - 1.2:
        kind = rng.random()
        if kind < 0.25:
            width = float(rng.uniform(0.8, 1.1))
            look = Look(Texture.WOOD if rng.random() < 0.5 else Texture.METAL,
                        float(rng.choice([0.2, 0.35, 0.6])))  # fmt: skip
            height = float(rng.choice([0.75, 1.2, 1.9]))
            furniture.add_cupboard(building, p + (at + 0.5 * width) * e, e, n, width, 0.42, height,
                                   look)  # fmt: skip
        elif kind < 0.40:
            width = float(rng.uniform(0.8, 1.0))
            furniture.add_shelf(building, p + (at + 0.5 * width) * e, e, n, width, rng)
        elif kind < 0.65:
            width = _hang_picture(building, p + (at + 0.5) * e, e, n, rng)
        else:
            width = float(rng.uniform(0.3, 0.9))
        at += width + float(rng.uniform(0.1, 0.5))


def _hang_picture(
    building: Construction, at: FloatArray, e: FloatArray, n: FloatArray, rng: np.random.Generator
) -> float:
    """Hang a picture or notice about a place on a wall; returns its width (m)."""
    if rng.random() < 0.65:
        width, height = float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.5, 0.8))
        look = Look(Texture.PHOTOGRAPH, 0.85, float(rng.choice([0.0, 0.03, 0.06])))
    else:
        width, height = float(rng.choice([0.21, 0.42, 0.6])), 0.6
        look = Look(Texture.PAPER, 0.85)
    z = float(rng.uniform(1.05, 1.4))
    furniture.add_poster(building, at, e, n, width, height, z, look, bool(rng.random() < 0.5))
    return width


def _furnish_corridors(office: Office, rng: np.random.Generator) -> None:
    building = office.building
    locker_albedo = float(rng.uniform(0.3, 0.5))
    for start, e, n, length in office.free_spans:
        at = float(rng.uniform(0.0, 0.4))
        while at < length - 0.45:
            rest = length - at
            place = start + at * e
            kind = rng.random()
            if kind < 0.14 and rest > 1.4:
                count = min(int(rest // 0.4), int(rng.integers(3, 7)))
                used = furniture.add_lockers(building, place, e, n, count, locker_albedo)
            elif kind < 0.24 and rest > 1.0:
                used = float(rng.uniform(0.7, 1.0))
                furniture.add_cupboard(
                    building, place + 0.5 * used * e, e, n, used, 0.36,
                    float(rng.choice([0.8, 1.1, 1.8])), Look(Texture.WOOD, 0.4),
                )  # fmt: skip
            elif kind < 0.52 and rest > 1.0:
                used = 0.5 + _hang_picture(building, place + 0.5 * e, e, n, rng)
            elif kind < 0.62:
                used = 0.32
                building.box(place + 0.16 * e + 0.09 * n, 0.32, 0.18, 0.0, 2.8,
                             Look(Texture.WALL, 0.6, 0.2), "pillar", e)  # fmt: skip
            elif kind < 0.68:
                used = 0.4
                building.box(place + 0.2 * e + 0.07 * n, 0.26, 0.14, 0.85, 1.5,
                             Look(albedo=0.22), "extinguisher box", e)  # fmt: skip
            elif kind < 0.75:
                used = 0.45
                furniture.add_bin(building, place + 0.2 * e + 0.2 * n, float(rng.uniform(0.1, 0.6)))
            elif kind < 0.80 and rest > 0.6:
                used = 0.6
                furniture.add_plant(building, place + 0.3 * e + 0.22 * n, rng)
            else:
                used = float(rng.uniform(0.3, 1.0))
            at += used + float(rng.uniform(0.15, 0.8))
    _add_fire_doors(building, rng)


def _add_fire_doors(building: Construction, rng: np.random.Generator) -> None:
    """Portals across the long corridors."""
    look = Look(albedo=float(rng.choice([0.3, 0.75])))
    for y in LONG_CORRIDORS_Y:
        for x in (10.5, 18.0, 29.5, 36.5, 46.0, 55.5):
            if rng.random() < 0.5:
                continue
            for side in (-1.0, 1.0):
                building.box(np.array([x, y + side * (_HALF - 0.17)]), 0.12, 0.20, 0.0, 2.75, look,
                             "portal")  # fmt: skip
            building.box(np.array([x, y]), 0.12, CORRIDOR_M - 0.5, 2.2, 2.74, look, "")


def _add_lamps(building: Construction, rooms: list[Room], rng: np.random.Generator) -> None:
    low, high = LONG_CORRIDORS_Y
    for y in (low, high):
        for x in np.arange(1.6, WIDTH_M, 2.7):
            if rng.random() < 0.85:
                building.lamp(float(x), y, 1.2, 0.25, float(rng.uniform(5.0, 8.0)))
    for x in SHORT_CORRIDORS_X:
        for y in np.arange(low + 2.6, high - 1.6, 2.7):
            if rng.random() < 0.85:
                building.lamp(x, float(y), 0.25, 1.2, float(rng.uniform(5.0, 8.0)))
    for room in rooms:
        lit = rng.random() < (0.45 if room.windows else 0.95)
        if not lit:
            continue
        for a in (0.3, 0.7):
            x = room.x0 + a * (room.x1 - room.x0)
            building.lamp(x, float(room.centre[1]), 0.25, 1.2, float(rng.uniform(5.0, 8.0)))


def _add_yard(building: Construction, rng: np.random.Generator) -> None:
    """Hedges, a bicycle shed, posts and cars east of the building."""
    for y in np.arange(2.5, 25.0, 2.6):
        building.box(np.array([YARD_X + 3.2, float(y)]), 0.7, 2.3, 0.0,
                     float(rng.uniform(0.9, 1.5)), Look(Texture.FOLIAGE, 0.14), "")  # fmt: skip
    for y in np.arange(3.0, 25.0, 4.4):
        building.box(np.array([YARD_X + 2.2, float(y)]), 0.12, 0.12, 0.0, 4.0,
                     Look(Texture.METAL, 0.3), "post")  # fmt: skip
    for y in (9.6, 12.6, 17.0):
        centre = np.array([WIDTH_M + 1.6, y])
        building.box(centre, 1.7, 2.2, 0.25, 0.95, Look(Texture.METAL, 0.25), "")
        building.box(centre, 1.4, 1.3, 0.95, 1.45, Look(Texture.METAL, 0.12), "")
    building.box(
        np.array([YARD_X + 7.0, 13.5]), 3.0, 30.0, 0.0, 6.0, Look(Texture.FACADE, 0.4), "wall"
    )
