"""Response: how well a step edge along a vertical explains the grey values.

With Gaussian weights g around a point on a vertical and h, the distance across the vertical in
units of its weighted standard deviation, the response is the sign of the covariance times

    Cov_g(h, I)^2 / (Var_g(I) + regulariser),

the squared correlation of grey value and distance (DLR Spatial Cognition data set report, line
detection). Affine changes of brightness change it only through the regulariser.

It is evaluated in a *stripe* along a path: a row of the stripe has the grey values and their
squares at integer distances from the path in an image row, interpolated between pixels. Both are
averaged along the visible part of the path (normalised convolution: H. Knutsson and C.-F. Westin,
CVPR 1993), then across it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from detect.line_settings import LineSettings
from lut.verticals import VerticalTable
from redetect.array_types import Float32Array, FloatArray, GreyImage
from redetect.compiled import kernel

#: Subtracted from grey values, so that small variances are accurate in single precision.
MIDDLE_GREY = np.float32(128.0)
STRIPE_ROWS = 16  #: Rows of a stripe in which the response is evaluated.
#: Least number of columns in which it is evaluated; the stripe's width is a multiple of `_VECTOR`.
_LEAST_COLUMNS, _VECTOR = 8, 8
_UNROLLED = 7  #: Weights along the path that are applied at a time.


class LineFilter(NamedTuple):
    """Weights of the filter."""

    reach: int  # r: the window across the line covers r pixels on either side
    #: (2, T) across the line: 2r + 1 weights of sum 1, and the same times h; padded by zeros
    across: Float32Array
    half_length: int  # s: the window along the line covers s rows on either side
    along: Float32Array  # (L,) along the line: 2s + 1 weights of sum 1; padded by zeros
    regulariser: np.float32  # added to the variance in the window (grey values squared)


class Strip(NamedTuple):
    """A table of verticals in the layout for kernels, vertical by vertical."""

    #: (W, H) column of each vertical in each row, and the elevation's tangent; NaN if not visible
    column: Float32Array
    rise: Float32Array
    #: (W,) of their bearings
    sine: FloatArray
    cosine: FloatArray
    columns_per_rad: FloatArray  # (W,) columns per bearing there; NaN at the ends
    # As in `lut.verticals.VerticalTable`:
    bearing: FloatArray
    anchor_row: FloatArray
    robot_from_camera: FloatArray
    row_aspect: float


class Stripe(NamedTuple):
    """A stripe of C columns and B rows, and its intermediate results."""

    window: LineFilter
    #: (B + 2s,) columns at which the path crosses rows, from s above the first; NaN if not visible
    path: FloatArray
    #: (2, (B + L) C) grey values relative to the middle grey and their squares, row by row
    samples: Float32Array
    means: Float32Array  # (2, B C + T) averages of these along the path
    moments: Float32Array  # (3, B C) mean, covariance and mean square in windows across it
    #: (B, C) the first column is r pixels inside the stripe; the last 2r columns are invalid
    response: Float32Array
    middle: int  # the column of the response that is on the path


def weights_across(sigma_px: float, spacing_px: float = 1.0) -> FloatArray:
    """(2, 2r + 1) weights of samples with some spacing, and the same times the distance h."""
    reach = math.ceil(3.0 * sigma_px)
    distance = spacing_px * np.arange(-reach, reach + 1)
    weight = np.exp(-0.5 * (distance / sigma_px) ** 2)
    weight /= weight.sum()
    return np.stack([weight, weight * distance / np.sqrt(weight @ distance**2)])


def line_filter(settings: LineSettings) -> LineFilter:
    """The filter of some settings."""
    across = weights_across(settings.sigma_across_px)
    along = weights_across(settings.sigma_along_rows)[0]
    return LineFilter(
        reach=across.shape[1] // 2,
        across=padded(across),
        half_length=len(along) // 2,
        along=padded(along),
        regulariser=np.float32(settings.regulariser),
    )


def padded(weights: FloatArray) -> Float32Array:
    """Pad weights with zeros (last axis) to a number that is summed together."""
    behind = [(0, 0)] * (weights.ndim - 1) + [(0, -weights.shape[-1] % _UNROLLED)]
    return np.pad(weights, behind).astype(np.float32)


def strip_of(table: VerticalTable) -> Strip:
    """The strip of a table."""
    per_rad = np.full(len(table.bearing_rad), np.nan)
    per_rad[1:-1] = 2.0 / (table.bearing_rad[2:] - table.bearing_rad[:-2])
    return Strip(
        column=np.ascontiguousarray(table.column.T),
        rise=np.ascontiguousarray(table.elevation_tan.T),
        sine=np.sin(table.bearing_rad),
        cosine=np.cos(table.bearing_rad),
        columns_per_rad=per_rad,
        bearing=table.bearing_rad,
        anchor_row=table.anchor_row,
        robot_from_camera=table.robot_from_camera,
        row_aspect=table.row_aspect,
    )


@kernel()
def empty_stripe(window: LineFilter) -> Stripe:
    """Buffers for the stripes of a filter."""
    taps, length = window.across.shape[1], len(window.along)
    columns = -(-(_LEAST_COLUMNS + 2 * window.reach) // _VECTOR) * _VECTOR
    size = STRIPE_ROWS * columns
    return Stripe(
        window,
        np.empty(STRIPE_ROWS + 2 * window.half_length),
        # Finite, since the padding of the filter's weights multiplies these values by zero.
        np.zeros((2, size + length * columns), np.float32),
        np.zeros((2, size + taps), np.float32),
        np.empty((3, size), np.float32),
        np.empty((STRIPE_ROWS, columns), np.float32),
        columns // 2 - window.reach,
    )


@kernel(forceinline=True)
def respond(image: GreyImage, top: int, stripe: Stripe) -> None:
    """Evaluate the response in a stripe along its path, from row `top` of the image on."""
    path, response, window = stripe.path, stripe.response, stripe.window
    reach = window.reach
    columns = response.shape[1]
    left = stripe.middle + reach
    inside = _sample(image, top - window.half_length, left, path, stripe.samples)
    # Loops, since each inlined call is compiled separately.
    for k in range(2):
        correlate(stripe.samples[k], window.along, columns, stripe.means[k, : response.size])
    for k in range(3):
        correlate(stripe.means[k // 2], window.across[k % 2], 1, stripe.moments[k])
    if not inside:
        _normalise(path, window.along, stripe.moments)
    divide(stripe.moments, window.regulariser, response.reshape(-1))
    if not inside:
        _leave_out(path[window.half_length :], left, image.shape[1] - 2 * reach - 1, response)


@kernel(forceinline=True)
def _leave_out(path: FloatArray, left: int, last: int, response: Float32Array) -> None:
    """Set the response to 0 where the path is not visible or windows leave the image."""
    columns = response.shape[1]
    for b in range(STRIPE_ROWS):
        first = last if math.isnan(path[b]) else math.floor(path[b]) - left
        for c in range(min(-first, columns)):
            response[b, c] = 0.0
        for c in range(max(last - first, 0), columns):
            response[b, c] = 0.0


@kernel(fastmath={"contract"}, forceinline=True)
def _sample(
    image: GreyImage, first_row: int, left: int, path: FloatArray, samples: Float32Array
) -> bool:
    """Grey values and their squares along a path; whether all are inside the image."""
    grey, square = samples[0], samples[1]
    pixels, width = image.reshape(-1), image.shape[1]
    # The rows are followed by as many as the filter has weights.
    columns = 2 * left
    inside = True
    for i in range(len(path)):
        seen = not math.isnan(path[i])
        j = math.floor(path[i]) - left if seen else 0
        # Beyond the array there are no pixels, beyond a row those of the next one.
        begin = (first_row + i) * width + j
        first, after = max(-j, 0), min(width - 1 - j, columns)
        if not seen or begin < 0 or begin + columns >= len(pixels):
            path[i] = np.nan
            first, after = columns, columns
        else:
            part = np.float32(path[i] - math.floor(path[i]))
            rest = np.float32(1.0) - part
            place, pixel = np.uint64(i * columns), np.uint64(begin)
            for c in range(np.uint64(columns)):
                a = np.float32(pixels[pixel + c]) - MIDDLE_GREY
                b = np.float32(pixels[pixel + c + np.uint64(1)]) - MIDDLE_GREY
                grey[place + c] = rest * a + part * b
                square[place + c] = rest * (a * a) + part * (b * b)
        inside = inside and first == 0 and after == columns
        for c in range(first):
            grey[i * columns + c] = square[i * columns + c] = 0.0
        for c in range(after, columns):
            grey[i * columns + c] = square[i * columns + c] = 0.0
    return inside


@kernel(fastmath={"contract"}, forceinline=True)
def correlate(values: Float32Array, weights: Float32Array, stride: int, sums: Float32Array) -> None:
    """Weighted sums of values a stride apart, several weights in one pass."""
    for c in range(len(sums)):
        sums[c] = 0.0
    step = np.uint64(stride)
    for m in range(np.uint64(0), np.uint64(len(weights)), np.uint64(_UNROLLED)):
        for c in range(np.uint64(len(sums))):
            total = sums[c]
            for k in range(np.uint64(_UNROLLED)):
                total += weights[m + k] * values[c + (m + k) * step]
            sums[c] = total


@kernel(forceinline=True)
def _normalise(path: FloatArray, along: Float32Array, moments: Float32Array) -> None:
    """Divide moments by the weights of the rows on which the path is visible."""
    columns = moments.shape[1] // STRIPE_ROWS
    for b in range(STRIPE_ROWS):
        share = np.float32(0.0)
        for m in range(len(path) - STRIPE_ROWS + 1):
            if not math.isnan(path[b + m]):
                share += along[m]
        for k in range(3):
            for c in range(b * columns, (b + 1) * columns):
                moments[k, c] /= share


@kernel(fastmath={"contract"}, forceinline=True)
def divide(moments: Float32Array, regulariser: np.float32, response: Float32Array) -> None:
    """Compute the response from mean, covariance and mean square."""
    mean, cov, mean_square = moments[0], moments[1], moments[2]
    for c in range(len(response)):
        # Rounding can make a vanishing variance negative.
        variance = abs(mean_square[c] - mean[c] * mean[c])
        response[c] = cov[c] * abs(cov[c]) / (variance + regulariser)
