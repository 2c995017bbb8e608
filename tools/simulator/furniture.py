"""Furniture of rooms and corridors, things on walls and ceilings, and discs on the floor."""

from __future__ import annotations

from itertools import cycle

import numpy as np

from redetect.array_types import FloatArray
from tools.simulator.building import (
    CORRIDOR_M,
    HALF_CORRIDOR_M,
    LONG_CORRIDORS_Y,
    SHORT_CORRIDORS_X,
    WALL_THICKNESS_M,
    WIDTH_M,
    YARD_X,
    Office,
    Room,
)
from tools.simulator.laser.site import clearance
from tools.simulator.scene import Construction, Face, FloorMark, Look, Mark, Texture

_DARK = Look(albedo=0.06)
_METAL_LEG = Look(Texture.METAL, 0.35)


def add_lockers(building: Construction, face: Face, count: int, albedo: float) -> float:
    """Add a row of lockers beginning at a place on a wall; returns its length (m)."""
    width, depth, height = 0.40, 0.38, 1.80
    total = count * width
    middle = face.moved(0.5 * total, 0.5 * depth)
    building.block(middle, (total, depth), (0.0, height), Look(Texture.METAL, albedo), "lockers")
    front = face.moved(0.0, depth + 0.003)
    for k in range(1, count):
        gap = front.moved(k * width)
        building.panel(gap, (-0.005, 0.005), (0.05, height), _DARK, "locker gap")
    for k in range(count):
        left = front.moved(k * width + 0.11)
        for z in (1.50, 1.54, 1.58, 1.62):
            building.panel(left, (0.0, 0.18), (z, z + 0.015), _DARK)
        lock = front.moved(k * width + 0.33).moved(0.0, 0.01)
        building.block(lock, (0.03, 0.02), (0.95, 1.0), _METAL_LEG)
    return total


def add_poster(
    building: Construction, face: Face, size: tuple[float, float], z: float, look: Look,
    framed: bool,
) -> None:  # fmt: skip
    """Hang a poster, notice or picture centred at a place on a wall, its lower side at z."""
    width, height = size
    face = face.moved(0.0, 0.006)
    a, b = face.point(-0.5 * width), face.point(0.5 * width)
    # Seen from the room, the left side comes first.
    building.upright(b, a, z, z + height, look, "poster")
    building.pictures.append((*a, *b, z, z + height))
    if framed:
        bar = Look(albedo=0.12)
        for side in (a, b):
            upright = face._replace(at=side).moved(0.0, 0.008)
            building.block(
                upright, (0.025, 0.02), (z - 0.01, z + height + 0.01), bar, "picture frame"
            )
        for edge in (z - 0.012, z + height):
            building.block(face.moved(0.0, 0.008), (width, 0.02), (edge, edge + 0.012), bar)


def add_radiator(building: Construction, face: Face, width: float) -> None:
    """Add a ribbed radiator centred at a place on a wall."""
    ribs = int(width / 0.12)
    look = Look(albedo=0.75)
    for k in range(ribs):
        rib = face.moved((k + 0.5 - 0.5 * ribs) * 0.12, 0.09)
        building.block(rib, (0.07, 0.08), (0.12, 0.68), look, "radiator rib")
    building.block(face.moved(0.0, 0.06), (ribs * 0.12, 0.02), (0.14, 0.66), Look(albedo=0.55))


def add_cupboard(
    building: Construction, face: Face, width: float, depth: float, height: float, look: Look
) -> None:
    """Add a cupboard with doors, its back centred at a place on a wall."""
    building.block(face.moved(0.0, 0.5 * depth), (width, depth), (0.0, height), look, "cupboard")
    front = face.moved(0.0, depth + 0.003)
    building.panel(front, (-0.004, 0.004), (0.06, height - 0.02), _DARK, "cupboard gap")
    for side in (-1.0, 1.0):
        handle = front.moved(side * 0.05, 0.01)
        building.block(handle, (0.015, 0.02), (0.5 * height, 0.5 * height + 0.12), _DARK)


