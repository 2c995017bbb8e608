"""Compiled loops of the plain quality map: one gather per sample, as one writes it first.

Numba's cache notices a change of this file, but not one of `camera.kernels`, whose function is
compiled into these: whoever changes that one has to touch this file as well.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from camera.kernels import project_floor_point


@njit(cache=True, error_model="numpy")
def sample_indices(
    numbers: NDArray[np.float64],
    floor_xy: NDArray[np.float64],
    centres: NDArray[np.int32],
    rings: NDArray[np.float64],
    height: int,
    width: int,
) -> NDArray[np.int32]:
    """Where each sample of each centre's outlines lies in an image padded by one pixel.

    Parameters
    ----------
    numbers : (22,) float64
        `camera.kernels.camera_numbers`.
    floor_xy : (H, W, 2) float64
        Floor position of each pixel, metres.
    centres : (N, 2) int32
        Pixels (u, v).
    rings : (K, 2) float64
        The outlines' samples relative to their centre, metres.
    height, width : int
        Size of the image without its padding.

    Returns
    -------
    (N, K) int32
        Index into the flattened padded image; 0, its padded corner, for samples outside the image.
    """
    index = np.zeros((len(centres), len(rings)), np.int32)
    for i in range(len(centres)):
        x, y = floor_xy[centres[i, 1], centres[i, 0]]
        for k in range(len(rings)):
            us, vs = project_floor_point(numbers, x + rings[k, 0], y + rings[k, 1])
            if 0.0 <= us + 0.5 < width and 0.0 <= vs + 0.5 < height:
                row = math.floor(vs + 0.5) + 1
                index[i, k] = row * (width + 2) + math.floor(us + 0.5) + 1
    return index


@njit(cache=True, error_model="numpy")
def gathered_quality(
    padded: NDArray[np.uint8],
    index: NDArray[np.int32],
    centres: NDArray[np.int32],
    votes_inner: NDArray[np.uint8],
    votes_outer: NDArray[np.uint8],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
) -> None:
    """Otsu's quality of the two outlines around every centre, each grey value gathered by itself.

    Parameters
    ----------
    padded : (P,) uint8
        The image with zeros around, flattened.
    index : (N, 2 K) int32
        See `sample_indices`: K samples of the inner outline, then K of the outer one.
    centres : (N, 2) int32
        Pixels (u, v).
    votes_inner, votes_outer : (N,) uint8
        Samples of each outline inside the image.
    quality : (H, W) float64
        Result: between-class variance / total variance.
    contrast : (H, W) float32
        Result: mean grey value inside minus outside.
    """
    samples = index.shape[1] // 2
    for i in range(len(centres)):
        inner = 0
        outer = 0
        squares = 0
        for k in range(samples):
            grey = int(padded[index[i, k]])
            inner += grey
            squares += grey * grey
        for k in range(samples, 2 * samples):
            grey = int(padded[index[i, k]])
            outer += grey
            squares += grey * grey
        n_inner = int(votes_inner[i])
        n_outer = int(votes_outer[i])
        n = n_inner + n_outer
        total = inner + outer
        spread = n * squares - total * total
        difference = n_outer * inner - n_inner * outer
        u, v = centres[i]
        if spread > 0:
            quality[v, u] = (difference * difference) / (float(n_inner * n_outer) * spread)
        contrast[v, u] = difference / (n_inner * n_outer)
