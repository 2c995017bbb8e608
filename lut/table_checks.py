"""Checks that the compiled loops can use a table's arrays as indices.

The loops check nothing, so a table that was read from a file is checked once before use.
"""

from __future__ import annotations

import math

import numpy as np

from camera import Camera
from lut.errors import TableError
from lut.outlines import DiscShape, DiscTable
from lut.verticals import VerticalTable


def check_disc_table(table: DiscTable, camera: Camera, shape: DiscShape) -> None:
    """Refuse a disc table by which a loop would leave the image, or its own arrays.

    Parameters
    ----------
    table : DiscTable
    camera : Camera
        The calibration that it should be of.
    shape : DiscShape
        Outlines and limits that it should be of.

    Raises
    ------
    TableError
        If a type, shape or index is impossible; the message names it.
    """
    height, width = camera.height, camera.width
    for name, dtype, dimensions in (
        ("samples", np.uint32, 3),
        ("row", np.int32, 1),
        ("column", np.int32, 1),
        ("floor_xy", np.float32, 3),
    ):
        _demand_array(getattr(table, name), name, dtype, dimensions)
    centres = len(table.row)
    _demand(table.floor_xy.shape == (height, width, 2), "floor_xy")
    _demand(table.samples.shape == (centres, shape.samples, 2), "samples")
    _demand(table.samples.max(initial=0) <= height * width, "samples")
    _demand(len(table.column) == centres, "column")
    _demand(bool(np.all((table.row >= 0) & (table.row < height))), "row")
    _demand(bool(np.all((table.column >= 0) & (table.column < width))), "column")


def check_vertical_table(table: VerticalTable, camera: Camera) -> None:
    """Refuse a table of verticals by which a loop would leave the image, or its own arrays.

    Parameters
    ----------
    table : VerticalTable
    camera : Camera
        The calibration that it should be of.

    Raises
    ------
    TableError
        If a type, shape, index or number is impossible; the message names it.
    """
    height, width = camera.height, camera.width
    for name, dtype, shape in (
        ("anchor_row", np.float64, (width,)),
        ("bearing_rad", np.float64, (width,)),
        ("first_row", np.int32, (width,)),
        ("last_row", np.int32, (width,)),
        ("column", np.float32, (height, width)),
        ("elevation_tan", np.float32, (height, width)),
        ("robot_from_camera", np.float64, (3, 3)),
    ):
        array = getattr(table, name)
        _demand_array(array, name, dtype, len(shape))
        _demand(array.shape == shape, name)
    for name in ("column", "elevation_tan"):
        _demand(bool(getattr(table, name).flags.f_contiguous), name)
    _demand(np.array_equal(table.robot_from_camera, camera.rotation), "robot_from_camera")
    _demand(table.row_aspect == camera.scale_x / camera.scale_y, "row_aspect")
    elevation = table.anchor_elevation_rad
    _demand(isinstance(elevation, float) and abs(elevation) < 0.5 * math.pi, "anchor_elevation_rad")
    with_anchor = np.isfinite(table.anchor_row)
    inside = (table.anchor_row >= 0.0) & (table.anchor_row <= height - 1.0)
    _demand(bool(np.all(inside | np.isnan(table.anchor_row))), "anchor_row")
    _demand(bool(np.all(np.isfinite(table.bearing_rad[with_anchor]))), "bearing_rad")

    usable = table.usable
    _demand(bool(np.all(with_anchor[usable])), "first_row")
    _demand(bool(np.all((table.first_row >= 0) & (table.last_row < height))), "last_row")
    row = np.arange(height)[:, None]
    followed = usable & (row >= table.first_row) & (row <= table.last_row)
    seen = (table.column >= 0.0) & (table.column <= width - 1.0)  # NaN fails this
    _demand(bool(np.all(seen == followed)), "column")
    _demand(bool(np.all(np.isfinite(table.elevation_tan) == followed)), "elevation_tan")


def _demand_array(array: object, name: str, dtype: type[np.generic], dimensions: int) -> None:
    right = isinstance(array, np.ndarray) and array.dtype == dtype and array.ndim == dimensions
    _demand(right, name)


def _demand(condition: bool | np.bool_, name: str) -> None:
    if not condition:
        raise TableError(f"the table's {name} cannot be: expected one for this calibration")
