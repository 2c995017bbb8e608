"""The commands ``groundtruth lasers`` and ``laser``: scanners on the map; poses by their scans."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from redetect.array_types import FloatArray
from redetect.command_line import EXIT_ERROR
from redetect.groundtruth.commands.outputs import check_outputs, provenance, remove_old, warn
from redetect.groundtruth.files import write_json
from redetect.groundtruth.fusion.stream_errors import COMMON
from redetect.groundtruth.lasers import scanners, tracking
from redetect.groundtruth.lasers.acquisition import ScanSets, load_session
from redetect.groundtruth.lasers.alignment import Alignment, align_scanners, icp_by_step
from redetect.groundtruth.lasers.building import find_building, read_building
from redetect.groundtruth.lasers.scanners import Robot, Scanner
from redetect.groundtruth.lasers.tracking import SetStatus
from redetect.groundtruth.lasers.tracking_kernels import BeamCounts
from redetect.groundtruth.lasers.walls import averaged_scan
from redetect.groundtruth.options import Laser, Lasers
from redetect.groundtruth.report.pictures import draw_alignment
from redetect.groundtruth.trajectories.streams import write_planar_poses
from redetect.json_text import json_text
from redetect.plane import pose_differences
from redetect.storage import write_bytes

#: Scanners this many standard deviations from their measured pose are reported.
_FAR_OFF_SIGMA = 5.0
#: Offsets of walls from the map above which a warning is printed (m).
_NOTED_M = 0.001
#: Share of readings on walls of the map below which a warning is printed.
_LEAST_ON_MAP = 0.5
#: Steps of the ICP that the picture shows.
_ICP_STEPS = 30
#: Number of readings that hide the robot, or of objects beside it, that make a set disturbed.
_DISTURBED = 3
#: Half of the robot's movement during a scan above which a warning is printed (m).
_LARGEST_SWEEP_M = 0.012
#: Share of beams through the robot above which a warning is printed: edges cause some per cent.
_MOST_SEEN_THROUGH = 0.08


def perform_lasers(options: Lasers) -> int:
    """Execute the command; returns the exit code."""
    session = options.session
    output = options.output or session / "aligned.json"
    picture = output.with_suffix(".png")
    check_outputs([output, picture], options.force)
    by_hand = session / "scanners.json"
    stated = scanners.read_scanners(by_hand)
    map_file = find_building(session)
    building = read_building(map_file)
    empties = [
        scanners.read_scans(scanners.find_scans(session / "empty", s.name), s.readings)
        for s in stated
    ]
    measured, texts = scanners.with_measured_noise(stated, empties, by_hand)
    for text in texts:
        warn(text)
    alignment = align_scanners(measured, empties, building, options.settings)

    pairs = zip(measured, alignment.scanners)
    far_off = [after.name for before, after in pairs if _sigmas(before, after) > _FAR_OFF_SIGMA]
    extra: dict[str, Any] = {
        **provenance(options.settings, [by_hand, map_file]),
        "steps": {name: poses.tolist() for name, poses in alignment.steps.items()},
        "pairs": [
            {"scanners": [measured[i].name, measured[j].name], "explained": share}
            for (i, j), share in sorted(alignment.pairs.items())
        ],
        "beams_on_map": alignment.matched.tolist(),
        "rms_m": alignment.rms_m.tolist(),
        "far_off_measured": far_off,
        "undetermined": list(alignment.undetermined),
        "inconsistent": list(alignment.inconsistent),
        "map_sigma_m": alignment.map_sigma_m,
        "covariance": {
            "scanners": [s.name for s in alignment.scanners],
            "matrix": alignment.covariance.tolist(),
        },
    }
    del extra["version"]  # that of the file's form is there
    scanners.write_scanners(output, alignment.scanners, extra, overwrite=options.force)
    points = [averaged_scan(a, b.ranges_mm).points for a, b in zip(measured, empties)]
    by_step = [
        icp_by_step(cloud, building, scanner.pose, options.settings, _ICP_STEPS)
        for cloud, scanner in zip(points, measured)
    ]
    drawn = draw_alignment(measured, alignment, points, building, by_step)
    write_bytes(picture, drawn, overwrite=options.force)
    _print_differences(measured, alignment, far_off)
    for one, seen, matched in zip(alignment.scanners, points, alignment.matched):
        if matched < _LEAST_ON_MAP * len(seen):
            warn(
                f"scanner {one.name}: only {100.0 * matched / len(seen):.0f} % of its readings lie "
                f"on walls of {map_file}: expected the map of this place, in metres"
            )
    return 0


def _print_differences(
    measured: Sequence[scanners.Scanner], alignment: Alignment, far_off: Sequence[str]
) -> None:
    for k, (before, after) in enumerate(zip(measured, alignment.scanners)):
        shift = pose_differences(after.pose, before.pose)
        sigma = np.sqrt(np.diag(after.covariance))
        print(
            f"{after.name}: moved by {1e3 * shift[0]:.1f}, {1e3 * shift[1]:.1f} mm and "
            f"{np.degrees(shift[2]):.3f} deg; sigma {1e3 * sigma[0]:.2f}, "
            f"{1e3 * sigma[1]:.2f} mm, {np.degrees(sigma[2]):.4f} deg; {alignment.matched[k]} "
            f"beams on the map, rms {1e3 * alignment.rms_m[k]:.2f} mm"
        )
    if alignment.map_sigma_m > _NOTED_M:
        warn(
            f"the walls are off the map by some {1e3 * alignment.map_sigma_m:.0f} mm, or too few "
            "walls are seen to rule that out: the covariances include it, and the scanners' "
            "errors are common to all"
        )
    for name in far_off:
        warn(f"scanner {name}: was measured wrong, or another place of the map is similar")
    for name in alignment.undetermined:
        warn(f"scanner {name}: a direction is not determined")
    for name in alignment.inconsistent:
        warn(f"scanner {name}: its pose on the map disagrees with the other scanners")


def _sigmas(before: scanners.Scanner, after: scanners.Scanner) -> float:
    """Distance of a scanner from its measured pose, in the measurement's standard deviations."""
    shift = pose_differences(after.pose, before.pose)
    if not np.any(before.covariance):
        return 0.0
    return float(np.sqrt(shift @ np.linalg.pinv(before.covariance + after.covariance) @ shift))


