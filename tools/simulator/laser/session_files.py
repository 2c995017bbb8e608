"""A simulated laser session as a folder (docs/groundtruth/sessions.md), its truth, a picture."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from redetect.groundtruth.files import read_json, write_json
from redetect.groundtruth.lasers.building import read_building
from redetect.groundtruth.lasers.scanners import (
    Scanner,
    Scans,
    find_scans,
    read_robot,
    read_scanners,
    read_scans,
    write_scanners,
)
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    read_planar_poses,
    write_planar_poses,
)
from redetect.groundtruth.validation.reference_poses import Distance, Survey, read_survey
from redetect.landmarks import wrap_angle
from redetect.storage import write_whole
from tools.arrays import BoolArray, FloatArray
from tools.simulator.laser.measuring import Scene, compose, measured, true_ranges
from tools.simulator.laser.motion import measured_path, ptpd_lines
from tools.simulator.laser.session import SessionPlan, plan_session, sides_of
from tools.simulator.laser.settings import LaserSettings
from tools.simulator.laser.site import FIDUCIALS, ROOM_M, Passer, legs_of
from tools.simulator.laser.writers import (
    write_building,
    write_distances,
    write_drawing,
    write_robot,
    write_scans,
    write_survey,
)

#: How long before and after each visit scans are logged, and the odometry if its log pauses.
SCAN_MARGIN_S = 2.0
LOG_MARGIN_S = 5.0

_CAMERAS = np.array([[0.3, 0.4], [9.6, 7.1]])
_NEAREST_FIDUCIALS = 4


def exact_poses(plan: SessionPlan, times_s: FloatArray) -> PlanarPoses:
    """True poses at times of the ground truth's clock, headings in (-pi, pi]."""
    poses = plan.route.poses(times_s)
    poses[:, 2] = wrap_angle(poses[:, 2])
    return PlanarPoses(times_s, poses)


def in_visits(plan: SessionPlan, times_s: FloatArray, margin_s: float) -> BoolArray:
    """Which times lie within a visit or a margin round it."""
    within = np.zeros(len(times_s), dtype=bool)
    for begin, end in plan.visits:
        within |= (times_s >= begin - margin_s) & (times_s <= end + margin_s)
    return within


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
    # What turns the robot in the image also moves it aside.
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
        robot = plan.route.poses(np.array([time]))
        near = np.argsort(np.linalg.norm(places - robot[0, :2], axis=1))[:_NEAREST_FIDUCIALS]
        for point, offset in survey.robot_points.items():
            world = compose(robot, np.array([[*offset, 0.0]]))[0, :2]
            for i in sorted(near):
                far = float(np.linalg.norm(places[i] - world)) + rng.normal(0.0, survey.sigma_m)
                rows.append(Distance(pose, float(time), point, names[i], max(float(far), 0.0)))
    return rows


NOTE = "SIMULATED by tools/simulator: no real robot drove here, and no such building stands"

_EMPTY_BEFORE_S = 60.0
_PTPD_SIGMA_S = 20e-6


def write_session(
    settings: LaserSettings,
    folder: Path,
    *,
    seed: int,
    overwrite: bool = False,
    on_file: Callable[[], None] | None = None,
) -> SessionPlan:
    """Simulate a session and write its folder."""
    plan = plan_session(settings, seed)
    (folder / "empty").mkdir(parents=True, exist_ok=True)
    _write_site(plan, folder, overwrite)
    for scanner, moved in zip(plan.scanners, plan.moved):
        for place, run in ((folder / "empty", _empty_scans), (folder, _fixed_scans)):
            scans = run(plan, scanner if place != folder else moved)
            write_scans(place / f"{scanner.name}.scans.npz", scans, overwrite=overwrite)
            if on_file is not None:
                on_file()
    for scanner in plan.robot.scanners:
        scans = _onboard_scans(plan, scanner)
        write_scans(folder / f"{scanner.name}.scans.npz", scans, overwrite=overwrite)
        if on_file is not None:
            on_file()
    write_planar_poses(folder / "odometry.csv", odometry_stream(plan), overwrite=overwrite)
    write_planar_poses(folder / "camera.csv", camera_stream(plan), overwrite=overwrite)
    write_survey(folder / "fiducials.json", survey_of(plan), {"note": NOTE}, overwrite=overwrite)
    write_distances(folder / "distances.csv", measured_distances(plan), overwrite=overwrite)
    reports = np.arange(plan.route.start_s, plan.route.end_s, 1.0 / settings.ptpd_hz)
    lines = ptpd_lines(plan.clock, reports, _PTPD_SIGMA_S, plan.random("ptpd"))
    with write_whole(folder / "ptpd.log", overwrite=overwrite) as stream:
        stream.write(("\n".join(lines) + "\n").encode())
    _write_truth(plan, folder, overwrite)
    return plan


