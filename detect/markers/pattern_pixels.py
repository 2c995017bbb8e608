"""Choice of the pixels that a marker is fitted to."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.homography import inverse_3x3, project, square_homography
from detect.markers.lens import Picture, straightened
from detect.markers.quadrangle import signed_area

FloatArray = NDArray[np.float64]


class Samples(NamedTuple):
    """Pixels to which a marker is fitted, row by row.

    Attributes
    ----------
    pixel : (N, 2) int32
        u, v.
    straight : (N, 2) float64
        Their positions without distortion, pixels.
    grey : (N,) float64
        Grey values.
    """

    pixel: NDArray[np.int32]
    straight: FloatArray
    grey: FloatArray


class PixelBox(NamedTuple):
    """First and last column, first and last row."""

    left: int
    right: int
    top: int
    bottom: int


class Seam(NamedTuple):
    """Which pixels round a marker are used.

    Attributes
    ----------
    reach : float
        Width of the seam, pixels.
    near : float
        If there are too many pixels, those farther than this from all cells' ends are thinned.
    most_pixels : int
        About how many are used at most.
    """

    reach: float
    near: float
    most_pixels: int


def pixel_box(picture: Picture, corners: FloatArray, seam: float) -> PixelBox | None:
    """The pixels of a marker with its seam; None if it leaves the image."""
    homography = square_homography(corners)
    along = np.linspace(0.0, 1.0, 5)
    zero, one = np.zeros(5), np.ones(5)
    sides = ((along, zero), (one, along), (along, one), (zero, along))
    outline = np.concatenate([np.stack(side, axis=-1) for side in sides])
    straight = outline @ homography[:2, :2].T + homography[:2, 2]
    straight /= (outline @ homography[2, :2] + 1.0)[:, None]
    pixels = picture.lens.bend(straight)
    if not np.all(np.isfinite(pixels)):
        return None
    height, width = picture.grey.shape
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    if low.min() < 0.0 or high[0] > width - 1.0 or high[1] > height - 1.0:
        return None
    reach = 1.5 * seam + 2.0
    return PixelBox(
        max(0, int(low[0] - reach)),
        min(width - 1, int(high[0] + reach)),
        max(0, int(low[1] - reach)),
        min(height - 1, int(high[1] + reach)),
    )


@njit(cache=True, error_model="numpy")
def select_pixels(
    picture: Picture, corners: FloatArray, lines: FloatArray, box: PixelBox, seam: Seam
) -> Samples:
    """Pixels of a marker and of a seam round it.

    Parameters
    ----------
    picture : Picture
        The image.
    corners : (4, 2) float64
        Straight pixels.
    lines : (L,) float64
        Where cells end, in widths of the marker.
    box : PixelBox
        Where to look.
    seam : Seam
        How far from the marker, and how many pixels.

    Returns
    -------
    Samples
    """
    reach, near, limit = seam.reach, seam.near, seam.most_pixels
    most = (box.right - box.left + 1) * (box.bottom - box.top + 1)
    pixels = np.empty((most, 2), np.int32)
    straight = np.empty((most, 2))
    grey = np.empty(most)
    inverse = inverse_3x3(square_homography(corners))
    area = signed_area(corners)
    expected = area + reach * 4.0 * math.sqrt(area)
    thin = expected > limit
    every = 1
    if thin:
        # What is near the cells' ends goes on in full where possible.
        side = math.sqrt(area)
        inner = min(1.0, 2.0 * near * len(lines) / side)
        share = 1.0 - (1.0 - inner) ** 2
        every = max(1, math.ceil(expected * (share + 0.1) / limit))
    count = 0
    for v in range(box.top, box.bottom + 1):
        for u in range(box.left, box.right + 1):
            x, y, _, _, _, _ = straightened(picture.lens, float(u), float(v))
            mx, my, q = project(inverse, x, y)
            if q <= 0.0 or mx < -1.0 or mx > 2.0 or my < -1.0 or my > 2.0:
                continue
            gx = math.hypot(inverse[0, 0] - mx * inverse[2, 0], inverse[0, 1] - mx * inverse[2, 1])
            gy = math.hypot(inverse[1, 0] - my * inverse[2, 0], inverse[1, 1] - my * inverse[2, 1])
            gx /= q
            gy /= q
            if max(-mx, mx - 1.0) > reach * gx or max(-my, my - 1.0) > reach * gy:
                continue
            if thin:
                hashed = (u * 73856093) ^ (v * 19349663)
                close = False
                for k in range(len(lines)):
                    if abs(mx - lines[k]) < near * gx or abs(my - lines[k]) < near * gy:
                        close = True
                        break
                if hashed % (every if close else 10 * every) != 0:
                    continue
            pixels[count, 0] = u
            pixels[count, 1] = v
            straight[count, 0] = x
            straight[count, 1] = y
            grey[count] = picture.grey[v, u]
            count += 1
    return Samples(pixels[:count], straight[:count], grey[:count])
