"""What stands in the office's rooms and corridors, hangs from its ceilings, and fills its yard."""

from __future__ import annotations

import numpy as np

from tools.simulator import furniture
from tools.simulator.construction import Construction, Look
from tools.simulator.office_plan import (
    CORRIDOR_M,
    HALF_CORRIDOR_M,
    LONG_CORRIDORS_Y,
    SHORT_CORRIDORS_X,
    WIDTH_M,
    YARD_X,
    Office,
    Room,
)
from tools.simulator.scene import FloatArray, Texture
from tools.simulator.walls import WALL_THICKNESS_M


def furnish_room(building: Construction, room: Room, rng: np.random.Generator) -> None:
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


def furnish_corridors(office: Office, rng: np.random.Generator) -> None:
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
                post = np.array([x, y + side * (HALF_CORRIDOR_M - 0.17)])
                building.box(post, 0.12, 0.20, 0.0, 2.75, look, "portal")
            building.box(np.array([x, y]), 0.12, CORRIDOR_M - 0.5, 2.2, 2.74, look, "")


def add_lamps(building: Construction, rooms: list[Room], rng: np.random.Generator) -> None:
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


def add_yard(building: Construction, rng: np.random.Generator) -> None:
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
