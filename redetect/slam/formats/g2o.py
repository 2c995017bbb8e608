"""A run as a g2o graph, written and read: poses, discs and their measurements.

Rows are described in docs/slam/formats.md. The error of an EDGE_SE2 is measured in the axes at the
*end* of the step, (measured)^-1 * (from^-1 * to), while the covariance of a STEP row is of dx and
dy in the axes before it: the information is rotated by dphi, so that a graph's error equals that of
this project's models. Comments are at the end: GTSAM's reader ignores all edges after the first
unknown row.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.bounds import FINITE, number_in, whole_number_in
from redetect.landmarks import is_positive_definite
from redetect.landmarks.axes import covariance_from_dataset, from_dataset, to_dataset
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import first_sight, graph_of_recording
from redetect.slam.models import in_turned_axes
from redetect.slam.recording import CircleRows, LineRows, Recording
from redetect.storage import write_text
from redetect.storage.bounded import read_text

#: The largest number of a vertex: other tools store it in 31 bits.
LARGEST_VERTEX = 2**31 - 1
_LARGEST_BYTES = 1 << 28
# Less has no finite inverse (m^-2, rad^-2).
_LEAST_INFORMATION = 1e-100
_POSE, _DISC, _STEP, _SIGHT, _FIX = "VERTEX_SE2", "VERTEX_XY", "EDGE_SE2", "EDGE_SE2_XY", "FIX"
# For each kind of row: its number of vertices, and its numbers.
_KINDS = {
    _POSE: (1, ("x", "y", "theta")),
    _DISC: (1, ("x", "y")),
    _STEP: (2, ("dx", "dy", "dphi", "I11", "I12", "I13", "I22", "I23", "I33")),
    _SIGHT: (2, ("x", "y", "I11", "I12", "I22")),
}


class RunGraph(NamedTuple):
    """A run whose discs all have identifiers, with estimates; in the data set's axes."""

    recording: Recording
    poses: FloatArray  # (N + 1, 3): estimates, the start first
    disc_ids: IntArray  # (M,): identifiers, ascending
    discs: FloatArray  # (M, 2): estimates (m)


def graph_of_run(recording: Recording) -> RunGraph:
    """A run's steps and identified discs; poses as by odometry, discs where first seen."""
    graph = graph_of_recording(recording)
    estimate = first_sight(graph)
    run = replace(recording, circles=recording.circles.only(recording.circles.identified))
    return RunGraph(run, estimate.poses, graph.disc_ids, estimate.disc_xy)


def first_disc_vertex(last_pose_vertex: int) -> int:
    """Offset of the discs' vertex numbers: the power of ten above all poses."""
    return int(10 ** len(str(last_pose_vertex)))


def write_g2o(
    path: str | os.PathLike[str],
    graph: RunGraph,
    *,
    comments: Sequence[str] = (),
    overwrite: bool = False,
) -> None:
    """Write a graph; numbers in full precision."""
    write_text(path, [*_rows(graph), *(f"# {c}" for c in comments)], overwrite=overwrite)


def _rows(graph: RunGraph) -> Iterator[str]:
    run = graph.recording
    for number, pose in enumerate(from_dataset(graph.poses) + 0.0):  # no -0.0
        yield f"{_POSE} {number} {_numbers(pose)}"
    base = first_disc_vertex(len(graph.poses) - 1)
    for disc, xy in zip(graph.disc_ids.tolist(), from_dataset(graph.discs)):
        if disc > LARGEST_VERTEX - base:
            raise SlamError(
                f"disc {disc}: expected an identifier of at most {LARGEST_VERTEX - base}, to have "
                "a number in the graph"
            )
        yield f"{_DISC} {base + disc} {_numbers(xy)}"
    steps, rows = from_dataset(run.steps), run.circles
    at_end = in_turned_axes(covariance_from_dataset(run.step_covariance), steps[:, 2])
    of_steps = _inverses(at_end)[:, *np.triu_indices(3)]
    seen = from_dataset(rows.xy)
    of_rows = _inverses(covariance_from_dataset(rows.covariance))[:, *np.triu_indices(2)]
    of_frame = np.searchsorted(rows.frame, np.arange(len(steps) + 1))
    for k, step in enumerate(steps):
        yield f"{_STEP} {k} {k + 1} {_numbers(step)} {_numbers(of_steps[k])}"
        for row in range(of_frame[k], of_frame[k + 1]):
            vertices = f"{k + 1} {base + int(rows.ids[row])}"
            yield f"{_SIGHT} {vertices} {_numbers(seen[row])} {_numbers(of_rows[row])}"
    yield f"{_FIX} 0"


def _inverses(matrices: FloatArray) -> FloatArray:
    """Inverses of positive definite (n, d, d) matrices, symmetric to the last digit."""
    inverse = np.linalg.inv(matrices)
    return np.asarray(0.5 * (inverse + np.swapaxes(inverse, 1, 2)))


def _numbers(values: FloatArray) -> str:
    return " ".join(map(repr, values.tolist()))


class _Row(NamedTuple):
    line: int
    vertices: tuple[int, ...]
    numbers: tuple[float, ...]


