"""Compiled choice of the pixels that a marker is fitted to."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.homography_kernels import inverse_3x3, square_homography
from detect.markers.lens_kernels import straightened
from detect.markers.pattern_residual_kernels import Samples


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


@njit(cache=True, error_model="numpy")
def select_pixels(
    image: NDArray[np.uint8],
    grid: NDArray[np.float64],
    step: float,
    corners: NDArray[np.float64],
    box: NDArray[np.int64],
    lines: NDArray[np.float64],
    seam: Seam,
) -> Samples:
    """Pixels of a marker and of a seam round it.

    Parameters
    ----------
    image, grid, step
        The image and its lens.
    corners : (4, 2) float64
        Straight pixels.
    box : (4,) int64
        First and last column, first and last row to look at (within the image).
    lines : (L,) float64
        Where cells end, in widths of the marker.
    seam : Seam
        How far from the marker, and how many pixels.

    Returns
    -------
    Samples
    """
    reach, near, limit = seam.reach, seam.near, seam.most_pixels
    most = (box[1] - box[0] + 1) * (box[3] - box[2] + 1)
    pixels = np.empty((most, 2), np.int32)
    straight = np.empty((most, 2))
    grey = np.empty(most)
    inverse = inverse_3x3(square_homography(corners))
    area = 0.0
    for k in range(4):
        j = (k + 1) % 4
        area += 0.5 * (corners[k, 0] * corners[j, 1] - corners[j, 0] * corners[k, 1])
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
    for v in range(box[2], box[3] + 1):
        for u in range(box[0], box[1] + 1):
            x, y, _, _, _, _ = straightened(grid, step, float(u), float(v))
            q = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
            if q <= 0.0:
                continue
            mx = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) / q
            my = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) / q
            if mx < -1.0 or mx > 2.0 or my < -1.0 or my > 2.0:
                continue
            gx = (
                math.hypot(inverse[0, 0] - mx * inverse[2, 0], inverse[0, 1] - mx * inverse[2, 1])
                / q
            )
            gy = (
                math.hypot(inverse[1, 0] - my * inverse[2, 0], inverse[1, 1] - my * inverse[2, 1])
                / q
            )
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
            grey[count] = image[v, u]
            count += 1
    return Samples(pixels[:count], straight[:count], grey[:count])
