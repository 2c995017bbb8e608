"""The quality of centres: how well two outlines on the floor separate the grey values.

A disc centred at a pixel has an inner outline within its edge and an outer one beyond it
(`lut.outlines`). Taken as two classes, their grey values have Otsu's quality (N. Otsu, A Threshold
Selection Method from Gray-Level Histograms, 1979; DLR Spatial Cognition data set report, circle
detection): the between-class variance over the total one. With n = n_inner + n_outer samples in the
image,

    difference = n_outer sum(inner) - n_inner sum(outer)
    spread     = n sum(x^2) - (sum x)^2
    quality    = difference^2 / (n_inner n_outer spread)
    contrast   = difference / (n_inner n_outer)

All of these are integers, so the only rounding is that of the final division.

Most centres are ruled out by their first samples: if these are a share f of all samples, equally
many of either outline, and have the quality q_f, then 1 - q >= f (1 - q_f). Proof: let them have
the contrast d and the within-class variance s, the rest e and 0. Then all samples have a
within-class variance of at least f s + f (1 - f) ((d - e) / 2)^2, and the between-class variance
((f d + (1 - f) e) / 2)^2. The former's share of the total is least at e = d + 4 s / d, and is
f (1 - q_f) there. (Samples outside the image make f larger.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lut import DiscTable
from redetect.array_types import ByteArray, Float32Array, FloatArray, GreyImage, IntArray
from redetect.compiled import kernel

_FIRST = 10  #: Number of samples of each outline that may rule a centre out.
#: Slack of the thresholds, so that rounding never rules out a good centre.
_ROUNDING = 1e-6


class Limits(NamedTuple):
    """Limits of the centres that are found."""

    quality: float  # minimum; 0 itself is excluded
    contrast: float = 0.0  # has to be exceeded, grey levels, by its absolute value
    sign: int = 0  # 1 for centres lighter than their surroundings, -1 for darker ones, 0 for both


class Centres(NamedTuple):
    """Some centres, in scan order."""

    pixels: IntArray  # (N, 2) pixels (u, v)
    quality: FloatArray  # (N,)
    contrast: Float32Array  # (N,) mean of the inner outline minus that of the outer, grey levels


@kernel(forceinline=True)
def _quality_of(
    grey: ByteArray, samples: NDArray[np.uint32], i: int, count: int
) -> tuple[float, float, bool]:
    """Quality and contrast of the first samples of a centre; whether all are in the image."""
    outside = len(grey)
    a = b = squares = np.int64(0)
    n_inner = n_outer = 0
    for k in range(count):
        inner, outer = samples[i, k, 0], samples[i, k, 1]
        if inner < outside:
            x = np.int64(grey[inner])
            a, squares, n_inner = a + x, squares + x * x, n_inner + 1
        if outer < outside:
            x = np.int64(grey[outer])
            b, squares, n_outer = b + x, squares + x * x, n_outer + 1
    difference, pairs = n_outer * a - n_inner * b, n_inner * n_outer
    spread = (n_inner + n_outer) * squares - (a + b) * (a + b)
    quality = difference * difference / (pairs * spread) if spread > 0 and pairs > 0 else 0.0
    contrast = difference / pairs if pairs > 0 else 0.0
    return quality, contrast, n_inner == count and n_outer == count


@kernel()
def _find_centres(
    grey: ByteArray, pixels: NDArray[np.int32], samples: NDArray[np.uint32], limits: Limits
) -> Centres:
    found_at = np.empty((len(samples), 2), np.int64)
    quality, contrast = np.empty(len(samples)), np.empty(len(samples), np.float32)
    count, found = samples.shape[1], 0
    # Lower bound of the quality of the first samples.
    least_first = (1.0 - _ROUNDING) * (1.0 - (1.0 - limits.quality) * count / _FIRST)
    for i in range(len(samples)):
        if count > _FIRST:
            of_first, _, inside = _quality_of(grey, samples, i, _FIRST)
            if inside and of_first < least_first:
                continue
        of_centre, step, _ = _quality_of(grey, samples, i, count)
        signed = limits.sign == 0 or limits.sign * step >= 0.0
        strong = limits.contrast == 0.0 or abs(step) > limits.contrast
        if of_centre >= limits.quality and of_centre > 0.0 and signed and strong:
            found_at[found, 0], found_at[found, 1] = pixels[i, 0], pixels[i, 1]
            quality[found], contrast[found] = of_centre, step
            found += 1
    return Centres(found_at[:found], quality[:found], contrast[:found])


def centres_of(image: GreyImage, table: DiscTable, limits: Limits) -> Centres:
    """Find the centres of a table within some limits, in an (H, W) image of its size."""
    return _find_centres(image.ravel(), table.pixels, table.samples, limits)
