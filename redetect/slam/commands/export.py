"""``slam export`` and ``slam import``: runs in the formats of other tools, and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from redetect import slam
from redetect.landmarks import CircleLandmark, read_frames, write_frames
from redetect.landmarks.map_file import (
    LandmarkMap,
    Landmarks,
    Path2D,
    read_map,
    read_path,
    write_map,
    write_path,
    write_table,
)
from redetect.landmarks.times import read_times
from redetect.slam.commands.files import camera_xy_of, demand_free, print_assumed, recording_of
from redetect.slam.errors import SlamError
from redetect.slam.formats import data_sets
from redetect.slam.formats.g2o import (
    demand_readable,
    frames_of_graph,
    graph_of_frames,
    poses_of_run,
    read_g2o,
    write_g2o,
)
from redetect.slam.formats.tables import bearing_table, disc_table, odometry_table
from redetect.slam.formats.text import (
    MEANING,
    Axes,
    covariance_from_dataset,
    from_dataset,
    text_rows,
)
from redetect.slam.formats.tum import read_tum, write_tum
from redetect.slam.options import Export, Import
from redetect.slam.recording import landmark_files
from redetect.storage.bounds import ABOVE_0, demand

_LANDMARKS = (".circles", ".lines", ".markers")
_G2O_WORDS = ("VERTEX_SE2", "VERTEX_XY", "EDGE_SE2", "EDGE_SE2_XY", "FIX")


def perform(command: Export | Import) -> int:
    """Carry the command out; returns the exit code."""
    if isinstance(command, Import):
        return _import(command)
    if command.to == "g2o":
        return _export_g2o(command)
    if command.to == "tum":
        return _export_tum(command)
    return _export_tables(command)


def _export_g2o(command: Export) -> int:
    if command.lines:
        raise SlamError("bearings of verticals have no edge in g2o: expected --to csv for --lines")
    (file,) = landmark_files(command.run, stem=command.stem)
    frames = list(read_frames(file))
    graph = graph_of_frames(frames, str(file), command.solution, command.odometry_noise)
    run = graph.recording
    print_assumed(run.unstated_steps, len(run), command.odometry_noise)
    total = sum(isinstance(row, CircleLandmark) for frame in frames for row in frame.landmarks)
    write_g2o(
        command.output,
        graph,
        axes=command.axes,
        comments=[_made_by(file)],
        overwrite=command.force,
    )
    print(
        f"{command.output}: {len(graph.path.poses)} poses, {len(graph.disc_ids)} discs, "
        f"{len(run)} steps, {len(run.circles)} measurements of discs"
        f"{_left_out(total - len(run.circles))}"
    )
    return 0


def _export_tum(command: Export) -> int:
    if command.run.suffix == ".csv":
        source, path = command.run, read_path(command.run)
    elif command.solution is not None:
        source = command.solution / "path.csv"
        path = read_path(source)
    else:
        source = command.run
        path = poses_of_run(recording_of(command), None)
    times = _times_of(command, path)
    write_tum(
        command.output,
        path,
        times=times,
        axes=command.axes,
        comments=[_made_by(source), "t counts the steps" if times is None else "t in seconds"],
        overwrite=command.force,
    )
    count = len(path.poses) if times is None else len(path.poses) - 1
    print(f"{command.output}: {count} poses")
    return 0


def _times_of(command: Export, path: Path2D) -> dict[str, float] | None:
    """Times of a path's poses: of the file named, or the first beside the run that has them all."""
    folder = command.run if command.run.is_dir() else command.run.parent
    for file in [command.times] if command.times else sorted(folder.glob("*.times")):
        times = read_times(file)
        missing = [name for name in path.prefixes[1:] if name not in times]
        if not missing:
            return {name: times[name] for name in path.prefixes[1:]}
        if command.times:
            raise SlamError(f"{file}: no time of {missing[0]}: expected those of all frames")
    return None


