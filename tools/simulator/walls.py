"""Walls with doors and windows."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tools.simulator.construction import CEILING_M, Construction, Look
from tools.simulator.scene import FloatArray, Texture

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
    """Add a wall.

    Parameters
    ----------
    building : Construction
        What the wall is added to.
    start, end : (x, y)
        Its centre line (m).
    openings : list of Opening
        Doors, windows and holes; they must not touch each other.
    left, right : Look
        The faces to the left and right of its direction.
    extend : pair of bool
        Whether each end reaches half a thickness further, as at corners.
    """
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
