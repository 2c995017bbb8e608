"""The place of the simulated sessions: a covered room within a ring of corridors.

World frame: x east, y north, the covered room spans x and y from 0. The robot enters it through the
western door and leaves through the eastern one, and drives round it in the corridors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

ROOM_M = (10.0, 7.5)
CORRIDOR_M = 3.0
WALL_M = 0.15
#: Middle and half width of both doors (y).
DOOR_Y_M = 3.8
DOOR_HALF_M = 0.8

#: Surveyed points on the walls and the columns of the room.
FIDUCIALS: dict[str, tuple[float, float]] = {
    "SW": (0.0, 0.0),
    "SE": (10.0, 0.0),
    "NE": (10.0, 7.5),
    "NW": (0.0, 7.5),
    "S": (5.2, 0.0),
    "column": (6.4, 6.1),
}


@dataclass(frozen=True, eq=False)
class Site:
    """Walls, and what stands there without being in the map.

    Attributes
    ----------
    walls : (S, 4) float64
        What the building map shows: x1, y1, x2, y2 (m).
    furniture : (F, 4) float64
        What the scanners see as well.
    """

    walls: FloatArray
    furniture: FloatArray

    @property
    def solid(self) -> FloatArray:
        """(S + F, 4) all that stands still."""
        return np.vstack([self.walls, self.furniture])


def make_site(furniture: bool = True) -> Site:
    """The building, and with `furniture` a cupboard and a box in the room, a bench outside."""
    walls = np.vstack([_room(), _outside(), rectangle(6.0, 6.1, 6.4, 6.5), _niches()])
    things = [
        rectangle(2.6, 7.05, 3.8, 7.5),
        rectangle(9.2, 0.0, 10.0, 0.5),
        rectangle(4.0, 10.1, 6.0, 10.5),
    ]
    return Site(walls, np.vstack(things) if furniture else np.zeros((0, 4)))


def rectangle(x1: float, y1: float, x2: float, y2: float) -> FloatArray:
    """(4, 4) sides of a rectangle."""
    return chain([(x1, y1), (x2, y1), (x2, y2), (x1, y2)], closed=True)


def chain(corners: list[tuple[float, float]], *, closed: bool = False) -> FloatArray:
    """(N, 4) sides between corners."""
    points = np.array([*corners, corners[0]] if closed else corners)
    return np.hstack([points[:-1], points[1:]])


def clearance(points: FloatArray, walls: FloatArray) -> FloatArray:
    """(N,) distances of (N, 2) points to the nearest of (S, 4) walls (m)."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    offset = points[:, None] - start
    share = np.clip((offset * along).sum(axis=-1) / (along**2).sum(axis=-1), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[..., None] * along, axis=-1).min(axis=1))


def is_covered(points: FloatArray) -> NDArray[np.bool_]:
    """Which of (N, 2) points lie in the room."""
    return np.asarray(np.all((points > 0.0) & (points < ROOM_M), axis=-1))


def _room() -> FloatArray:
    """The room's walls: two halves, left and right of the doors, each a closed outline."""
    x, y = ROOM_M
    low, high, w = DOOR_Y_M - DOOR_HALF_M, DOOR_Y_M + DOOR_HALF_M, WALL_M
    south = [(0.0, low), (0.0, 0.0), (x, 0.0), (x, low),
             (x + w, low), (x + w, -w), (-w, -w), (-w, low)]  # fmt: skip
    # A recess in the northern wall tells east from west.
    north = [(0.0, high), (0.0, y), (7.6, y), (7.6, y + 0.1), (8.6, y + 0.1), (8.6, y), (x, y),
             (x, high), (x + w, high), (x + w, y + w), (-w, y + w), (-w, high)]  # fmt: skip
    return np.vstack([chain(south, closed=True), chain(north, closed=True)])


def _outside() -> FloatArray:
    """The corridors' outer walls; a stretch of the eastern one is glass, which gives no echo."""
    x, y = ROOM_M[0] + CORRIDOR_M, ROOM_M[1] + CORRIDOR_M
    c = -CORRIDOR_M
    return chain([(x, 6.0), (x, y), (c, y), (c, c), (x, c), (x, 2.5)])


def _niches() -> FloatArray:
    """Pilasters along the corridors, without which they would look the same all along."""
    x, y, c = ROOM_M[0] + CORRIDOR_M, ROOM_M[1] + CORRIDOR_M, -CORRIDOR_M
    boxes = [rectangle(at, y - 0.2, at + 0.4, y) for at in (-1.0, 1.7, 7.3, 9.0)]
    boxes += [rectangle(at, c, at + 0.4, c + 0.2) for at in (0.5, 4.1, 5.5, 9.4)]
    boxes += [rectangle(c, at, c + 0.2, at + 0.4) for at in (-0.6, 2.1, 3.9, 7.5)]
    boxes += [rectangle(x - 0.2, at, x, at + 0.4) for at in (-1.1, 1.3, 7.9)]
    return np.vstack(boxes)
