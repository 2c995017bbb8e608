"""A run's frames as a g2o graph, and back."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import (
    CircleLandmark,
    Frame,
    Step,
    circle_landmarks,
    format_record,
    parse_record,
)
from redetect.landmarks.map_file import Path2D, read_map, read_path
from redetect.slam.errors import SlamError
from redetect.slam.formats.g2o import RunGraph
from redetect.slam.formats.tables import identified_discs
from redetect.slam.models.measurement import disc_in_map
from redetect.slam.models.motion import chain_steps
from redetect.slam.models.odometry_noise import OdometryNoise
from redetect.slam.recording import ASSUMED, CircleRows, Recording, recording_of_frames

# Smaller values are rounded to 0 in a row of a landmark file.
_LEAST_STEP_COVARIANCE = 0.5e-12


def graph_of_frames(
    frames: Sequence[Frame],
    name: str,
    solution: Path | None = None,
    noise: OdometryNoise = ASSUMED,
) -> RunGraph:
    """A run's steps and identified discs with estimates of poses and discs."""
    recording = recording_of_frames(frames, name, noise)
    if len(recording.lines):
        raise SlamError(
            f"{name}: bearings of verticals have no edge in g2o: expected discs only, or --to csv"
        )
    keep = identified_discs(recording.circles)
    rows = CircleRows(
        frame=recording.circles.frame[keep],
        xy=recording.circles.xy[keep],
        covariance=recording.circles.covariance[keep],
        ids=recording.circles.ids[keep],
    )
    quality = np.array(
        [
            row.quality
            for frame in frames
            for row in frame.landmarks
            if isinstance(row, CircleLandmark)
        ],
        dtype=np.float64,
    )[keep]
    poses = poses_of_run(recording, solution)
    disc_ids, first = np.unique(rows.ids, return_index=True)
    if solution is None:
        discs = disc_in_map(poses.poses[rows.frame[first] + 1], rows.xy[first])
    else:
        discs = _places(solution / "map.csv", disc_ids)
    return RunGraph(
        prefixes=poses.prefixes,
        poses=poses.poses,
        disc_ids=disc_ids,
        discs=discs,
        steps=recording.steps,
        step_covariance=recording.step_covariance,
        circles=rows,
        quality=quality,
        unstated_steps=recording.unstated_steps,
    )


def frames_of_graph(graph: RunGraph) -> list[Frame]:
    """The rows of a graph's steps and measurements; a quality that is unknown becomes 1."""
    spread = graph.step_covariance.copy()
    spread[np.abs(spread) < _LEAST_STEP_COVARIANCE] = 0.0
    rows = graph.circles
    of_frame = np.searchsorted(rows.frame, np.arange(len(graph.steps) + 1))
    quality = np.where(np.isfinite(graph.quality), graph.quality, 1.0)
    frames = []
    for k, (step, c) in enumerate(zip(graph.steps.tolist(), spread.tolist())):
        dx, dy, dphi = step
        record = Step(
            *(graph.prefixes[k + 1], dx, dy, dphi),
            *(c[0][0], c[0][1], c[1][1], c[0][2], c[1][2], c[2][2]),
        )
        some = slice(of_frame[k], of_frame[k + 1])
        # Of a zero, information matrices do not keep the sign.
        spread_of_rows = rows.covariance[some] + 0.0
        seen = circle_landmarks(rows.xy[some], quality[some], spread_of_rows, rows.ids[some])
        frames.append(Frame(record, seen))
    return frames


def demand_readable(frames: Sequence[Frame], name: str) -> None:
    """Refuse values that the digits of a landmark file cannot represent."""
    again = []
    for frame in frames:
        step = parse_record(format_record(frame.step))
        rows = [parse_record(format_record(row)) for row in frame.landmarks]
        assert isinstance(step, Step)
        again.append(Frame(step, tuple(row for row in rows if isinstance(row, CircleLandmark))))
    try:
        recording_of_frames(again, name)
    except SlamError as error:
        raise SlamError(f"{error} in the digits of a .circles file") from None


def poses_of_run(recording: Recording, solution: Path | None) -> Path2D:
    """Poses of a run: odometry's, or those of a solution."""
    prefixes = ("start", *recording.prefixes)
    if solution is None:
        return Path2D(prefixes, chain_steps(recording.steps))
    file = solution / "path.csv"
    path = read_path(file)
    if len(path.poses) != len(prefixes):
        raise SlamError(f"{file}: {len(path.poses)} poses: expected {len(prefixes)} of this run")
    for number, (name, expected) in enumerate(zip(path.prefixes, prefixes)):
        if number and name != expected:
            raise SlamError(f"{file}: pose {number} is {name}: expected {expected} of this run")
    return path


def _places(file: Path, disc_ids: IntArray) -> FloatArray:
    """Where a map has these discs."""
    discs = read_map(file).discs
    place = dict(zip(discs.ids.tolist(), discs.xy))
    for number in disc_ids.tolist():
        if number not in place:
            raise SlamError(f"{file}: no disc {number}: expected all that the run measured")
    return np.array([place[number] for number in disc_ids.tolist()]).reshape(-1, 2)
