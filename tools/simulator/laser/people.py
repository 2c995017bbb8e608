"""Passers-by: pairs of legs that walk through the room, as a scanner near the floor sees them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tools.simulator.laser.site import DOOR_Y_M, ROOM_M, clearance

FloatArray = NDArray[np.float64]

LEG_RADIUS_M = 0.055
_HALF_STANCE_M = 0.10
_SWING_M = 0.22
_STEPS_PER_M = 0.75
_FREE_M = 0.35
_TRIES = 300


@dataclass(frozen=True, eq=False)
class Passer:
    """Somebody who walks along straight pieces at a constant speed.

    Attributes
    ----------
    points : (N, 2) float64
        The pieces' ends (m).
    from_s : float
        When the walk begins.
    speed_m_s : float
    """

    points: FloatArray
    from_s: float
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


def legs_of(passers: list[Passer], times_s: FloatArray) -> FloatArray:
    """(N, 2 P, 3) x, y, radius of the legs of all passers-by."""
    legs = [passer.legs(times_s) for passer in passers]
    return np.concatenate(legs, axis=1) if legs else np.zeros((len(times_s), 0, 3))


def strolling(
    rng: np.random.Generator,
    robot_poses: Callable[[FloatArray], FloatArray],
    walls: FloatArray,
    interval_s: tuple[float, float],
    apart_m: float,
) -> Passer | None:
    """Somebody who comes in by one door, crosses the room and leaves, without hurrying the robot.

    Parameters
    ----------
    rng : numpy Generator
    robot_poses : callable
        (N, 3) poses at times.
    walls : (S, 4) float64
        Nobody comes nearer to them than 0.35 m.
    interval_s : (float, float)
        The walk begins within.
    apart_m : float
        Least distance to the robot's origin (m).

    Returns
    -------
    Passer or None
        None if there was no room for one in 300 tries.
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
    rng: np.random.Generator,
    robot_poses: Callable[[FloatArray], FloatArray],
    walls: FloatArray,
    when_s: float,
    near_m: float,
) -> Passer | None:
    """Somebody who passes right beside the robot, for `near_m` at the nearest.

    Returns
    -------
    Passer or None
        None if walls leave no way within 300 tries.
    """
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


def _is_free(
    passer: Passer,
    robot_poses: Callable[[FloatArray], FloatArray],
    walls: FloatArray,
    apart_m: float,
) -> bool:
    times = np.arange(passer.from_s, passer.to_s, 0.05)
    places, _ = passer.places(times)
    there = np.isfinite(places[:, 0])
    places, robot = places[there], robot_poses(times[there])[:, :2]
    far = np.linalg.norm(places - robot, axis=1).min() >= apart_m
    return bool(far and clearance(places, walls).min() >= _FREE_M)
