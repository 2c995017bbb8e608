"""``slam localize`` and ``slam ekf``: a run through a filter; path, figures and pictures out."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from redetect import __version__
from redetect.landmarks import map_file
from redetect.slam.commands import files
from redetect.slam.errors import SlamError
from redetect.slam.filters.ekf_slam import EkfSlam, run_ekf
from redetect.slam.filters.localizer import localize_by_flags
from redetect.slam.filters.run import Associator, FilterRun
from redetect.slam.options import Ekf, Localize
from redetect.slam.pictures import demand_windows, draw_errors, draw_map
from redetect.slam.recording import Recording, camera_xy_of
from redetect.slam.scoring import map_distance, path_distance
from redetect.slam.settings import MOST_FACTOR
from redetect.storage import demand_free, write_bytes

ERROR_PICTURE = "errors.png"
# The pose is lost if less than this share of the rows of this number of frames with discs match.
_LOST_SHARE, _LOST_FRAMES = 0.3, 20

#: Results of a filter: the run, the map, and further lines for the terminal.
_Result = tuple[FilterRun, map_file.LandmarkMap, list[str]]


def perform(command: Localize | Ekf) -> int:
    """Execute the command; returns the exit code."""
    if command.interactive:
        demand_windows()
    name = type(command).__name__.lower()
    output = command.output or files.default_output(command.run, name)
    names = [map_file.PATH_NAME, f"{name}.json", files.MAP_PICTURE]
    names += [ERROR_PICTURE] * (command.reference is not None)
    if isinstance(command, Ekf):
        names += [map_file.MAP_NAME, map_file.covariance_file(Path(map_file.MAP_NAME)).name]
    demand_free([output / name for name in names], overwrite=command.force)
    reference = None if command.reference is None else map_file.read_path(command.reference)
    known = None
    if isinstance(command, Ekf) and command.reference_map is not None:
        known = map_file.read_map(command.reference_map)
    recording = files.recording_of(command)
    began = time.perf_counter()
    if isinstance(command, Localize):
        run, landmark_map, said = _localized(command, recording)
        source, title = f"{command.run} in {command.map}", "localised"
    else:
        run, landmark_map, said = _mapped(command, recording)
        source, title = f"{command.run}", "EKF-SLAM, poses as they were at the time, map at the end"
    seconds = time.perf_counter() - began
    placed = isinstance(command, Localize) and not command.lost
    if command.association != "known":
        hint = " (--lost finds the start)" if placed else ""
        said += [line + hint for line in lost_lines(run, recording)]
    elif run.count.innovation_squared > MOST_FACTOR * run.count.degrees_of_freedom:
        start = "is --start where the run begins? " if placed else ""
        said.append(
            f"errors are much larger than stated: {start}`slam audit` finds wrong identifiers"
        )
    said.append(f"time              {seconds:.2f} s, {len(recording) / seconds:.0f} steps/s")
    distance = None
    if reference is not None:
        distance = path_distance(run.path, reference.poses, f"{command.reference}: ")
    off = None if known is None else map_distance(landmark_map, known)

    output.mkdir(parents=True, exist_ok=True)
    head = [f"slam {name} {__version__}: {source}"]
    map_file.write_path(output / map_file.PATH_NAME, run.path, head, overwrite=command.force)
    content: dict[str, Any] = {
        "version": __version__,
        "settings": files.flags_of(command),
        "figures": _figures(run, distance),
    }
    if isinstance(command, Ekf):
        content["landmarks"] = {"discs": len(landmark_map.discs), "lines": len(landmark_map.lines)}
        if off is not None:
            content["distance_from_reference_map"] = off
            said.append(
                "from reference    landmarks rms {rms_m:.3f} m, median {median_m:.3f}, max "
                "{max_m:.3f}; normalised error squared per "
                "coordinate: {normalised:.2f} (1 if consistent)".format(**off)
            )
    files.write_json(output / f"{name}.json", content, overwrite=command.force)
    print("\n".join([*_table(run, distance), *said]))
    title = f"{command.run.name}: {title}"
    shown = command.interactive
    drawn = draw_map(landmark_map, run.path, reference=reference, title=title, interactive=shown)
    write_bytes(output / files.MAP_PICTURE, drawn, overwrite=command.force)
    if reference is not None:
        drawn = draw_errors(run.path, reference.poses, title=title, interactive=shown)
        write_bytes(output / ERROR_PICTURE, drawn, overwrite=command.force)
    if isinstance(command, Ekf):
        map_file.write_map(output / map_file.MAP_NAME, landmark_map, head, overwrite=command.force)
    return 0


def _localized(command: Localize, recording: Recording) -> _Result:
    said: list[str] = []
    landmark_map = map_file.with_joint_covariance(map_file.read_map(command.map), command.map)
    if landmark_map.joint_covariance is None:
        name = map_file.covariance_file(command.map).name
        said.append(f"errors of the map are assumed independent: no {name}")
    run = localize_by_flags(command, recording, landmark_map)
    if (found := run.located) is not None:
        x, y, heading = found.pose
        print(
            f"located at {x:.2f}, {y:.2f} m, heading {np.degrees(heading):.1f} deg: "
            f"{found.agreeing} of {found.discs} discs of the first {found.frames} frames are in "
            "the map"
        )
    return run, landmark_map, said


def lost_lines(run: FilterRun, recording: Recording) -> list[str]:
    """The longest stretch of frames with discs of which few rows match, in words, if it is long."""
    frames, of_row = np.unique(recording.circles.frame, return_inverse=True)
    matched = np.bincount(of_row[run.disc_ids >= 0], minlength=len(frames))
    counts = np.stack([matched, np.bincount(of_row)], axis=1)
    before = np.concatenate([[[0, 0]], np.cumsum(counts, axis=0)])
    several = before[_LOST_FRAMES:] - before[:-_LOST_FRAMES]
    lost = np.flatnonzero(several[:, 0] < _LOST_SHARE * several[:, 1])
    if len(lost) == 0:
        return []
    longest = max(np.split(lost, np.flatnonzero(np.diff(lost) > 1) + 1), key=len)
    part = np.arange(longest[0], longest[-1] + _LOST_FRAMES)
    few = part[matched[part] < _LOST_SHARE * counts[part, 1]]
    part = np.arange(few[0], few[-1] + 1)
    fitting, rows = counts[part].sum(axis=0)
    return [
        f"lost              only {fitting} of {rows} rows in {len(part)} frames with discs, from "
        f"{recording.prefixes[frames[few[0]]]} on, match the map: poses from there on may be wrong"
    ]


def _mapped(command: Ekf, recording: Recording) -> _Result:
    camera_xy = camera_xy_of(recording, command.run, command.camera)
    ekf = EkfSlam(
        command.start, camera_xy=camera_xy, common_tilt_variance=recording.common_tilt_variance
    )
    run = run_ekf(recording, ekf, Associator(command.association, command.gate_probability))
    landmark_map = ekf.landmark_map()
    discs, lines = len(landmark_map.discs), len(landmark_map.lines)
    if not discs and not lines:
        raise SlamError(
            f"{command.run}: no landmark in the map: expected rows with identifiers, or "
            "--association joint"
        )
    said = [f"landmarks         {discs} discs, {lines} lines"]
    if waiting := len(ekf.line_slots) - lines:
        said.append(f"                  {waiting} more lines, seen with too little parallax")
    return run, landmark_map, said


def _figures(run: FilterRun, distance: dict[str, float] | None) -> dict[str, Any]:
    """Figures of any filter for the JSON file."""
    count = run.count
    figures = {
        "steps": len(run.path.poses) - 1,
        "disc_rows_used": count.discs,
        "line_rows_used": count.lines,
        "rows_left_out": dict(sorted(count.left_out.items())),
        "innovation_squared": count.innovation_squared,
        "innovation_expected": count.degrees_of_freedom,
    }
    return figures if distance is None else figures | {"distance_from_reference": distance}


def _table(run: FilterRun, distance: dict[str, float] | None) -> list[str]:
    """Lines for the terminal."""
    count = run.count
    lines = [f"steps             {len(run.path.poses) - 1}"]
    rows = {"discs": count.discs, "lines": count.lines}
    used = [f"{number} of {what}" for what, number in rows.items() if number]
    lines.append(f"rows used         {', '.join(used) or 'none'}")
    for reason, number in sorted(count.left_out.items()):
        lines.append(f"left out          {number} ({reason})")
    if count.degrees_of_freedom:
        factor = count.innovation_squared / count.degrees_of_freedom
        lines.append(
            f"innovations       chi2 {count.innovation_squared:.1f}, expected "
            f"{count.degrees_of_freedom}, factor {factor:.2f}, its root {math.sqrt(factor):.2f}"
        )
    if distance is not None:
        for head, kind, unit, scale, form in (
            ("from reference    position", "position_{}_m", "m", 1.0, ".3f"),
            ("                  heading", "heading_{}_rad", "deg", 180.0 / math.pi, ".2f"),
        ):
            rms, *more = (
                f"{name} {scale * distance[kind.format(name)]:{form}}"
                for name in ("rms", "median", "max", "last")
            )
            lines.append(f"{head} {rms} {unit}, {', '.join(more)}")
    return lines
