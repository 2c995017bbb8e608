"""The published detector: the best centres of a good quality and contrast, as they are.

It accepts centres of the table by their quality and contrast alone, and keeps the best within a
disc's width (DLR Spatial Cognition data set report, circle detection).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.quality import Blocks, Wanted, find_centres


@njit(cache=True, error_model="numpy", nogil=True)
def published_centres(
    pixels: NDArray[np.uint8],
    blocks: Blocks,
    chosen: NDArray[np.int64],
    wanted: Wanted,
    floor_xy: NDArray[np.float32],
    separation: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Pixels (M, 2) and quality (M,) of the centres that stay: one call for each image.

    Parameters are those of `find_centres` and `strong_and_highest`.
    """
    found = find_centres(pixels, blocks, chosen, wanted)
    places = np.empty((len(found), 2), np.int64)
    places[:, 0], places[:, 1] = found["u"], found["v"]
    quality = found["quality"].copy()
    keep = strong_and_highest(
        places, quality, found["contrast"].copy(), floor_xy, wanted.quality, wanted.contrast,
        separation,
    )  # fmt: skip
    return places[keep], quality[keep]


@njit(cache=True, error_model="numpy", nogil=True)
def strong_and_highest(
    pixels: NDArray[np.int64],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
    floor_xy: NDArray[np.float32],
    threshold: float,
    weakest: float,
    separation: float,
) -> NDArray[np.int64]:
    """Which centres exceed both limits, and have none of a higher quality nearby that does.

    Of centres of the same quality, the first stays that has none nearby that stays.

    Parameters
    ----------
    pixels, quality, contrast : (N, 2) int64, (N,) float64, (N,) float32
        Centres in scan order (see `detect.discs.candidates`).
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    threshold : float
        Qualities are higher than this,
    weakest : float
        and contrasts too, of either sign, grey levels; 0: whatever they are.
    separation : float
        Nearer than this is nearby, metres.

    Returns
    -------
    (M,) int64
        Indices, ascending.
    """
    strong = np.flatnonzero(
        (quality > threshold) & ((np.abs(contrast) > weakest) | (weakest == 0.0))
    )
    x = np.empty(len(strong))
    y = np.empty(len(strong))
    for k in range(len(strong)):
        u, v = pixels[strong[k], 0], pixels[strong[k], 1]
        x[k] = floor_xy[v, u, 0]
        y[k] = floor_xy[v, u, 1]
    kept = np.zeros(len(strong), np.bool_)
    near = separation * separation
    for i in range(len(strong)):
        own = quality[strong[i]]
        kept[i] = True
        for j in range(len(strong)):
            other = quality[strong[j]]
            better = other > own or (other == own and j < i and kept[j])
            if better and (x[j] - x[i]) ** 2 + (y[j] - y[i]) ** 2 < near:
                kept[i] = False
                break
    return strong[kept]
