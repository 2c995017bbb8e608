"""The quality of centres: how well two outlines on the floor part the grey values.

A disc centred at a pixel has an inner outline within its edge and an outer one beyond it
(`lut.outlines`). Taken as two classes, their grey values have Otsu's quality (N. Otsu, A Threshold
Selection Method from Gray-Level Histograms, 1979; DLR Spatial Cognition data set report, circle
detection): the between-class variance over the total one. With n = n_inner + n_outer samples in the
image,

    difference = n_outer sum(inner) - n_inner sum(outer)
    spread     = n sum(x^2) - (sum x)^2
    quality    = difference^2 / (n_inner n_outer spread)
    contrast   = difference / (n_inner n_outer)

All of these are whole numbers, so the only rounding is that of the final division.

Most centres are ruled out by half of their pairs of samples, every second direction. If all have
the quality q, these have at least 2 q - 1: with the contrast d and the variance s within the
classes, and e and 0 in the other half, the variance within the classes of both together is at least
s / 2 + ((d - e) / 4)^2, that between them ((d + e) / 4)^2, whatever e is.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.errors import FrameError
from lut import DiscTable

#: Pairs of samples by which most centres are ruled out: half of 16 (a constant number, so that the
#: compiler writes them out).
_FIRST = 8
# Unsigned: an index that is none of those counted from the end.
_U64, _I32 = np.uint64, np.int32


class Limits(NamedTuple):
    """Which centres are found."""

    quality: float
    """At least, and above 0,"""
    half_quality: float = 0.0
    """in every second direction at least this,"""
    contrast: float = 0.0
    """and more than this, grey levels, of either sign."""
    sign: int = 0
    """1 for those lighter than what is around them, -1 for darker ones, 0 for both."""


class Centres(NamedTuple):
    """Some centres, in scan order."""

    pixels: NDArray[np.int64]
    """(N, 2) pixels (u, v)."""
    quality: NDArray[np.float64]
    """(N,)"""
    contrast: NDArray[np.float32]
    """(N,) of the inner outline to the outer, grey levels."""


@njit(cache=True, error_model="numpy", forceinline=True)
def _rules_out(
    pixels: NDArray[np.uint8], samples: NDArray[np.uint32], i: int, least_quality: float
) -> bool:
    """Whether the first directions have too little quality; all are in the image."""
    a = b = squares = _I32(0)
    for k in range(_U64(_FIRST)):
        x, y = _I32(pixels[samples[i, k, 0]]), _I32(pixels[samples[i, k, 1]])
        a += x
        b += y
        squares += x * x + y * y
    difference, total = a - b, a + b
    spread = 2 * _FIRST * squares - total * total
    return bool(difference * difference < least_quality * spread)


@njit(cache=True, error_model="numpy", forceinline=True)
def _quality_of(
    pixels: NDArray[np.uint8], samples: NDArray[np.uint32], i: int
) -> tuple[float, float]:
    """Quality and contrast of a centre."""
    outside = len(pixels) - 1
    a: Any = 0
    b: Any = 0
    squares: Any = 0
    n_inner = n_outer = 0
    for k in range(_U64(samples.shape[1])):
        x, y = np.int64(pixels[samples[i, k, 0]]), np.int64(pixels[samples[i, k, 1]])
        a += x
        b += y
        squares += x * x + y * y
        n_inner += samples[i, k, 0] < outside
        n_outer += samples[i, k, 1] < outside
    difference, pairs = n_outer * a - n_inner * b, n_inner * n_outer
    spread = (n_inner + n_outer) * squares - (a + b) * (a + b)
    quality = float(difference * difference) / float(pairs * spread) if spread > 0 else 0.0
    return quality, difference / pairs if pairs > 0 else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def find_centres(
    pixels: NDArray[np.uint8], samples: NDArray[np.uint32], whole: NDArray[np.bool_], limits: Limits
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float32]]:
    """The centres within some limits: (M,) indices, qualities and contrasts.

    Parameters
    ----------
    pixels : (H W + 1,) uint8
        The image in scan order, and a zero, which adds nothing to any sum.
    samples, whole : (N, K, 2) uint32, (N,) bool
        Of `lut.DiscTable`.
    limits : Limits
    """
    n, pairs = len(samples), samples.shape[1]
    index, count = np.empty(n, np.int64), 0
    screened = _FIRST <= pairs <= 2 * _FIRST
    for i in range(_U64(n)):
        if screened and whole[i] and _rules_out(pixels, samples, i, limits.half_quality):
            continue
        index[count] = i
        count += 1
    quality, contrast = np.empty(count), np.empty(count, np.float32)
    kept = 0
    for i in index[:count]:
        of_centre, step = _quality_of(pixels, samples, i)
        signed = limits.sign == 0 or limits.sign * step >= 0.0
        strong = limits.contrast == 0.0 or abs(step) > limits.contrast
        if of_centre >= limits.quality and of_centre > 0.0 and signed and strong:
            index[kept], quality[kept], contrast[kept] = i, of_centre, step
            kept += 1
    return index[:kept], quality[:kept], contrast[:kept]


def centres_of(image: NDArray[np.uint8], table: DiscTable, limits: Limits) -> Centres:
    """The centres of a table that are within some limits.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.
    table : DiscTable
        The camera's table.
    limits : Limits

    Raises
    ------
    FrameError
        If the image does not belong to the table.
    """
    expected = table.floor_xy.shape[:2]
    if image.shape != expected or image.dtype != np.uint8:
        raise FrameError(
            f"the image is {image.dtype} of shape {image.shape}: the table is for uint8 of shape "
            f"{expected}"
        )
    pixels = np.append(image, np.uint8(0))
    index, quality, contrast = find_centres(pixels, table.samples, table.whole, limits)
    places = np.empty((len(index), 2), np.int64)
    places[:, 0], places[:, 1] = table.column[index], table.row[index]
    return Centres(places, quality, contrast)


def quality_of_centres(
    image: NDArray[np.uint8], table: DiscTable
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Otsu's quality, and the contrast, of the outlines around every centre of a table.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.
    table : DiscTable
        The camera's table.

    Returns
    -------
    quality : (H, W) float64
        Between-class variance / total variance of the outlines' grey values, 0 to 1; 0 where the
        table has no centre.
    contrast : (H, W) float32
        Mean grey value of the inner outline minus that of the outer.

    Raises
    ------
    FrameError
        If the image does not belong to the table.
    """
    centres = centres_of(image, table, Limits(quality=0.0))
    u, v = centres.pixels.T
    quality, contrast = np.zeros(image.shape), np.zeros(image.shape, np.float32)
    quality[v, u], contrast[v, u] = centres.quality, centres.contrast
    return quality, contrast
