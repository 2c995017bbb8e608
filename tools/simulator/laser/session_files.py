"""A simulated laser session as a folder (docs/groundtruth/sessions.md), and its truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.files import write_json
from redetect.groundtruth.lasers.building import HEAD
from redetect.groundtruth.lasers.scanners import (
    Robot,
    Scanner,
    Scans,
    scanner_entry,
    write_scanners,
)
from redetect.groundtruth.trajectories.streams import PlanarPoses, write_planar_poses
from redetect.groundtruth.validation.reference_poses import (
    DIMENSIONS_HEAD,
    DISTANCES_HEAD,
    FIDUCIAL_DISTANCES_HEAD,
    Distance,
    Survey,
)
from redetect.landmarks import wrap_angle
from redetect.plane import apply
from redetect.storage import write_whole
from tools.simulator.files import write_lines
from tools.simulator.laser.measuring import Scene, measured, true_ranges
from tools.simulator.laser.motion import measured_path, ptpd_lines
from tools.simulator.laser.session import SessionPlan, displaced, plan_session
from tools.simulator.laser.settings import LaserSettings
from tools.simulator.laser.site import FIDUCIALS, ROOM_M, Passer, chain, legs_of

#: How long before and after each visit scans are logged, and the odometry if its log pauses.
SCAN_MARGIN_S = 2.0
LOG_MARGIN_S = 5.0

_CAMERAS = np.array([[0.3, 0.4], [9.6, 7.1]])
_NEAREST_FIDUCIALS = 4
#: How many walls are measured by tape: the longest.
_DIMENSIONS = 12


def exact_poses(plan: SessionPlan, times_s: FloatArray) -> PlanarPoses:
    """True poses at times of the ground truth's clock, headings in (-pi, pi]."""
    poses = plan.route.poses(times_s)
    poses[:, 2] = wrap_angle(poses[:, 2])
    return PlanarPoses(times_s, poses)


def in_visits(plan: SessionPlan, times_s: FloatArray, margin_s: float) -> BoolArray:
    """Which times lie within a visit or a margin around it."""
    begin, end = np.array(plan.visits).T[:, :, None]
    within = (times_s >= begin - margin_s) & (times_s <= end + margin_s)
    return np.asarray(np.any(within, axis=0))


def odometry_stream(plan: SessionPlan) -> PlanarPoses:
    """Odometry by the robot's clock."""
    settings, rng = plan.settings, plan.random("odometry")
    route = plan.route
    times = plan.clock.ticks(
        route.start_s, route.end_s, 1.0 / settings.odometry_hz, float(rng.random())
    )
    path = measured_path(route.poses(times), settings.wheels, rng)
    path[:, 2] = wrap_angle(path[:, 2])
    logged = np.ones(len(times), dtype=bool)
    if settings.pause_log:
        logged = in_visits(plan, times, LOG_MARGIN_S)
    return PlanarPoses(plan.clock.robot_times(times)[logged], path[logged])


def camera_stream(plan: SessionPlan) -> PlanarPoses:
    """Poses from markers with the covariances from which their errors are drawn."""
    settings, rng = plan.settings, plan.random("camera")
    period = 1.0 / settings.camera_hz
    times = np.arange(plan.route.start_s + period * rng.random(), plan.route.end_s, period)
    exact = plan.route.poses(times)
    covariances = camera_covariances(exact)
    root = np.linalg.cholesky(covariances)
    noise = np.einsum("nij,nj->ni", root, rng.standard_normal((len(times), 3)))
    seen = (rng.random(len(times)) >= settings.camera_misses) & in_visits(plan, times, 0.0)
    faults = plan.settings.faults
    lost_s = times - plan.visits[0][0] - faults.lost_camera_at_s
    seen &= ~((lost_s >= 0.0) & (lost_s < faults.lost_camera_s))
    poses = exact + noise
    poses[:, 2] = wrap_angle(poses[:, 2])
    return PlanarPoses(times[seen], poses[seen], covariances[seen])


def camera_covariances(poses: FloatArray) -> FloatArray:
    """(N, 3, 3) covariances of poses from two cameras: worse along a camera's ray, and far away."""
    information = np.zeros((len(poses), 2, 2))
    for camera in _CAMERAS:
        ray = poses[:, :2] - camera
        far = np.linalg.norm(ray, axis=1)
        unit = ray / far[:, None]
        outer = unit[:, :, None] * unit[:, None, :]
        deep, wide = (0.02 * far) ** 2, (0.006 * far) ** 2
        spread = deep[:, None, None] * outer + wide[:, None, None] * (np.eye(2) - outer)
        information += np.linalg.inv(spread + 0.02**2 * np.eye(2))
    covariances = np.zeros((len(poses), 3, 3))
    covariances[:, :2, :2] = np.linalg.inv(information)
    covariances[:, 2, 2] = np.deg2rad(0.6) ** 2
    # Errors of the heading also shift the position sideways.
    middle = poses[:, :2] - 0.5 * np.array(ROOM_M)
    joint = np.column_stack([0.001 * middle[:, 1], -0.001 * middle[:, 0],
                             np.full(len(poses), np.deg2rad(0.4))])  # fmt: skip
    return np.asarray(covariances + joint[:, :, None] * joint[:, None, :])


