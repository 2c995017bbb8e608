"""An office building with its contents, and routes through it."""

from __future__ import annotations

import numpy as np

from redetect.array_types import BoolArray, FloatArray
from tools.simulator.building import (
    DEPTH_M,
    DOOR_HEIGHT_M,
    HALF_CORRIDOR_M,
    LONG_CORRIDORS_Y,
    SHORT_CORRIDORS_X,
    WALL_THICKNESS_M,
    WIDTH_M,
    Door,
    Office,
    Opening,
    Room,
    Window,
    add_wall,
    lay_floors,
    plan_rooms,
)
from tools.simulator.furniture import add_lamps, add_yard, furnish_corridors, furnish_room
from tools.simulator.scene import Construction, Face, Look, Texture

_DOOR_M = 0.96


def build_office(rng: np.random.Generator) -> Office:
    """Build the office; doors, furniture, pictures, lamps and floors are drawn by `rng`."""
    building = Construction()
    rooms = plan_rooms(rng)
    paint = Look(Texture.WALL, float(rng.uniform(0.62, 0.75)), float(rng.uniform(0.10, 0.25)))
    room_paint = Look(Texture.WALL, float(rng.uniform(0.68, 0.8)), 0.3)
    office = Office(building, rooms, *lay_floors(rooms, rng))
    _add_walls(office, paint, room_paint, rng)
    building.add_crossing_edges()
    for room in rooms:
        furnish_room(building, room, rng)
    furnish_corridors(office, rng)
    add_lamps(building, rooms, rng)
    add_yard(building, rng)
    return office


def _add_walls(office: Office, paint: Look, room_paint: Look, rng: np.random.Generator) -> None:
    building, rooms = office.building, office.rooms
    low, high = LONG_CORRIDORS_Y
    leaves = [Look(Texture.WOOD, 0.42), Look(Texture.WOOD, 0.55), Look(Texture.PLAIN, 0.68)]
    casing = Look(albedo=float(rng.choice([0.12, 0.2, 0.8])))
    leaf = leaves[int(rng.integers(len(leaves)))]

    def door(room: Room, s: float, inward: int) -> Door:
        opened: float | None = 0.0
        if room.enterable:
            opened = float(rng.choice([80.0, 92.0, 105.0])) if rng.random() < 0.85 else None
        return Door(
            s - 0.5 * _DOOR_M, s + 0.5 * _DOOR_M, 0.0, DOOR_HEIGHT_M, leaf_deg=opened,
            inward=inward, hinge_at_end=bool(rng.random() < 0.5), casing=casing, leaf=leaf,
        )  # fmt: skip

    def corridor_wall(
        side: str, start: tuple[float, float], end: tuple[float, float],
        extend: tuple[bool, bool] = (True, True),
    ) -> None:  # fmt: skip
        """A wall with the doors of the rooms beside it, whose door wall is on that side."""
        # Doors open into the rooms, away from the corridor.
        corridor_is_left = side in ("north", "west")
        along = 0 if side in ("south", "north") else 1
        openings: list[Opening] = [
            door(room, room.door_at - start[along], -1 if corridor_is_left else 1)
            for room in rooms
            if room.door_wall == side
            and abs(room.door[1 - along] - start[1 - along]) <= 1e-6
            and start[along] <= room.door_at <= end[along]
        ]
        left, right = (paint, room_paint) if corridor_is_left else (room_paint, paint)
        add_wall(building, start, end, openings, left, right, extend)
        p, q = np.array(start), np.array(end)
        e = (q - p) / np.linalg.norm(q - p)
        n = np.array([-e[1], e[0]]) * (1.0 if corridor_is_left else -1.0)
        at = 0.15
        for hole in [*sorted(openings, key=lambda o: o.begin), None]:
            until = float(np.linalg.norm(q - p)) - 0.15 if hole is None else hole.begin - 0.12
            if until - at > 0.5:
                place = Face(p, e, n).moved(at, 0.5 * WALL_THICKNESS_M)
                office.free_spans.append((place, until - at))
            at = until if hole is None else hole.end + 0.12

    half = HALF_CORRIDOR_M
    # The rows of rooms south and north.
    for side, y in (("north", low - half), ("south", high + half)):
        corridor_wall(side, (0.0, y), (WIDTH_M, y), (False, False))
    # The blocks between the corridors.
    borders = [0.0, *(x + off for x in SHORT_CORRIDORS_X for off in (-half, half)), WIDTH_M]
    for x0, x1 in zip(borders[::2], borders[1::2]):
        for side, y in (("south", low + half), ("north", high - half)):
            corridor_wall(side, (x0, y), (x1, y), (x0 > 0.0, x1 < WIDTH_M))
    for middle in SHORT_CORRIDORS_X:
        for side, x in (("east", middle - half), ("west", middle + half)):
            corridor_wall(side, (x, low + half), (x, high - half))
    _add_partitions(building, rooms, room_paint)
    _add_outer_walls(building, rooms, room_paint, rng)


