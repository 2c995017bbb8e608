"""A run as a g2o graph, written and read: poses, discs, steps of odometry, measurements of discs.

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
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, repeat
from pathlib import Path
from typing import NamedTuple

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import (
    CircleLandmark,
    Frame,
    Step,
    format_record,
    is_positive_definite,
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
    demand_axes,
    finite,
    from_dataset,
    text_rows,
    to_dataset,
    whole,
    write_text,
)
from redetect.slam.models import OdometryNoise, chain_steps
from redetect.slam.recording import (
    ASSUMED,
    CircleRows,
    LineRows,
    Recording,
    frames_of_discs,
    recording_of_frames,
)

#: Begins the comment with a frame's name and the qualities of its rows.
FRAME_COMMENT = "# FRAME"


@dataclass(frozen=True, eq=False)
class RunGraph:
    """A run of discs that all have an identifier, with estimates; in the data set's axes."""

    recording: Recording
    quality: FloatArray  # (n,): of its rows of discs; NaN where it is unknown
    path: Path2D  # estimates of the poses
    disc_ids: IntArray  # (M,): identifiers, ascending
    discs: FloatArray  # (M, 2): estimates (m)


def first_disc_vertex(last_pose_vertex: int) -> int:
    """The number that a disc's identifier is added to: the power of ten above all poses."""
    return int(10 ** len(str(last_pose_vertex)))


