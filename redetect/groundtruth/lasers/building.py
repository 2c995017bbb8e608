"""Building maps: wall segments, from rows of numbers or from a drawing (DXF).

``building.csv`` has the head ``x1_m,y1_m,x2_m,y2_m`` and a row per segment.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import PathLike, read_table
from redetect.messages import imported_for, one_line
from redetect.storage.bounded import read_content

#: Curved walls are approximated by segments no farther from the curve than this (m).
CURVE_TOLERANCE_M = 0.002
MOST_SEGMENTS = 1_000_000

HEAD = "x1_m,y1_m,x2_m,y2_m"
_LARGEST_FILE_BYTES = 1 << 28
_FARTHEST_M = 1e6
_SHORTEST_M = 1e-6
_DEEPEST = 32


def find_building(folder: PathLike) -> Path:
    """The building map of a session: ``building.csv`` or else ``building.dxf``."""
    for name in ("building.csv", "building.dxf"):
        if (path := Path(folder) / name).is_file():
            return path
    raise GroundTruthError(f"{Path(folder)}: contains neither building.csv nor building.dxf")


def read_building(path: PathLike) -> FloatArray:
    """Read a building map.

    Parameters
    ----------
    path : path
        ``.dxf``: lines, polylines and curves of its model space, including those in blocks, without
        their heights. Other entities (texts, dimensions, hatches, ...) are ignored. Any other file
        is read as rows of four numbers.

    Returns
    -------
    (S, 4) float64
        x1, y1, x2, y2 of wall segments in the world (m), in the scanners' plane.

    Raises
    ------
    GroundTruthError
        If the file cannot be read, has no walls, more than `MOST_SEGMENTS` segments, or one that
        ends a million metres away.
    """
    if Path(path).suffix.lower() == ".dxf":
        segments = _read_drawing(path)
    else:
        segments = np.array([row.numbers for row in read_table(path, HEAD)]).reshape(-1, 4)
    if len(segments) > MOST_SEGMENTS:
        raise GroundTruthError(f"{path}: more than {MOST_SEGMENTS} walls")
    # NaN fails this comparison too.
    if not np.all(np.abs(segments) < _FARTHEST_M):
        raise GroundTruthError(f"{path}: a wall ends {_FARTHEST_M:.0e} m or farther away")
    # Equal neighbours occur where curves of a drawing meet, and if a line is vertical.
    long = np.hypot(*(segments[:, 2:] - segments[:, :2]).T) > _SHORTEST_M
    segments = np.asarray(segments[long])
    if not len(segments):
        raise GroundTruthError(f"{path}: no lines or curves: expected walls")
    return segments


def _read_drawing(path: PathLike) -> FloatArray:
    pieces: list[tuple[float, float, float, float]] = []
    read_content(path, _LARGEST_FILE_BYTES, "file", GroundTruthError)
    with imported_for(f"{path}: drawings are read by the package ezdxf", "dxf", GroundTruthError):
        from ezdxf import units
        from ezdxf.enums import InsertUnits
        from ezdxf.filemanagement import readfile
    try:
        drawing = readfile(os.fspath(path))
        unit = InsertUnits(drawing.header.get("$INSUNITS", 0))
        unit_m = units.conversion_factor(unit, InsertUnits.Meters) if unit else 1.0
        for curve in _curves(path, drawing.modelspace(), CURVE_TOLERANCE_M / unit_m):
            pieces += [(*a, *b) for a, b in pairwise(curve)]
            if len(pieces) > MOST_SEGMENTS:
                raise GroundTruthError(f"{path}: more than {MOST_SEGMENTS} walls")
    except GroundTruthError:
        raise
    except Exception as error:  # a damaged drawing may fail anywhere in the library
        text = one_line(str(error).partition("\n")[0] or type(error).__name__, 200)
        raise GroundTruthError(f"{path}: unreadable DXF: {text}") from None
    return unit_m * np.array(pieces, dtype=np.float64).reshape(-1, 4)


def _curves(
    path: PathLike, space: Iterable[Any], tolerance: float
) -> Iterator[list[tuple[float, float]]]:
    """Lines and curves of a drawing as chains of points, in its units."""
    # Not ezdxf's own decomposition: it also converts dimensions and leaders to lines.
    waiting: list[tuple[int, Iterator[Any]]] = [(0, iter(space))]
    seen = 0
    while waiting:
        depth, entities = waiting[-1]
        entity = next(entities, None)
        if entity is None:
            waiting.pop()
            continue
        seen += 1
        if seen > MOST_SEGMENTS:
            raise GroundTruthError(f"{path}: more than {MOST_SEGMENTS} entities")
        kind = entity.dxftype()
        if kind == "INSERT":
            if depth == _DEEPEST:
                raise GroundTruthError(f"{path}: blocks nested more than {_DEEPEST} deep")
            copies = iter((entity,)) if entity.mcount == 1 else entity.multi_insert()
            waiting.append((depth + 1, (e for copy in copies for e in copy.virtual_entities())))
        elif kind in ("LWPOLYLINE", "POLYLINE"):
            waiting.append((depth, iter(entity.virtual_entities())))  # its lines and arcs
        elif kind == "LINE":
            yield [(float(p.x), float(p.y)) for p in (entity.dxf.start, entity.dxf.end)]
        elif kind in ("ARC", "CIRCLE", "ELLIPSE", "SPLINE"):
            # A circle as large as the world would otherwise fill the memory.
            points = islice(entity.flattening(tolerance), MOST_SEGMENTS + 2)
            yield [(float(p.x), float(p.y)) for p in points]
