"""Requirements on the views of a board, and warnings about a calibration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from camera.calibration.adjustment import Adjusted, Points
from camera.calibration.model import corner_radius
from camera.errors import CalibrationError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

FEWEST_VIEWS = 3
# Below this the focal length hangs on the perspective of single views alone.
_SMALLEST_SPREAD_DEG = 3.0
_LARGEST_SCALE_SIGMA = 0.03
# Points are found to some tenths of a pixel; in large images, which are softer, less well.
_LARGEST_RMS_PX = 1.0
_LARGEST_RMS_WIDTHS = 1.0 / 2000.0


def demand_enough(count: int, without: str = "") -> None:
    """Refuse fewer pictures than a calibration takes; `without` says what was left out."""
    if count < FEWEST_VIEWS:
        raise CalibrationError(
            f"{count} pictures of the board{without}: at least {FEWEST_VIEWS} are needed, and 15 "
            "to 40 are good; take more, from different sides and out to the image's corners"
        )


def demand_different_views(fit: Adjusted, spread_deg: float) -> None:
    """Refuse views that do not separate focal length and distance."""
    variance = float(fit.covariance[0, 0])
    # In a singular problem rounding can make the variance zero or negative.
    sigma = np.sqrt(variance) if variance > 0.0 else np.inf
    relative = float(sigma / fit.estimate.intrinsics[0])
    if spread_deg < _SMALLEST_SPREAD_DEG or not relative < _LARGEST_SCALE_SIGMA:
        raise CalibrationError(
            f"the boards have almost the same orientation: their normals differ by at most "
            f"{spread_deg:.1f} deg and leave the focal length {100.0 * relative:.2g} % uncertain, "
            "because it is not separable from the distance; tilt the board by 20 to 45 deg in "
            "different directions between pictures"
        )


def warnings_of(fit: Adjusted, points: Points, spread_deg: float) -> list[str]:
    """Warnings about weaknesses of a calibration."""
    warnings = []
    if fit.rms_px > max(_LARGEST_RMS_PX, _LARGEST_RMS_WIDTHS * points.width):
        warnings.append(
            f"an RMS residual of {fit.rms_px:.2f} px says that the points are not explained: is "
            "the board flat, are --board, --columns and --rows right, and does the lens see less "
            "than 90 deg off its axis in the image's corners?"
        )
    views = len(points.starts)
    if views < 10:
        warnings.append(f"only {views} pictures: 15 to 40 make the result firmer")
    if spread_deg < 20.0:
        warnings.append(
            f"the boards' normals differ by at most {spread_deg:.0f} deg: tilt the board by 20 to "
            "45 deg in different directions"
        )
    warnings += coverage_warnings(fit.estimate.intrinsics, points)
    return warnings


def coverage(points: Points, columns: int = 8, rows: int = 6) -> IntArray:
    """Number of points in each cell of the image, (rows, columns)."""
    u = np.clip(((points.pixels[:, 0] + 0.5) * columns / points.width).astype(int), 0, columns - 1)
    v = np.clip(((points.pixels[:, 1] + 0.5) * rows / points.height).astype(int), 0, rows - 1)
    counts = np.zeros((rows, columns), dtype=np.int64)
    np.add.at(counts, (v, u), 1)
    return counts


def coverage_warnings(intrinsics: FloatArray, points: Points) -> list[str]:
    """Parts of the image in which no point was seen."""
    warnings = []
    thirds = coverage(points, 3, 3)
    across, down = ("left", "middle", "right"), ("top", "middle", "bottom")
    empty = [
        f"{down[row]} {across[column]}" if row != 1 or column != 1 else "centre"
        for row, column in np.argwhere(thirds == 0)
    ]
    if empty:
        warnings.append(f"no points in the image's {', '.join(empty)}: hold the board there, too")
    normalised = (points.pixels - intrinsics[2:4]) / intrinsics[:2]
    seen = float(np.hypot(normalised[:, 0], normalised[:, 1]).max())
    share = seen / corner_radius(intrinsics, points.width, points.height)
    if share < 0.9:
        warnings.append(
            f"points reach only {100.0 * share:.0f} % of the way from the centre to the farthest "
            "corner: beyond, the distortion is extrapolated"
        )
    return warnings
