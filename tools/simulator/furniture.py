"""Things that stand in rooms and corridors or hang on their walls.

A place on a wall is given by a point on the wall's face, the unit vector along it, and the unit
vector out of it into the room.
"""

from __future__ import annotations

import numpy as np

from tools.simulator.construction import Construction, Look
from tools.simulator.scene import FloatArray, Texture

_DARK = Look(albedo=0.06)
_METAL_LEG = Look(Texture.METAL, 0.35)


def add_lockers(
    building: Construction, at: FloatArray, e: FloatArray, n: FloatArray, count: int, albedo: float
) -> float:
    """Add a row of lockers beginning at a place on a wall; returns its length (m)."""
    width, depth, height = 0.40, 0.38, 1.80
    look = Look(Texture.METAL, albedo)
    total = count * width
    building.box(at + 0.5 * total * e + 0.5 * depth * n, total, depth, 0.0, height, look,
                 "lockers", e)  # fmt: skip
    front = at + (depth + 0.003) * n
    for k in range(1, count):
        gap = front + k * width * e
        building.upright(gap - 0.005 * e, gap + 0.005 * e, 0.05, height, _DARK, "locker gap")
    for k in range(count):
        left = front + (k * width + 0.11) * e
        for z in (1.50, 1.54, 1.58, 1.62):
            building.upright(left, left + 0.18 * e, z, z + 0.015, _DARK)
        lock = front + (k * width + 0.33) * e
        building.box(lock + 0.01 * n, 0.03, 0.02, 0.95, 1.0, _METAL_LEG, "", e)
    return total


def add_poster(
    building: Construction,
    at: FloatArray,
    e: FloatArray,
    n: FloatArray,
    width: float,
    height: float,
    z: float,
    look: Look,
    framed: bool,
) -> None:
    """Hang a poster, notice or picture centred at a place on a wall, its lower side at z."""
    face = at + 0.006 * n
    a, b = face - 0.5 * width * e, face + 0.5 * width * e
    # Seen from the room, the left side comes first.
    building.upright(b, a, z, z + height, look, "poster")
    building.pictures.append((*a, *b, z, z + height))
    if framed:
        bar = Look(albedo=0.12)
        for s in (a, b):
            building.box(s + 0.008 * n, 0.025, 0.02, z - 0.01, z + height + 0.01, bar,
                         "picture frame", e)  # fmt: skip
        for edge in (z - 0.012, z + height):
            building.box(face + 0.008 * n, width, 0.02, edge, edge + 0.012, bar, "", e)


def add_radiator(
    building: Construction, at: FloatArray, e: FloatArray, n: FloatArray, width: float
) -> None:
    """Add a ribbed radiator centred at a place on a wall."""
    ribs = int(width / 0.12)
    look = Look(albedo=0.75)
    for k in range(ribs):
        s = (k + 0.5 - 0.5 * ribs) * 0.12
        building.box(at + s * e + 0.09 * n, 0.07, 0.08, 0.12, 0.68, look, "radiator rib", e)
    building.box(at + 0.06 * n, ribs * 0.12, 0.02, 0.14, 0.66, Look(albedo=0.55), "", e)


def add_cupboard(
    building: Construction,
    at: FloatArray,
    e: FloatArray,
    n: FloatArray,
    width: float,
    depth: float,
    height: float,
    look: Look,
) -> None:
    """Add a cupboard with doors, its back centred at a place on a wall."""
    building.box(at + 0.5 * depth * n, width, depth, 0.0, height, look, "cupboard", e)
    front = at + (depth + 0.003) * n
    building.upright(
        front - 0.004 * e, front + 0.004 * e, 0.06, height - 0.02, _DARK, "cupboard gap"
    )
    for side in (-1.0, 1.0):
        handle = front + side * 0.05 * e + 0.01 * n
        building.box(handle, 0.015, 0.02, 0.5 * height, 0.5 * height + 0.12, _DARK, "", e)


