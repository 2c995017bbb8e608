"""Numba kernel of exact area coverage: how much of each cell of a grid a polygon covers."""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray


@nb.njit(cache=True)
def polygon_coverage(
    x: NDArray[np.float64], y: NDArray[np.float64], width: int, height: int
) -> NDArray[np.float64]:
    """Share of every grid cell's area inside a closed polygon, exact.

    Each edge adds the signed area to its right, cell by cell; the running sum along a row is the
    coverage (the accumulation buffer of scan-line font rasterisers).

    Parameters
    ----------
    x, y : (N,) float64
        Vertices in cells, (0, 0) the top-left *corner* of the top-left cell; the polygon is closed
        by itself. It must lie inside the grid.
    width, height : int
        Cells of the grid.

    Returns
    -------
    (height, width) float64
        Signed coverage: +1 inside for one sense of rotation, -1 for the other.
    """
    deltas = np.zeros((height, width + 2))
    count = x.shape[0]
    for k in range(count):
        x0, y0 = x[k], y[k]
        x1, y1 = x[(k + 1) % count], y[(k + 1) % count]
        if y0 == y1:
            continue
        sense = 1.0
        if y0 > y1:
            x0, y0, x1, y1 = x1, y1, x0, y0
            sense = -1.0
        slope = (x1 - x0) / (y1 - y0)
        for row in range(max(int(np.floor(y0)), 0), min(int(np.ceil(y1)), height)):
            top = max(y0, float(row))
            bottom = min(y1, float(row + 1))
            if bottom <= top:
                continue
            xa = x0 + slope * (top - y0)
            xb = x0 + slope * (bottom - y0)
            left, right = min(xa, xb), max(xa, xb)
            rise = sense * (bottom - top)
            first, last = int(np.floor(left)), int(np.floor(right))
            if first == last or right == left:
                # Within one column: the cell gets the trapezoid to the right of the edge.
                share = first + 1.0 - 0.5 * (left + right)
                deltas[row, first] += rise * share
                deltas[row, first + 1] += rise * (1.0 - share)
                continue
            # Across columns: what lies right of the edge grows quadratically in the first and last
            # column and linearly between them.
            per_column = rise / (right - left)
            before = 0.0
            for column in range(first, last + 1):
                begin, end = max(left, float(column)), min(right, column + 1.0)
                crossed = per_column * (end - begin)
                area = before + crossed * (column + 1.0 - 0.5 * (begin + end))
                # `area` is the coverage of this column; the buffer holds its increments.
                deltas[row, column] += area
                deltas[row, column + 1] -= area
                before += crossed
            deltas[row, last + 1] += rise
    coverage = np.empty((height, width))
    for row in range(height):
        total = 0.0
        for column in range(width):
            total += deltas[row, column]
            coverage[row, column] = total
    return coverage
