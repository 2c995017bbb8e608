"""Which rows of centres are evaluated where whatever looks like a disc is fitted anyway.

The quality of a large disc's centre is also that of the centres round it: as long as one outline is
on the disc and the other off it. A fit finds the same disc from each of them, so it is enough to
look at some rows.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.settings import CircleSettings
from lut import DiscTable

#: Of the centres of a row, every n-th decides how far apart rows may be.
_EVERY = 8


class CentreRows(NamedTuple):
    """Some rows of a table's centres."""

    blocks: NDArray[np.int64]
    """(B,) the table's blocks in these rows, ascending."""
    rank: NDArray[np.int64]
    """(H,) of each row of the image: its number among those evaluated. Neighbours differ by 1."""


@lru_cache(maxsize=4)
def every_row(table: DiscTable) -> CentreRows:
    """All rows of a table's centres."""
    return CentreRows(np.arange(len(table.block_row)), np.arange(len(table.floor_xy)))


def rows_to_look_at(table: DiscTable, settings: CircleSettings) -> CentreRows:
    """The rows of centres that are evaluated: all, unless whatever is found is fitted.

    Parameters
    ----------
    table : DiscTable
        For the settings.
    settings : CircleSettings
        `rows_apart` and the radii; `verify` and `refine`.

    Returns
    -------
    CentreRows
    """
    if not (settings.verify and settings.refine):
        return every_row(table)
    to_outline_m = min(
        settings.radius_m - settings.inner_radius_m, settings.outer_radius_m - settings.radius_m
    )
    return centre_rows(table, settings.rows_apart * to_outline_m)


@lru_cache(maxsize=4)
def centre_rows(table: DiscTable, apart_m: float) -> CentreRows:
    """Rows of centres that are so close that no centre between them is far from one of them.

    Parameters
    ----------
    table : DiscTable
        Of all centres.
    apart_m : float
        How far on the floor that may be, seen as a row of the image sees it, metres; 0 for all
        rows.

    Returns
    -------
    CentreRows
    """
    height = len(table.floor_xy)
    rows = _rows_apart(_farthest_step(table, apart_m))
    rank = np.zeros(height, np.int64)
    rank[rows] = 1
    rank = np.cumsum(rank)
    looked_at = np.zeros(height, np.bool_)
    looked_at[rows] = True
    return CentreRows(np.flatnonzero(looked_at[table.block_row]), rank)


def _farthest_step(table: DiscTable, apart_m: float) -> NDArray[np.int64]:
    """(H,) how far from one row to the next, by the usable centre where a circle is flattest."""
    floor = table.floor_xy
    height, width = floor.shape[:2]
    step = np.ones(height, np.int64)
    if apart_m <= 0.0:
        return step
    flattest = np.full(height, np.inf)
    row, column = (centres[::_EVERY] for centres in table.centres)
    row, column = np.clip(row, 1, height - 2), np.minimum(column, width - 2)
    column = np.maximum(column, 1)
    by_u = floor[row, column + 1].astype(np.float64) - floor[row, column - 1]
    by_v = floor[row + 1, column].astype(np.float64) - floor[row - 1, column]
    area = np.abs(by_u[..., 0] * by_v[..., 1] - by_u[..., 1] * by_v[..., 0])
    half_height = 2.0 * apart_m * np.hypot(by_u[..., 0], by_u[..., 1]) / area
    usable = np.isfinite(half_height)
    np.minimum.at(flattest, row[usable], half_height[usable])
    known = np.isfinite(flattest)
    step[known] = np.maximum(1, np.floor(2.0 * flattest[known])).astype(np.int64)
    return step


def _rows_apart(step: NDArray[np.int64]) -> list[int]:
    """Rows from the first on, none farther from the next than any row between them allows."""
    rows = [0]
    while rows[-1] < len(step) - 1:
        row = rows[-1]
        apart = 1
        while row + apart + 1 < len(step) and step[row + 1 : row + apart + 2].min() > apart:
            apart += 1
        rows.append(row + apart)
    return rows