def perform_laser(options: Laser) -> int:
    """Execute the command; returns the exit code: 1 without a single pose."""
    output = options.output or options.session / "laser.csv"
    per_set, summary = output.with_suffix(".jsonl"), output.with_suffix(".json")
    check_outputs([output, per_set, summary], options.force)
    calibration = options.scanners or options.session / "aligned.json"
    if options.scanners is None and not calibration.is_file():
        calibration = options.session / "scanners.json"
        warn(
            f"no {options.session / 'aligned.json'}: the scanners' poses are those of "
            f"{calibration}; their errors are common to all poses, and do not average out in a "
            "fusion"
        )
    scanners, robot, fixed, sets, texts = load_session(options.session, calibration)
    for text in texts:
        warn(text)
    warn_of_sweeps(scanners, sets, robot)
    settings = options.settings
    track, left_out = tracking.track_without_suspects(sets, fixed, robot, scanners, settings)

    average = options.average or tracking.usual_sets_per_pose(track)
    poses = tracking.combined_poses(track, average)
    if len(poses):
        write_planar_poses(output, poses, overwrite=options.force)
    else:
        remove_old([output], options.force)
    write_bytes(per_set, ("\n".join(set_lines(track)) + "\n").encode(), overwrite=options.force)
    described = describe(track, scanners, left_out)
    files = [calibration, options.session / "robot.json"]
    content = {**provenance(settings, files), "sets_per_pose": average, **described}
    write_json(summary, content, overwrite=options.force)

    print(
        f"{len(sets)} sets of scans, {len(track.fronts)} visits, "
        f"{np.sum(track.status != SetStatus.LOST)} sets with the robot: {len(poses)} poses, "
        f"{np.sum(track.is_determined)} of them determined in all directions; "
        f"{np.sum(track.status == SetStatus.COASTING)} without"
    )
    if track.outline_moved_m:
        warn(
            f"the outline in robot.json is some {1e3 * abs(track.outline_moved_m):.0f} mm too "
            f"{'small' if track.outline_moved_m > 0.0 else 'large'} on each side: one that fits "
            "the readings was used"
        )
    if track.outline_sigma_m:
        warn(
            f"the sides of the outline in robot.json are off by some "
            f"{1e3 * track.outline_sigma_m:.0f} mm each: so are all poses, and their covariances "
            "include it"
        )
    if track.seen_through > _MOST_SEEN_THROUGH:
        warn(
            f"{100.0 * track.seen_through:.0f} % of the beams that should meet the robot see "
            "what is behind it: the outline in robot.json is too large, or the pose of a scanner "
            "is wrong"
        )
    for segment in described["segments"]:
        print(f"  {segment['from_s']:.2f} to {segment['to_s']:.2f} s: front: {segment['front']}")
    for scanner in described["scanners"]:
        if scanner["suspect"]:
            shift = scanner["correction"]
            warn(
                f"scanner {scanner['name']} does not fit the others: its readings suggest "
                f"a shift of {1e3 * shift[0]:.1f}, {1e3 * shift[1]:.1f} mm and "
                f"{np.degrees(shift[2]):.2f} deg; "
                + ("it was excluded" if scanner["left_out"] else "it was used nevertheless")
            )
    if not len(poses):
        print(f"error: no pose: {per_set} has the status of every set", file=sys.stderr)
    return 0 if len(poses) else EXIT_ERROR


