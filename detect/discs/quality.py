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

Most centres are ruled out by a subset of their samples with equally many of either outline: if the
subset is a share f of all samples and has the quality q_f, then 1 - q >= f (1 - q_f). Proof: let
the subset have the contrast d and the within-class variance s, the rest e and 0. Then all samples
have a within-class variance of at least f s + f (1 - f) ((d - e) / 2)^2, and the between-class
variance ((f d + (1 - f) e) / 2)^2. The former's share of the total is least at e = d + 4 s / d, and
is f (1 - q_f) there. (Samples outside the image make f larger.) Neighbouring centres share such
subsets (`lut.CentreGroups`), and the columns of a group are summed side by side. A grey value and
its square are added at once, as x 2^20 + x^2: both sums of up to 16 pixels fit into 32 bits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lut import GROUP_COLUMNS, GROUP_SAMPLES, CentreGroups, DiscTable
from redetect.array_types import ByteArray, Float32Array, FloatArray, GreyImage, IntArray
from redetect.compiled import kernel

# Unsigned, so that no code for negative indices is generated.
_U64, _U32, _I32, _F32 = np.uint64, np.uint32, np.int32, np.float32
_SAMPLES, _COLUMNS = _U64(GROUP_SAMPLES), _U64(GROUP_COLUMNS)
#: In a joint sum of grey values and their squares: first bit of the former, mask of the latter.
_SHIFT, _SQUARES = _U32(20), _U32((1 << 20) - 1)
#: Slack of the thresholds, so that rounding in single precision never rules out a good centre.
_ROUNDING = 1e-6


class Limits(NamedTuple):
    """Limits of the centres that are found."""

    quality: float  # minimum; 0 itself is excluded
    part_quality: float = 0.0  # minimum in the samples that a group shares
    contrast: float = 0.0  # has to be exceeded, grey levels, by its absolute value
    sign: int = 0  # 1 for centres lighter than their surroundings, -1 for darker ones, 0 for both


class Centres(NamedTuple):
    """Some centres, in scan order."""

    pixels: IntArray  # (N, 2) pixels (u, v)
    quality: FloatArray  # (N,)
    contrast: Float32Array  # (N,) mean of the inner outline minus that of the outer, grey levels


def least_part_quality(quality: float, samples: int) -> float:
    """Lower bound of the quality of a group's samples if all samples have `quality`."""
    return 1.0 - (1.0 - quality) * samples / GROUP_SAMPLES


@kernel(forceinline=True)
def _with_squares(grey: ByteArray, first: int, end: int) -> NDArray[np.uint32]:
    """Terms x 2^20 + x^2 of some pixels; uninitialised before and after them."""
    both = np.empty(len(grey), np.uint32)
    for i in range(_U64(first), _U64(end)):
        x = _U32(grey[i])
        both[i] = _U32(_U32(x << _SHIFT) + _U32(x * x))
    return both


@kernel(forceinline=True)
def _columns_left(
    both: NDArray[np.uint32], samples: NDArray[np.uint32], g: int, least_quality: np.float32
) -> np.int32:
    """Columns of a group that their shared samples do not rule out, one bit each."""
    left = _I32(0)
    for column in range(_COLUMNS):
        inner = outer = _U32(0)
        for k in range(_SAMPLES):
            inner = _U32(inner + both[samples[g, k, 0] + column])
            outer = _U32(outer + both[samples[g, k, 1] + column])
        a, b = _I32(inner >> _SHIFT), _I32(outer >> _SHIFT)
        squares = _I32(_I32(inner & _SQUARES) + _I32(outer & _SQUARES))
        difference, total = _I32(a - b), _I32(a + b)
        spread = _I32(_I32(2 * GROUP_SAMPLES) * squares) - _I32(total * total)
        enough = _F32(_I32(difference * difference)) >= least_quality * _F32(_I32(spread))
        left = _I32(left | _I32(_I32(enough) << _I32(column)))
    return left


@kernel(forceinline=True)
def _quality_of(
    grey: ByteArray, samples: NDArray[np.uint32], i: int, outside: int
) -> tuple[float, float]:
    """Quality and contrast of a centre."""
    # All sums are integers, hence exact. As floats they are not reordered by the compiler, which is
    # faster than gathering single samples into vectors.
    a = b = squares = 0.0
    n_inner = n_outer = 0
    for k in range(_U64(samples.shape[1])):
        inner, outer = samples[i, k, 0], samples[i, k, 1]
        x = float(grey[inner]) if inner < outside else 0.0
        y = float(grey[outer]) if outer < outside else 0.0
        a += x
        b += y
        squares += x * x + y * y
        n_inner += inner < outside
        n_outer += outer < outside
    difference, pairs = n_outer * a - n_inner * b, float(n_inner * n_outer)
    spread = (n_inner + n_outer) * squares - (a + b) * (a + b)
    quality = difference * difference / (pairs * spread) if spread > 0.0 else 0.0
    return quality, difference / pairs if pairs > 0.0 else 0.0


@kernel()
def find_centres(
    grey: ByteArray, outside: int, pixels: NDArray[np.int32],
    samples: NDArray[np.uint32], groups: CentreGroups, limits: Limits,
) -> Centres:  # fmt: skip
    """Find the centres of a `lut.DiscTable` within some limits.

    `grey` is the image in scan order, H W pixels, padded to at least `GROUP_COLUMNS` pixels;
    `outside` is H W.
    """
    least_part = _F32((1.0 - _ROUNDING) * limits.part_quality)
    both = _with_squares(grey, groups.begin, groups.end)
    left_of = np.empty(len(groups.samples), np.int32)
    for g in range(_U64(len(left_of))):
        left_of[g] = _columns_left(both, groups.samples, g, least_part)
    # The remaining centres are collected first, so that fetching of their samples overlaps.
    group = np.flatnonzero(left_of)
    centre = np.empty(len(group) * GROUP_COLUMNS, np.int64)
    most = 0
    for h in group:
        left = left_of[h] & groups.columns[h]
        i = int(groups.first[h]) - 1
        for k in range(GROUP_COLUMNS):
            i += (groups.columns[h] >> k) & 1
            centre[most] = i
            most += (left >> k) & 1
    found_at = np.empty((most, 2), np.int64)
    quality, contrast = np.empty(most), np.empty(most, np.float32)
    found = 0
    for c in centre[:most]:
        of_centre, step = _quality_of(grey, samples, c, outside)
        signed = limits.sign == 0 or limits.sign * step >= 0.0
        strong = limits.contrast == 0.0 or abs(step) > limits.contrast
        if of_centre >= limits.quality and of_centre > 0.0 and signed and strong:
            found_at[found, 0], found_at[found, 1] = pixels[c, 0], pixels[c, 1]
            quality[found], contrast[found] = of_centre, step
            found += 1
    return Centres(found_at[:found], quality[:found], contrast[:found])


def centres_of(image: GreyImage, table: DiscTable, limits: Limits) -> Centres:
    """Find the centres of a table within some limits.

    Parameters
    ----------
    image : (H, W) uint8
        Of the table's size.
    table : DiscTable
        The camera's.
    limits : Limits
    """
    grey = image.ravel()
    if image.size < GROUP_COLUMNS:
        grey = np.append(grey, np.zeros(GROUP_COLUMNS, np.uint8))
    return find_centres(grey, image.size, table.pixels, table.samples, table.groups, limits)