def _add_partitions(building: Construction, rooms: list[Room], paint: Look) -> None:
    """Walls between rooms."""
    inner = [room for room in rooms if not room.windows]
    done: set[tuple[float, float, float, float]] = set()
    for room in rooms:
        for x in (room.x0, room.x1) if room.door_wall in ("south", "north") else ():
            key = (x, room.y0, x, room.y1)
            blocked = (
                any(abs(x - c) < HALF_CORRIDOR_M + 0.01 for c in SHORT_CORRIDORS_X)
                and room in inner
            )
            if key not in done and 0.0 < x < WIDTH_M and not blocked:
                done.add(key)
                add_wall(building, (x, room.y0), (x, room.y1), [], paint, paint, (False, False))
        for y in (room.y0, room.y1) if room.door_wall in ("west", "east") else ():
            key = (room.x0, y, room.x1, y)
            if key not in done and all(
                abs(y - c) > HALF_CORRIDOR_M + 0.01 for c in LONG_CORRIDORS_Y
            ):
                done.add(key)
                add_wall(building, (room.x0, y), (room.x1, y), [], paint, paint, (False, False))
    middle = 0.5 * sum(LONG_CORRIDORS_Y)
    for k in range(2):
        x0, x1 = SHORT_CORRIDORS_X[k] + HALF_CORRIDOR_M, SHORT_CORRIDORS_X[k + 1] - HALF_CORRIDOR_M
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


_LOW, _HIGH = LONG_CORRIDORS_Y
_WEST, _MIDDLE, _EAST = SHORT_CORRIDORS_X
_YARD = WIDTH_M + 2.9

#: Two blocks one after the other, then the whole building by the yard: three loops.
FULL_ROUTE = (
    (1.5, _LOW), (_WEST, _LOW), (_MIDDLE, _LOW), (_MIDDLE, _HIGH), (_WEST, _HIGH), (_WEST, _LOW),
    (_MIDDLE, _LOW), (_EAST, _LOW), (_EAST, _HIGH), (_MIDDLE, _HIGH), (_MIDDLE, _LOW),
    (_EAST, _LOW), (_YARD, _LOW), (_YARD, _HIGH), (_EAST, _HIGH), (_MIDDLE, _HIGH), (_WEST, _HIGH),
    (1.5, _HIGH), (_WEST, _HIGH), (_WEST, _LOW), (1.5, _LOW),
)  # fmt: skip

_INTO_ROOM_M = 2.3


def office_route(office: Office, rng: np.random.Generator, visits: float) -> FloatArray:
    """The corners of a way through the office. Returns (K, 2)."""
    corners: list[FloatArray] = [np.array(FULL_ROUTE[0])]
    unvisited = {id(room) for room in office.rooms if room.enterable}
    for _ in range(3):
        for goal in FULL_ROUTE[1:]:
            start, end = corners[-1], np.array(goal)
            length = float(np.linalg.norm(end - start))
            if length < 1e-6:
                continue
            along = (end - start) / length
            for s, room in _doors_passed(office.rooms, start, along, length):
                if id(room) in unvisited and rng.random() < visits:
                    unvisited.discard(id(room))
                    corners += _visit(start + s * along, room, rng)
            corners.append(end)
    return np.array(corners)


def is_outside(poses: FloatArray) -> BoolArray:
    """(N,) bool: which poses lie in the yard."""
    return np.asarray(poses[:, 0] > WIDTH_M)


def _doors_passed(
    rooms: list[Room], start: FloatArray, along: FloatArray, length: float
) -> list[tuple[float, Room]]:
    """Rooms with doors on a stretch of corridor, by their place along it."""
    found = []
    for room in rooms:
        off = room.door - start
        s = float(off @ along)
        aside = off - s * along
        beside = float(np.linalg.norm(aside))
        facing = float(aside @ room.inward)
        # The stretch lies before the door, not behind a wall of the same line.
        if 1.3 < s < length - 1.3 and 1.0 < beside < 1.4 and facing > 0.9 * beside:
            found.append((s, room))
    return sorted(found, key=lambda item: item[0])


def _visit(at: FloatArray, room: Room, rng: np.random.Generator) -> list[FloatArray]:
    inside = room.door + (_INTO_ROOM_M + float(rng.uniform(-0.4, 0.4))) * room.inward
    return [at, inside, at]