def add_shelf(building: Construction, face: Face, width: float, rng: np.random.Generator) -> None:
    """Add a shelf full of books, its back centred at a place on a wall."""
    depth, height = 0.30, 1.95
    board = Look(Texture.WOOD, 0.5)
    for s in (-0.5 * width, 0.5 * width):
        side = face.moved(s, 0.5 * depth)
        building.block(side, (0.025, depth), (0.0, height), board, "shelf")
    levels = 5
    for level in range(levels + 1):
        z = level * (height - 0.03) / levels
        building.block(face.moved(0.0, 0.5 * depth), (width, depth), (z, z + 0.025), board)
        if level == levels:
            break
        s = -0.5 * width + 0.03
        while s < 0.5 * width - 0.12:
            thick = float(rng.uniform(0.025, 0.09))
            tall = float(rng.uniform(0.22, 0.33))
            grey = float(rng.choice([0.08, 0.15, 0.3, 0.5, 0.75, 0.85]))
            spine = face.moved(0.0, depth - 0.04).moved(s)
            heights = (z + 0.025, z + 0.025 + tall)
            building.panel(spine, (0.0, thick), heights, Look(albedo=grey), "book")
            s += thick + (0.12 if rng.random() < 0.08 else 0.002)
    back = face.moved(0.0, 0.02)
    building.panel(back, (-0.5 * width, 0.5 * width), (0.0, height), Look(albedo=0.12))


def add_table(building: Construction, place: Face, width: float, depth: float, top: Look) -> None:
    """Add a table with four legs."""
    building.block(place, (width, depth), (0.70, 0.73), top)
    for i in (-1.0, 1.0):
        for j in (-1.0, 1.0):
            foot = place.moved(i * (0.5 * width - 0.06), j * (0.5 * depth - 0.06))
            building.block(foot, (0.05, 0.05), (0.0, 0.70), _METAL_LEG, "table leg")


def add_monitor(building: Construction, place: Face) -> None:
    """Put a screen on a table."""
    building.block(place, (0.2, 0.16), (0.73, 0.75), _DARK)
    building.block(place, (0.05, 0.04), (0.75, 0.85), _DARK)
    building.block(place, (0.48, 0.05), (0.85, 1.18), Look(albedo=0.07), "screen")


def add_chair(building: Construction, place: Face, albedo: float) -> None:
    """Add a chair."""
    look = Look(albedo=albedo)
    building.block(place, (0.44, 0.44), (0.43, 0.47), look)
    building.block(place.moved(0.0, -0.2), (0.42, 0.035), (0.62, 0.92), look, "chair back")
    for i in (-0.19, 0.19):
        for j in (-0.19, 0.19):
            top = 0.62 if j < 0.0 else 0.43
            building.block(place.moved(i, j), (0.028, 0.028), (0.0, top), _METAL_LEG)


def add_plant(building: Construction, centre: FloatArray, rng: np.random.Generator) -> None:
    """Add a potted plant."""
    building.box(centre, 0.32, 0.32, 0.0, 0.32, Look(albedo=0.55), "pot")
    for _ in range(7):
        angle = rng.uniform(0.0, np.pi)
        e = np.array([np.cos(angle), np.sin(angle)])
        size = rng.uniform(0.2, 0.5)
        z = rng.uniform(0.35, 1.0)
        leaf = Face(centre + rng.uniform(-0.1, 0.1, 2), e, e)
        leaves = Look(Texture.FOLIAGE, 0.13)
        building.panel(leaf, (-0.5 * size, 0.5 * size), (z, z + size), leaves)


def add_bin(building: Construction, centre: FloatArray, albedo: float) -> None:
    """Add a round waste bin (a prism of ten sides: its outline is no edge of the building)."""
    angle = np.arange(11) * (2.0 * np.pi / 10)
    ring = centre + 0.15 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    for k in range(10):
        building.upright(ring[k], ring[k + 1], 0.0, 0.42, Look(Texture.METAL, albedo))
    building.footprints.append(ring[:10:3])


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
        face = Face(np.array(corner), np.array(along), np.array(out))
        if wall in room.windows:
            count = 2 if length > 4.4 else 1
            for k in range(count):
                add_radiator(building, face.moved(length * (k + 0.5) / count), 1.2)
            _add_desk(building, face.point(0.3 * length, 0.75), face.along, rng)
            continue
        _fill_wall(building, face, length, rng)


