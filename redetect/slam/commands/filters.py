"""``slam localize`` and ``slam ekf``: a run through a filter; path, figures and pictures out."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from redetect import __version__
from redetect.array_types import FloatArray
from redetect.bounds import demand
from redetect.landmarks import map_file, squared_mahalanobis, wrap_angle
from redetect.slam.association.registration import localise_globally
from redetect.slam.commands import files
from redetect.slam.errors import SlamError
from redetect.slam.filters.ekf_slam import EkfSlam, run_ekf
from redetect.slam.filters.frames import Associator, FilterRun, run_filter
from redetect.slam.filters.localizer import Localizer
from redetect.slam.options import Ekf, Localize
from redetect.slam.pictures import draw_errors, draw_map
from redetect.slam.recording import Recording
from redetect.slam.settings import PLACE, PLACE_SIGMA
from redetect.storage import demand_free, write_bytes

ERROR_PICTURE = "errors.png"
# The pose is lost if this many frames with discs in succession match none of them.
_LOST_FRAMES = 20
# Factor of innovations with known identifiers above which some are wrong, or covariances too small.
_MOST_FACTOR = 2.5

#: Results of a filter: the run, the map, and further lines for the terminal.
_Result = tuple[FilterRun, map_file.LandmarkMap, list[str]]


def perform(command: Localize | Ekf) -> int:
    """Execute the command; returns the exit code."""
    demand(command, SlamError, start=PLACE)
    name = type(command).__name__.lower()
    output = command.output or files.default_output(command.run, name)
    names = [files.PATH_NAME, f"{name}.json", files.MAP_PICTURE]
    names += [ERROR_PICTURE] * (command.reference is not None)
    if isinstance(command, Ekf):
        names += [files.MAP_NAME, map_file.covariance_file(Path(files.MAP_NAME)).name]
    demand_free([output / name for name in names], overwrite=command.force)
    recording = files.recording_of(command)
    began = time.perf_counter()
    if isinstance(command, Localize):
        run, landmark_map, said = _localized(command, recording)
        source, title = f"{command.run} in {command.map}", "localised"
    else:
        run, landmark_map, said = _mapped(command, recording)
        source, title = f"{command.run}", "EKF-SLAM, poses as they were at the time, map at the end"
    seconds = time.perf_counter() - began
    if command.association != "known":
        said += lost_lines(run, recording)
    elif run.count.innovation_squared > _MOST_FACTOR * run.count.innovation_numbers:
        said.append("errors are much larger than stated: `slam audit` finds wrong identifiers")
    said.append(f"time              {seconds:.2f} s, {len(recording) / seconds:.0f} steps/s")
    reference = None if command.reference is None else map_file.read_path(command.reference)
    distance = None
    if reference is not None:
        distance = path_distance(run.path, reference.poses, f"{command.reference}: ")

    output.mkdir(parents=True, exist_ok=True)
    head = [f"slam {name} {__version__}: {source}"]
    map_file.write_path(output / files.PATH_NAME, run.path, head, overwrite=command.force)
    content: dict[str, Any] = {
        "version": __version__,
        "settings": files.flags_of(command),
        "figures": _figures(run, distance),
    }
    if isinstance(command, Ekf):
        content["landmarks"] = {"discs": len(landmark_map.discs), "lines": len(landmark_map.lines)}
        if command.reference_map:
            off = map_distance(landmark_map, map_file.read_map(command.reference_map))
            content["distance_from_reference_map"] = off
            said.append(
                "from reference    landmarks rms {rms_m:.3f} m, median {median_m:.3f}, max "
                "{max_m:.3f}; squared, over their covariance and 2: {normalised:.2f}".format(**off)
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
        map_file.write_map(output / files.MAP_NAME, landmark_map, head, overwrite=command.force)
    return 0


def _localized(command: Localize, recording: Recording) -> _Result:
    landmark_map = map_file.read_map(command.map)
    said: list[str] = []
    if command.association == "known":
        landmark_map = map_file.with_joint_covariance(landmark_map, command.map)
        if landmark_map.joint_covariance is None:
            name = map_file.covariance_file(command.map).name
            said.append(f"errors of the map are assumed independent: no {name}")
    return localized_run_of(command, recording, landmark_map), landmark_map, said


def localized_run_of(
    command: Localize, recording: Recording, landmark_map: map_file.LandmarkMap
) -> FilterRun:
    """Localise a run's rows in a map, as a command asks.

    Raises `SlamError` if no row shows a landmark of the map, or a flag is out of its range.
    """
    demand(command, SlamError, start=PLACE, start_sigma=PLACE_SIGMA)
    start, covariance = np.array(command.start), np.diag(np.square(command.start_sigma))
    if command.lost:
        start, covariance = _global_start(command, recording, landmark_map)
    localizer = Localizer(
        landmark_map,
        start,
        covariance,
        files.camera_xy_of(recording, command.run, command.camera),
        common_tilt_variance=recording.common_tilt_variance,
        # Considering the map's errors makes the filter slow to converge to it, which does little
        # harm with known pairs, but loses track if pairs have to be found.
        exact=command.association != "known",
    )
    associator = Associator(command.association, command.gate_probability)
    run = run_filter(recording, localizer, associator)
    if not run.count.discs and not run.count.lines:
        expected = "identifiers of the same run, or --association joint"
        if command.association != "known":
            expected = "some near one, seen from the pose at --start"
        lost = f"{command.run}: no row shows a landmark of {command.map}"
        raise SlamError(f"{lost}: expected {expected}")
    return run


def lost_lines(run: FilterRun, recording: Recording) -> list[str]:
    """The longest stretch of frames with discs that match none, in words, if it is long."""
    frames, of_row = np.unique(recording.circles.frame, return_inverse=True)
    matched = np.flatnonzero(np.bincount(of_row[run.disc_ids >= 0], minlength=len(frames)))
    ends = np.concatenate([[-1], matched, [len(frames)]])
    without = np.diff(ends) - 1
    longest = int(np.argmax(without))
    if without[longest] < _LOST_FRAMES:
        return []
    first = frames[ends[longest] + 1]
    return [
        f"lost              {without[longest]} frames with discs, from {recording.prefixes[first]} "
        "on, match none of the map: poses from there on may be wrong"
    ]


def _global_start(
    command: Localize, recording: Recording, landmark_map: map_file.LandmarkMap
) -> tuple[FloatArray, FloatArray]:
    """The pose at the start and its covariance, from the discs of the first frames."""
    if any(command.start) or any(command.start_sigma):
        raise SlamError("--lost and --start: expected one of them")
    found = localise_globally(recording, landmark_map.discs.xy)
    if found is None:
        raise SlamError(
            f"{command.run}: the discs of the first frames have no certain place in {command.map}: "
            "expected five or more that fit no other place as well; or give the pose by --start"
        )
    x, y, heading = found.pose
    print(
        f"located at {x:.2f}, {y:.2f} m, heading {np.degrees(heading):.1f} deg: {found.agreeing} "
        f"of {found.discs} discs of the first {found.frames} frames are in the map"
    )
    return found.pose, found.covariance


def _mapped(command: Ekf, recording: Recording) -> _Result:
    camera_xy = files.camera_xy_of(recording, command.run, command.camera)
    ekf = EkfSlam(
        command.start, camera_xy=camera_xy, common_tilt_variance=recording.common_tilt_variance
    )
    associator = Associator(command.association, command.gate_probability)
    run = run_ekf(recording, ekf, associator)
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


def path_distance(path: map_file.Path2D, reference: ArrayLike, name: str = "") -> dict[str, float]:
    """Distance of a path from another one of the same run in the same map, `reference` (N, 3).

    Rms, median and largest distance of positions (m) and headings (rad), and those of the last
    pose. Raises `SlamError`, beginning with `name`, if their numbers of poses differ.
    """
    other = np.asarray(reference, dtype=np.float64)
    if len(other) != len(path.poses):
        raise SlamError(f"{name}{len(other)} poses: expected {len(path.poses)}, as in this run")
    position = np.hypot(*(path.poses[:, :2] - other[:, :2]).T)
    heading = np.abs(wrap_angle(path.poses[:, 2] - other[:, 2]))
    return {
        f"{name}_{figure}_{unit}": float(value)
        for name, unit, distance in (("position", "m", position), ("heading", "rad", heading))
        for figure, value in (
            ("rms", math.sqrt(float(np.mean(distance**2)))),
            ("median", np.median(distance)),
            ("max", np.max(distance)),
            ("last", distance[-1]),
        )
    }


def map_distance(
    landmark_map: map_file.LandmarkMap, reference: map_file.LandmarkMap
) -> dict[str, float]:
    """Distance of landmarks from those of another map with the same identifiers."""
    offsets, covariances = [], []
    kinds = (landmark_map.discs, reference.discs), (landmark_map.lines, reference.lines)
    for some, others in kinds:
        _, own, other = np.intersect1d(some.ids, others.ids, return_indices=True)
        offsets.append(some.xy[own] - others.xy[other])
        covariances.append(some.covariance[own])
    offset, covariance = np.concatenate(offsets), np.concatenate(covariances)
    if not len(offset):
        raise SlamError("no landmark is in both maps: expected some of the same identifiers")
    distance = np.hypot(*offset.T)
    return {
        "landmarks": float(len(distance)),
        "rms_m": math.sqrt(float(np.mean(distance**2))),
        "median_m": float(np.median(distance)),
        "max_m": float(np.max(distance)),
        "normalised": float(np.mean(squared_mahalanobis(offset, covariance))) / 2.0,
    }


def _figures(run: FilterRun, distance: dict[str, float] | None) -> dict[str, Any]:
    """Figures of any filter for the JSON file."""
    count = run.count
    figures = {
        "steps": len(run.path.poses) - 1,
        "disc_rows_used": count.discs,
        "line_rows_used": count.lines,
        "rows_left_out": dict(sorted(count.left_out.items())),
        "innovation_squared": count.innovation_squared,
        "innovation_expected": count.innovation_numbers,
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
    if count.innovation_numbers:
        factor = count.innovation_squared / count.innovation_numbers
        lines.append(
            f"innovations       chi2 {count.innovation_squared:.1f}, expected "
            f"{count.innovation_numbers}, factor {factor:.2f}, its root {math.sqrt(factor):.2f}"
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
