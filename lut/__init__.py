"""Tables that depend on the calibration only, and their cache."""

from lut.cache import TABLE_VERSION, cache_folder, cached_disc_table, cached_vertical_table
from lut.errors import TableError
from lut.outlines import (
    GROUP_COLUMNS,
    GROUP_SAMPLES,
    MIN_SHARE_INSIDE,
    CentreGroups,
    DiscShape,
    DiscTable,
    build_disc_table,
    floor_positions,
    ring,
)
from lut.verticals import VerticalTable, build_vertical_table

__all__ = [
    "GROUP_COLUMNS",
    "GROUP_SAMPLES",
    "MIN_SHARE_INSIDE",
    "TABLE_VERSION",
    "CentreGroups",
    "DiscShape",
    "DiscTable",
    "TableError",
    "VerticalTable",
    "build_disc_table",
    "build_vertical_table",
    "cache_folder",
    "cached_disc_table",
    "cached_vertical_table",
    "floor_positions",
    "ring",
]