def read_g2o(path: str | os.PathLike[str]) -> RunGraph:
    """Read a graph of a run; frames are named by the numbers of their poses' vertices.

    If all discs' vertices are above the power of ten over the poses', identifiers are counted from
    there, otherwise they are the vertices' numbers.

    Raises `SlamError` if the file cannot be read, a row is malformed or names a vertex that is
    missing, an information matrix is not positive definite, or the poses are no chain from each to
    the next number; the message names file and line.
    """
    rows = _read_rows(path)
    poses, discs = ({row.vertices[0]: row for row in rows[kind]} for kind in (_POSE, _DISC))
    order = sorted(poses)
    rank = {vertex: k for k, vertex in enumerate(order)}
    steps, sights = _chain(path, order, rows[_STEP]), rows[_SIGHT]
    for row in sights:
        pose, disc = row.vertices
        if disc not in discs or not rank.get(pose):
            raise SlamError(
                f"{path}:{row.line}: {_SIGHT} {pose} {disc}: expected a pose after a step, and a "
                "disc, of the graph"
            )
    sights.sort(key=lambda row: rank[row.vertices[0]])
    step_covariance, sight_covariance = _covariances(path, steps, 3), _covariances(path, sights, 2)
    base = first_disc_vertex(order[-1])
    if min(discs, default=base) < base:
        base = 0
    moved = _table(steps, 3)
    of_steps = in_turned_axes(step_covariance, -moved[:, 2])
    recording = Recording(
        prefixes=tuple(f"vertex.{vertex}" for vertex in order[1:]),
        steps=to_dataset(moved),
        step_covariance=covariance_from_dataset(of_steps, back=True),
        circles=CircleRows(
            frame=np.array([rank[row.vertices[0]] - 1 for row in sights], dtype=np.int64),
            xy=to_dataset(_table(sights, 2)),
            covariance=covariance_from_dataset(sight_covariance, back=True),
            ids=np.array([row.vertices[1] - base for row in sights], dtype=np.int64),
        ),
        lines=LineRows.of(),
    )
    return RunGraph(
        recording,
        poses=to_dataset(_table([poses[vertex] for vertex in order], 3)),
        disc_ids=np.array(sorted(discs), dtype=np.int64) - base,
        discs=to_dataset(_table([discs[vertex] for vertex in sorted(discs)], 2)),
    )


def _read_rows(path: str | os.PathLike[str]) -> dict[str, list[_Row]]:
    """The rows of each kind, without `FIX` and text after ``#``."""
    rows: dict[str, list[_Row]] = {kind: [] for kind in _KINDS}
    known: set[tuple[int, ...]] = set()  # vertices, and those between which there is a step
    text = read_text(path, _LARGEST_BYTES, "g2o graph", SlamError)
    for line, row in enumerate(text.split("\n"), 1):
        kind, *words = row.partition("#")[0].split() or [_FIX]
        if kind == _FIX:
            continue
        if kind not in _KINDS:
            raise SlamError(
                f"{path}:{line}: row starts with {kind[:30]!a}: expected {', '.join(_KINDS)} or FIX"
            )
        count, names = _KINDS[kind]
        try:
            vertices = tuple(map(whole_number_in, words[:count]))
            numbers = tuple(map(number_in, words[count:]))
        except ValueError:
            vertices, numbers = (), ()
        usable = all(0 <= i <= LARGEST_VERTEX for i in vertices)
        usable &= all(map(FINITE.contain, numbers))
        if not usable or len(numbers) != len(names):
            raise SlamError(
                f"{path}:{line}: {kind} {' '.join(words)[:60]!a}: expected "
                f"{'a vertex' if count == 1 else 'two vertices'}, whole numbers of 0 to "
                f"{LARGEST_VERTEX}, and finite numbers {' '.join(names)}"
            )
        if kind != _SIGHT:
            if vertices in known:
                raise SlamError(f"{path}:{line}: {kind} {' '.join(words[:count])} is there already")
            known.add(vertices)
        rows[kind].append(_Row(line, vertices, numbers))
    return rows


def _chain(path: str | os.PathLike[str], order: list[int], steps: list[_Row]) -> list[_Row]:
    """The steps in the poses' order; there has to be one from each to the next and no other."""
    if len(order) < 2:
        raise SlamError(f"{path}: {len(order)} {_POSE} rows: expected a run of at least one step")
    found: dict[tuple[int, ...], _Row] = {row.vertices: row for row in steps}
    wanted = dict.fromkeys(pairwise(order))
    for row in steps:
        if row.vertices not in wanted:
            raise SlamError(
                f"{path}:{row.line}: {_STEP} from {row.vertices[0]} to {row.vertices[1]}: expected "
                "edges from each pose to the next, as the steps of a run"
            )
    for edge in wanted:
        if edge not in found:
            raise SlamError(f"{path}: no {_STEP} from {edge[0]} to {edge[1]}: expected one")
    return [found[edge] for edge in wanted]


def _table(rows: Sequence[_Row], width: int) -> FloatArray:
    """The first numbers of rows: (n, width)."""
    return np.array([row.numbers[:width] for row in rows], dtype=np.float64).reshape(-1, width)


def _covariances(path: str | os.PathLike[str], rows: Sequence[_Row], size: int) -> FloatArray:
    """Inverses of the information matrices, whose upper triangles are at the end of each row."""
    triangle = np.triu_indices(size)
    count = len(triangle[0])
    upper = np.zeros((len(rows), size, size))
    upper[:, *triangle] = np.reshape([row.numbers[-count:] for row in rows], (-1, count))
    information = upper + np.triu(upper, 1).swapaxes(1, 2)
    usable = is_positive_definite(information)
    usable &= np.all(np.diagonal(information, axis1=1, axis2=2) > _LEAST_INFORMATION, axis=1)
    for bad in np.flatnonzero(~usable)[:1]:
        raise SlamError(f"{path}:{rows[bad].line}: the information matrix is not positive definite")
    return _inverses(information)
