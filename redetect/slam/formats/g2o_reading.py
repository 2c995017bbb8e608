"""Reading a g2o graph that is a run: a chain of poses, and measurements of discs."""

from __future__ import annotations

import os
from collections import Counter
from itertools import pairwise, repeat
from typing import NamedTuple

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
    step_covariance, covariance = covariances_of_graph(
        steps, _symmetric(chain, 3), _symmetric(sights, 2), axes
    )
    for some, spread in ((chain, step_covariance), (sights, covariance)):
        for bad in np.flatnonzero(~np.all(np.isfinite(spread), axis=(1, 2)))[:1]:
            raise SlamError(f"{path}:{some[bad].line}: the information matrix has no inverse")
    base = first_disc_vertex(order[-1])
    if any(vertex < base for vertex in discs):
        base = 0
    prefixes, quality = _named(path, frames, order, sights)
    return RunGraph(
        prefixes=prefixes,
        poses=to_dataset(_table([poses[vertex].numbers for vertex in order], 3), axes),
        disc_ids=np.array([vertex - base for vertex in sorted(discs)], dtype=np.int64),
        discs=to_dataset(_table([discs[vertex].numbers for vertex in sorted(discs)], 2), axes),
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