def _add_desk(
    building: Construction, centre: FloatArray, e: FloatArray, rng: np.random.Generator
) -> None:
    desk = Face(centre, e, np.array([-e[1], e[0]]))
    add_table(building, desk, 1.5, 0.75, Look(Texture.WOOD, float(rng.uniform(0.4, 0.65))))
    add_monitor(building, desk.moved(rng.uniform(-0.3, 0.3)))
    away = 1.0 if rng.random() < 0.5 else -1.0
    spot = centre + 0.62 * desk.out * away + rng.uniform(-0.3, 0.3) * e
    turned = Face(spot, e * away, np.array([-(e * away)[1], (e * away)[0]]))
    add_chair(building, turned, float(rng.choice([0.05, 0.12, 0.4])))


def _fill_wall(building: Construction, face: Face, length: float, rng: np.random.Generator) -> None:
    """Cupboards, shelves and pictures along a wall of a room."""
    at = 0.35
    while at < length - 1.2:
        kind = rng.random()
        if kind < 0.25:
            width = float(rng.uniform(0.8, 1.1))
            look = Look(Texture.WOOD if rng.random() < 0.5 else Texture.METAL,
                        float(rng.choice([0.2, 0.35, 0.6])))  # fmt: skip
            height = float(rng.choice([0.75, 1.2, 1.9]))
            add_cupboard(building, face.moved(at + 0.5 * width), width, 0.42, height, look)
        elif kind < 0.40:
            width = float(rng.uniform(0.8, 1.0))
            add_shelf(building, face.moved(at + 0.5 * width), width, rng)
        elif kind < 0.65:
            width = _hang_picture(building, face.moved(at + 0.5), rng)
        else:
            width = float(rng.uniform(0.3, 0.9))
        at += width + float(rng.uniform(0.1, 0.5))


def _hang_picture(building: Construction, face: Face, rng: np.random.Generator) -> float:
    """Hang a picture or notice about a place on a wall; returns its width (m)."""
    if rng.random() < 0.65:
        width, height = float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.5, 0.8))
        look = Look(Texture.PHOTOGRAPH, 0.85, float(rng.choice([0.0, 0.03, 0.06])))
    else:
        width, height = float(rng.choice([0.21, 0.42, 0.6])), 0.6
        look = Look(Texture.PAPER, 0.85)
    z = float(rng.uniform(1.05, 1.4))
    add_poster(building, face, (width, height), z, look, bool(rng.random() < 0.5))
    return width


