"""Table of the curves of vertical lines in the image: the horizon and the verticals through it.

A vertical plane through the camera's centre appears as one curve, all points of which have the same
bearing. It is identified by the pixel at which it crosses the horizon: the table has, for each
image column, the row of the horizon and the vertical through that point, as a column for each row,
including distortion (DLR Spatial Cognition data set report, line detection). For a camera that does
not see the horizon, a line of constant elevation near the border replaces it: the *anchor*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import camera_numbers, project_direction
from redetect.array_types import BoolArray, Float32Array, FloatArray
from redetect.compiled import kernel

#: Largest abs(du/dv) at which verticals are followed: 45 deg from the image's vertical.
STEEPEST_SLOPE = 1.0

_NEWTON_STEPS, _STEP_RAD, _TOLERANCE_PX = 12, 1e-7, 1e-9

#: The horizon is the anchor if it is visible in at least this share of the columns.
_LEAST_SEEN = 0.5
#: Otherwise the anchor is, in most columns, at least this share of the height from the border,
_MARGIN = 1.0 / 12.0
#: and at most this far from the horizon: cameras that look farther down see only the floor.
_LARGEST_ELEVATION = math.radians(45.0)


@dataclass(frozen=True, eq=False)
class VerticalTable:
    """The anchor and the verticals of a calibration; hashed and compared by identity."""

    anchor_elevation_rad: float  # elevation of the anchor: 0 for the horizon
    #: (W,) row at which the anchor crosses each column; NaN outside the image
    anchor_row: FloatArray
    #: (W,) bearing of that point, positive to the left; NaN as above
    bearing_rad: FloatArray
    #: (W,) rows over which the vertical through it is continuously visible, inside the image and
    #: within 45 deg of the image's vertical; first > last if there are none
    first_row: NDArray[np.int32]
    last_row: NDArray[np.int32]
    #: (H, W) column at which the vertical of the second index crosses each row; NaN outside those
    #: rows. In Fortran order, so that following a vertical reads memory sequentially.
    column: Float32Array
    #: (H, W) tangent of the elevation at that crossing; NaN as `column`
    elevation_tan: Float32Array
    robot_from_camera: FloatArray  # (3, 3) rotation
    #: height of a row in widths of a column (2 for single fields of interlaced frames)
    row_aspect: float

    @property
    def usable(self) -> BoolArray:
        """(W,) mask of the columns that have a vertical."""
        return self.first_row <= self.last_row


def build_vertical_table(camera: Camera) -> VerticalTable:
    """Compute the anchor and the verticals through it, for a calibrated camera in any pose.

    Columns whose anchor lies outside the image have no vertical; a camera that looks more than 45
    deg past the horizon gets a table without verticals.
    """
    height, width = camera.height, camera.width
    normalised = camera.undistort(camera.pixel_grid())
    elevation_rad, row = _anchor(camera, normalised)
    on_anchor = camera.directions_robot(np.stack([np.arange(width, dtype=np.float64), row], -1))
    bearing = np.arctan2(on_anchor[:, 0], -on_anchor[:, 1])
    column = np.empty((height, width))
    elevation = np.empty_like(column)
    trace_verticals(camera_numbers(camera), bearing, row, elevation_rad, column, elevation)
    first, last, seen = _unbroken(column, row)
    return VerticalTable(
        anchor_elevation_rad=elevation_rad, anchor_row=row, bearing_rad=bearing,
        first_row=first, last_row=last,
        column=np.asfortranarray(np.where(seen, column, np.nan), np.float32),
        elevation_tan=np.asfortranarray(np.where(seen, np.tan(elevation), np.nan), np.float32),
        # Like arrays of a cached table, since kernels are compiled for one kind of array only.
        robot_from_camera=np.array(camera.rotation),
        row_aspect=camera.scale_x / camera.scale_y,
    )  # fmt: skip


def _anchor(camera: Camera, normalised: FloatArray) -> tuple[float, FloatArray]:
    """Elevation of the anchor, rad, and the (W,) rows at which it crosses the columns."""
    row = anchor_rows(camera, normalised, 0.0)
    if np.mean(np.isfinite(row)) >= _LEAST_SEEN:
        return 0.0, row
    margin = min(math.ceil(_MARGIN * camera.height), camera.height - 1)
    nearest = 1.0
    for ray in (normalised[margin], normalised[camera.height - 1 - margin]):
        sine = _above(camera, ray, 0.0) / np.sqrt(1.0 + np.sum(ray * ray, axis=-1))
        sine = sine[np.isfinite(sine)]
        if not len(sine):
            continue
        # A larger distance from the horizon is farther inside the image.
        past = float(np.quantile(sine, 0.1 if np.median(sine) < 0.0 else 0.9))
        if abs(past) < abs(nearest):
            nearest = past
    elevation_rad = math.asin(nearest)
    if abs(elevation_rad) > _LARGEST_ELEVATION:
        return 0.0, row
    return elevation_rad, anchor_rows(camera, normalised, elevation_rad)


def anchor_rows(camera: Camera, normalised: FloatArray, elevation_rad: float) -> FloatArray:
    """(W,) rows at which a line of constant elevation (0: the horizon) crosses each column.

    `normalised` is `camera.undistort` of all pixels (H, W, 2). NaN if it does not cross the column
    inside the image; of several crossings, the nearest to the image's middle row.
    """
    height, width = camera.height, camera.width
    above = _above(camera, normalised, math.sin(elevation_rad))
    row = np.full(width, np.nan)
    if height > 1:
        crosses = (above[:-1] > 0.0) != (above[1:] > 0.0)
        crosses &= np.isfinite(above[:-1]) & np.isfinite(above[1:])
        distance = np.abs(np.arange(height - 1) + 0.5 - 0.5 * (height - 1))
        nearest = np.where(crosses, distance[:, None], np.inf).argmin(axis=0)
        some = np.flatnonzero(crosses.any(axis=0))
        row[some] = _roots(camera, math.sin(elevation_rad), some, nearest[some], above)
    return row


def _above(camera: Camera, normalised: FloatArray, sine: float) -> FloatArray:
    """Signed height of the ends of rays (x, y, 1) above the cone of elevation arcsin(`sine`)."""
    toward_up = camera.rotation[2]
    rise = normalised @ toward_up[:2] + toward_up[2]
    return np.asarray(rise - sine * np.sqrt(1.0 + np.sum(normalised * normalised, axis=-1)))


def _roots(
    camera: Camera,
    sine: float,
    columns: NDArray[np.intp],
    before: NDArray[np.intp],
    above: FloatArray,
) -> FloatArray:
    """Sub-pixel rows between `before` and the next at which columns have that elevation."""
    low, high = before.astype(np.float64), before + 1.0
    rises = above[before, columns] <= 0.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        at = camera.undistort(np.stack([columns.astype(np.float64), middle], axis=-1))
        beyond = (_above(camera, at, sine) > 0.0) == rises
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return np.asarray(0.5 * (low + high))


@kernel()
def trace_verticals(
    numbers: FloatArray,
    bearing: FloatArray,
    anchor_row: FloatArray,
    anchor_elevation: float,
    column: FloatArray,
    elevation: FloatArray,
) -> None:
    """Follow (N,) verticals from the anchor up and down, row by row, through a camera.

    Results are (H, N) `column` and `elevation` (rad) of each vertical in each row; NaN where it is
    not visible, or not continuously from the anchor on.
    """
    column[:] = elevation[:] = math.nan
    for n in range(len(bearing)):
        if not (math.isfinite(bearing[n]) and math.isfinite(anchor_row[n])):
            continue
        first = math.floor(anchor_row[n])
        for direction in (-1, 1):
            v = first if direction < 0 else first + 1
            angle, orientation = anchor_elevation, 0.0
            while 0 <= v < len(column):
                u, angle, slope = _crossing(numbers, bearing[n], v, angle)
                # A vertical that turns back would cross a row twice.
                if not math.isfinite(slope) or orientation * slope < 0.0:
                    break
                column[v, n], elevation[v, n] = u, angle
                orientation = slope
                v += direction
                angle += direction / slope


@kernel()
def _crossing(
    numbers: FloatArray, bearing: float, row: float, angle: float
) -> tuple[float, float, float]:
    """Column and elevation at which a vertical crosses a row, and its rows per radian there.

    By Newton's method from an elevation nearby; NaN if there is no crossing.
    """
    for _ in range(_NEWTON_STEPS):
        u, v = _project_bearing(numbers, bearing, angle)
        slope = (_project_bearing(numbers, bearing, angle + _STEP_RAD)[1] - v) / _STEP_RAD
        if abs(row - v) < _TOLERANCE_PX:
            return u, angle, slope
        angle += (row - v) / slope
    return math.nan, math.nan, math.nan


@kernel()
def _project_bearing(numbers: FloatArray, bearing: float, elevation: float) -> tuple[float, float]:
    ahead = math.cos(elevation)
    return project_direction(
        numbers, ahead * math.sin(bearing), -ahead * math.cos(bearing), math.sin(elevation)
    )


def _unbroken(
    column: FloatArray, anchor_row: FloatArray
) -> tuple[NDArray[np.int32], NDArray[np.int32], BoolArray]:
    """First and last row around the anchor over which verticals are visible; mask of these rows."""
    height, width = column.shape
    with np.errstate(invalid="ignore"):
        seen = (column >= 0.0) & (column <= width - 1.0)
        slope = np.gradient(column, axis=0) if height > 1 else np.zeros_like(column)
        seen &= ~(np.abs(slope) > STEEPEST_SLOPE)
    row, columns = np.arange(height)[:, None], np.arange(width)
    start = np.rint(np.where(np.isfinite(anchor_row), anchor_row, 0.0)).astype(np.int32)
    there = np.isfinite(anchor_row) & seen[start, columns]
    first = np.where(~seen & (row < start), row + 1, 0).max(axis=0)
    last = np.where(~seen & (row >= start), row - 1, height - 1).min(axis=0)
    first, last = np.where(there, first, 1), np.where(there, last, 0)
    return first.astype(np.int32), last.astype(np.int32), (row >= first) & (row <= last)