def add_shelf(
    building: Construction,
    at: FloatArray,
    e: FloatArray,
    n: FloatArray,
    width: float,
    rng: np.random.Generator,
) -> None:
    """Add a shelf full of books, its back centred at a place on a wall."""
    depth, height = 0.30, 1.95
    board = Look(Texture.WOOD, 0.5)
    for s in (-0.5 * width, 0.5 * width):
        building.box(at + s * e + 0.5 * depth * n, 0.025, depth, 0.0, height, board, "shelf", e)
    levels = 5
    for level in range(levels + 1):
        z = level * (height - 0.03) / levels
        building.box(at + 0.5 * depth * n, width, depth, z, z + 0.025, board, "", e)
        if level == levels:
            break
        s = -0.5 * width + 0.03
        while s < 0.5 * width - 0.12:
            thick = float(rng.uniform(0.025, 0.09))
            tall = float(rng.uniform(0.22, 0.33))
            grey = float(rng.choice([0.08, 0.15, 0.3, 0.5, 0.75, 0.85]))
            spine = at + (depth - 0.04) * n + s * e
            building.upright(
                spine, spine + thick * e, z + 0.025, z + 0.025 + tall, Look(albedo=grey), "book"
            )
            s += thick + (0.12 if rng.random() < 0.08 else 0.002)
    building.upright(
        at + 0.02 * n - 0.5 * width * e, at + 0.02 * n + 0.5 * width * e, 0.0, height,
        Look(albedo=0.12),
    )  # fmt: skip


def add_table(
    building: Construction,
    centre: FloatArray,
    e: FloatArray,
    width: float,
    depth: float,
    top: Look,
) -> None:
    """Add a table with four legs; `e` is the direction of its width."""
    n = np.array([-e[1], e[0]])
    building.box(centre, width, depth, 0.70, 0.73, top, "", e)
    for i in (-1.0, 1.0):
        for j in (-1.0, 1.0):
            foot = centre + i * (0.5 * width - 0.06) * e + j * (0.5 * depth - 0.06) * n
            building.box(foot, 0.05, 0.05, 0.0, 0.70, _METAL_LEG, "table leg", e)


def add_monitor(building: Construction, centre: FloatArray, e: FloatArray) -> None:
    """Put a screen on a table; `e` is the direction of its width."""
    building.box(centre, 0.2, 0.16, 0.73, 0.75, _DARK, "", e)
    building.box(centre, 0.05, 0.04, 0.75, 0.85, _DARK, "", e)
    building.box(centre, 0.48, 0.05, 0.85, 1.18, Look(albedo=0.07), "screen", e)


def add_chair(building: Construction, centre: FloatArray, e: FloatArray, albedo: float) -> None:
    """Add a chair; `e` is the direction of its width."""
    n = np.array([-e[1], e[0]])
    building.box(centre, 0.44, 0.44, 0.43, 0.47, Look(albedo=albedo), "", e)
    building.box(centre - 0.2 * n, 0.42, 0.035, 0.62, 0.92, Look(albedo=albedo), "chair back", e)
    for i in (-0.19, 0.19):
        for j in (-0.19, 0.19):
            top = 0.62 if j < 0.0 else 0.43
            building.box(centre + i * e + j * n, 0.028, 0.028, 0.0, top, _METAL_LEG, "", e)


def add_plant(building: Construction, centre: FloatArray, rng: np.random.Generator) -> None:
    """Add a potted plant."""
    building.box(centre, 0.32, 0.32, 0.0, 0.32, Look(albedo=0.55), "pot")
    for _ in range(7):
        angle = rng.uniform(0.0, np.pi)
        e = np.array([np.cos(angle), np.sin(angle)])
        size = rng.uniform(0.2, 0.5)
        z = rng.uniform(0.35, 1.0)
        off = rng.uniform(-0.1, 0.1, 2)
        building.upright(
            centre + off - 0.5 * size * e, centre + off + 0.5 * size * e, z, z + size,
            Look(Texture.FOLIAGE, 0.13),
        )  # fmt: skip


def add_bin(building: Construction, centre: FloatArray, albedo: float) -> None:
    """Add a round waste bin (a prism of ten sides: its outline is no edge of the building)."""
    angle = np.arange(11) * (2.0 * np.pi / 10)
    ring = centre + 0.15 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    for k in range(10):
        building.upright(ring[k], ring[k + 1], 0.0, 0.42, Look(Texture.METAL, albedo))
    building.footprints.append(ring[:10:3])