def furnish_corridors(office: Office, rng: np.random.Generator) -> None:
    building = office.building
    locker_albedo = float(rng.uniform(0.3, 0.5))
    for wall, length in office.free_spans:
        at = float(rng.uniform(0.0, 0.4))
        while at < length - 0.45:
            rest = length - at
            place = wall.moved(at)
            kind = rng.random()
            if kind < 0.14 and rest > 1.4:
                count = min(int(rest // 0.4), int(rng.integers(3, 7)))
                used = add_lockers(building, place, count, locker_albedo)
            elif kind < 0.24 and rest > 1.0:
                used = float(rng.uniform(0.7, 1.0))
                height = float(rng.choice([0.8, 1.1, 1.8]))
                middle = place.moved(0.5 * used)
                add_cupboard(building, middle, used, 0.36, height, Look(Texture.WOOD, 0.4))
            elif kind < 0.52 and rest > 1.0:
                used = 0.5 + _hang_picture(building, place.moved(0.5), rng)
            elif kind < 0.62:
                used, look = 0.32, Look(Texture.WALL, 0.6, 0.2)
                building.block(place.moved(0.16, 0.09), (0.32, 0.18), (0.0, 2.8), look, "pillar")
            elif kind < 0.68:
                used, middle, look = 0.4, place.moved(0.2, 0.07), Look(albedo=0.22)
                building.block(middle, (0.26, 0.14), (0.85, 1.5), look, "extinguisher box")
            elif kind < 0.75:
                used = 0.45
                add_bin(building, place.point(0.2, 0.2), float(rng.uniform(0.1, 0.6)))
            elif kind < 0.80 and rest > 0.6:
                used = 0.6
                add_plant(building, place.point(0.3, 0.22), rng)
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


DISC_RADIUS_M = 0.10

_ALONG_SIDE_M = (0.15, 2.2)
_APART_M = 0.34
_FROM_FURNITURE_M = 0.17
#: Shape, radius and second radius (or half sides), albedo; one of each kind in turn.
_LOOKALIKES = {
    "ring": (Mark.RING, 0.10, 0.055, 0.85),
    "ellipse": (Mark.ELLIPSE, 0.16, 0.06, 0.8),
    "large disc": (Mark.DISC, 0.16, 0.0, 0.8),
    "dark disc": (Mark.DISC, 0.10, 0.0, 0.05),
    "plate": (Mark.PLATE, 0.125, 0.085, 0.8),
    "paper": (Mark.RECTANGLE, 0.149, 0.105, 0.85),
    "sheet": (Mark.PRINTED, 0.149, 0.105, 0.85),
    "light spot": (Mark.LIGHT_SPOT, 0.11, 0.0, 1.2),
    "small disc": (Mark.DISC, 0.055, 0.0, 0.8),
    "square": (Mark.RECTANGLE, 0.09, 0.09, 0.8),
    "cable": (Mark.RECTANGLE, 0.6, 0.012, 0.05),
}


def lay_discs(
    building: Construction, path: FloatArray, count: int, lookalikes: int,
    rng: np.random.Generator, within: tuple[float, float, float, float],
) -> None:  # fmt: skip
    """Lay discs and lookalikes on the floor on both sides of a path.
    `path` (N, 3); `within` (x0, y0, x1, y1).
    """
    total = count + lookalikes
    boxes = np.array([(ring.min(axis=0), ring.max(axis=0)) for ring in building.footprints])
    walls = _low_segments(building)
    chosen: list[tuple[float, float, float]] = []
    tries = 0
    while len(chosen) < total:
        tries += 1
        if tries > 200 * total:
            raise ValueError(f"only {len(chosen)} of {total} marks fit on the floor by the path")
        at = rng.uniform(0.0, len(path) - 1.0)
        pose = path[int(at)]
        aside = rng.uniform(*_ALONG_SIDE_M) * rng.choice([-1.0, 1.0])
        ahead = rng.uniform(-0.3, 1.8)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        x = pose[0] + c * aside + s * ahead
        y = pose[1] + s * aside - c * ahead
        if not (within[0] + 1 < x < within[2] - 1 and within[1] + 1 < y < within[3] - 1):
            continue
        place = np.array([x, y])
        if any(np.hypot(x - a, y - b) < _APART_M for a, b, _ in chosen):
            continue
        if _crowded(place, pose[:2], boxes, walls):
            continue
        chosen.append((x, y, float(at)))
    order = rng.permutation(total)
    discs = sorted((chosen[k] for k in order[:count]), key=lambda c: c[2])
    for number, (x, y, _) in enumerate(discs, start=1):
        albedo = float(rng.uniform(0.78, 0.92))
        building.marks.append(FloorMark(Mark.DISC, x, y, DISC_RADIUS_M, albedo, disc_id=number))
    for index, label in zip(order[count:], cycle(_LOOKALIKES)):
        x, y, _ = chosen[index]
        shape, radius, second, albedo = _LOOKALIKES[label]
        angle = float(rng.uniform(0.0, np.pi))
        building.marks.append(FloorMark(shape, x, y, radius, albedo, second, angle, label=label))


def _low_segments(building: Construction) -> FloatArray:
    """(K, 4) ground plan of everything upright that reaches the floor."""
    z = (corners := building.corners())[:, :, 2]
    low = corners[(z.min(axis=1) < 0.02) & (np.ptp(z, axis=1) > 0.02)]
    return np.array([[*c[0, :2], *c[1, :2]] for c in low]).reshape(-1, 4)


def _crowded(
    place: FloatArray, seen_from: FloatArray, boxes: FloatArray, walls: FloatArray
) -> bool:
    """Whether something stands on, next to or between the place and the path.
    `boxes` (N, 2, 2) are opposite corners; `walls` (K, 4).
    """
    low, high = boxes[:, 0] - _FROM_FURNITURE_M, boxes[:, 1] + _FROM_FURNITURE_M
    if np.any(np.all((place > low) & (place < high), axis=1)):
        return True
    if clearance(place[None], walls)[0] < _FROM_FURNITURE_M:
        return True
    a, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    way = place - seen_from
    cross = way[0] * along[:, 1] - way[1] * along[:, 0]
    safe = np.where(np.abs(cross) < 1e-12, np.inf, cross)
    off = a - seen_from
    s = (off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0]) / safe
    t = (off[:, 0] * way[1] - off[:, 1] * way[0]) / safe
    return bool(np.any((s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0)))
