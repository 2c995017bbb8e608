"""Reading a g2o graph that is a run: a chain of poses, and measurements of discs."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from redetect.array_types import FloatArray
from redetect.landmarks import is_positive_definite
from redetect.slam.errors import SlamError
from redetect.slam.formats.g2o import (
    FRAME_COMMENT,
    RunGraph,
    covariances_of_graph,
    first_disc_vertex,
)
from redetect.slam.formats.text import Axes, demand_axes, finite, text_rows, to_dataset, whole
from redetect.slam.recording import CircleRows

_TRIANGLE_3 = ("I11", "I12", "I13", "I22", "I23", "I33")
# Of each kind of row: how many vertices it names, and its numbers.
_KINDS: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "VERTEX_SE2": (1, ("x", "y", "theta")),
    "VERTEX_XY": (1, ("x", "y")),
    "EDGE_SE2": (2, ("dx", "dy", "dphi", *_TRIANGLE_3)),
    "EDGE_SE2_XY": (2, ("x", "y", "I11", "I12", "I22")),
}


@dataclass(frozen=True, slots=True)
class _Row:
    line: int
    vertices: tuple[int, ...]
    numbers: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _Rows:
    """The rows of a file; vertices by their numbers."""

    poses: dict[int, _Row] = field(default_factory=dict)
    discs: dict[int, _Row] = field(default_factory=dict)
    steps: dict[tuple[int, ...], _Row] = field(default_factory=dict)
    sights: list[_Row] = field(default_factory=list)
    fixed: list[_Row] = field(default_factory=list)
    frames: dict[int, tuple[int, str, tuple[float, ...]]] = field(default_factory=dict)


def read_g2o(path: str | os.PathLike[str], *, axes: Axes = "robotics") -> RunGraph:
    """Read a graph of a run.

    Parameters
    ----------
    path : path
        The file.
    axes : str
        The axes that it is in.

    Returns
    -------
    RunGraph
        In the data set's axes. Where the file has no ``# FRAME`` comments, poses are called by
        their vertices' numbers and qualities are unknown. Discs whose vertices all have numbers
        above the power of ten over the poses' are counted from there, others named by the vertex.

    Raises
    ------
    SlamError
        If the file cannot be read, a row is malformed or names a vertex that is missing, an
        information matrix is not positive definite, the poses are no chain from each to the next
        number, or the file says that its axes are others; the message names file and line.
    """
    rows = _read_rows(path, axes)
    _demand_vertices(path, rows)
    order = _chain(path, rows)
    rank = {vertex: k for k, vertex in enumerate(order)}
    for sight in rows.sights:
        if rank[sight.vertices[0]] == 0:
            raise SlamError(
                f"{path}:{sight.line}: a disc seen from the first pose: expected measurements "
                "after a step"
            )
    sights = sorted(rows.sights, key=lambda row: rank[row.vertices[0]])
    _demand_positive_definite(path, list(rows.steps.values()), 3)
    _demand_positive_definite(path, sights, 2)

    chain = [rows.steps[edge] for edge in pairwise(order)]
    steps = _table([row.numbers[:3] for row in chain], 3)
    step_covariance, covariance = covariances_of_graph(
        steps, _symmetric(chain, 3), _symmetric(sights, 2), axes
    )
    for some, spread in ((chain, step_covariance), (sights, covariance)):
        for bad in np.flatnonzero(~np.all(np.isfinite(spread), axis=(1, 2)))[:1]:
            raise SlamError(f"{path}:{some[bad].line}: the information matrix has no inverse")
    base = first_disc_vertex(order[-1])
    if any(vertex < base for vertex in rows.discs):
        base = 0
    discs = sorted(rows.discs)
    prefixes, quality = _frames(path, rows, order, sights)
    return RunGraph(
        prefixes=prefixes,
        poses=to_dataset(_table([rows.poses[vertex].numbers for vertex in order], 3), axes),
        disc_ids=np.array([vertex - base for vertex in discs], dtype=np.int64),
        discs=to_dataset(_table([rows.discs[vertex].numbers for vertex in discs], 2), axes),
        steps=to_dataset(steps, axes),
        step_covariance=step_covariance,
        circles=CircleRows(
            frame=np.array([rank[row.vertices[0]] - 1 for row in sights], dtype=np.int64),
            xy=to_dataset(_table([row.numbers[:2] for row in sights], 2), axes),
            covariance=covariance,
            ids=np.array([row.vertices[1] - base for row in sights], dtype=np.int64),
        ),
        quality=quality,
    )


def _read_rows(path: str | os.PathLike[str], axes: Axes) -> _Rows:
    rows = _Rows()
    for line, text in text_rows(path):
        if text.startswith("#"):
            demand_axes(path, line, text, axes)
            if text.startswith(FRAME_COMMENT + " "):
                _read_frame(path, line, text, rows)
            continue
        tag, *words = text.split()
        if tag == "FIX":
            vertices = tuple(whole(path, line, "vertex", word) for word in words)
            rows.fixed.append(_Row(line, vertices, ()))
            continue
        if tag not in _KINDS:
            raise SlamError(
                f"{path}:{line}: row starts with {tag[:30]!a}: expected {', '.join(_KINDS)} or FIX"
            )
        count, names = _KINDS[tag]
        if len(words) != count + len(names):
            raise SlamError(
                f"{path}:{line}: {tag} with {len(words)} values: expected {count + len(names)}: "
                f"{count} vertex number{'s' if count > 1 else ''} and {' '.join(names)}"
            )
        row = _Row(
            line,
            tuple(whole(path, line, "vertex", word) for word in words[:count]),
            tuple(finite(path, line, name, word) for name, word in zip(names, words[count:])),
        )
        if tag == "EDGE_SE2_XY":
            rows.sights.append(row)
        elif tag == "EDGE_SE2":
            if row.vertices in rows.steps:
                raise SlamError(f"{path}:{line}: there is an EDGE_SE2 between these poses already")
            rows.steps[row.vertices] = row
        else:
            vertex = row.vertices[0]
            if vertex in rows.poses or vertex in rows.discs:
                raise SlamError(f"{path}:{line}: there is a vertex {vertex} already")
            (rows.poses if tag == "VERTEX_SE2" else rows.discs)[vertex] = row
    return rows


def _read_frame(path: str | os.PathLike[str], line: int, text: str, rows: _Rows) -> None:
    words = text[len(FRAME_COMMENT) :].split()
    if len(words) < 2:
        raise SlamError(f"{path}:{line}: {FRAME_COMMENT}: expected a vertex number and a name")
    vertex = whole(path, line, "vertex", words[0])
    if vertex in rows.frames:
        raise SlamError(f"{path}:{line}: vertex {vertex} has a frame already")
    qualities = tuple(finite(path, line, "quality", word) for word in words[2:])
    rows.frames[vertex] = (line, words[1], qualities)


def _demand_vertices(path: str | os.PathLike[str], rows: _Rows) -> None:
    """Every row names vertices of the right kind."""
    for row in rows.fixed:
        for vertex in row.vertices:
            if vertex not in rows.poses and vertex not in rows.discs:
                raise SlamError(f"{path}:{row.line}: no vertex {vertex}")
    named = [(row.line, vertex) for row in rows.steps.values() for vertex in row.vertices]
    named += [(row.line, row.vertices[0]) for row in rows.sights]
    named += [(line, vertex) for vertex, (line, _, _) in rows.frames.items()]
    for line, vertex in named:
        if vertex not in rows.poses:
            raise SlamError(f"{path}:{line}: no VERTEX_SE2 {vertex}")
    for row in rows.sights:
        if row.vertices[1] not in rows.discs:
            raise SlamError(f"{path}:{row.line}: no VERTEX_XY {row.vertices[1]}")


def _chain(path: str | os.PathLike[str], rows: _Rows) -> list[int]:
    """The poses' numbers in order, where edges lead from each to the next and nowhere else."""
    order = sorted(rows.poses)
    if len(order) < 2:
        raise SlamError(
            f"{path}: {len(order)} VERTEX_SE2 rows: expected a run of at least one step"
        )
    following = dict(pairwise(order))
    for (first, second), row in rows.steps.items():
        if following.get(first) != second:
            raise SlamError(
                f"{path}:{row.line}: EDGE_SE2 from {first} to {second}: expected edges from each "
                "pose to the next, as the steps of a run"
            )
    for first, second in following.items():
        if (first, second) not in rows.steps:
            raise SlamError(
                f"{path}:{rows.poses[second].line}: no EDGE_SE2 from {first} to {second}: expected "
                "one from each pose to the next"
            )
    return order


def _demand_positive_definite(path: str | os.PathLike[str], rows: list[_Row], size: int) -> None:
    usable = is_positive_definite(_symmetric(rows, size))
    for bad in np.flatnonzero(~usable)[:1]:
        raise SlamError(f"{path}:{rows[bad].line}: the information matrix is not positive definite")


def _frames(
    path: str | os.PathLike[str], rows: _Rows, order: list[int], sights: list[_Row]
) -> tuple[tuple[str, ...], FloatArray]:
    """Names of the poses, and qualities of the measurements in their order."""
    counts = dict.fromkeys(order, 0)
    for sight in sights:
        counts[sight.vertices[0]] += 1
    prefixes = ["start"]
    quality: list[float] = []
    for vertex in order[1:]:
        line, prefix, known = rows.frames.get(vertex, (0, f"vertex.{vertex}", ()))
        if known and len(known) != counts[vertex]:
            raise SlamError(
                f"{path}:{line}: {len(known)} qualities: expected {counts[vertex]}, one for each "
                f"EDGE_SE2_XY from {vertex}"
            )
        prefixes.append(prefix)
        quality.extend(known or [np.nan] * counts[vertex])
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
