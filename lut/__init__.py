"""What a calibration decides before the first image: tables, and their cache."""

from lut.cache import TABLE_VERSION, cache_folder, cached_disc_table
from lut.errors import TableError
from lut.outlines import (
    MIN_SHARE_INSIDE,
    DiscShape,
    DiscTable,
    build_disc_table,
    floor_positions,
    ring,
)

__all__ = [
    "MIN_SHARE_INSIDE",
    "TABLE_VERSION",
    "DiscShape",
    "DiscTable",
    "TableError",
    "build_disc_table",
    "cache_folder",
    "cached_disc_table",
    "floor_positions",
    "ring",
]
