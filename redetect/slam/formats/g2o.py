"""A run as a g2o graph: poses, discs, steps of odometry and measurements of discs.

Rows are ``VERTEX_SE2 number x y theta``, ``VERTEX_XY number x y``, ``EDGE_SE2 from to dx dy dphi``
and ``EDGE_SE2_XY pose disc x y``, edges with the upper triangle of their information matrix row by
row, and ``FIX`` of the first pose. Poses are numbered from 0, the start; disc n is vertex B + n,
where B is the smallest power of ten above the last pose's number.

The error of an EDGE_SE2 is measured in the axes at the *end* of the step, (measured)^-1 * (from^-1
* to), while the covariance of a STEP row is of dx and dy in the axes before it: the information is
rotated by dphi, so that a graph's error is the one of this project's models.

Names of frames and qualities of rows, which the format does not have, follow in comments at the
file's end: GTSAM's reader ignores all edges after the first row that it does not know.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import (
    CircleLandmark,
    Frame,
    Step,
    format_record,
    parse_record,
)
from redetect.landmarks.map_file import Path2D, read_map, read_path
from redetect.plane import apply, rotation
from redetect.slam.errors import SlamError
from redetect.slam.formats.text import (
    AXES_COMMENT,
    LARGEST_NUMBER,
    MEANING,
    Axes,
    covariance_from_dataset,
    from_dataset,
    write_text,
)
from redetect.slam.models import OdometryNoise, chain_steps
from redetect.slam.recording import (
    ASSUMED,
    CircleRows,
    Recording,
    frames_of_discs,
    recording_of_frames,
)

#: Begins the comment with a frame's name and the qualities of its rows.
FRAME_COMMENT = "# FRAME"


@dataclass(frozen=True, eq=False)
class RunGraph:
    """A run with estimates of its poses and discs, in the data set's axes."""

    prefixes: tuple[str, ...]  # name of each pose; of the start ``start``
    poses: FloatArray  # (N + 1, 3): Estimates: x, y (m), theta (rad)
    disc_ids: IntArray  # (M,): identifiers, ascending
    discs: FloatArray  # (M, 2): estimates (m)
    steps: FloatArray  # (N, 3): dx, dy (m), dphi (rad) in the robot frame before each step
    step_covariance: FloatArray  # (N, 3, 3): of `steps`
    circles: CircleRows  # measurements of discs, all with an identifier
    quality: FloatArray  # (n,): of those rows; NaN where it is unknown
    unstated_steps: int = 0  # steps whose covariance is an assumed one


def first_disc_vertex(last_pose_vertex: int) -> int:
    """The number that a disc's identifier is added to: the power of ten above all poses."""
    return int(10 ** len(str(last_pose_vertex)))