def _export_tables(command: Export) -> int:
    recording = recording_of(command)
    axes, folder, force = command.axes, command.output, command.force
    tables = {
        "odometry.csv": odometry_table(recording, axes),
        "discs.csv": disc_table(recording, axes),
    }
    if len(recording.lines):
        camera_xy = camera_xy_of(recording, command.run, command.camera)
        tables["bearings.csv"] = bearing_table(recording, camera_xy, axes)
    solution = ("path.csv", "map.csv") if command.solution is not None else ()
    demand_free([folder / name for name in (*tables, *solution)], overwrite=force)
    folder.mkdir(parents=True, exist_ok=True)
    head = [_made_by(command.run), f"AXES {axes} ({MEANING[axes]})"]
    for name, table in tables.items():
        write_table(folder / name, table.columns, table.rows, head, overwrite=force)
    if command.solution is not None:
        path = poses_of_run(recording, command.solution)
        landmark_map = read_map(command.solution / "map.csv")
        write_path(folder / "path.csv", _turned_path(path, axes), head, overwrite=force)
        write_map(folder / "map.csv", _turned_map(landmark_map, axes), head, overwrite=force)
    discs, lines = recording.circles.identified, recording.lines.identified
    parts = [f"{len(recording)} steps"]
    parts.append(f"{discs.sum()} measurements of discs{_left_out(int(np.sum(~discs)))}")
    if len(lines):
        parts.append(f"{lines.sum()} bearings{_left_out(int(np.sum(~lines)))}")
    print(f"{folder}: {', '.join(parts)}")
    return 0


def _import(command: Import) -> int:
    if command.file.suffix in _LANDMARKS:
        raise SlamError(
            f"{command.file}: is a landmark file: expected a .g2o graph or a .tum trajectory; "
            "`slam export` writes them"
        )
    if command.file.suffix in (".dat", ".mat"):
        return _import_data_set(command)
    if command.file.suffix == ".tum" or (
        command.file.suffix != ".g2o" and _first_word(command.file) not in _G2O_WORDS
    ):
        return _write_path(command, read_tum(command.file, axes=command.axes))
    graph = read_g2o(command.file, axes=command.axes)
    if command.output.suffix == ".csv":
        return _write_path(command, graph.path)
    frames = frames_of_graph(graph)
    demand_readable(frames, str(command.file))
    unknown = int(np.sum(~np.isfinite(graph.quality)))
    head = _made_by(command.file)
    note = f"; {unknown} of them without quality: 1 is written" if unknown else ""
    write_frames(command.output, frames, head=head, overwrite=command.force)
    seen = len(graph.recording.circles)
    print(f"{command.output}: {len(frames)} steps, {seen} measurements of discs{note}")
    return 0


def _import_data_set(command: Import) -> int:
    """Of the UTIAS data set a robot's run, its true path or the landmarks; of Victoria Park all."""
    demand(command, SlamError, range_sigma=ABOVE_0, bearing_sigma=ABOVE_0)
    file, head = command.file, [_made_by(command.file)]
    if file.name == data_sets.LANDMARKS:
        landmark_map = data_sets.read_landmarks(file)
        write_map(command.output, landmark_map, head, overwrite=command.force)
        print(f"{command.output}: {len(landmark_map.discs)} landmarks")
        return 0
    if file.name.endswith(data_sets.ODOMETRY) and command.output.suffix == ".csv":
        return _write_path(command, data_sets.read_truth(file))
    if file.name.endswith(data_sets.ODOMETRY):
        run = data_sets.read_robot(file)
    elif file.name == data_sets.DRIVE:
        run = data_sets.read_drive(file)
    else:
        raise SlamError(
            f"{file}: expected a RobotN{data_sets.ODOMETRY} or {data_sets.LANDMARKS} of the UTIAS "
            f"data set, or the {data_sets.DRIVE} of Victoria Park"
        )
    frames = data_sets.frames_of(run, command.range_sigma, command.bearing_sigma)
    write_frames(command.output, frames, head=head[0], overwrite=command.force)
    print(f"{command.output}: {len(frames)} steps, {len(run.frame)} measurements")
    return 0


def _write_path(command: Import, path: Path2D) -> int:
    write_path(command.output, path, [_made_by(command.file)], overwrite=command.force)
    print(f"{command.output}: {len(path.poses)} poses")
    return 0


def _first_word(path: Path) -> str:
    for _, text in text_rows(path):
        if not text.startswith("#"):
            return text.split()[0]
    return ""


def _turned_path(path: Path2D, axes: Axes) -> Path2D:
    spread = path.covariance
    return Path2D(
        path.prefixes,
        from_dataset(path.poses, axes),
        None if spread is None else covariance_from_dataset(spread, axes),
    )


def _turned_map(landmark_map: LandmarkMap, axes: Axes) -> LandmarkMap:
    def turned(some: Landmarks) -> Landmarks:
        spread = covariance_from_dataset(some.covariance, axes)
        return Landmarks(some.ids, from_dataset(some.xy, axes), spread, some.rows)

    return LandmarkMap(turned(landmark_map.discs), turned(landmark_map.lines))


def _made_by(source: Path) -> str:
    return f"Made by slam {slam.__version__} of {source.name}"


def _left_out(count: int) -> str:
    return f" ({count} without ID left out)" if count else ""
