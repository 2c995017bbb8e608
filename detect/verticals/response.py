"""Response: how much a step of the grey value along a vertical explains.

A *strip* image has a pixel (v, c) for row v of the vertical that crosses the horizon at column c
(see `lut.verticals`): the building's verticals are its columns, whatever the camera's pose and
distortion. With Gaussian weights g round a pixel of the strip and h, the distance across the
vertical in units of its weighted standard deviation, the response is the sign of the covariance
times

    Cov_g(h, I)^2 / (Var_g(I) + regulariser),

the squared correlation of grey value and distance (DLR Spatial Cognition data set report, line
detection). Affine changes of brightness change it only through the regulariser.

Moments are taken across the vertical in each row of the image, and averaged along the vertical as
far as that is seen (normalised convolution: H. Knutsson and C.-F. Westin, CVPR 1993). Tracks need
few pixels of the strip: these are evaluated where a track comes by (`extend`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from lut.verticals import VerticalTable

FloatArray = NDArray[np.float64]
SingleArray = NDArray[np.float32]

#: Grey values about 0 keep small variances exact in single precision.
MIDDLE_GREY = np.float32(128.0)
#: Rows of a vertical that are evaluated together.
BLOCK = 8
#: Verticals whose moments are kept: more than a track needs side by side.
_PLACES = 16
#: Weights are padded with zeros to a multiple of this: whole vectors.
_VECTOR = 8


class LineFilter(NamedTuple):
    """Weights of the filter.

    Attributes
    ----------
    reach : int
        r: the window across the line covers r pixels on either side.
    across : (4, T) float32
        For a window between two pixels, from r pixels left of the left one on: weights of the mean
        and of the covariance if it is on the left one, each followed by what is to be added for a
        whole pixel to the right. There are 2r + 2 of each; behind them zeros.
    half_length : int
        s: the window along the line covers s rows on either side.
    along : (L,) float32
        Along the line, of sum 1: 2s + 1 weights, and behind them zeros.
    along_sums : (L + 1,) float32
        Sums of these up to each.
    regulariser : float32
        Added to the variance in the window (grey values squared).
    """

    reach: int
    across: NDArray[np.float32]
    half_length: int
    along: NDArray[np.float32]
    along_sums: NDArray[np.float32]
    regulariser: np.float32


class Strip(NamedTuple):
    """A table of verticals as compiled code reads it, vertical by vertical.

    Attributes
    ----------
    column, rise : (W, H) float32
        Column at which each vertical crosses each row, and the tangent of the elevation there; NaN
        where it is not seen.
    first_row, last_row : (W,) int32
        First and last row in which each is seen.
    sine, cosine : (W,) float64
        Of their bearings.
    columns_per_rad : (W,) float64
        Columns per bearing there; NaN at the ends.
    bearing, anchor_row, robot_from_camera, row_aspect
        See `lut.verticals.VerticalTable`.
    """

    column: SingleArray
    rise: SingleArray
    first_row: NDArray[np.int32]
    last_row: NDArray[np.int32]
    sine: FloatArray
    cosine: FloatArray
    columns_per_rad: FloatArray
    bearing: FloatArray
    anchor_row: FloatArray
    robot_from_camera: FloatArray
    row_aspect: float


class StripResponse(NamedTuple):
    """The response of one image, vertical by vertical, as far as `extend` has evaluated it.

    Attributes
    ----------
    pixels : (H * W,) uint8
        Grey values in scan order.
    column, first_row, last_row
        See `Strip`.
    window : LineFilter
        The filter.
    value : (W, H) float32
        Responses, in [-1, 1]; positive where the image is brighter on the right.
    known : (W, B) bool
        Blocks of rows in which each vertical has them.
    moments : (S, 4, H) float32
        Means, covariances and mean squares across the verticals evaluated last, and 1 where these
        are defined, else 0. They are few, so that they stay in the cache: that of number c has
        place c modulo S.
    owner : (S, B) int32
        One more than the number of the vertical whose moments are in each block of rows; 0 for
        none.
    sums : (4, BLOCK) float32
        Sums along a vertical in a block.
    """

    pixels: NDArray[np.uint8]
    column: NDArray[np.float32]
    first_row: NDArray[np.int32]
    last_row: NDArray[np.int32]
    window: LineFilter
    value: NDArray[np.float32]
    known: NDArray[np.bool_]
    moments: NDArray[np.float32]
    owner: NDArray[np.int32]
    sums: NDArray[np.float32]


def weights_across(sigma_px: float, spacing_px: float = 1.0) -> FloatArray:
    """(2, 2r + 1) weights of samples that are a distance apart, and the same times the lever."""
    reach = math.ceil(3.0 * sigma_px)
    distance = spacing_px * np.arange(-reach, reach + 1)
    weight = np.exp(-0.5 * (distance / sigma_px) ** 2)
    weight /= weight.sum()
    return np.stack([weight, weight * distance / np.sqrt(weight @ distance**2)])


def line_filter(settings: LineSettings) -> LineFilter:
    """The filter of some settings."""
    weights = weights_across(settings.sigma_across_px)
    # Moments between two pixels are those of both, interpolated; so are the weights.
    left = np.pad(weights, [(0, 0), (0, 1)])
    step = np.pad(weights, [(0, 0), (1, 0)]) - left
    along = weights_across(settings.sigma_along_rows)[0]
    s = len(along) // 2
    along = np.pad(along, (0, -len(along) % _VECTOR))
    across = np.stack([left[0], step[0], left[1], step[1]])
    return LineFilter(
        reach=weights.shape[1] // 2,
        across=np.pad(across, [(0, 0), (0, -across.shape[1] % _VECTOR)]).astype(np.float32),
        half_length=s,
        along=along.astype(np.float32),
        along_sums=np.cumsum([0.0, *along]).astype(np.float32),
        regulariser=np.float32(settings.regulariser),
    )


def strip_of(table: VerticalTable) -> Strip:
    """The strip of a table."""
    per_rad = np.full(len(table.bearing_rad), np.nan)
    per_rad[1:-1] = 2.0 / (table.bearing_rad[2:] - table.bearing_rad[:-2])
    return Strip(
        column=np.ascontiguousarray(table.column.T),
        rise=np.ascontiguousarray(table.elevation_tan.T),
        first_row=table.first_row,
        last_row=table.last_row,
        sine=np.sin(table.bearing_rad),
        cosine=np.cos(table.bearing_rad),
        columns_per_rad=per_rad,
        bearing=table.bearing_rad,
        anchor_row=table.anchor_row,
        robot_from_camera=table.robot_from_camera,
        row_aspect=table.row_aspect,
    )


def strip_response(image: NDArray[np.uint8], strip: Strip, window: LineFilter) -> StripResponse:
    """The response of an image, of which nothing is evaluated yet."""
    width, height = strip.column.shape
    blocks = -(-height // BLOCK)
    return StripResponse(
        image.reshape(-1),
        strip.column,
        strip.first_row,
        strip.last_row,
        window,
        value=np.empty((width, height), np.float32),
        known=np.zeros((width, blocks), np.bool_),
        # Behind the filter's weights are zeros: what they are multiplied by must be finite.
        moments=np.zeros((_PLACES, 4, height), np.float32),
        owner=np.zeros((_PLACES, blocks), np.int32),
        sums=np.empty((4, BLOCK), np.float32),
    )


def line_response(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> SingleArray:
    """The response at every pixel of the strip.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        Widths of the filter, regulariser.

    Returns
    -------
    (H, W) float32
        In [-1, 1], positive where the image is brighter on the right; 0 where it is not defined.
    """
    response = strip_response(np.ascontiguousarray(image), strip_of(table), line_filter(settings))
    _extend_all(response)
    return response.value.T


@njit(cache=True, error_model="numpy")
def _extend_all(response: StripResponse) -> None:
    width, blocks = response.known.shape
    for c in range(width):
        for block in range(blocks):
            extend(response, c, block)


@njit(cache=True, error_model="numpy", forceinline=True)
def extend(response: StripResponse, c: int, block: int) -> None:
    """Evaluate vertical c in the rows of a block."""
    pixels, window, column = response.pixels, response.window, response.column[c]
    moments, owner = response.moments[c % _PLACES], response.owner[c % _PLACES]
    width, half_length = len(response.known), window.half_length
    begin, end = block * BLOCK, min((block + 1) * BLOCK, len(column))
    top, bottom = response.first_row[c], response.last_row[c] + 1
    first = max(begin - half_length, min(begin, top))
    after = min(end + half_length, max(end, bottom))
    for other in range(first // BLOCK, (after + BLOCK - 1) // BLOCK):
        if owner[other] != c + 1:
            owner[other] = c + 1
            rows = other * BLOCK, min((other + 1) * BLOCK, len(column))
            _take_moments(pixels, width, column, window.across, window.reach, rows, moments)
    _sum_along(moments, window, (begin, end), (top, bottom), response.sums)
    _respond(response.sums, window.regulariser, response.value[c, begin:end])
    response.known[c, block] = True


# Kernels with loops take arrays one by one: Numba counts references to arrays in tuples. Unsigned
# indices are not checked for being negative.


@njit(cache=True, error_model="numpy", forceinline=True)
def _take_moments(
    pixels: NDArray[np.uint8], width: int, column: NDArray[np.float32],
    weights: NDArray[np.float32], reach: int, rows: tuple[int, int], moments: NDArray[np.float32],
) -> None:  # fmt: skip
    """(4, H) moments across a vertical from the first of two rows to before the second."""
    means, covs, squares, inside = moments[0], moments[1], moments[2], moments[3]
    leftmost, rightmost = np.float32(reach), np.float32(width - 1 - reach)
    for v in range(np.uint64(rows[0]), np.uint64(rows[1])):
        x = column[v]
        mean = cov = square = one = np.float32(0.0)
        # Where the window leaves the image, the vertical counts as of middle grey.
        if x >= leftmost and x < rightmost:
            j = np.uint64(x)
            begin = v * np.uint64(width) + j - np.uint64(reach)
            mean, cov, square = _moments_across(pixels, begin, weights, x - np.float32(j))
            one = np.float32(1.0)
        means[v], covs[v], squares[v], inside[v] = mean, cov, square, one


@njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _sum_along(
    moments: NDArray[np.float32], window: LineFilter, rows: tuple[int, int], seen: tuple[int, int],
    sums: NDArray[np.float32],
) -> None:  # fmt: skip
    """(4, BLOCK) weighted sums of moments and of 1, over the rows on which a vertical is seen."""
    along, share, half_length = window.along, window.along_sums, window.half_length
    means, covs, squares, inside = moments[0], moments[1], moments[2], moments[3]
    for v in range(rows[0], rows[1]):
        mean = cov = square = np.float32(0.0)
        own_share = np.float32(1.0)
        # A window that leaves the image has no response, nor has a vertical that is not seen.
        if inside[v] > 0.0:
            begin = v - half_length
            first, after = max(begin, seen[0]), min(begin + len(along), seen[1])
            mean, cov, square = _weighted_sums(
                along[first - begin : after - begin], means, covs, squares, np.uint64(first)
            )
            own_share = share[after - begin] - share[first - begin]
        i = np.uint64(v - rows[0])
        sums[0, i], sums[1, i], sums[2, i], sums[3, i] = mean, cov, square, own_share


@njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _respond(sums: NDArray[np.float32], noise: np.float32, value: NDArray[np.float32]) -> None:
    for i in range(np.uint64(len(value))):
        scale = np.float32(1.0) / sums[3, i]
        mean, cov = sums[0, i] * scale, sums[1, i] * scale
        # Rounding can make a vanishing variance negative.
        value[i] = cov * abs(cov) / (abs(sums[2, i] * scale - mean * mean) + noise)


# Sums in any order become vectors; inlined, their order is that of the kernel that has them.


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"}, forceinline=True)
def _moments_across(
    pixels: NDArray[np.uint8], begin: np.uint64, weights: NDArray[np.float32], part: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """Mean, covariance and mean square in a window `part` of a pixel right of its first one."""
    mean = cov = square = np.float32(0.0)
    # At the end of the image only pixels of weight 0 are missing.
    for k in range(np.uint64(min(weights.shape[1], len(pixels) - np.int64(begin)))):
        grey = np.float32(pixels[begin + k]) - MIDDLE_GREY
        weighted = (weights[0, k] + part * weights[1, k]) * grey
        mean += weighted
        square += weighted * grey
        cov += (weights[2, k] + part * weights[3, k]) * grey
    return mean, cov, square


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"}, forceinline=True)
def _weighted_sums(
    weights: NDArray[np.float32], one: NDArray[np.float32], two: NDArray[np.float32],
    three: NDArray[np.float32], begin: np.uint64,
) -> tuple[np.float32, np.float32, np.float32]:  # fmt: skip
    """Sums of three arrays from some place on."""
    first = second = third = np.float32(0.0)
    for k in range(np.uint64(len(weights))):
        first += weights[k] * one[begin + k]
        second += weights[k] * two[begin + k]
        third += weights[k] * three[begin + k]
    return first, second, third