def reference_times(plan: SessionPlan) -> FloatArray:
    """(R,) when the distances are measured: the middle of each stand."""
    return np.array([0.5 * (begin + end) for begin, end in plan.references])


def survey_of(plan: SessionPlan) -> Survey:
    """The fiducials of the room and three points on the robot."""
    outline = plan.robot.outline
    left = outline[np.argmax(outline[:, 0] + 10.0 * outline[:, 1])]
    right = left * [1.0, -1.0]
    back = np.array([outline[:, 0].min(), 0.0])
    points = {"left": left, "right": right, "back": back}
    fiducials = {name: np.array(point) for name, point in FIDUCIALS.items()}
    return Survey(fiducials, points, plan.settings.distance_sigma_m)


def measured_distances(plan: SessionPlan) -> list[Distance]:
    """Distances of three robot points to the nearest fiducials, at every reference pose."""
    survey, rng = survey_of(plan), plan.random("distances")
    names = list(survey.fiducials)
    places = np.stack([survey.fiducials[name] for name in names])
    rows = []
    for pose, time in enumerate(reference_times(plan)):
        robot = plan.route.poses(np.array([time]))[0]
        near = np.argsort(np.linalg.norm(places - robot[:2], axis=1))[:_NEAREST_FIDUCIALS]
        for point, offset in survey.robot_points.items():
            world = apply(robot, offset)
            for i in sorted(near):
                far = float(np.linalg.norm(places[i] - world)) + rng.normal(0.0, survey.sigma_m)
                rows.append(Distance(pose, float(time), point, names[i], max(float(far), 0.0)))
    return rows


NOTE = "SIMULATED by tools/simulator: no real robot drove here, and no such building stands"

_EMPTY_BEFORE_S = 60.0
_PTPD_SIGMA_S = 20e-6


def write_session(
    settings: LaserSettings, folder: Path, *, seed: int, overwrite: bool = False
) -> SessionPlan:
    """Simulate a session and write its folder."""
    plan = plan_session(settings, seed)
    (folder / "empty").mkdir(parents=True, exist_ok=True)
    _write_site(plan, folder, overwrite)
    for place, run, scanners in (
        (folder / "empty", _empty_scans, plan.scanners),
        (folder, _fixed_scans, plan.moved),
        (folder, _onboard_scans, plan.robot.scanners),
    ):
        for scanner in scanners:
            scans = run(plan, scanner)
            write_scans(place / f"{scanner.name}.scans.npz", scans, overwrite=overwrite)
    write_planar_poses(folder / "odometry.csv", odometry_stream(plan), overwrite=overwrite)
    write_planar_poses(folder / "camera.csv", camera_stream(plan), overwrite=overwrite)
    write_survey(folder / "fiducials.json", survey_of(plan), overwrite=overwrite)
    write_distances(folder / "distances.csv", measured_distances(plan), overwrite=overwrite)
    _write_tape(plan, folder, overwrite)
    reports = np.arange(plan.route.start_s, plan.route.end_s, 1.0 / settings.ptpd_hz)
    lines = ptpd_lines(plan.clock, reports, _PTPD_SIGMA_S, plan.random("ptpd"))
    write_lines(folder / "ptpd.log", lines, overwrite=overwrite)
    _write_truth(plan, folder, overwrite)
    return plan


def _write_tape(plan: SessionPlan, folder: Path, overwrite: bool) -> None:
    """Dimensions of the building and distances between fiducials, measured by tape."""
    rng, sigma = plan.random("tape"), plan.settings.distance_sigma_m
    drawn, walls = _drawn(plan), plan.site.walls
    length = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    rows = [
        f"wall{i},{','.join(f'{x:.4f}' for x in drawn[i])},{length[i] + rng.normal(0.0, sigma):.4f}"
        for i in np.argsort(-length, kind="stable")[:_DIMENSIONS]
    ]
    write_lines(folder / "dimensions.csv", [DIMENSIONS_HEAD, *rows], overwrite=overwrite)
    rows = [
        f"{a},{b},{math.dist(FIDUCIALS[a], FIDUCIALS[b]) + rng.normal(0.0, sigma):.4f}"
        for a, b in combinations(FIDUCIALS, 2)
    ]
    path = folder / "fiducial_distances.csv"
    write_lines(path, [FIDUCIAL_DISTANCES_HEAD, *rows], overwrite=overwrite)


