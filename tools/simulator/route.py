"""Ways through the office: round its blocks, into rooms, and across the yard."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tools.simulator.office_plan import LONG_CORRIDORS_Y, SHORT_CORRIDORS_X, WIDTH_M, Office, Room
from tools.simulator.scene import FloatArray

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


def office_route(
    office: Office, rng: np.random.Generator, visits: float, rounds: int = 3
) -> FloatArray:
    """The corners of a way through the office.

    Parameters
    ----------
    office : Office
        The building.
    rng : numpy Generator
        Draws which rooms are visited.
    visits : float
        Probability that a room with an open door is visited when the robot passes by.
    rounds : int
        How often `FULL_ROUTE` is driven.

    Returns
    -------
    (K, 2) array
        Corners (m), to be rounded by `tools.simulator.drive.drive`.
    """
    corners: list[FloatArray] = [np.array(FULL_ROUTE[0])]
    unvisited = {id(room) for room in office.rooms if room.enterable}
    for _ in range(rounds):
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


def is_outside(poses: FloatArray) -> NDArray[np.bool_]:
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
