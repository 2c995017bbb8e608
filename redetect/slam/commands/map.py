"""The command ``slam map``: files in, map, path, table and picture out."""

from __future__ import annotations

import math
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from camera import write_camera
from redetect import __version__
from redetect.landmarks import map_file
from redetect.slam.commands import files
from redetect.slam.mapping import run_map
from redetect.slam.mapping.odometry_check import OdometryCheck, check_odometry
from redetect.slam.mapping.run_map import MappedRun, Mounting, map_run_by_flags, table_lines
from redetect.slam.mounting import mounted_camera
from redetect.slam.options import Map
from redetect.slam.pictures import demand_windows, draw_map
from redetect.slam.recording import first_poses, joined
from redetect.slam.settings import MOST_FACTOR
from redetect.storage import demand_free, write_bytes

TABLE_NAME, CAMERA_NAME = "table.json", "mounted.cam"

# Systematic errors of odometry are reported if they exceed this many standard deviations, and these
# changes of lengths (%), turns (rad/m) and lags (intervals between frames).
_SIGNIFICANT, _LEAST_PERCENT, _LEAST_TURN, _LEAST_LAG = 5.0, 2.0, 0.01, 0.1


def perform(command: Map) -> int:
    """Execute the command; returns 0 if it succeeds."""
    if command.interactive:
        demand_windows()
    output = command.output or files.default_output(command.run)
    joint_name = map_file.covariance_file(Path(map_file.MAP_NAME)).name
    names = [map_file.MAP_NAME, *map_file.path_names(len(command.runs)), TABLE_NAME]
    names.append(files.MAP_PICTURE)
    names += [joint_name] + [CAMERA_NAME] * command.calibrate
    demand_free([output / name for name in names], overwrite=command.force)
    runs = files.recordings_of(command)
    recording = joined(runs)
    begin = time.perf_counter()
    mapped = map_run_by_flags(command, recording)
    seconds = time.perf_counter() - begin

    check = check_odometry(mapped)
    name = ", ".join(run.resolve().name for run in command.runs)
    head = [f"slam map {__version__}: {name}"]
    final, path = mapped.landmarks_to_write(), mapped.path
    paths = [path.part(*ends) for ends in pairwise(first_poses(runs).tolist())]
    map_file.write_map_and_paths(output, final, paths, head, overwrite=command.force)
    files.write_json(output / TABLE_NAME, _results(mapped, check, command), overwrite=command.force)
    for line in _report(mapped, check, seconds):
        print(line)
    if final.joint_covariance is None:
        names.remove(joint_name)
        print(
            f"more than {run_map.MOST_LANDMARKS_TOGETHER} landmarks: no {joint_name}, so that "
            "`slam localize` assumes independent errors"
        )
    drawn = draw_map(final, path, before=mapped.before, title=name, interactive=command.interactive)
    write_bytes(output / files.MAP_PICTURE, drawn, overwrite=command.force)
    if (found := mapped.mounting) is not None and mapped.graph.camera is not None:
        mounted = mounted_camera(mapped.graph.camera, found.robot_from_camera, found.covariance)
        write_camera(mounted, output / CAMERA_NAME, overwrite=command.force)
        if mounted.covariance is None:
            print("the .cam file has no covariance of the lens: that of the mounting is left out")
    print(f"{output}: {', '.join(names)}")
    return 0


def _report(mapped: MappedRun, check: OdometryCheck, seconds: float) -> list[str]:
    lines = table_lines(mapped.table)
    for name, factor in (("odometry", check.odometry_factor), ("rows", check.rows_factor)):
        if not math.isnan(factor):
            lines.append(f"{f'factor of {name} alone':<28}{factor:>12.2f}")
    if mapped.cost < mapped.table.chi_squared * (1.0 - 1e-9):
        lines.append(f"{'minimised, under the loss':<28}{mapped.cost:>12,.2f}")
    if mapped.mounting is not None:
        lines += _mounting_lines(mapped.mounting)
    left_out = mapped.left_out
    said = [
        (left_out.rows_without_id, "rows without an identifier, not used"),
        (left_out.discs_seen_once, "discs seen once"),
        (left_out.lines_without_parallax, "lines without a certain position, not used"),
        (left_out.line_rows, "rows of these lines, not used"),
    ]
    lines += [f"{what}: {count}" for count, what in said if count]
    lines += doubts_of(check, mapped)
    lines.append(f"steps of the solver: {mapped.steps}, in {seconds:.2f} s")
    return lines


