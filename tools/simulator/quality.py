"""The published detector's quality of a disc, measured on the spot.

Written anew, without tables, so that rendered images can be judged by it before they are used to
judge a detector.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera import Camera

INNER_M, OUTER_M = 0.06, 0.14
SAMPLES = 16

#: Borders of forward distance (m), and the shipped rows' median quality between them.
DISTANCE_BORDERS_M = (0.8, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
SHIPPED_MEDIANS = (0.987, 0.973, 0.924, 0.836, 0.781, 0.703)


def disc_quality(grey: NDArray[np.uint8], camera: Camera, pixel: ArrayLike) -> float:
    """Otsu quality of a disc whose centre is seen at a pixel.

    Parameters
    ----------
    grey : (H, W) uint8
        The image.
    camera : Camera
        Its calibration.
    pixel : (2,) array of int
        u, v.

    Returns
    -------
    float
        Between-class variance over total variance of the grey values at 16 points inside and 16
        outside the disc's outline (nearest pixels, clipped to the image), 0 to 1.
    """
    centre = camera.floor_from_pixel(np.asarray(pixel, dtype=np.float64))
    angle = np.arange(SAMPLES) * (2.0 * np.pi / SAMPLES)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    outlines = centre + np.array([INNER_M, OUTER_M])[:, None, None] * circle
    seen = camera.project_floor(outlines)
    if np.isnan(seen).any():
        return 0.0
    u = np.clip(np.rint(seen[..., 0]).astype(int), 0, grey.shape[1] - 1)
    v = np.clip(np.rint(seen[..., 1]).astype(int), 0, grey.shape[0] - 1)
    values = grey[v, u].astype(np.float64)
    total = values.var()
    if total <= 0.0:
        return 0.0
    difference = values[0].mean() - values[1].mean()
    return float(0.25 * difference * difference / total)


def best_quality_near(
    grey: NDArray[np.uint8], camera: Camera, pixel: ArrayLike, reach: int = 2
) -> tuple[float, tuple[int, int]]:
    """The best quality within `reach` pixels of a place, and its pixel (u, v): a detector's row."""
    u0, v0 = np.rint(np.asarray(pixel, dtype=np.float64)).astype(int)
    best, where = -1.0, (int(u0), int(v0))
    for v in range(max(v0 - reach, 0), min(v0 + reach, grey.shape[0] - 1) + 1):
        for u in range(max(u0 - reach, 0), min(u0 + reach, grey.shape[1] - 1) + 1):
            found = disc_quality(grey, camera, (u, v))
            if found > best:
                best, where = found, (int(u), int(v))
    return best, where
