"""``slam export`` and ``import``: runs for other tools, and from them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from redetect import __version__
from redetect.landmarks import write_frames
from redetect.landmarks.axes import MEANING
from redetect.landmarks.frame_files import read_times
from redetect.landmarks.map_file import Path2D, read_path, write_map, write_path, write_table
from redetect.plane import chain_steps
from redetect.slam.commands.files import recording_of
from redetect.slam.errors import SlamError
from redetect.slam.formats import utias, victoria_park
from redetect.slam.formats.g2o import graph_of_run, read_g2o, write_g2o
from redetect.slam.formats.tables import bearing_table, disc_table, odometry_table
from redetect.slam.formats.tum import read_tum, write_tum
from redetect.slam.options import Export, Import
from redetect.slam.recording import Recording, camera_xy_of, frames_of_discs
from redetect.storage import demand_free

_DATA_SET_FLAGS = ("range_sigma", "bearing_sigma", "calibrated")


def perform_export(command: Export) -> int:
    """Execute the command; returns the exit code."""
    if command.times is not None and command.to != "tum":
        raise SlamError(f"--times: only --to tum has times, not {command.to}")
    {"g2o": _export_g2o, "tum": _export_tum, "csv": _export_tables}[command.to](command)
    return 0


def _export_g2o(command: Export) -> None:
    recording = recording_of(command)
    if len(recording.lines):
        raise SlamError("bearings of verticals have no edge in g2o: expected discs, or --to csv")
    graph = graph_of_run(recording)
    rows = graph.recording.circles
    write_g2o(command.output, graph, comments=_head(command.run), overwrite=command.force)
    print(
        f"{command.output}: {len(graph.poses)} poses, {len(graph.disc_ids)} discs, "
        f"{len(recording)} steps, {len(rows)} measurements of discs"
        f"{_left_out(len(recording.circles) - len(rows))}"
    )


def _export_tum(command: Export) -> None:
    if command.run.suffix == ".csv":
        path = read_path(command.run)
    else:
        recording = recording_of(command)
        path = Path2D(("start", *recording.prefixes), chain_steps(recording.steps))
    times = _times_of(command, path)
    head = [*_head(command.run), "t counts the steps" if times is None else "t in seconds"]
    write_tum(command.output, path, times=times, comments=head, overwrite=command.force)
    count = len(path.poses) if times is None else len(times)
    print(f"{command.output}: {count} poses")


def _times_of(command: Export, path: Path2D) -> dict[str, float] | None:
    """Times of a path's poses, from the given file, or the first complete one beside the run."""
    folder = command.run if command.run.is_dir() else command.run.parent
    names = path.prefixes[path.prefixes[0] == "start" :]  # it has no frame
    for file in [command.times] if command.times else sorted(folder.glob("*.times")):
        times = read_times(file)
        missing = [name for name in names if name not in times]
        if not missing:
            found = {name: times[name] for name in names}
            if np.any(np.diff([times[name] for name in names]) <= 0.0):
                raise SlamError(f"{file}: the frames' times do not ascend: expected one for each")
            return found
        if command.times:
            raise SlamError(f"{file}: no time of {missing[0]}: expected those of all frames")
    return None


def _export_tables(command: Export) -> None:
    folder = command.output
    if folder.suffix == ".csv" and not folder.is_dir():
        raise SlamError(
            f"{folder}: several tables are written: expected a folder, such as {folder.stem}"
        )
    recording = recording_of(command)
    tables = {"odometry.csv": odometry_table(recording), "discs.csv": disc_table(recording)}
    if len(recording.lines):
        camera_xy = camera_xy_of(recording, command.run, command.camera)
        tables["bearings.csv"] = bearing_table(recording, camera_xy)
    demand_free([folder / name for name in tables], overwrite=command.force)
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        write_table(folder / name, *table, _head(command.run), overwrite=command.force)
    discs, lines = recording.circles.identified, recording.lines.identified
    parts = [f"{len(recording)} steps"]
    parts.append(f"{discs.sum()} measurements of discs{_left_out(int(np.sum(~discs)))}")
    if len(lines):
        parts.append(f"{lines.sum()} bearings{_left_out(int(np.sum(~lines)))}")
    print(f"{folder}: {', '.join(parts)}")