def doubts_of(check: OdometryCheck, mapped: MappedRun) -> list[str]:
    """What does not fit, in words: large and significant errors of odometry, or of rows."""
    least = _SIGNIFICANT * max(mapped.table.root, 1.0)
    lines = []
    of_length = (
        "is it in metres, is the discs' radius right (--radius-m), does the camera lean or have "
        "another height (--calibrate)?"
    )
    if check.length < -1.0:
        of_length = "forward is -Y in STEP rows, X in other poses, and up in counts of wheels"
    for value, sigma, smallest, ways, text in (
        (100.0 * check.length, 100.0 * check.length_sigma, _LEAST_PERCENT, ("longer", "shorter"),
         "its steps would have to be {0:.1f} % {1}; " + of_length),
        (check.turn_per_metre, check.turn_per_metre_sigma, _LEAST_TURN, ("left", "right"),
         "it would have to turn to the {1} by {0:.3f} rad more in each metre"),
        (check.lag_frames, check.lag_frames_sigma, _LEAST_LAG, ("behind", "ahead of"),
         "it is {0:.2f} of the interval between frames {1} them; do the clocks of odometry and "
         "camera agree, is the camera where its calibration says (--calibrate)?"),
    ):  # fmt: skip
        if abs(value) > max(least * sigma, smallest):
            said = text.format(abs(value), ways[value < 0.0])
            lines.append(f"odometry does not fit the rows: {said}")
    if check.outliers:
        lines.append(
            f"steps with errors beyond chance: {check.outliers}; odometry slipped there, or rows "
            f"are wrong, most at {mapped.prefixes[check.worst_step + 1]}"
        )
    if check.rows_factor > MOST_FACTOR and not check.odometry_factor > check.rows_factor:
        without = ", and --loss geman-mcclure maps without them"
        lines.append(
            f"errors of rows are {math.sqrt(check.rows_factor):.1f} times as large as their "
            "covariances state: `slam audit` finds wrong identifiers"
            f"{without if mapped.weighting.loss != 'geman-mcclure' else ''}"
        )
    elif check.odometry_factor > MOST_FACTOR:
        lines.append(
            f"errors of odometry are {math.sqrt(check.odometry_factor):.1f} times as large as its "
            "covariances state: those of the map are larger than stated, too"
        )
    return lines


def _mounting_lines(mounting: Mounting) -> list[str]:
    sigma = np.sqrt(np.diag(mounting.covariance))
    names = [f"rotation about {axis}" for axis in "xyz"] + ["place x", "place y", "height"]
    lines = [
        f"{name:<28}{value:>12.4f} +- {spread:.4f} {unit}"
        for name, value, spread, unit in zip(names, mounting.change, sigma, ["rad"] * 3 + ["m"] * 3)
        if spread > 0.0
    ]
    if any(mounting.levelled_by):
        pitch, roll = np.degrees(mounting.levelled_by)
        lines.append(
            f"it contains {pitch:.2f}, {roll:.2f} degrees by which rows are levelled (mean)"
        )
    return [*lines, f"{'gained by the mounting':<28}{mounting.gain:>12,.2f}"]


def _results(mapped: MappedRun, check: OdometryCheck, command: Map) -> dict[str, Any]:
    results: dict[str, Any] = {
        "version": __version__,
        "configuration": files.flags_of(command, ("output", "force", "interactive")),
        "table": mapped.table,
        "odometry": check,
        "minimised": mapped.cost,
        "steps": mapped.steps,
        "left_out": mapped.left_out,
    }
    if (found := mapped.mounting) is not None:
        results["mounting"] = {
            "rotation_rad": found.change[:3],
            "place_m": found.change[3:5],
            "height_m": found.change[5],
            "covariance": found.covariance,
            "robot_from_camera": found.robot_from_camera,
            "chi_squared_gained": found.gain,
        }
    return results
