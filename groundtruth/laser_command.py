"""The command ``groundtruth laser``: a session's scans in, poses and an account of each set out."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from groundtruth.errors import GroundTruthError
from groundtruth.options import Laser

if TYPE_CHECKING:
    from groundtruth.laser_sets import ScannerTables, ScanSets
    from groundtruth.laser_tracking import LaserTrack
    from groundtruth.scans import Robot, Scanner

FloatArray = NDArray[np.float64]

#: So many readings that hide the robot, or of things beside it, mark a set as disturbed.
_DISTURBED = 3

_SUSPECT_SIGMA, _SUSPECT_M, _SUSPECT_RAD = 5.0, 0.005, 0.002


def perform(options: Laser) -> int:
    """Carry the command out; returns the exit code: 1 without a single pose."""
    from groundtruth.commands import check_outputs, provenance
    from groundtruth.laser_blocks import combined_poses
    from groundtruth.laser_settings import LaserSettings
    from groundtruth.laser_tracking import COASTING, LOST, OK, REACQUIRED
    from groundtruth.streams import write_planar_poses

    settings = LaserSettings(gate_m=options.gate_m, kept=options.keep)
    output = options.output or options.session / "laser.csv"
    account, summary = output.with_suffix(".jsonl"), output.with_suffix(".json")
    check_outputs([output, account, summary], options.force)
    calibration = options.scanners or options.session / "aligned.json"
    if options.scanners is None and not calibration.is_file():
        calibration = options.session / "scanners.json"
    scanners, robot, tables, sets = load_session(options.session, calibration)
    track, left_out = track_without_suspects(sets, tables, robot, scanners, settings)

    poses = combined_poses(track, options.average)
    write_planar_poses(output, poses, overwrite=options.force)
    _write(account, account_lines(track), options.force)
    described = describe(track, scanners, left_out)
    files = [calibration, options.session / "robot.json"]
    content = {**provenance(settings, files), "sets_per_pose": options.average, **described}
    _write(summary, [json.dumps(content, indent=1)], options.force)

    expected = int(np.sum(track.status != LOST))
    determined = int(np.isin(track.status, (OK, REACQUIRED)).sum())
    coasted = int((track.status == COASTING).sum())
    print(
        f"{len(sets)} sets of scans, {len(track.fronts)} visits, {expected} sets with the robot: "
        f"{len(poses)} poses, {determined} of them determined in all directions; {coasted} without"
    )
    for segment in described["segments"]:
        print(f"  {segment['from_s']:.2f} to {segment['to_s']:.2f} s: front: {segment['front']}")
    for scanner in described["scanners"]:
        if scanner["suspect"]:
            shift = scanner["correction"]
            print(
                f"warning: scanner {scanner['name']} does not fit the others: its readings ask for "
                f"a shift of {1e3 * shift[0]:.1f}, {1e3 * shift[1]:.1f} mm and "
                f"{np.degrees(shift[2]):.2f} deg; "
                + ("it was left out" if scanner["left_out"] else "it was used all the same"),
                file=sys.stderr,
            )
    return 0 if len(poses) else 1


def load_session(
    folder: Path, calibration: Path
) -> tuple[tuple[Scanner, ...], Robot, ScannerTables, ScanSets]:
    """Read fixed scanners, robot, scans, and learn the background.

    Raises
    ------
    GroundTruthError
        If a file is missing or does not fit the others.
    """
    from groundtruth.background import learn_background
    from groundtruth.laser_sets import scanner_tables, sets_of_scans
    from groundtruth.scans import find_scans, read_robot, read_scanners, read_scans

    scanners = read_scanners(calibration)
    robot = read_robot(folder / "robot.json")
    backgrounds = []
    for scanner in scanners:
        path = find_scans(folder / "empty", scanner.name)
        backgrounds.append(
            learn_background(read_scans(path, scanner.readings).ranges_mm, scanner.max_range_m)
        )
    tables = scanner_tables(scanners, backgrounds, joint_covariance(calibration, scanners))
    scans = [read_scans(find_scans(folder, s.name), s.readings) for s in scanners]
    return scanners, robot, tables, sets_of_scans(scans)


def joint_covariance(path: Path, scanners: tuple[Scanner, ...]) -> FloatArray | None:
    """The scanners' joint covariance that `groundtruth lasers` writes, if the file has one."""
    from groundtruth.calibration import read_json

    entry = read_json(path).get("joint_covariance")
    if entry is None:
        return None
    names = [scanner.name for scanner in scanners]
    size = 3 * len(names)
    if not isinstance(entry, dict) or entry.get("scanners") != names:
        raise GroundTruthError(f"{path}: joint_covariance: expected scanners {names} in this order")
    try:
        matrix = np.array(entry.get("matrix"), dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise GroundTruthError(f"{path}: joint_covariance: expected {size} x {size} finite numbers")
    return matrix


def track_robot(
    sets: ScanSets, tables: ScannerTables, robot: Robot, settings: Any = None
) -> LaserTrack:
    """Follow the robot through sets of scans (see `groundtruth.laser_tracking`)."""
    from groundtruth.laser_acquisition import robot_body
    from groundtruth.laser_settings import LaserSettings
    from groundtruth.laser_tracking import Tracker

    settings = LaserSettings() if settings is None else settings
    body = robot_body(robot.outline, settings.symmetry_m)
    return Tracker(
        sets, tables, body, robot.largest_speed_m_s, robot.largest_turn_rad_s, settings
    ).run()


def track_without_suspects(
    sets: ScanSets,
    tables: ScannerTables,
    robot: Robot,
    scanners: tuple[Scanner, ...],
    settings: Any = None,
) -> tuple[LaserTrack, dict[str, FloatArray]]:
    """Follow the robot, leaving out scanners whose readings do not fit the others'.

    One at a time, the worst first, and only while three scanners or more are left to say so.

    Returns
    -------
    track : LaserTrack
    left_out : dict of str to (2, 3) float64
        By scanner, the shift its readings asked for and its standard deviations.
    """
    left_out: dict[str, FloatArray] = {}
    track = track_robot(sets, tables, robot, settings)
    while len(scanners) - len(left_out) >= 3:
        excess = _excess(track, scanners)
        worst = int(np.argmax(excess))
        if excess[worst] <= 1.0:
            break
        left_out[scanners[worst].name] = np.stack(
            [track.corrections[worst], track.correction_sigma[worst]]
        )
        rows = sets.rows.copy()
        rows[:, worst] = -1
        sets = replace(sets, rows=rows)
        track = track_robot(sets, tables, robot, settings)
    return track, left_out


def _excess(track: LaserTrack, scanners: tuple[Scanner, ...]) -> FloatArray:
    """(scanners,) how far beyond what is allowed their shifts are; above 1 is suspect."""
    least = np.array([_SUSPECT_M, _SUSPECT_M, _SUSPECT_RAD])
    excess = np.zeros(len(scanners))
    for k, scanner in enumerate(scanners):
        shift, sigma = track.corrections[k], track.correction_sigma[k]
        if np.isfinite(shift).all():
            allowed = _SUSPECT_SIGMA * np.sqrt(sigma**2 + np.diag(scanner.covariance))
            excess[k] = float(np.max(np.abs(shift) / np.maximum(allowed, least)))
    return excess


def account_lines(track: LaserTrack) -> list[str]:
    """A line of JSON for every set of scans."""
    from groundtruth.laser_tracking import COASTING, LOST, STATUS, UNDETERMINED

    lines = []
    names = ("expected", "agree", "through", "hidden", "none", "beside")
    for i, status in enumerate(track.status.tolist()):
        line: dict[str, Any] = {"t": round(float(track.times_s[i]), 6), "status": STATUS[status]}
        if status != LOST:
            line["visit"] = int(track.segment[i])
        if status not in (LOST, COASTING):
            beams = {name: int(n) for name, n in zip(names, track.beams[i])}
            line["readings"] = int(track.readings[i])
            line["rms_m"] = round(float(track.rms_m[i]), 5)
            line["chi2_per_freedom"] = round(float(track.chi2[i]), 3)
            line["beams"] = beams
            line["disturbed"] = beams["hidden"] + beams["beside"] >= _DISTURBED
        if status == UNDETERMINED:
            line["direction"] = [round(float(v), 4) for v in track.weak[i]]
        if i in track.reasons and status == COASTING:
            line["reason"] = track.reasons[i]
        lines.append(json.dumps(line))
    return lines


def describe(
    track: LaserTrack, scanners: tuple[Scanner, ...], left_out: dict[str, FloatArray]
) -> dict[str, Any]:
    """Visits and how their front was found; what each scanner's residuals say of its pose."""
    segments = []
    for segment, front in sorted(track.fronts.items()):
        times = track.times_s[track.segment == segment]
        segments.append(
            {"visit": segment, "from_s": float(times[0]), "to_s": float(times[-1]), "front": front}
        )
    entries = []
    excess = _excess(track, scanners)
    for k, scanner in enumerate(scanners):
        out = scanner.name in left_out
        shift, sigma = (
            left_out[scanner.name] if out else (track.corrections[k], track.correction_sigma[k])
        )
        entries.append(
            {
                "name": scanner.name,
                "correction": [float(v) if np.isfinite(v) else None for v in shift],
                "sigma": [float(v) if np.isfinite(v) else None for v in sigma],
                "suspect": bool(out or excess[k] > 1.0),
                "left_out": out,
            }
        )
    return {"segments": segments, "scanners": entries}


def _write(path: Path, lines: list[str], force: bool) -> None:
    from storage import write_whole

    with write_whole(path, overwrite=force) as stream:
        stream.write(("\n".join(lines) + "\n").encode())