def _drawn(plan: SessionPlan) -> FloatArray:
    """(S, 4) walls as the drawing has them."""
    sigma, walls = plan.settings.drawing_sigma_m, plan.site.walls
    return walls + sigma * plan.random("drawing").standard_normal(walls.shape)


def _by_hand(
    scanners: Sequence[Scanner], sigma_m: float, sigma_deg: float, rng: np.random.Generator
) -> list[Scanner]:
    """Scanners with their poses as they were measured."""
    sigma = np.array([sigma_m, sigma_m, np.deg2rad(sigma_deg)])
    return [
        replace(s, pose=s.pose + sigma * rng.standard_normal(3), covariance=np.diag(sigma**2))
        for s in scanners
    ]


def _write_site(plan: SessionPlan, folder: Path, overwrite: bool) -> None:
    settings, building, note = plan.settings, _drawn(plan), {"note": NOTE}
    write_building(folder / "building.csv", building, overwrite=overwrite)
    write_drawing(folder / "building.dxf", building, overwrite=overwrite)
    sigmas = settings.mount_sigma_m, settings.mount_sigma_deg
    mounted = _by_hand(plan.robot.scanners, *sigmas, plan.random("mounts"))
    robot = replace(plan.robot, scanners=tuple(mounted))
    write_robot(folder / "robot.json", robot, overwrite=overwrite)
    sigmas = settings.hand_sigma_m, settings.hand_sigma_deg
    fixed = _by_hand(plan.scanners, *sigmas, plan.random("hand"))
    fixed = displaced(fixed, settings.faults.wrong_scanner, settings.faults.by)
    x, y = ROOM_M
    extra = {**note, "covered_area": [[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]]}
    write_scanners(folder / "scanners.json", fixed, extra, overwrite=overwrite)
    note = {"note": f"{NOTE}. The exact poses, as the empty room was scanned."}
    write_scanners(folder / "scanners.truth.json", plan.scanners, note, overwrite=overwrite)


def _empty_scans(plan: SessionPlan, scanner: Scanner) -> Scans:
    """Scans of the room before anybody enters."""
    settings, rng = plan.settings, plan.random(f"empty {scanner.name}")
    count = max(1, round(settings.empty_s * settings.rate_hz))
    ticks = float(rng.random()) + np.arange(count, dtype=np.float64)
    times = plan.route.start_s - _EMPTY_BEFORE_S + ticks / settings.rate_hz
    scene = Scene(plan.site.solid, None, np.zeros((0, 4)), partial(legs_of, ()))
    ranges = true_ranges(scanner, None, times, scene)
    return measured(times, ranges, scanner, settings.reading, rng)


def _fixed_scans(plan: SessionPlan, scanner: Scanner) -> Scans:
    settings, rng = plan.settings, plan.random(f"scans {scanner.name}")
    phase, period = float(rng.random()), 1.0 / settings.rate_hz
    first, last = _logged_span(plan)
    times = np.arange(first + phase * period, last, period)
    times = times[in_visits(plan, times, SCAN_MARGIN_S)]
    lost_s = times - plan.visits[0][0] - settings.faults.lost_laser_at_s
    times = times[~((lost_s >= 0.0) & (lost_s < settings.faults.lost_laser_s))]
    sides = chain(plan.robot.outline, closed=True)
    scene = Scene(plan.site.solid, plan.route.poses, sides, partial(legs_of, plan.passers))
    ranges = true_ranges(scanner, None, times, scene, settings.reading.sweep_s)
    return measured(times, ranges, scanner, settings.reading, rng)


def _onboard_scans(plan: SessionPlan, scanner: Scanner) -> Scans:
    """By the robot's clock."""
    settings, rng = plan.settings, plan.random(f"scans {scanner.name}")
    span = _logged_span(plan)
    times = plan.clock.ticks(*span, 1.0 / settings.onboard_hz, float(rng.random()))
    times = times[in_visits(plan, times, SCAN_MARGIN_S)]
    scene = Scene(plan.site.solid, None, np.zeros((0, 4)), partial(legs_of, plan.passers))
    ranges = true_ranges(scanner, plan.route.poses, times, scene, settings.reading.sweep_s)
    return measured(plan.clock.robot_times(times), ranges, scanner, settings.reading, rng)


def _logged_span(plan: SessionPlan) -> tuple[float, float]:
    return plan.visits[0][0] - SCAN_MARGIN_S, plan.visits[-1][1] + SCAN_MARGIN_S