def end_covariance(steps: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances of steps in the axes at their end, as errors of SE(2) edges are measured.

    Takes `steps` (N, 3), `covariance` (N, 3, 3); returns (N, 3, 3).
    """
    return _in_turned_axes(covariance, steps[:, 2])


def start_covariance(steps: FloatArray, covariance: FloatArray) -> FloatArray:
    """Undo `end_covariance`."""
    return _in_turned_axes(covariance, -steps[:, 2])


def write_g2o(
    path: str | os.PathLike[str],
    graph: RunGraph,
    *,
    axes: Axes = "robotics",
    comments: Sequence[str] = (),
    overwrite: bool = False,
) -> None:
    """Write a graph; numbers in full precision."""
    write_text(path, list(_rows(graph, axes, comments)), overwrite=overwrite)


def _rows(graph: RunGraph, axes: Axes, comments: Sequence[str]) -> Iterator[str]:
    for number, pose in enumerate(from_dataset(graph.poses, axes) + 0.0):  # no -0.0
        yield f"VERTEX_SE2 {number} {_numbers(pose)}"
    base = first_disc_vertex(len(graph.poses) - 1)
    for disc in graph.disc_ids.tolist():
        if not 0 <= disc <= LARGEST_NUMBER - base:
            raise SlamError(
                f"disc {disc}: expected an identifier of 0 to {LARGEST_NUMBER - base}, to have a "
                "number in the graph"
            )
    for disc, xy in zip(graph.disc_ids.tolist(), from_dataset(graph.discs, axes)):
        yield f"VERTEX_XY {base + disc} {_numbers(xy)}"

    steps = from_dataset(graph.steps, axes)
    of_steps = inverse_of_3x3(
        end_covariance(steps, covariance_from_dataset(graph.step_covariance, axes))
    )[:, *np.triu_indices(3)]
    rows = graph.circles
    seen = from_dataset(rows.xy, axes)
    of_rows = inverse_of_2x2(covariance_from_dataset(rows.covariance, axes))[:, *np.triu_indices(2)]
    for what, information in (("step", of_steps), ("measurement of a disc", of_rows)):
        for bad in np.flatnonzero(~np.all(np.isfinite(information), axis=1))[:1]:
            raise SlamError(f"{what} {bad + 1}: expected a covariance that can be inverted")
    of_frame = np.searchsorted(rows.frame, np.arange(len(steps) + 1))
    for k, step in enumerate(steps):
        yield f"EDGE_SE2 {k} {k + 1} {_numbers(step)} {_numbers(of_steps[k])}"
        for row in range(of_frame[k], of_frame[k + 1]):
            yield (
                f"EDGE_SE2_XY {k + 1} {base + int(rows.ids[row])} {_numbers(seen[row])} "
                f"{_numbers(of_rows[row])}"
            )
    yield "FIX 0"
    for comment in comments:
        yield f"# {comment}"
    yield f"{AXES_COMMENT} {axes} ({MEANING[axes]})"
    for k in range(len(steps)):
        qualities = graph.quality[of_frame[k] : of_frame[k + 1]]
        # Qualities are identified by their order: if one is unknown, none of the frame is written.
        known = qualities if np.all(np.isfinite(qualities)) else qualities[:0]
        words = [FRAME_COMMENT, str(k + 1), graph.prefixes[k + 1], *map(_number, known)]
        yield " ".join(words)


def inverse_of_2x2(matrices: FloatArray) -> FloatArray:
    """Inverses of symmetric (n, 2, 2) matrices, by elements: twice gives the same 6 digits again.

    Solvers mix the elements, and what was 0 comes back as a rounding error. Where there is no
    inverse the result is not finite.
    """
    xx, xy, yy = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    with np.errstate(all="ignore"):
        determinant = xx * yy - xy * xy
        inverse = np.stack([yy, -xy, -xy, xx], axis=-1) / determinant[:, None]
    return np.asarray(inverse.reshape(-1, 2, 2))


def inverse_of_3x3(matrices: FloatArray) -> FloatArray:
    """Inverses of symmetric (n, 3, 3) matrices, scaled to ones on the diagonal meanwhile.

    Metres and radians may differ by orders of magnitude. Where there is no inverse the result is
    not finite.
    """
    with np.errstate(all="ignore"):
        scale = np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
        unit = matrices / scale[:, :, None] / scale[:, None, :]
        usable = np.all(np.isfinite(unit), axis=(1, 2))
        usable[usable] = np.abs(np.linalg.det(unit[usable])) > 0.0
        inverse = np.full(matrices.shape, np.nan)
        inverse[usable] = np.linalg.inv(unit[usable])
        inverse = inverse / scale[:, :, None] / scale[:, None, :]
    return np.asarray(0.5 * (inverse + np.swapaxes(inverse, 1, 2)))


def _in_turned_axes(covariance: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """Covariances of vectors as seen from axes that are turned by an angle."""
    turn = np.zeros((len(angle_rad), 3, 3))
    turn[:, :2, :2] = np.swapaxes(rotation(angle_rad), 1, 2)
    turn[:, 2, 2] = 1.0
    with np.errstate(all="ignore"):  # what is not finite stays so
        turned = np.asarray(turn @ covariance @ np.swapaxes(turn, 1, 2))
    return np.asarray(0.5 * (turned + np.swapaxes(turned, 1, 2)))


def covariances_of_graph(
    steps: FloatArray, of_steps: FloatArray, of_rows: FloatArray, axes: Axes
) -> tuple[FloatArray, FloatArray]:
    """Covariances in the data set's axes of the information matrices of a graph's edges.

    Takes `steps` (N, 3), `of_steps` (N, 3, 3), `of_rows` (n, 2, 2); returns `step_covariance` (N,
    3, 3), `covariance` (n, 2, 2).
    """
    spread = covariance_from_dataset(
        start_covariance(steps, inverse_of_3x3(of_steps)), axes, back=True
    )
    return spread, covariance_from_dataset(inverse_of_2x2(of_rows), axes, back=True)


def _number(value: float) -> str:
    return repr(float(value))


def _numbers(values: FloatArray) -> str:
    return " ".join(map(repr, values.tolist()))


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
    keep = recording.circles.identified
    rows = recording.circles.only(keep)
    quality = np.array(
        [row.quality for frame in frames for row in frame.circles], dtype=np.float64
    )[keep]
    poses = poses_of_run(recording, solution)
    disc_ids, first = np.unique(rows.ids, return_index=True)
    if solution is None:
        discs = apply(poses.poses[rows.frame[first] + 1], rows.xy[first])
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
    quality = np.where(np.isfinite(graph.quality), graph.quality, 1.0)
    # Of a zero, information matrices do not keep the sign.
    rows = replace(graph.circles, covariance=graph.circles.covariance + 0.0)
    return frames_of_discs(graph.prefixes[1:], graph.steps, spread, rows, quality)


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
