"""Compiled sampling of a marker's cells."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.homography_kernels import square_homography
from detect.markers.lens_kernels import bent


@njit(cache=True, error_model="numpy")
def sample_cells(
    image: NDArray[np.uint8],
    grid: NDArray[np.float64],
    step: float,
    corners: NDArray[np.float64],
    guess: NDArray[np.float64],
    centres: NDArray[np.float64],
    spread: float,
    cells: NDArray[np.float64],
) -> bool:
    """Mean grey value round the middle of each cell.

    Parameters
    ----------
    image, grid, step
        The image and its lens.
    corners : (4, 2) float64
        Straight pixels.
    guess : (2,) float64
        A pixel near the marker.
    centres : (G,) float64
        Where cells have their middles, in widths of the marker, along both axes.
    spread : float
        Distance of the 3x3 samples of a cell, in widths of the marker.
    cells : (G, G) float64
        Result: row 0 is the one by the first edge.

    Returns
    -------
    bool
        Whether all samples are inside the image.
    """
    height, width = image.shape
    homography = square_homography(corners)
    n = len(centres)
    for j in range(n):
        for i in range(n):
            total = 0.0
            for b in range(-1, 2):
                for a in range(-1, 2):
                    mx = centres[i] + a * spread
                    my = centres[j] + b * spread
                    w = homography[2, 0] * mx + homography[2, 1] * my + 1.0
                    x = (homography[0, 0] * mx + homography[0, 1] * my + homography[0, 2]) / w
                    y = (homography[1, 0] * mx + homography[1, 1] * my + homography[1, 2]) / w
                    u, v = bent(grid, step, x, y, guess[0], guess[1])
                    if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
                        return False
                    iu = min(math.floor(u), width - 2)
                    iv = min(math.floor(v), height - 2)
                    fu, fv = u - iu, v - iv
                    total += (1.0 - fv) * (
                        (1.0 - fu) * image[iv, iu] + fu * image[iv, iu + 1]
                    ) + fv * ((1.0 - fu) * image[iv + 1, iu] + fu * image[iv + 1, iu + 1])
            cells[j, i] = total / 9.0
    return True
