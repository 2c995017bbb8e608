"""The table of verticals, laid out as tracks read it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lut.verticals import VerticalTable


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """Neighbouring verticals in groups (see `detect.verticals.group_kernels`), and how verticals
    lean.

    Attributes
    ----------
    column : (G * H * L,) float32
        Columns at which the L verticals of a group cross rows, row by row, for one group after the
        other; NaN where they are not seen.
    ends : (G, 4) int32
        First and last row in which any of the group's verticals is seen; first and last row in
        which all are, the first after the last where there are none.
    rise : (W, H) float32
        Tangents of elevations: the table's, column by column, as tracks read them.
    lean_by_pitch, lean_by_roll : (W,) float64
        By how many columns of the strip a vertical moves for a rise of 1 in a camera of unit pitch,
        and of unit roll; NaN where there is no vertical, or none beside it.
    """

    column: NDArray[np.float32]
    ends: NDArray[np.int32]
    rise: NDArray[np.float32]
    lean_by_pitch: NDArray[np.float64]
    lean_by_roll: NDArray[np.float64]


@lru_cache(maxsize=4)
def strip_of(table: VerticalTable) -> Strip:
    """The strip of a table; made once for each."""
    from detect.vector_code import LANES
    from detect.verticals.group_kernels import MARGIN, STEP

    height, width = table.column.shape
    base = np.clip(np.arange(0, width, STEP) - MARGIN, 0, max(width - LANES, 0))
    member = np.minimum(base[:, None] + np.arange(LANES), width - 1)
    seen = table.usable[member]
    first, last = table.first_row[member], table.last_row[member]
    ends = np.stack(
        [
            np.where(seen, first, height).min(axis=1),
            np.where(seen, last, -1).max(axis=1),
            np.where(seen, first, height).max(axis=1),
            np.where(seen, last, -1).min(axis=1),
        ],
        axis=1,
    )
    bearing = table.bearing_rad
    per_rad = np.full(width, np.nan)
    per_rad[1:-1] = 2.0 / (bearing[2:] - bearing[:-2])
    return Strip(
        column=np.ascontiguousarray(table.column.T[member].transpose(0, 2, 1)).reshape(-1),
        ends=ends.astype(np.int32),
        rise=np.ascontiguousarray(table.elevation_tan.T),
        lean_by_pitch=np.sin(bearing) * per_rad,
        lean_by_roll=-np.cos(bearing) * per_rad,
    )