def in_turned_axes(covariance: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """Covariances (N, 3, 3) of steps as seen from axes that are turned by angles (N,).

    Turned by their own dphi: in the axes at their end, as errors of SE(2) edges are measured.
    """
    turn = np.zeros((len(angle_rad), 3, 3))
    turn[:, :2, :2] = np.swapaxes(rotation(angle_rad), 1, 2)
    turn[:, 2, 2] = 1.0
    with np.errstate(all="ignore"):  # what is not finite stays so
        turned = np.asarray(turn @ covariance @ np.swapaxes(turn, 1, 2))
    return np.asarray(0.5 * (turned + np.swapaxes(turned, 1, 2)))


def write_g2o(
    path: str | os.PathLike[str],
    graph: RunGraph,
    *,
    axes: Axes = "robotics",
    comments: Sequence[str] = (),
    overwrite: bool = False,
) -> None:
    """Write a graph; numbers in full precision."""
    write_text(path, _rows(graph, axes, comments), overwrite=overwrite)


def _rows(graph: RunGraph, axes: Axes, comments: Sequence[str]) -> Iterator[str]:
    run = graph.recording
    for number, pose in enumerate(from_dataset(graph.path.poses, axes) + 0.0):  # no -0.0
        yield f"VERTEX_SE2 {number} {_numbers(pose)}"
    base = first_disc_vertex(len(graph.path.poses) - 1)
    for disc in graph.disc_ids.tolist():
        if not 0 <= disc <= LARGEST_NUMBER - base:
            raise SlamError(
                f"disc {disc}: expected an identifier of 0 to {LARGEST_NUMBER - base}, to have a "
                "number in the graph"
            )
    for disc, xy in zip(graph.disc_ids.tolist(), from_dataset(graph.discs, axes)):
        yield f"VERTEX_XY {base + disc} {_numbers(xy)}"

    steps = from_dataset(run.steps, axes)
    at_end = in_turned_axes(covariance_from_dataset(run.step_covariance, axes), steps[:, 2])
    of_steps = inverses(at_end)[:, *np.triu_indices(3)]
    rows = run.circles
    seen = from_dataset(rows.xy, axes)
    of_rows = inverses(covariance_from_dataset(rows.covariance, axes))[:, *np.triu_indices(2)]
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
        yield f"{FRAME_COMMENT} {k + 1} {graph.path.prefixes[k + 1]} {_numbers(known)}".rstrip()


def inverses(matrices: FloatArray) -> FloatArray:
    """Inverses of symmetric (n, d, d) matrices, scaled to ones on the diagonal meanwhile.

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


def _numbers(values: FloatArray) -> str:
    return " ".join(map(repr, values.tolist()))


_POSE, _DISC, _STEP, _SIGHT, _FIX = "VERTEX_SE2", "VERTEX_XY", "EDGE_SE2", "EDGE_SE2_XY", "FIX"
# Of each kind of row: how many vertices it names, and its numbers.
_KINDS = {
    _POSE: (1, ("x", "y", "theta")),
    _DISC: (1, ("x", "y")),
    _STEP: (2, ("dx", "dy", "dphi", "I11", "I12", "I13", "I22", "I23", "I33")),
    _SIGHT: (2, ("x", "y", "I11", "I12", "I22")),
}
# Which vertices rows name.
_NAMED = {
    _STEP: (_POSE, _POSE),
    _SIGHT: (_POSE, _DISC),
    FRAME_COMMENT: (_POSE,),
    _FIX: repeat("vertex"),
}


class _Row(NamedTuple):
    line: int
    vertices: tuple[int, ...]
    numbers: tuple[float, ...] = ()
    name: str = ""  # of a frame


def read_g2o(path: str | os.PathLike[str], *, axes: Axes = "robotics") -> RunGraph:
    """Read a graph of a run that is in some axes; the result is in the data set's.

    Where the file has no ``# FRAME`` comments, poses are called by their vertices' numbers and
    qualities are unknown. Discs whose vertices all have numbers above the power of ten over the
    poses' are counted from there, others named by the vertex.

    Raises `SlamError` if the file cannot be read, a row is malformed or names a vertex that is
    missing, an information matrix is not positive definite, the poses are no chain from each to the
    next number, or the file says that its axes are others; the message names file and line.
    """
    rows = _read_rows(path, axes)
    _once(path, [*rows[_POSE], *rows[_DISC]], "there is a vertex {} already")
    steps_between = _once(path, rows[_STEP], "there is an EDGE_SE2 between these poses already")
    frames = _once(path, rows[FRAME_COMMENT], "vertex {} has a frame already")
    poses, discs = ({row.vertices[0]: row for row in rows[kind]} for kind in (_POSE, _DISC))
    known = {_POSE: {*poses}, _DISC: {*discs}, "vertex": {*poses, *discs}}
    for kind, named in _NAMED.items():
        for row in rows[kind]:
            for vertex, what in zip(row.vertices, named):
                if vertex not in known[what]:
                    raise SlamError(f"{path}:{row.line}: no {what} {vertex}")
    order = _chain(path, poses, steps_between)
    rank = {vertex: k for k, vertex in enumerate(order)}
    sights = sorted(rows[_SIGHT], key=lambda row: rank[row.vertices[0]])
    for row in sights:
        if rank[row.vertices[0]] == 0:
            raise SlamError(
                f"{path}:{row.line}: a disc seen from the first pose: expected measurements after "
                "a step"
            )
    chain = [steps_between[edge] for edge in pairwise(order)]
    for some, size in ((chain, 3), (sights, 2)):
        for bad in np.flatnonzero(~is_positive_definite(_symmetric(some, size)))[:1]:
            raise SlamError(
                f"{path}:{some[bad].line}: the information matrix is not positive definite"
            )
    steps = _table([row.numbers[:3] for row in chain], 3)
    at_start = in_turned_axes(inverses(_symmetric(chain, 3)), -steps[:, 2])
    step_covariance = covariance_from_dataset(at_start, axes, back=True)
    of_rows = inverses(_symmetric(sights, 2))
    covariance = covariance_from_dataset(of_rows, axes, back=True)
    for some, spread in ((chain, step_covariance), (sights, covariance)):
        for bad in np.flatnonzero(~np.all(np.isfinite(spread), axis=(1, 2)))[:1]:
            raise SlamError(f"{path}:{some[bad].line}: the information matrix has no inverse")
    base = first_disc_vertex(order[-1])
    if any(vertex < base for vertex in discs):
        base = 0
    circles = CircleRows(
        frame=np.array([rank[row.vertices[0]] - 1 for row in sights], dtype=np.int64),
        xy=to_dataset(_table([row.numbers[:2] for row in sights], 2), axes),
        covariance=covariance,
        ids=np.array([row.vertices[1] - base for row in sights], dtype=np.int64),
    )
    prefixes, quality = _named(path, frames, order, sights)
    numbers = _table([poses[vertex].numbers for vertex in order], 3)
    places = _table([discs[vertex].numbers for vertex in sorted(discs)], 2)
    return RunGraph(
        Recording(prefixes[1:], to_dataset(steps, axes), step_covariance, circles, LineRows.of()),
        quality,
        Path2D(prefixes, to_dataset(numbers, axes)),
        disc_ids=np.array([vertex - base for vertex in sorted(discs)], dtype=np.int64),
        discs=to_dataset(places, axes),
    )


def _read_rows(path: str | os.PathLike[str], axes: Axes) -> dict[str, list[_Row]]:
    rows: dict[str, list[_Row]] = {kind: [] for kind in (*_KINDS, _FIX, FRAME_COMMENT)}
    for line, text in text_rows(path):
        tag, *words = text.split()
        if text.startswith(FRAME_COMMENT + " "):
            tag, words = FRAME_COMMENT, text[len(FRAME_COMMENT) :].split()
            if len(words) < 2:
                raise SlamError(
                    f"{path}:{line}: {FRAME_COMMENT}: expected a vertex number and a name"
                )
            qualities = tuple(finite(path, line, "quality", word) for word in words[2:])
            row = _Row(line, (whole(path, line, "vertex", words[0]),), qualities, words[1])
        elif text.startswith("#"):
            demand_axes(path, line, text, axes)
            continue
        elif tag == _FIX:
            row = _Row(line, tuple(whole(path, line, "vertex", word) for word in words))
        elif tag in _KINDS:
            count, names = _KINDS[tag]
            if len(words) != count + len(names):
                raise SlamError(
                    f"{path}:{line}: {tag} with {len(words)} values: expected "
                    f"{count + len(names)}: {count} vertex number{'s' if count > 1 else ''} and "
                    f"{' '.join(names)}"
                )
            row = _Row(
                line,
                tuple(whole(path, line, "vertex", word) for word in words[:count]),
                tuple(finite(path, line, name, word) for name, word in zip(names, words[count:])),
            )
        else:
            raise SlamError(
                f"{path}:{line}: row starts with {tag[:30]!a}: expected {', '.join(_KINDS)} or FIX"
            )
        rows[tag].append(row)
    return rows


def _once(
    path: str | os.PathLike[str], rows: list[_Row], already: str
) -> dict[tuple[int, ...], _Row]:
    """Rows by their vertices, which no two may have in common."""
    found: dict[tuple[int, ...], _Row] = {}
    for row in rows:
        if found.setdefault(row.vertices, row) is not row:
            raise SlamError(f"{path}:{row.line}: {already.format(row.vertices[0])}")
    return found


def _chain(
    path: str | os.PathLike[str], poses: dict[int, _Row], steps: dict[tuple[int, ...], _Row]
) -> list[int]:
    """The poses' numbers in order, where edges lead from each to the next and nowhere else."""
    order = sorted(poses)
    if len(order) < 2:
        raise SlamError(
            f"{path}: {len(order)} VERTEX_SE2 rows: expected a run of at least one step"
        )
    wanted = set(pairwise(order))
    for edge, row in steps.items():
        if edge not in wanted:
            raise SlamError(
                f"{path}:{row.line}: EDGE_SE2 from {edge[0]} to {edge[1]}: expected edges from "
                "each pose to the next, as the steps of a run"
            )
    for first, second in pairwise(order):
        if (first, second) not in steps:
            raise SlamError(
                f"{path}:{poses[second].line}: no EDGE_SE2 from {first} to {second}: expected one "
                "from each pose to the next"
            )
    return order


def _named(
    path: str | os.PathLike[str],
    frames: dict[tuple[int, ...], _Row],
    order: list[int],
    sights: list[_Row],
) -> tuple[tuple[str, ...], FloatArray]:
    """Names of the poses, and qualities of the measurements in their order."""
    counts = Counter(sight.vertices[0] for sight in sights)
    prefixes = ["start"]
    quality: list[float] = []
    for vertex in order[1:]:
        row = frames.get((vertex,), _Row(0, (vertex,), (), f"vertex.{vertex}"))
        if row.numbers and len(row.numbers) != counts[vertex]:
            raise SlamError(
                f"{path}:{row.line}: {len(row.numbers)} qualities: expected {counts[vertex]}, one "
                f"for each EDGE_SE2_XY from {vertex}"
            )
        prefixes.append(row.name)
        quality.extend(row.numbers or [np.nan] * counts[vertex])
    return tuple(prefixes), np.array(quality, dtype=np.float64)


def _table(rows: list[tuple[float, ...]], width: int) -> FloatArray:
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def _symmetric(rows: list[_Row], size: int) -> FloatArray:
    """Information matrices from their upper triangles, which are last in each row."""
    triangle = np.triu_indices(size)
    count = len(triangle[0])
    matrices = np.zeros((len(rows), size, size))
    matrices[:, *triangle] = _table([row.numbers[-count:] for row in rows], count)
    return np.asarray(matrices + np.triu(matrices, 1).swapaxes(1, 2))


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
    return RunGraph(replace(recording, circles=rows), quality, poses, disc_ids, discs)


def frames_of_graph(graph: RunGraph) -> list[Frame]:
    """The rows of a graph's steps and measurements; a quality that is unknown becomes 1."""
    run = graph.recording
    spread = np.where(
        np.abs(run.step_covariance) < _LEAST_STEP_COVARIANCE, 0.0, run.step_covariance
    )
    quality = np.where(np.isfinite(graph.quality), graph.quality, 1.0)
    # Of a zero, information matrices do not keep the sign.
    rows = replace(run.circles, covariance=run.circles.covariance + 0.0)
    return frames_of_discs(replace(run, step_covariance=spread, circles=rows), quality)


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
