"""One disc on the floor, rendered to a thousandth of a pixel, for Monte Carlo tests.

The disc's outline goes forward through the camera as a fine polygon; the area that it covers of the
cells of a supersampled grid is exact; the optics' blur and the pixel's aperture follow. Nothing
here uses a detector's tables or models.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from camera import Camera
from redetect.array_types import FloatArray


@nb.njit(cache=True)
def polygon_coverage(x: FloatArray, y: FloatArray, width: int, height: int) -> FloatArray:
    """Share of every grid cell's area inside a closed polygon, exact.

    Each edge adds the signed area to its right, cell by cell; the running sum along a row is the
    coverage (the accumulation buffer of scan-line font rasterisers).

    `x`, `y` (N,); returns (height, width).
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


_OUTLINE_POINTS = 2048
_CELLS = 8  # per pixel and axis, on which the blur is computed
_BLUR_REACH = 5.0  # standard deviations after which the blur is cut off
_SURROUND = 2.0  # radii about the disc's centre that a crop shows, as far as they are in the image


class DiscCrop(NamedTuple):
    """The part of an image round one disc."""

    grey: FloatArray  # (H, W) grey values, neither rounded nor noisy.
    window: tuple[slice, slice]  # Rows and columns of the image that it shows.


def render_disc(
    camera: Camera,
    floor_xy: ArrayLike,
    radius_m: float = 0.10,
    light: float = 200.0,
    dark: float = 100.0,
    blur_px: float | tuple[float, float] = 0.0,
) -> DiscCrop:
    """Render one disc on a uniform floor as the camera sees it.

    Parameters
    ----------
    floor_xy : (2,) array
        The disc's centre on the floor in the robot frame, metres.
    light, dark : float
        Grey values of disc and floor.
    blur_px : float or pair of floats
        Standard deviation of the optics' Gaussian blur in pixels, along u and v. (The optics of an
        interlaced camera blur a single field half as many pixels along v as along u.)

    Raises
    ------
    ValueError
        If part of the disc is not in front of the camera, or none of it is in the image.
    """
    blur_u, blur_v = blur_px if isinstance(blur_px, tuple) else (blur_px, blur_px)
    outline = _outline(camera, floor_xy, radius_m)
    u0, v0, u1, v1 = _crop_bounds(camera, floor_xy, radius_m * _SURROUND, outline)
    # The blur reaches in from beyond the crop, so the grid is wider than the crop.
    pad_u = int(np.ceil(_BLUR_REACH * blur_u)) + 1
    pad_v = int(np.ceil(_BLUR_REACH * blur_v)) + 1
    left = min(u0 - pad_u, int(np.floor(outline[:, 0].min())) - 1)
    top = min(v0 - pad_v, int(np.floor(outline[:, 1].min())) - 1)
    right = max(u1 + pad_u, int(np.ceil(outline[:, 0].max())) + 1)
    bottom = max(v1 + pad_v, int(np.ceil(outline[:, 1].max())) + 1)

    # Pixel centres are integers, cell corners are the kernel's: half a pixel between them.
    x, y = np.ascontiguousarray(((outline - (left, top) + 0.5) * _CELLS).T)
    columns, rows = right - left + 1, bottom - top + 1
    covered = np.abs(polygon_coverage(x, y, columns * _CELLS, rows * _CELLS))
    sigmas = blur_u * _CELLS, blur_v * _CELLS
    blurred = gaussian_filter(covered.T, sigmas, mode="nearest", truncate=_BLUR_REACH)
    cells = np.ascontiguousarray(blurred.T).reshape(rows, _CELLS, columns, _CELLS)
    share = cells.mean(axis=3).mean(axis=1)
    share = share[v0 - top : v1 - top + 1, u0 - left : u1 - left + 1]
    return DiscCrop(dark + (light - dark) * share, (slice(v0, v1 + 1), slice(u0, u1 + 1)))


def _outline(camera: Camera, floor_xy: ArrayLike, radius_m: float) -> FloatArray:
    """(N, 2) pixels of a circle on the floor."""
    angle = np.arange(_OUTLINE_POINTS) * (2.0 * np.pi / _OUTLINE_POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    outline = camera.project_floor(np.asarray(floor_xy, dtype=np.float64) + radius_m * circle)
    if np.isnan(outline).any():
        raise ValueError(f"the disc at {floor_xy!r} is not wholly in front of the camera")
    return outline


def _crop_bounds(
    camera: Camera, floor_xy: ArrayLike, reach_m: float, disc: FloatArray
) -> tuple[int, int, int, int]:
    """First and last column and row of the crop, as u0, v0, u1, v1."""
    try:
        wide = _outline(camera, floor_xy, reach_m)
    except ValueError:
        wide = disc
    u0, v0 = np.maximum(np.floor(wide.min(axis=0)).astype(int), 0)
    u1, v1 = np.minimum(
        np.ceil(wide.max(axis=0)).astype(int), (camera.width - 1, camera.height - 1)
    )
    if u0 > u1 or v0 > v1:
        raise ValueError(f"the disc at {floor_xy!r} is not in the image")
    return int(u0), int(v0), int(u1), int(v1)