def _write_truth(plan: SessionPlan, folder: Path, overwrite: bool) -> None:
    settings, route = plan.settings, plan.route
    times = np.arange(route.start_s, route.end_s, 1.0 / settings.truth_hz)
    write_planar_poses(folder / "truth.csv", exact_poses(plan, times), overwrite=overwrite)
    stands = exact_poses(plan, reference_times(plan))
    write_planar_poses(folder / "reference.csv", stands, overwrite=overwrite)
    content = {
        "note": NOTE,
        "seed": plan.seed,
        "settings": asdict(settings),
        "clock": _clock_entry(plan),
        "visits": [list(visit) for visit in plan.visits],
        "references": [list(stand) for stand in plan.references],
        "passers": [
            {"from_s": p.from_s, "to_s": p.to_s, "nearest_m": _nearest_m(plan, p)}
            for p in plan.passers
        ],
        "scanners": {s.name: s.pose.tolist() for s in plan.scanners},
        "scanners_in_session": {s.name: s.pose.tolist() for s in plan.moved},
        "onboard": {s.name: s.pose.tolist() for s in plan.robot.scanners},
    }
    write_json(folder / "truth.json", content, overwrite=overwrite)


def _clock_entry(plan: SessionPlan) -> dict[str, Any]:
    """The robot's clock: straight pieces of robot_time = t + offset + drift (t - reference)."""
    clock = plan.clock
    piece: dict[str, Any] = {
        "from_s": None, "reference_s": clock.reference_s, "offset_s": clock.offset_s,
        "drift": clock.drift,
    }  # fmt: skip
    after = {**piece, "from_s": clock.jump_at_s, "offset_s": clock.offset_s + clock.jump_s}
    return {
        "meaning": "robot_time = t + offset_s + drift (t - reference_s), from from_s on",
        "pieces": [piece, after] if np.isfinite(clock.jump_at_s) else [piece],
    }


def _nearest_m(plan: SessionPlan, passer: Passer) -> float:
    """Least distance of somebody from the robot's origin."""
    times = np.arange(passer.from_s, passer.to_s, 0.02)
    gaps = passer.places(times)[0] - plan.route.poses(times)[:, :2]
    return round(float(np.nanmin(np.linalg.norm(gaps, axis=1))), 3)


def write_scans(path: Path, scans: Scans, *, overwrite: bool = False) -> None:
    """Write scans as a ``.npz``; the same scans give the same bytes."""
    with write_whole(path, overwrite=overwrite) as stream:
        np.savez_compressed(stream, times_s=scans.times_s, ranges_mm=scans.ranges_mm)


def write_robot(path: Path, robot: Robot, *, overwrite: bool = False) -> None:
    """Write a ``robot.json``."""
    content = {
        "version": 1,
        "outline": robot.outline.tolist(),
        "largest_speed_m_s": robot.largest_speed_m_s,
        "largest_turn_rad_s": robot.largest_turn_rad_s,
        "scanners": [scanner_entry(scanner) for scanner in robot.scanners],
        "note": NOTE,
    }
    write_json(path, content, overwrite=overwrite)


def write_building(path: Path, walls: FloatArray, *, overwrite: bool = False) -> None:
    """Write walls (S, 4) as a ``building.csv``, in micrometres."""
    rows = (",".join(f"{x:.6f}" for x in wall) for wall in walls)
    write_lines(path, [HEAD, *rows], overwrite=overwrite)


def write_drawing(path: Path, walls: FloatArray, *, overwrite: bool = False) -> None:
    """Write walls (S, 4) as lines on the layer WALLS of a drawing in metres (DXF R12)."""
    head = "0\nSECTION\n2\nHEADER\n9\n$ACADVER\n1\nAC1009\n9\n$INSUNITS\n70\n6\n0\nENDSEC"
    rows = (
        f"0\nLINE\n8\nWALLS\n10\n{x1:.6f}\n20\n{y1:.6f}\n30\n0.0\n"
        f"11\n{x2:.6f}\n21\n{y2:.6f}\n31\n0.0"
        for x1, y1, x2, y2 in walls
    )
    entities = ["0\nSECTION\n2\nENTITIES", *rows, "0\nENDSEC\n0\nEOF"]
    write_lines(path, [head, *entities], overwrite=overwrite)


def write_survey(path: Path, survey: Survey, *, overwrite: bool = False) -> None:
    """Write a ``fiducials.json``."""
    content = {
        "version": 1,
        "fiducials": {name: point.tolist() for name, point in survey.fiducials.items()},
        "robot_points": {name: point.tolist() for name, point in survey.robot_points.items()},
        "sigma_m": survey.sigma_m,
        "note": NOTE,
    }
    write_json(path, content, overwrite=overwrite)


def write_distances(path: Path, distances: list[Distance], *, overwrite: bool = False) -> None:
    """Write a ``distances.csv``, in tenths of a millimetre."""
    rows = [f"{d.pose},{d.time_s:.6f},{d.point},{d.fiducial},{d.distance_m:.4f}" for d in distances]
    write_lines(path, [DISTANCES_HEAD, *rows], overwrite=overwrite)