def _write_site(plan: SessionPlan, folder: Path, overwrite: bool) -> None:
    building = plan.site.walls
    write_building(folder / "building.csv", building, overwrite=overwrite)
    write_drawing(folder / "building.dxf", building, overwrite=overwrite)
    write_robot(folder / "robot.json", plan.robot, {"note": NOTE}, overwrite=overwrite)
    x, y = ROOM_M
    extra = {"note": NOTE, "covered_area": [[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]]}
    write_scanners(folder / "scanners.json", _measured_by_hand(plan), extra, overwrite=overwrite)
    exact = folder / "scanners.truth.json"
    note = {"note": f"{NOTE}. The exact poses, as the empty room was scanned."}
    write_scanners(exact, plan.scanners, note, overwrite=overwrite)


def _measured_by_hand(plan: SessionPlan) -> list[Scanner]:
    settings, rng = plan.settings, plan.random("hand")
    sigma = np.array(
        [settings.hand_sigma_m, settings.hand_sigma_m, np.deg2rad(settings.hand_sigma_deg)]
    )
    scanners = []
    for scanner in plan.scanners:
        pose = scanner.pose + sigma * rng.standard_normal(3)
        if scanner.name == settings.faults.wrong_scanner:
            pose = pose + np.array(settings.faults.by)
        scanners.append(replace(scanner, pose=pose, covariance=np.diag(sigma**2)))
    return scanners


def _no_legs(times_s: FloatArray) -> FloatArray:
    return np.zeros((len(times_s), 0, 3))


def _empty_scans(plan: SessionPlan, scanner: Scanner) -> Scans:
    """The scanner looking at the room before anybody comes."""
    settings, rng = plan.settings, plan.random(f"empty {scanner.name}")
    count = max(1, round(settings.empty_s * settings.rate_hz))
    phase = float(rng.random())
    times = (
        plan.route.start_s
        - _EMPTY_BEFORE_S
        + (phase + np.arange(count, dtype=np.float64)) / settings.rate_hz
    )
    scene = Scene(plan.site.solid, None, np.zeros((0, 4)), _no_legs)
    ranges = true_ranges(scanner, None, times, scene)
    return measured(times, ranges, scanner, settings.reading, rng)


def _fixed_scans(plan: SessionPlan, scanner: Scanner) -> Scans:
    settings, rng = plan.settings, plan.random(f"scans {scanner.name}")
    phase, period = float(rng.random()), 1.0 / settings.rate_hz
    first, last = plan.visits[0][0] - SCAN_MARGIN_S, plan.visits[-1][1] + SCAN_MARGIN_S
    times = np.arange(first + phase * period, last, period)
    times = times[in_visits(plan, times, SCAN_MARGIN_S)]
    lost_s = times - plan.visits[0][0] - settings.faults.lost_laser_at_s
    times = times[~((lost_s >= 0.0) & (lost_s < settings.faults.lost_laser_s))]
    scene = Scene(
        plan.site.solid, plan.route.poses, sides_of(plan.robot.outline),
        lambda t: legs_of(list(plan.passers), t),
    )  # fmt: skip
    ranges = true_ranges(scanner, None, times, scene, settings.reading.sweep_s)
    return measured(times, ranges, scanner, settings.reading, rng)


def _onboard_scans(plan: SessionPlan, scanner: Scanner) -> Scans:
    """By the robot's clock."""
    settings, rng = plan.settings, plan.random(f"scans {scanner.name}")
    first, last = plan.visits[0][0] - SCAN_MARGIN_S, plan.visits[-1][1] + SCAN_MARGIN_S
    times = plan.clock.ticks(first, last, 1.0 / settings.onboard_hz, float(rng.random()))
    times = times[in_visits(plan, times, SCAN_MARGIN_S)]
    scene = Scene(plan.site.solid, None, np.zeros((0, 4)), lambda t: legs_of(list(plan.passers), t))
    ranges = true_ranges(scanner, plan.route.poses, times, scene, settings.reading.sweep_s)
    return measured(plan.clock.robot_times(times), ranges, scanner, settings.reading, rng)


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
    pieces = [piece]
    if np.isfinite(clock.jump_at_s):
        pieces.append(
            {**piece, "from_s": clock.jump_at_s, "offset_s": clock.offset_s + clock.jump_s}
        )
    return {
        "meaning": "robot_time = t + offset_s + drift (t - reference_s), from from_s on",
        "pieces": pieces,
    }


