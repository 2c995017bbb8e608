"""The place of the laser sessions, and passers-by: a covered room within a ring of corridors.

World frame: x east, y north, the covered room spans x and y from 0. The robot enters it through the
western door and leaves through the eastern one, and drives around it in the corridors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import BoolArray, FloatArray

#: (N, 3) poses of the robot at times (N,).
Poses = Callable[[FloatArray], FloatArray]

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
    """Walls, and furniture that is not in the map."""

    walls: FloatArray  # (S, 4) What the building map shows: x1, y1, x2, y2 (m).
    furniture: FloatArray  # (F, 4) What the scanners see as well.

    @property
    def solid(self) -> FloatArray:
        """(S + F, 4) everything at rest."""
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


def chain(corners: ArrayLike, *, closed: bool = False) -> FloatArray:
    """(N, 4) sides between corners (N, 2)."""
    points = np.asarray(corners, dtype=np.float64)
    if closed:
        points = np.vstack([points, points[:1]])
    return np.hstack([points[:-1], points[1:]])


def clearance(points: FloatArray, walls: FloatArray) -> FloatArray:
    """(N,) distances of (N, 2) points to the nearest of (S, 4) walls (m)."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    offset = points[:, None] - start
    share = np.clip((offset * along).sum(axis=-1) / (along**2).sum(axis=-1), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[..., None] * along, axis=-1).min(axis=1))


def is_covered(points: FloatArray) -> BoolArray:
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


LEG_RADIUS_M = 0.055
_HALF_STANCE_M = 0.10
_SWING_M = 0.22
_STEPS_PER_M = 0.75
_FREE_M = 0.35
_TRIES = 300


@dataclass(frozen=True, eq=False)
class Passer:
    """Somebody who walks along straight pieces at a constant speed."""

    points: FloatArray  # (N, 2) The pieces' ends (m).
    from_s: float  # When the walk begins.
    speed_m_s: float

    @property
    def to_s(self) -> float:
        """When the walk ends."""
        return self.from_s + float(self._way()[-1]) / self.speed_m_s

    def places(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (N, 2) and directions (N,) at times; NaN before and after the walk."""
        way = self._way()
        gone = (times_s - self.from_s) * self.speed_m_s
        there = (gone >= 0.0) & (gone <= way[-1])
        piece = np.clip(np.searchsorted(way, gone, side="right") - 1, 0, len(way) - 2)
        along = np.diff(self.points, axis=0)[piece]
        unit = along / np.linalg.norm(along, axis=1, keepdims=True)
        place = self.points[piece] + (gone - way[piece])[:, None] * unit
        return np.where(there[:, None], place, np.nan), np.arctan2(unit[:, 1], unit[:, 0])

    def legs(self, times_s: FloatArray) -> FloatArray:
        """(N, 2, 3) x, y, radius of both legs at times; radius 0 before and after the walk."""
        place, heading = self.places(times_s)
        ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        aside = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
        phase = 2.0 * np.pi * _STEPS_PER_M * (times_s - self.from_s) * self.speed_m_s
        legs = np.zeros((len(times_s), 2, 3))
        for leg, side in enumerate((1.0, -1.0)):
            swing = side * _SWING_M * np.sin(phase)
            centre = place + side * _HALF_STANCE_M * aside + swing[:, None] * ahead
            legs[:, leg, :2] = np.nan_to_num(centre)
        legs[:, :, 2] = np.where(np.isfinite(place[:, :1]), LEG_RADIUS_M, 0.0)
        return legs

    def _way(self) -> FloatArray:
        steps = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


def legs_of(passers: Sequence[Passer], times_s: FloatArray) -> FloatArray:
    """(N, 2 P, 3) x, y, radius of the legs of all passers-by."""
    legs = [passer.legs(times_s) for passer in passers]
    return np.concatenate(legs, axis=1) if legs else np.zeros((len(times_s), 0, 3))


def strolling(
    rng: np.random.Generator,
    robot_poses: Poses,
    walls: FloatArray,
    interval_s: tuple[float, float],
    apart_m: float,
) -> Passer | None:
    """Somebody who comes in by one door, crosses the room and leaves, without hurrying the robot.
    `walls` (S, 4).
    """
    doors = np.array([[-1.4, DOOR_Y_M], [ROOM_M[0] + 1.4, DOOR_Y_M]])
    for _ in range(_TRIES):
        ends = doors[rng.integers(0, 2, 2)]
        inner = rng.uniform([0.8, 0.8], [ROOM_M[0] - 0.8, ROOM_M[1] - 0.8], (rng.integers(1, 4), 2))
        points = np.vstack([ends[:1], inner, ends[1:]])
        passer = Passer(points, float(rng.uniform(*interval_s)), float(rng.uniform(0.9, 1.4)))
        if _is_free(passer, robot_poses, walls, apart_m):
            return passer
    return None


def crossing(
    rng: np.random.Generator, robot_poses: Poses, walls: FloatArray, when_s: float, near_m: float
) -> Passer | None:
    """Somebody who passes right beside the robot, for `near_m` at the nearest."""
    centre = robot_poses(np.array([when_s]))[0, :2]
    for _ in range(_TRIES):
        angle, speed = float(rng.uniform(-np.pi, np.pi)), float(rng.uniform(0.9, 1.3))
        ahead = np.array([np.cos(angle), np.sin(angle)])
        nearest = centre + near_m * np.array([-ahead[1], ahead[0]])
        points = nearest + np.outer([-1.8, 1.8], ahead)
        passer = Passer(points, when_s - 1.8 / speed, speed)
        if _is_free(passer, robot_poses, walls, 0.8 * near_m):
            return passer
    return None


def _is_free(passer: Passer, robot_poses: Poses, walls: FloatArray, apart_m: float) -> bool:
    times = np.arange(passer.from_s, passer.to_s, 0.05)
    places, _ = passer.places(times)
    there = np.isfinite(places[:, 0])
    places, robot = places[there], robot_poses(times[there])[:, :2]
    far = np.linalg.norm(places - robot, axis=1).min() >= apart_m
    return bool(far and clearance(places, walls).min() >= _FREE_M)
