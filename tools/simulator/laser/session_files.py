"""A simulated laser session as a folder (docs/groundtruth/sessions.md), and its truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.json_file import write_json
from redetect.groundtruth.lasers.building import Building, write_building, write_drawing
from redetect.groundtruth.lasers.scanners import Scanner, write_robot, write_scanners
from redetect.groundtruth.lasers.scans import Scans, write_scans
from redetect.groundtruth.trajectories.streams import write_planar_poses
from redetect.groundtruth.validation.fiducials import write_distances, write_survey
from redetect.storage import write_whole
from tools.simulator.laser.clock import ptpd_lines
from tools.simulator.laser.measuring import Scene, measured, true_ranges
from tools.simulator.laser.people import Passer, legs_of
from tools.simulator.laser.session import SessionPlan, plan_session, sides_of
from tools.simulator.laser.settings import LaserSettings
from tools.simulator.laser.site import ROOM_M
from tools.simulator.laser.streams import (
    SCAN_MARGIN_S,
    camera_stream,
    exact_poses,
    in_visits,
    measured_distances,
    odometry_stream,
    reference_times,
    survey_of,
)

FloatArray = NDArray[np.float64]

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
    """Simulate a session and write its folder.

    Parameters
    ----------
    settings : LaserSettings
    folder : path
        Made if missing.
    seed : int
        Everything about the session follows from it and the settings.
    overwrite : bool
        Whether existing files may be replaced.
    on_file : callable, optional
        Called after each scanner's file.

    Returns
    -------
    SessionPlan
        What is true of it.

    Raises
    ------
    redetect.storage.OutputExistsError
        If a file exists and `overwrite` is false.
    redetect.groundtruth.errors.GroundTruthError
        If no way through the room was found.
    """
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
    building = Building(plan.site.walls)
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