def _nearest_m(plan: SessionPlan, passer: Passer) -> float:
    """How near somebody comes to the robot's origin."""
    times = np.arange(passer.from_s, passer.to_s, 0.02)
    gaps = passer.places(times)[0] - plan.route.poses(times)[:, :2]
    return round(float(np.nanmin(np.linalg.norm(gaps, axis=1))), 3)


_COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:purple")


def draw_session(
    folder: Path, path: Path, *, at_s: float | None = None, overwrite: bool = False
) -> None:
    """Draw a session from its files."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    truth, camera = (read_planar_poses(folder / f"{n}.csv") for n in ("truth", "camera"))
    at_s = float(camera.times_s[len(camera) // 2]) if at_s is None else at_s
    robot_pose = truth.poses[np.argmin(np.abs(truth.times_s - at_s))]
    robot = read_robot(folder / "robot.json")
    figure = Figure(figsize=(12.0, 10.0), layout="tight")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(aspect="equal")
    walls = read_building(folder / "building.csv").reshape(-1, 2, 2)
    axes.add_collection(LineCollection(list(walls), colors="black", linewidths=1.2))
    axes.plot(*truth.poses[:, :2].T, color="0.6", linewidth=0.8, label="way")
    axes.plot(*camera.poses[:, :2].T, ".", color="tab:red", markersize=2, label="marker poses")
    stands = read_planar_poses(folder / "reference.csv") if _has_rows(folder) else None
    if stands is not None:
        axes.plot(*stands.poses[:, :2].T, "k+", markersize=9, label="reference poses")
    survey = read_survey(folder / "fiducials.json")
    axes.plot(*np.stack(list(survey.fiducials.values())).T, "k*", label="fiducials")
    scanners = read_scanners(folder / "scanners.truth.json")
    for scanner, colour in zip(scanners, _COLOURS):
        points = _points_at(folder, scanner, scanner.pose, at_s)
        axes.plot(*points.T, ".", color=colour, markersize=3, label=scanner.name)
        axes.plot(*_arrow(scanner.pose), color=colour, linewidth=2.5)
    for scanner, colour in zip(robot.scanners, ("0.3", "tab:cyan")):
        pose = compose(robot_pose[None], scanner.pose[None])[0]
        points = _points_at(folder, scanner, pose, _robot_time(folder, at_s))
        axes.plot(*points.T, "x", color=colour, markersize=3, label=f"{scanner.name} (on board)")
    outline = np.vstack([robot.outline, robot.outline[:1]])
    body = compose(
        np.tile(robot_pose, (len(outline), 1)), np.column_stack([outline, 0 * outline[:, :1]])
    )
    axes.plot(*body[:, :2].T, color="tab:red", linewidth=1.5)
    axes.autoscale_view()
    axes.set(xlabel="x / m", ylabel="y / m", title=f"t = {at_s:.2f} s")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100, metadata={"Software": None})
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write(buffer.getvalue())


def _robot_time(folder: Path, at_s: float) -> float:
    """What the robot's clock showed, by the truth."""
    time = at_s
    for piece in read_json(folder / "truth.json")["clock"]["pieces"]:
        if piece["from_s"] is None or at_s >= piece["from_s"]:
            time = at_s + piece["offset_s"] + piece["drift"] * (at_s - piece["reference_s"])
    return time


def _has_rows(folder: Path) -> bool:
    return (folder / "reference.csv").stat().st_size > 0


def _arrow(pose: FloatArray) -> FloatArray:
    """(2, 2) ends of a short line from a scanner along its middle beam."""
    tip = pose[:2] + 0.5 * np.array([np.cos(pose[2]), np.sin(pose[2])])
    return np.stack([pose[:2], tip]).T


def _points_at(folder: Path, scanner: Scanner, pose: FloatArray, at_s: float) -> FloatArray:
    """(M, 2) points in the world of the scan nearest in time."""
    scans = read_scans(find_scans(folder, scanner.name), scanner.readings)
    points = scanner.points(scans.ranges_mm[np.argmin(np.abs(scans.times_s - at_s))])
    points = points[np.isfinite(points[:, 0])]
    local = np.column_stack([points, np.zeros(len(points))])
    return compose(np.tile(pose, (len(points), 1)), local)[:, :2]