def warn_of_sweeps(scanners: tuple[Scanner, ...], sets: ScanSets, robot: Robot) -> None:
    """Warn of scans that seem to be of one moment, although the robot moves during them."""
    if any(scanner.sweep_s for scanner in scanners) or len(sets) < 2:
        return
    turn = max((s.readings - 1) * abs(s.angle_step_rad) for s in scanners) / (2.0 * np.pi)
    sweep_s = turn * float(np.median(np.diff(sets.times_s)))
    moved_m = 0.5 * sweep_s * robot.largest_speed_m_s
    if moved_m > _LARGEST_SWEEP_M:
        warn(
            f"no sweep_s of any scanner: if a mirror turns once a scan, its beams take "
            f"{1e3 * sweep_s:.0f} ms, in which the robot moves up to {2e3 * moved_m:.0f} mm"
        )


def set_lines(track: tracking.LaserTrack) -> list[str]:
    """A line of JSON for every set of scans."""
    lines = []
    for i, status in enumerate(map(SetStatus, track.status.tolist())):
        line: dict[str, Any] = {"t": round(float(track.times_s[i]), 6), "status": status.words}
        if status != SetStatus.LOST:
            line["visit"] = int(track.visit[i])
        if status not in (SetStatus.LOST, SetStatus.COASTING):
            beams = {name: int(n) for name, n in zip(BeamCounts._fields, track.beams[i])}
            line["readings"] = int(track.readings[i])
            line["rms_m"] = round(float(track.rms_m[i]), 5)
            line["chi2_per_freedom"] = round(float(track.chi2_per_dof[i]), 3)
            line["beams"] = beams
            line["disturbed"] = beams["hidden"] + beams["beside"] >= _DISTURBED
        if status == SetStatus.UNDETERMINED_DIRECTION:
            line["direction"] = [round(float(v), 4) for v in track.weakest[i]]
        if i in track.reasons and status == SetStatus.COASTING:
            line["reason"] = track.reasons[i]
        lines.append(json_text(line, indent=None))
    return lines


def describe(
    track: tracking.LaserTrack, scanners: tuple[Scanner, ...], left_out: dict[str, FloatArray]
) -> dict[str, Any]:
    """Sets by status, visits and how their front was found, and the residuals of scanners."""
    segments = []
    for visit, front in sorted(track.fronts.items()):
        times = track.times_s[track.visit == visit].tolist()
        segments.append({"visit": visit, "from_s": times[0], "to_s": times[-1], "front": front})
    entries = []
    excess = tracking.excess_shifts(track, scanners)
    for k, scanner in enumerate(scanners):
        out = scanner.name in left_out
        found = (track.corrections[k], track.correction_sigma[k])
        shift, sigma = (values.tolist() for values in left_out.get(scanner.name, found))
        entry = {"name": scanner.name, "correction": shift, "sigma": sigma}
        entries.append({**entry, "suspect": bool(out or excess[k] > 1.0), "left_out": out})
    shared = (track.covariances - track.noise)[track.is_determined]
    counts = np.bincount(track.status, minlength=len(SetStatus)).tolist()
    return {
        "sets": {status.words: count for status, count in zip(SetStatus, counts) if count},
        "outline_moved_m": track.outline_moved_m,
        "outline_sigma_m": track.outline_sigma_m,
        "segments": segments,
        COMMON: (shared.mean(axis=0) if len(shared) else np.zeros((3, 3))).tolist(),
        "scanners": entries,
    }