def perform_import(command: Import) -> int:
    """Execute the command; returns the exit code."""
    if command.file.suffix in (".circles", ".lines", ".markers"):
        raise SlamError(
            f"{command.file}: is a landmark file: expected a .g2o graph or a trajectory; "
            "`slam export` writes them"
        )
    for name in _DATA_SET_FLAGS:
        if name not in _flags_used(command) and getattr(command, name) != getattr(Import, name):
            flag = "no-calibrated" if name == "calibrated" else name.replace("_", "-")
            raise SlamError(f"--{flag}: has no effect on {command.file.name}")
    suffixes = _suffixes_of_results(command.file)
    if command.output.suffix not in suffixes:
        raise SlamError(f"{command.output}: expected a {' or '.join(suffixes)} file to write")
    if command.file.suffix in (".dat", ".mat"):
        _import_data_set(command)
    elif command.file.suffix != ".g2o":
        _write_path(command, read_tum(command.file))
    elif command.output.suffix != ".csv":
        _write_run(command, read_g2o(command.file).recording, "measurements of discs")
    else:
        graph = read_g2o(command.file)
        _write_path(command, Path2D(("start", *graph.recording.prefixes), graph.poses))
    return 0


def _suffixes_of_results(file: Path) -> tuple[str, ...]:
    """Those of a run, and of a path or map, if a file contains such."""
    if file.name == victoria_park.DRIVE:
        return (".circles",)
    if file.name == utias.LANDMARKS or file.suffix not in (".dat", ".mat", ".g2o"):
        return (".csv",)
    return (".circles", ".csv")


def _flags_used(command: Import) -> tuple[str, ...]:
    """Those of `_DATA_SET_FLAGS` that have an effect."""
    if command.file.name.endswith(utias.ODOMETRY) and command.output.suffix != ".csv":
        return _DATA_SET_FLAGS
    return _DATA_SET_FLAGS[:2] if command.file.name == victoria_park.DRIVE else ()


def _import_data_set(command: Import) -> None:
    """Import a robot's run, true path or landmarks of UTIAS, or the run of Victoria Park."""
    file, sigmas = command.file, (command.range_sigma, command.bearing_sigma)
    if file.name == utias.LANDMARKS:
        landmark_map = utias.read_landmarks(file)
        write_map(command.output, landmark_map, [_made_by(file)], overwrite=command.force)
        print(f"{command.output}: {len(landmark_map.discs)} landmarks")
    elif file.name.endswith(utias.ODOMETRY) and command.output.suffix == ".csv":
        path, repeated = utias.read_truth(file)
        note = f", {repeated} of them outside the true ones: the nearest" if repeated else ""
        _write_path(command, path, note)
    elif file.name.endswith(utias.ODOMETRY):
        run, response, noise = utias.read_run(file, *sigmas, calibrated=command.calibrated)
        notes = [some.sentence() for some in (response, noise) if some is not None]
        _write_run(command, run, "measurements", *notes)
        doubts = response and response.doubt(), noise and noise.doubt(len(run.circles))
        for doubt in filter(None, doubts):
            print(f"warning: {doubt}", file=sys.stderr)
    elif file.name == victoria_park.DRIVE:
        _write_run(command, victoria_park.read_run(file, *sigmas), "measurements")
    else:
        raise SlamError(
            f"{file}: expected a RobotN{utias.ODOMETRY} or {utias.LANDMARKS} of the UTIAS "
            f"data set, or the {victoria_park.DRIVE} of Victoria Park"
        )


def _write_run(command: Import, run: Recording, what: str, *notes: str) -> None:
    settings = ", ".join(f"{name}: {getattr(command, name)}" for name in _flags_used(command))
    head = [_made_by(command.file), *([settings] if settings else []), *notes]
    frames = frames_of_discs(run)
    # Five decimals are too few for the steps of fast frames, and twelve for their covariances.
    text = "\n".join(head)
    write_frames(command.output, frames, head=text, overwrite=command.force, exact=True)
    print("; ".join([f"{command.output}: {len(run)} steps, {len(run.circles)} {what}", *notes]))


def _write_path(command: Import, path: Path2D, note: str = "") -> None:
    write_path(command.output, path, [_made_by(command.file)], overwrite=command.force)
    print(f"{command.output}: {len(path.poses)} poses{note}")


def _made_by(source: Path) -> str:
    return f"Made by slam {__version__} of {source.name}"


def _head(source: Path) -> list[str]:
    """Comments of a file for other tools."""
    return [_made_by(source), f"axes: {MEANING['robotics']}"]


def _left_out(count: int) -> str:
    return f" ({count} without ID left out)" if count else ""
