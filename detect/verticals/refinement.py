"""Refinement: moves straight lines through tracks to the steepest grey value gradient.

Lines are described in a chart around a reference bearing phi: a direction at bearing phi + d whose
elevation has tangent e is X = tan(d), Z = e / cos(d). There every line is straight, X = a + b Z; a
is the tangent of its bearing at the horizon relative to phi, b its lean.

The filter H(u) = sum of d G(d) I / sigma^2 over the pixels, d their distances from u and G a
Gaussian, measures the height of a step of the grey value at u. H has its maximum there; its first
and second derivatives, times sigma^2, have the weights (q - 1) G and (q - 3) d / sigma^2 G,
q = d^2 / sigma^2. Newton's method moves a line to the maximum of the sum of H over its rows, each
evaluated at the sub-pixel column at which the line crosses it. The covariance of the maximum
assumes that noise is independent from row to row and uses the rows' own gradients (a sandwich
estimator), so it needs no noise model.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.verticals.response import MIDDLE_GREY, Strip
from detect.verticals.tracking import LineTracks
from redetect.array_types import BoolArray, Float32Array, FloatArray, GreyImage, IntArray
from redetect.compiled import kernel

#: Sub-pixel positions for which weights are tabulated; between them, the derivative interpolates.
SUBPIXELS = 64
_REACH = 4.4  #: Standard deviations beyond which the Gaussian is negligible.
_STILL_PX = 0.02  #: A step is not repeated if it moved all rows by less than this, pixels.


class LineFits(NamedTuple):
    """Straight lines through tracks, each in the chart around a reference bearing."""

    reference_rad: FloatArray  # (T,) bearing of the chart's origin
    pixel_rad: FloatArray  # (T,) width of a pixel at the horizon there
    line: FloatArray  # (T, 2) a, b; NaN without a line
    covariance: FloatArray  # (T, 2, 2) covariance of a, b, due to noise
    #: (T,) root-mean-square distance of the tracked points from their straight line, pixels
    scatter_px: FloatArray
    shift_px: FloatArray  # (T,) displacement of the line's middle by the refinement, pixels
    spread: FloatArray  # (T,) variance of the points' Z
    #: (T,) height of the step in grey values, at the fine scale; NaN without refinement
    contrast: FloatArray
    #: (T,) contrast at the fine scale relative to the coarse one, at most 1; 1 without refinement
    sharpness: FloatArray


class StepFilters(NamedTuple):
    """The K steps of the refinement, and tables of their filters."""

    #: (K,) the filter between pixels i and i + 1 covers 2 half pixels, from i - half + 1
    half: IntArray
    #: (K, 2, SUBPIXELS, N) weights of the first and second derivative of the step's height, times
    #: sigma^2, at sub-pixel positions; those of the 2 half pixels come first, then zeros
    weights: Float32Array
    #: (2, SUBPIXELS, M) weights of the height itself, at the fine and the coarse scale
    heights: Float32Array
    #: (K,) largest displacement of a line's middle by a step, pixels; a larger step ends the
    #: refinement and is not made. Without steps the lines stay as tracked.
    farthest: FloatArray
    same: BoolArray  # (K,) whether a step has the filter of the one before it


def step_filters(settings: LineSettings) -> StepFilters:
    """Filters of the settings' steps and of the two contrasts."""
    sigmas = [sigma for sigma, _ in settings.refine_steps_px]
    half = [_half(sigma) for sigma in sigmas]
    weights = np.zeros((len(sigmas), 2, SUBPIXELS, 2 * max(half, default=0)))
    for own, sigma, h in zip(weights, sigmas, half):
        own[..., : 2 * h] = gaussian_steps(sigma, h)[1:]
    # Both contrasts use the same pixels, some with weight 0.
    scales = settings.fine_scale_px, settings.coarse_scale_px
    heights = [gaussian_steps(sigma, _half(sigma))[0] for sigma in scales]
    taps = max(table.shape[1] for table in heights)
    heights = [np.pad(h, [(0, 0), ((taps - h.shape[1]) // 2,) * 2]) for h in heights]
    return StepFilters(
        half=np.array(half, np.int64),
        weights=weights.astype(np.float32),
        heights=np.stack(heights).astype(np.float32),
        farthest=np.array([distance for _, distance in settings.refine_steps_px], np.float64),
        same=np.array([k > 0 and sigmas[k] == sigmas[k - 1] for k in range(len(sigmas))], np.bool_),
    )


def _half(sigma: float) -> int:
    """Half the number of pixels that a filter covers, rounded up to whole vectors."""
    return 4 * math.ceil(_REACH * sigma / 4.0)


def gaussian_steps(sigma: float, half: int) -> FloatArray:
    """(3, SUBPIXELS, 2 half) weights of a step's height, and of its derivatives times sigma^2."""
    d = np.arange(-half + 1, half + 1) - (np.arange(SUBPIXELS)[:, None] + 0.5) / SUBPIXELS
    q = (d / sigma) ** 2
    g = np.exp(-0.5 * q)
    weights = np.stack([d / sigma**2 * g, (q - 1.0) * g, (q - 3.0) * d / sigma**2 * g])
    # Windows that are cut off must not depend on the image's brightness.
    return np.asarray(weights - weights.mean(axis=-1, keepdims=True))


class Crossings(NamedTuple):
    """Crossings of a line with the N rows of its track: columns, NaN for none, and derivatives."""

    row: NDArray[np.int32]
    column: FloatArray
    by_a: FloatArray
    by_b: FloatArray


class NewtonStep(NamedTuple):
    """A step of Newton's method: changes of a and b, and their covariance after that."""

    change_a: float
    change_b: float
    aa: float
    ab: float
    bb: float


class Eigenline(NamedTuple):
    """A line a + b Z, the variance across it, and mean and variance of the points' Z."""

    a: float
    b: float
    scatter: float
    middle: float
    spread: float


@kernel(inline="always")
def _fit_points(
    strip: Strip, tracks: LineTracks, t: int, least: tuple[int, float], chart: FloatArray,
    fits: LineFits, k: int,
) -> Eigenline:  # fmt: skip
    """Fit a line to track t by the eigen-decomposition of its points' scatter matrix.

    Tracks with fewer points or a lower sum of scores than `least` get none. X and Z of the points
    are written to `chart` (2, N), the line to index k of `fits`; the covariance is that of
    independent points with the observed scatter.
    """
    begin, end = tracks.bounds[t], tracks.bounds[t + 1]
    n, row, column, score = end - begin, tracks.row, tracks.column, tracks.score
    middle = total = 0.0
    for i in range(begin, end):
        middle += column[i]
        total += score[i]
    origin = min(max(int(middle / n + 0.5), 1), len(strip.bearing) - 2)
    pixel = 1.0 / abs(strip.columns_per_rad[origin])
    fits.reference_rad[k], fits.pixel_rad[k] = strip.bearing[origin], pixel
    if n < least[0] or total < least[1]:
        return Eigenline(np.nan, np.nan, np.nan, np.nan, np.nan)
    x, z = chart[0, :n], chart[1, :n]
    _place_in_chart(strip, row[begin:end], column[begin:end], strip.bearing[origin], x, z)
    line = _eigenline(x, z)
    fits.scatter_px[k], fits.spread[k] = math.sqrt(line.scatter) / pixel, line.spread
    if line.spread > line.scatter:
        variance = line.scatter / (max(n - 2, 1) * line.spread)
        fits.line[k, 0], fits.line[k, 1] = line.a, line.b
        fits.covariance[k, 0, 0] = (line.spread + line.middle**2) * variance
        fits.covariance[k, 0, 1] = fits.covariance[k, 1, 0] = -line.middle * variance
        fits.covariance[k, 1, 1] = variance
        fits.shift_px[k] = 0.0
    return line


@kernel()
def fit_lines(
    image: GreyImage, strip: Strip, tracks: LineTracks, filters: StepFilters,
    least: tuple[int, float], first: int,
) -> LineFits:  # fmt: skip
    """Fit lines to tracks from `first` on, and refine them on the grey values in some steps.

    Tracks with fewer points or a lower sum of scores than `least` have no line.
    """
    count, height = len(tracks.polarity) - first, image.shape[0]
    own, nan = np.empty((2, count)), np.full((4, count), np.nan)
    ab, of_ab = np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan)
    fits = LineFits(own[0], own[1], ab, of_ab, nan[0], nan[1], nan[2], nan[3], np.ones(count))
    chart, column = np.empty((2, height)), np.empty(height)
    by_a, by_b = np.empty(height), np.empty(height)
    for k in range(count):
        t = first + k
        line = _fit_points(strip, tracks, t, least, chart, fits, k)
        if len(filters.half) == 0 or np.isnan(fits.line[k, 0]):
            continue
        begin, end = tracks.bounds[t], tracks.bounds[t + 1]
        n, sign, pixel = end - begin, tracks.polarity[t], fits.pixel_rad[k]
        crossings = Crossings(tracks.row[begin:end], column[:n], by_a[:n], by_b[:n])
        x, z = chart[0, :n], chart[1, :n]
        _cross_rows(strip, tracks.column[begin:end], x, z, line, crossings)
        steps = _climb(image, crossings, filters, sign, line.middle, pixel)
        # NaN where there is no maximum.
        fits.line[k, 0] += steps.change_a
        fits.line[k, 1] += steps.change_b
        fits.covariance[k, 0, 0], fits.covariance[k, 1, 1] = steps.aa, steps.bb
        fits.covariance[k, 0, 1] = fits.covariance[k, 1, 0] = steps.ab
        fits.shift_px[k] = abs(steps.change_a + steps.change_b * line.middle) / pixel
        if np.isnan(steps.aa):
            continue
        rows, fine, coarse = _contrasts(image, crossings, filters.heights)
        fits.contrast[k] = sign * fine / rows if rows > 0 else 0.0
        sharp = fine / coarse if sign * coarse > 0.0 else 1.0
        fits.sharpness[k] = min(max(sharp, 0.0), 1.0)
    return fits


@kernel(inline="always")
def _place_in_chart(
    strip: Strip, row: NDArray[np.int32], column: FloatArray, reference: float,
    x: FloatArray, z: FloatArray,
) -> None:  # fmt: skip
    """X and Z of a track's points."""
    sine, cosine, rise = strip.sine, strip.cosine, strip.rise
    left, ahead = math.sin(reference), math.cos(reference)
    for i in range(len(row)):
        j = min(int(column[i]), len(sine) - 2)
        f = column[i] - j
        s = (1.0 - f) * sine[j] + f * sine[j + 1]
        c = (1.0 - f) * cosine[j] + f * cosine[j + 1]
        e = (1.0 - f) * rise[j, row[i]] + f * rise[j + 1, row[i]]
        x[i] = (s * ahead - c * left) / (c * ahead + s * left)
        z[i] = e / (c * ahead + s * left)


@kernel(inline="always")
def _eigenline(x: FloatArray, z: FloatArray) -> Eigenline:
    """The line along the larger eigenvalue's eigenvector of the points' scatter."""
    n = len(x)
    mean_x = mean_z = xx = xz = zz = 0.0
    share = 1.0 / n
    for i in range(n):
        mean_x += share * x[i]
        mean_z += share * z[i]
    for i in range(n):
        off_x, off_z = x[i] - mean_x, z[i] - mean_z
        xx += share * off_x * off_x
        xz += share * off_x * off_z
        zz += share * off_z * off_z
    half = 0.5 * (xx - zz)
    smaller = max(0.5 * (xx + zz) - math.sqrt(half * half + xz * xz), 0.0)
    b = xz / (zz - smaller)
    return Eigenline(mean_x - b * mean_z, b, smaller, mean_z, zz)


@kernel(inline="always")
def _cross_rows(
    strip: Strip, tracked: FloatArray, x: FloatArray, z: FloatArray, line: Eigenline,
    crossings: Crossings,
) -> None:  # fmt: skip
    """Compute the crossings of a line with the rows of its track, near the track's points."""
    bearing, column = strip.bearing, strip.column
    row, crossing, by_a, by_b = crossings.row, crossings.column, crossings.by_a, crossings.by_b
    last = len(bearing) - 1
    for i in range(len(x)):
        v = row[i]
        j = min(int(tracked[i]), last - 1)
        # In the strip, to first order in X: d atan(X) = dX / (1 + X^2).
        by_x = 1.0 / ((1.0 + x[i] * x[i]) * (bearing[j + 1] - bearing[j]))
        place = tracked[i] + (line.a + line.b * z[i] - x[i]) * by_x
        j = min(max(int(place), 0), last - 1)
        du_dc = column[j + 1, v] - column[j, v]
        # The neighbouring vertical may have ended.
        if place >= 0.0 and place <= last and math.isfinite(du_dc):
            crossing[i] = column[j, v] + (place - j) * du_dc
            by_a[i] = by_x * du_dc
            by_b[i] = by_x * du_dc * z[i]
        else:
            crossing[i] = np.nan
            by_a[i] = by_b[i] = 0.0


@kernel(inline="always")
def _climb(
    image: GreyImage, crossings: Crossings, filters: StepFilters, sign: float,
    middle: float, pixel: float,
) -> NewtonStep:  # fmt: skip
    """The sum of all steps of a line, and its covariance after the last.

    The steps move the crossings in proportion to their derivatives.
    """
    column, by_a, by_b = crossings.column, crossings.by_a, crossings.by_b
    a = b = 0.0
    aa = ab = bb = np.nan
    moved_px = np.inf
    for step in range(len(filters.half)):
        if filters.same[step] and moved_px <= _STILL_PX:
            continue
        weights, half = filters.weights[step], filters.half[step]
        newton = newton_step(image, crossings, weights, half, sign)
        # Without a maximum at this scale, the result of the coarser ones is kept.
        if not abs(newton.change_a + newton.change_b * middle) <= filters.farthest[step] * pixel:
            break
        a += newton.change_a
        b += newton.change_b
        aa, ab, bb = newton.aa, newton.ab, newton.bb
        moved_px = 0.0
        for i in range(len(column)):
            change = newton.change_a * by_a[i] + newton.change_b * by_b[i]
            column[i] += change
            moved_px = max(moved_px, abs(change))
    if np.isnan(aa):
        a = b = np.nan
    return NewtonStep(a, b, aa, ab, bb)


@kernel(fastmath={"contract", "reassoc"}, forceinline=True)
def newton_step(
    image: GreyImage, crossings: Crossings, weights: Float32Array, half: int, sign: float
) -> NewtonStep:
    """One Newton step towards the maximum of the sum of the responses of a line's rows.

    `weights` and `half` are those of a step in `StepFilters`; the sign is 1 if the image is
    brighter on the right, else -1. NaN if there is no maximum at this scale.
    """
    # Unpacked once, since Numba counts references at every access to an array in a tuple.
    row, column, to_a, to_b = crossings.row, crossings.column, crossings.by_a, crossings.by_b
    used = 0
    g_a = g_b = h_aa = h_ab = h_bb = m_aa = m_ab = m_bb = 0.0
    for i in range(len(row)):
        inside, slope, bend, off = _filtered(image, row[i], column[i], weights, half)
        if inside:
            used += 1
            by_a, by_b = to_a[i], to_b[i]
            gradient = slope + off * bend
            g_a += gradient * by_a
            g_b += gradient * by_b
            h_aa += bend * by_a * by_a
            h_ab += bend * by_a * by_b
            h_bb += bend * by_b * by_b
            m_aa += gradient * gradient * by_a * by_a
            m_ab += gradient * gradient * by_a * by_b
            m_bb += gradient * gradient * by_b * by_b
    determinant = h_aa * h_bb - h_ab * h_ab
    if used < 5 or not (sign * h_aa < 0.0 and determinant > 1e-12 * h_aa * h_bb):
        return NewtonStep(np.nan, np.nan, np.nan, np.nan, np.nan)
    i_aa, i_ab, i_bb = h_bb / determinant, -h_ab / determinant, h_aa / determinant
    # Two parameters were fitted to the same rows.
    scale = used / (used - 2.0)
    left_aa, left_ab = i_aa * m_aa + i_ab * m_ab, i_aa * m_ab + i_ab * m_bb
    left_ba, left_bb = i_ab * m_aa + i_bb * m_ab, i_ab * m_ab + i_bb * m_bb
    return NewtonStep(
        -(i_aa * g_a + i_ab * g_b),
        -(i_ab * g_a + i_bb * g_b),
        scale * (left_aa * i_aa + left_ab * i_ab),
        scale * (left_aa * i_ab + left_ab * i_bb),
        scale * (left_ba * i_ab + left_bb * i_bb),
    )


@kernel(forceinline=True)
def _contrasts(
    image: GreyImage, crossings: Crossings, heights: Float32Array
) -> tuple[int, float, float]:
    """The number of visible rows, and the sums of their heights at two scales."""
    row, column, half = crossings.row, crossings.column, heights.shape[2] // 2
    rows, fine, coarse = 0, 0.0, 0.0
    for i in range(len(row)):
        inside, one, other, _ = _filtered(image, row[i], column[i], heights, half)
        if inside:
            rows += 1
            fine += one
            coarse += other
    return rows, fine, coarse


# Sums in any order are vectorised; inlined, so that each kernel has its own fixed order.
@kernel(fastmath={"contract", "reassoc"}, forceinline=True)
def _filtered(
    image: GreyImage, v: int, u: float, weights: Float32Array, half: int
) -> tuple[bool, float, float, float]:
    """Whether the window at a position is inside the image; the values of two filters there.

    Finally the distance from the nearest tabulated position.
    """
    if not (u > half and u < image.shape[1] - 1 - half):
        return False, 0.0, 0.0, 0.0
    j = int(u)
    node = int((u - j) * SUBPIXELS)
    grey = image[v, j - half + 1 : j + half + 1]
    first, second = weights[0, node], weights[1, node]
    one = other = np.float32(0.0)
    for k in range(len(grey)):
        value = np.float32(grey[k]) - MIDDLE_GREY
        one += first[k] * value
        other += second[k] * value
    return True, float(one), float(other), u - j - (node + 0.5) / SUBPIXELS
