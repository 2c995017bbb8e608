"""Plan of a simulated session: all motion over time, and the faults, before any measurement."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.scanners import Robot, Scanner
from tools.simulator.laser.motion import Curve, RobotClock, Route, Stop
from tools.simulator.laser.settings import LaserSettings
from tools.simulator.laser.site import (
    DOOR_Y_M,
    ROOM_M,
    Passer,
    Site,
    clearance,
    crossing,
    is_covered,
    make_site,
    strolling,
)

#: Near the session's beginning, as stamps of real logs are: seconds since 1970.
EPOCH_S = 1235561600.0

_FIXED = ((1.5, 0.12, 90.0), (9.88, 1.5, 180.0), (8.3, 7.38, -90.0), (0.12, 6.0, 0.0))
_ROBOT_CLEAR_M = 0.6
_PASSER_APART_M = 0.9
_CROSSING_M = 0.65
_TRIES = 20_000
_STUCK = 40
#: The shortest route from door to door outside, and once more round the room, at full speed.
_SHORTEST_AWAY_S = 36.0
_ROUND_S = 62.0


@dataclass(frozen=True, eq=False)
class SessionPlan:
    """The truth of a session."""

    seed: int
    settings: LaserSettings
    site: Site
    robot: Robot  # With the scanners on board, exact.
    scanners: tuple[Scanner, ...]
    """The fixed ones, exact, as they stood when the empty room was scanned."""
    moved: tuple[Scanner, ...]  # As they stand in the session.
    route: Route  # On the ground truth's clock.
    visits: tuple[tuple[float, float], ...]  # From and to when the robot is in the room.
    references: tuple[tuple[float, float], ...]  # From and to when it stands for a reference pose.
    passers: tuple[Passer, ...]
    clock: RobotClock

    def random(self, what: str) -> np.random.Generator:
        """The random numbers of one part of the session, independent of all others."""
        return random_for(self.seed, what)


def random_for(seed: int, what: str) -> np.random.Generator:
    """Random numbers for one purpose."""
    return np.random.default_rng([seed, zlib.crc32(what.encode())])


def plan_session(settings: LaserSettings, seed: int) -> SessionPlan:
    """Plan a session."""
    site = make_site(settings.furniture)
    route, visits, references = _drive(settings, seed, site)
    scanners = _fixed_scanners(settings, seed)
    faults = settings.faults
    moved = tuple(displaced(scanners, faults.moved_scanner, faults.by))
    clock = RobotClock(
        route.start_s, settings.clock_offset_s, settings.clock_drift,
        visits[0][0] + faults.clock_jump_at_s if faults.clock_jump_s else float("inf"),
        faults.clock_jump_s,
    )  # fmt: skip
    passers = _passers(settings, seed, site, route, visits)
    return SessionPlan(
        seed, settings, site, _robot(settings), scanners, moved, route, visits, references,
        passers, clock,
    )  # fmt: skip


def displaced(
    scanners: Sequence[Scanner], name: str, by: tuple[float, float, float]
) -> list[Scanner]:
    """Scanners of which the one with a name is elsewhere: by x, y (m), theta (rad)."""
    return [replace(s, pose=s.pose + by) if s.name == name else s for s in scanners]


def sick_scanner(name: str, pose: FloatArray, settings: LaserSettings) -> Scanner:
    """A scanner of 181 beams over half a turn at an exact pose."""
    return Scanner(
        name, pose, np.zeros((3, 3)), -np.pi / 2, np.pi / 180, 181, settings.max_range_m,
        settings.reading.sigma_m, settings.reading.sweep_s,
    )  # fmt: skip


def _robot(settings: LaserSettings) -> Robot:
    """A box whose origin is between the driven wheels, a little before its middle."""
    front, back, half, cut = 0.35, -0.45, 0.3, settings.front_cut_m
    corners = [(back, half), (back, -half), (front - cut, -half), (front, cut - half),
               (front, half - cut), (front - cut, half)]  # fmt: skip
    mounts = (("front", (0.36, 0.0, 0.0)), ("rear", (-0.46, 0.0, np.pi)))
    onboard = tuple(sick_scanner(name, np.array(pose), settings) for name, pose in mounts)
    limits = settings.driving
    # Without a cut there are two corners less.
    outline = np.array(list(dict.fromkeys(corners)))
    return Robot(outline, 1.25 * limits.speed_m_s, 1.25 * limits.turn_rad_s, onboard)


def _fixed_scanners(settings: LaserSettings, seed: int) -> tuple[Scanner, ...]:
    """One at each wall, slightly off its intended pose."""
    rng = random_for(seed, "scanners")
    scanners = []
    for i, (x, y, degrees) in enumerate(_FIXED):
        angle = np.deg2rad(degrees)
        along = rng.uniform(-0.25, 0.25)
        pose = np.array(
            [x - along * np.sin(angle), y + along * np.cos(angle),
             angle + np.deg2rad(rng.uniform(-4.0, 4.0))]
        )  # fmt: skip
        scanners.append(sick_scanner(f"fixed{i}", pose, settings))
    return tuple(scanners)


def _drive(
    settings: LaserSettings, seed: int, site: Site
) -> tuple[Route, tuple[tuple[float, float], ...], tuple[tuple[float, float], ...]]:
    """The whole drive, the visits and where the robot stands for reference poses."""
    rounds = int(max(0.0, settings.between_s - _SHORTEST_AWAY_S) / _ROUND_S)
    points: list[tuple[float, float]] = [*_WEST_DOOR]
    parks: list[int] = []
    for visit in range(settings.visits):
        inside = _routes_inside(settings, random_for(seed, f"way {visit}"), site)
        points += [*((float(x), float(y)) for x, y in inside), *_EAST_DOOR]
        if visit + 1 < settings.visits:
            points += [*_NORTH, *(_RING * rounds), *_WEST_DOOR]
            parks.append(len(points) - len(_WEST_DOOR))
    waypoints = np.array(points)
    curve = Curve(waypoints)
    covered = is_covered(curve.poses(curve.arc_length)[:, :2]).astype(int)
    enter = curve.arc_length[np.flatnonzero(np.diff(covered) == 1)]
    leave = curve.arc_length[np.flatnonzero(np.diff(covered) == -1)]
    stops = []
    for visit in range(settings.visits):
        count = len(range(visit, settings.references, settings.visits))
        distances = np.linspace(enter[visit] + 1.0, leave[visit] - 1.0, count + 2)[1:-1]
        stops += [Stop(float(distance), settings.stand_s) for distance in distances]
    references = [stop.distance_m for stop in stops]
    # If it comes too early, it waits at the western door.
    route = Route(waypoints, stops, settings.driving, EPOCH_S)
    visits = _visits(route)
    for (_, left), (entered, _), park in zip(visits, visits[1:], parks):
        if (rest := settings.between_s - (entered - left)) > 0.0:
            stops.append(Stop(curve.arc_length_at(park), rest))
    stops.sort(key=lambda stop: stop.distance_m)
    route = Route(waypoints, stops, settings.driving, EPOCH_S)
    stands = [span for span, stop in zip(route.stands, stops) if stop.distance_m in references]
    return route, tuple(_visits(route)), tuple(stands)


def _visits(route: Route) -> list[tuple[float, float]]:
    """From and to when the robot is in the room."""
    times = np.arange(route.start_s, route.end_s, 0.01)
    change = np.diff(is_covered(route.poses(times)[:, :2]).astype(int))
    return list(zip(times[1:][change == 1].tolist(), times[:-1][change == -1].tolist()))


_SHARES_OF_TIME = (0.85, 0.6, 0.4, 0.2)
_X, _Y = ROOM_M
_OUT = 1.55
_WEST_DOOR = ((-_OUT, _Y - 0.4), (-_OUT, 5.9), (-1.0, 4.4), (0.0, DOOR_Y_M), (0.9, DOOR_Y_M))
_EAST_DOOR = ((_X - 0.9, DOOR_Y_M), (_X, DOOR_Y_M), (_X + 1.0, 4.4), (_X + _OUT, 5.9),
              (_X + _OUT, _Y - 0.4))  # fmt: skip
_NORTH = ((_X + 0.9, _Y + 1.3), (_X - 0.5, _Y + _OUT), (5.0, _Y + _OUT), (0.5, _Y + _OUT),
          (-0.9, _Y + 1.3))  # fmt: skip
_RING = ((-_OUT, _Y - 0.4), (-_OUT, DOOR_Y_M), (-_OUT, 0.4), (-0.9, -1.3), (0.5, -_OUT),
         (5.0, -_OUT), (_X - 0.5, -_OUT), (_X + 0.9, -1.3), (_X + _OUT, 0.4),
         (_X + _OUT, DOOR_Y_M), (_X + _OUT, _Y - 0.4), *_NORTH)  # fmt: skip


def _routes_inside(settings: LaserSettings, rng: np.random.Generator, site: Site) -> FloatArray:
    """Waypoints of a visit, between the doors: random, but clear of the furniture."""
    if settings.straight:
        return np.array([[x, DOOR_Y_M] for x in (3.0, 5.0, 7.0)])
    driving = settings.driving
    stop = settings.stand_s + driving.speed_m_s / driving.acceleration_m_s2
    standing = stop * settings.references / settings.visits
    longest = driving.speed_m_s * max(settings.visit_s - standing, 0.0)
    # Sometimes no long route is found: then a shorter one is searched.
    for share in _SHARES_OF_TIME:
        if (points := _random_route(share * longest, rng, site)) is not None:
            return points
    raise GroundTruthError("no route through the room was found: try another seed")


def _random_route(wanted: float, rng: np.random.Generator, site: Site) -> FloatArray | None:
    """Waypoints of a route of at least this length (m), or None if many tries find none."""
    before, after = np.array(_WEST_DOOR[-2:]), np.array(_EAST_DOOR[:2])
    points, failed, dead_ends = [*before], 0, 0
    for _ in range(_TRIES):
        length = float(np.linalg.norm(np.diff([*points, after[0]], axis=0), axis=1).sum())
        if len(points) > 2 and length >= wanted:
            whole = np.vstack([*points, after])
            if _bends_softly(points, after[0]) and _is_clear(whole, site):
                return np.array(points[2:])
            dead_ends += 1
            points = points[: max(2, len(points) - 2)] if dead_ends % _STUCK else [*before]
        low, high = (
            ((2.0, 2.0), (3.5, 5.5)) if len(points) == 2 else ((1.1, 1.1), (_X - 1.1, _Y - 1.1))
        )
        new = rng.uniform(low, high)
        if _bends_softly(points, new) and _is_clear(np.array([*points[-4:], new]), site):
            points.append(new)
            failed = 0
        elif (failed := failed + 1) > _STUCK:
            points, failed = points[: max(2, len(points) - 1)], 0
    return None


def _bends_softly(points: list[FloatArray], new: FloatArray) -> bool:
    """Whether the leg to a new point is neither short nor turns by more than about 110 degrees."""
    came, goes = points[-1] - points[-2], new - points[-1]
    lengths = np.linalg.norm(came) * np.linalg.norm(goes)
    return bool(np.linalg.norm(goes) > 1.2 and came @ goes > -0.35 * lengths)


def _is_clear(waypoints: FloatArray, site: Site) -> bool:
    curve = Curve(waypoints, grid_m=0.1)
    places = curve.poses(curve.arc_length)[:, :2]
    near = site.solid.reshape(-1, 2, 2)
    near = site.solid[np.any((near > -0.2) & (near < np.array(ROOM_M) + 0.2), axis=1).all(axis=1)]
    in_door = np.abs(places[:, 1] - DOOR_Y_M) < 0.3
    return bool(
        np.all(is_covered(places) | in_door) and clearance(places, near).min() >= _ROBOT_CLEAR_M
    )


def _passers(
    settings: LaserSettings,
    seed: int,
    site: Site,
    route: Route,
    visits: tuple[tuple[float, float], ...],
) -> tuple[Passer, ...]:
    passers: list[Passer | None] = []
    for visit, (begin, end) in enumerate(visits):
        for number in range(settings.passers):
            rng = random_for(seed, f"passer {visit} {number}")
            passers.append(strolling(rng, route.poses, site.solid, (begin, end), _PASSER_APART_M))
        if settings.faults.crossing:
            rng = random_for(seed, f"crossing {visit}")
            passers.append(crossing(rng, route.poses, site.solid, 0.5 * (begin + end), _CROSSING_M))
    return tuple(passer for passer in passers if passer is not None)
