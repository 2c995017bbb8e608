"""Refinement: straight lines through tracks, moved to where the grey values are steepest.

Lines are described in the chart round a reference bearing phi: a direction at bearing phi + d whose
elevation has tangent e is X = tan(d), Z = e / cos(d). There every line is straight, X = a + b Z; a
is the tangent of its bearing at the horizon relative to phi, b its lean.

A step of the grey value at u is seen by H(u) = sum of d G(d) I / sigma^2 over the pixels, d their
distances from u and G a Gaussian: its height, if u is where the step is. H is largest there; its
first and second derivatives, times sigma^2, have the weights (q - 1) G and (q - 3) d / sigma^2 G,
q = d^2 / sigma^2. Newton's method moves a line to the maximum of the sum of H over its rows.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.verticals.response import MIDDLE_GREY, FloatArray, Strip
from detect.verticals.tracking import LineTracks, sum_of

#: Positions in a pixel for which weights are tabulated; between them the derivative helps out.
SUBPIXELS = 64
#: Standard deviations beyond which the Gaussian is negligible.
_REACH = 4.4
#: Up to here series of tangents and arc tangents are as good as these.
_SMALL = 0.1
#: A step is not repeated where it moved no row farther than this, pixels.
_STILL_PX = 0.02


class Eigenlines(NamedTuple):
    """Lines through tracks by the eigen-decomposition of their points' scatter.

    Attributes
    ----------
    reference : (T,) float64
        Bearing round which each line's chart lies (rad).
    pixel : (T,) float64
        Width of a column there (rad).
    line : (T, 2) float64
        a, b of X = a + b Z along the larger eigenvalue's eigenvector; NaN, as what follows, for
        tracks that are left alone or of less than 3 points.
    scatter_px : (T,) float64
        Root of the smaller eigenvalue of the points' covariance, pixels.
    middle, spread : (T,) float64
        Mean of the points' Z, and its variance.
    rise, off : (P,) float64
        Tangent of the elevation of each point, and its bearing from the chart's origin (rad); of
        tracks that are not left alone.
    """

    reference: FloatArray
    pixel: FloatArray
    line: FloatArray
    scatter_px: FloatArray
    middle: FloatArray
    spread: FloatArray
    rise: FloatArray
    off: FloatArray


class LineFits(NamedTuple):
    """Straight lines through tracks, each in the chart round a reference bearing.

    Attributes
    ----------
    reference_rad : (T,) float64
        Bearing of the chart's origin.
    pixel_rad : (T,) float64
        Width of a pixel's column at the horizon there.
    line : (T, 2) float64
        a, b; NaN where there is no line.
    covariance : (T, 2, 2) float64
        Covariance of a, b, due to noise.
    scatter_px : (T,) float64
        Root-mean-square distance of the tracked points from their straight line, pixels.
    shift_px : (T,) float64
        How far the refinement took the line's middle, pixels.
    spread : (T,) float64
        Variance of the points' Z.
    contrast : (T,) float64
        Height of the step in grey values, as the fine filter sees it; NaN without refinement.
    sharpness : (T,) float64
        Contrast at the fine scale relative to the coarse one, at most 1; 1 without refinement.
    """

    reference_rad: FloatArray
    pixel_rad: FloatArray
    line: FloatArray
    covariance: FloatArray
    scatter_px: FloatArray
    shift_px: FloatArray
    spread: FloatArray
    contrast: FloatArray
    sharpness: FloatArray


class StepFilters(NamedTuple):
    """The steps of the refinement, and tables of their filters.

    A filter at a position in pixels i to i + 1 covers ``2 half`` pixels, from i - half + 1; for
    `SUBPIXELS` positions each there is a row of weights, of the sum 0.

    Attributes
    ----------
    half : (K,) int64
        See above, of each step.
    begin : (K,) int64
        Where its weights begin; equal steps share them.
    derivatives : (N,) float32
        Weights of the first derivative of the step's height, times sigma^2, for all positions, then
        those of the second.
    heights : (2, SUBPIXELS, 2 half) float32
        Weights of the height itself, at the fine and the coarse scale that are compared.
    farthest : (K,) float64
        Largest displacement of the middle of a line by a step, pixels; a larger step is not made,
        nor any after it. Without steps the lines stay as tracked.
    """

    half: NDArray[np.int64]
    begin: NDArray[np.int64]
    derivatives: NDArray[np.float32]
    heights: NDArray[np.float32]
    farthest: FloatArray


@lru_cache(maxsize=16)
def refinement_of(settings: LineSettings, steps: int | None = None) -> StepFilters:
    """Filters of the settings' (first) steps and of the two contrasts; how far a step may go."""
    some = settings.refine_steps_px[:steps]
    sigmas = [sigma for sigma, _ in some]
    # Equal ones share a table.
    tables = {sigma: gaussian_steps(sigma, _half(sigma))[1:] for sigma in sigmas}
    begins = dict(zip(tables, np.cumsum([0, *(table.size for table in tables.values())])))
    scales = settings.fine_scale_px, settings.coarse_scale_px
    heights = [gaussian_steps(sigma, _half(sigma))[0] for sigma in scales]
    taps = max(table.shape[1] for table in heights)
    # Both see the same pixels; those of weight 0 do not count.
    heights = [np.pad(h, [(0, 0), ((taps - h.shape[1]) // 2,) * 2]) for h in heights]
    flat = [np.empty(0), *(table.reshape(-1) for table in tables.values())]
    return StepFilters(
        half=np.array([_half(sigma) for sigma in sigmas], np.int64),
        begin=np.array([begins[sigma] for sigma in sigmas], np.int64),
        derivatives=np.concatenate(flat).astype(np.float32),
        heights=np.stack(heights).astype(np.float32),
        farthest=np.array([distance for _, distance in some], np.float64),
    )


def _half(sigma: float) -> int:
    """Half the number of pixels that a filter covers; a number that is whole in vectors."""
    return 4 * math.ceil(_REACH * sigma / 4.0)


def gaussian_steps(sigma: float, half: int) -> FloatArray:
    """(3, SUBPIXELS, 2 half) weights of a step's height, and of its derivatives times sigma^2."""
    position = (np.arange(SUBPIXELS)[:, None] + 0.5) / SUBPIXELS
    d = np.arange(-half + 1, half + 1) - position
    q = (d / sigma) ** 2
    gaussian = np.exp(-0.5 * q)
    weights = np.stack(
        [d / sigma**2 * gaussian, (q - 1.0) * gaussian, (q - 3.0) * d / sigma**2 * gaussian]
    )
    # Windows that are cut off must not depend on the image's brightness.
    return np.asarray(weights - weights.mean(axis=-1, keepdims=True))


@njit(cache=True, error_model="numpy", forceinline=True)
def fit_lines(
    image: NDArray[np.uint8], strip: Strip, tracks: LineTracks, filters: StepFilters,
    least_points: int, least_score: float,
) -> LineFits:  # fmt: skip
    """Fit lines to tracks, and refine them.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    strip, tracks, filters
        The table, the tracks, the steps of the refinement; where there are none the covariance is
        that of independent points with the scatter that the track shows.
    least_points, least_score : int, float
        Tracks of fewer points, or of a smaller sum of scores, are left alone.
    """
    of_track = fit_eigenlines(strip, tracks, least_points, least_score)
    count = len(of_track.reference)
    if len(filters.farthest) > 0:
        line, covariance, shift_px, contrast, sharpness = refine_lines(
            image, strip, tracks, of_track, filters
        )
    else:
        line = of_track.line
        covariance = regression_covariance(of_track, tracks.bounds)
        shift_px = np.zeros(count)
        contrast = np.full(count, np.nan)
        sharpness = np.ones(count)
    return LineFits(
        of_track.reference, of_track.pixel, line, covariance, of_track.scatter_px, shift_px,
        of_track.spread, contrast, sharpness,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def regression_covariance(lines: Eigenlines, bounds: NDArray[np.int64]) -> FloatArray:
    """(T, 2, 2) covariance of a, b of regressions on points with independent errors."""
    middle, count = lines.middle, len(lines.pixel)
    covariance = np.empty((count, 2, 2))
    for t in range(count):
        points = bounds[t + 1] - bounds[t]
        of_mean = (lines.scatter_px[t] * lines.pixel[t]) ** 2 / max(points - 2, 1)
        of_lean = of_mean / lines.spread[t]
        covariance[t, 0, 0] = of_mean + middle[t] * middle[t] * of_lean
        covariance[t, 0, 1] = -middle[t] * of_lean
        covariance[t, 1, 0] = covariance[t, 0, 1]
        covariance[t, 1, 1] = of_lean
    return covariance


@njit(cache=True, error_model="numpy", forceinline=True)
def _short_tan_and_secant(angle: float) -> tuple[float, float]:
    """Tangent and inverse cosine of the small angles of a chart, by their series."""
    q = angle * angle
    tangent = angle * (1.0 + q * (1.0 / 3.0 + q * (2.0 / 15.0 + q * (17.0 / 315.0))))
    secant = 1.0 + q * (0.5 + q * (5.0 / 24.0 + q * (61.0 / 720.0 + q * (277.0 / 8064.0))))
    return tangent, secant


@njit(cache=True, error_model="numpy", forceinline=True)
def _arctan_series(x: float) -> float:
    """Arc tangent of small arguments, by its series."""
    q = x * x
    return x * (1.0 - q * (1.0 / 3.0 - q * (0.2 - q * (1.0 / 7.0 - q * (1.0 / 9.0)))))


@njit(cache=True, error_model="numpy")
def _sums_in_chart(off: FloatArray, rise: FloatArray) -> tuple[float, float, float, float, float]:
    """Sums of X, Z, X^2, X Z and Z^2 of points."""
    sum_x = sum_z = sum_xx = sum_xz = sum_zz = 0.0
    wide = 0
    for i in range(len(off)):
        wide += abs(off[i]) > _SMALL
    # Near the chart's origin in a loop that becomes vectors.
    near = len(off) if wide == 0 else 0
    for i in range(near):
        x, secant = _short_tan_and_secant(off[i])
        z = rise[i] * secant
        sum_x += x
        sum_z += z
        sum_xx += x * x
        sum_xz += x * z
        sum_zz += z * z
    for i in range(near, len(off)):
        x = math.tan(off[i])
        z = rise[i] / math.cos(off[i])
        sum_x += x
        sum_z += z
        sum_xx += x * x
        sum_xz += x * z
        sum_zz += z * z
    return sum_x, sum_z, sum_xx, sum_xz, sum_zz


@njit(cache=True, error_model="numpy")
def _place_in_chart(
    bearing: FloatArray, elevation: NDArray[np.float32], row: NDArray[np.int32],
    column: FloatArray, off: FloatArray, rise: FloatArray,
) -> int:  # fmt: skip
    """Bearings of points from the chart's origin, and elevations; return the origin's column."""
    width = len(bearing)
    mean = 0.0
    for i in range(len(column)):
        mean += column[i]
    origin = min(max(int(mean / len(column) + 0.5), 1), width - 2)
    for i in range(len(column)):
        j = min(int(column[i]), width - 2)
        f = column[i] - j
        off[i] = (1.0 - f) * bearing[j] + f * bearing[j + 1] - bearing[origin]
        rise[i] = (1.0 - f) * elevation[j, row[i]] + f * elevation[j + 1, row[i]]
    return origin


@njit(cache=True, error_model="numpy")
def fit_eigenlines(
    strip: Strip, tracks: LineTracks, least_points: int, least_score: float
) -> Eigenlines:
    """Straight lines through tracks, by the eigen-decomposition of their points' scatter.

    Tracks of fewer points, or of a smaller sum of scores, are left alone.
    """
    bearing, bounds = strip.bearing, tracks.bounds
    count = len(bounds) - 1
    reference, pixel, line = np.empty(count), np.empty(count), np.full((count, 2), np.nan)
    scatter_px, middle, spread = np.full((3, count), np.nan)
    rise, off = np.empty(len(tracks.row)), np.empty(len(tracks.row))
    for t in range(count):
        own = slice(bounds[t], bounds[t + 1])
        n = bounds[t + 1] - bounds[t]
        j = _place_in_chart(
            bearing, strip.rise, tracks.row[own], tracks.column[own], off[own], rise[own]
        )
        reference[t] = bearing[j]
        pixel[t] = 0.5 * abs(bearing[j + 1] - bearing[j - 1])
        if n < least_points or sum_of(tracks.score[own]) < least_score:
            continue
        sum_x, sum_z, sum_xx, sum_xz, sum_zz = _sums_in_chart(off[own], rise[own])
        mean_x, mean_z = sum_x / n, sum_z / n
        xx = sum_xx / n - mean_x * mean_x
        xz = sum_xz / n - mean_x * mean_z
        zz = sum_zz / n - mean_z * mean_z
        middle[t] = mean_z
        spread[t] = zz
        half = 0.5 * (xx - zz)
        smaller = 0.5 * (xx + zz) - math.sqrt(half * half + xz * xz)
        if n < 3 or not zz > smaller:
            continue
        b = xz / (zz - smaller)
        line[t, 0] = mean_x - b * mean_z
        line[t, 1] = b
        scatter_px[t] = math.sqrt(max(smaller, 0.0)) / pixel[t]
    return Eigenlines(reference, pixel, line, scatter_px, middle, spread, rise, off)


class Crossings(NamedTuple):
    """Where a line crosses the N rows of its track: columns, NaN for none, and their derivatives.

    `seen`, (3, N or more), is for what filters see there.
    """

    row: NDArray[np.int32]
    column: FloatArray
    by_a: FloatArray
    by_b: FloatArray
    seen: FloatArray


class NewtonStep(NamedTuple):
    """A step of Newton's method: how a and b change, and their covariance after that."""

    change_a: float
    change_b: float
    aa: float
    ab: float
    bb: float


@njit(cache=True, error_model="numpy")
def _turns(
    a: float, b: float, rise: FloatArray, turn: FloatArray, height: FloatArray, by_a: FloatArray
) -> None:
    """Bearings of a line's points from the chart's origin, their Z, and derivatives by a."""
    wide = 0
    for i in range(len(rise)):
        # Z depends on X in second order only: one repetition settles it.
        x = a + b * rise[i]
        z = rise[i] * math.sqrt(1.0 + x * x)
        x = a + b * z
        wide += abs(x) > _SMALL
        turn[i] = _arctan_series(x)
        height[i] = z
        by_a[i] = 1.0 / (1.0 + x * x)
    if wide > 0:
        for i in range(len(rise)):
            turn[i] = math.atan(a + b * height[i])


@njit(cache=True, error_model="numpy")
def _cross_rows(
    strip: Strip, tracks: LineTracks, lines: Eigenlines, t: int, scratch: FloatArray
) -> Crossings:
    """Where the line through track t crosses its rows."""
    begin, end = tracks.bounds[t], tracks.bounds[t + 1]
    n = end - begin
    turn, height = scratch[0, :n], scratch[1, :n]
    crossings = Crossings(
        tracks.row[begin:end], scratch[2, :n], scratch[3, :n], scratch[4, :n], scratch[6:]
    )
    rise = lines.rise[begin:end]
    _turns(lines.line[t, 0], lines.line[t, 1], rise, turn, height, crossings.by_a)
    # To a hundredth of a column: that decides between which columns it is.
    bearing = strip.bearing
    j = min(max(int(tracks.column[begin]), 1), len(bearing) - 2)
    columns_per_rad = 2.0 / (bearing[j + 1] - bearing[j - 1])
    near = scratch[5, :n]
    for i in range(n):
        moved = (turn[i] - lines.off[begin + i]) * columns_per_rad
        near[i] = tracks.column[begin + i] + moved
        turn[i] += lines.reference[t]
    _cross_verticals(bearing, strip.column, near, turn, height, crossings)
    return crossings


@njit(cache=True, error_model="numpy")
def _cross_verticals(
    bearing: FloatArray, column: NDArray[np.float32], near: FloatArray, place: FloatArray,
    height: FloatArray, crossings: Crossings,
) -> None:  # fmt: skip
    """Columns of the image of points at bearings `place` between two verticals of the strip."""
    row, crossing, by_a, by_b = crossings.row, crossings.column, crossings.by_a, crossings.by_b
    last = len(bearing) - 1
    for i in range(len(row)):
        j = min(max(int(near[i]), 0), last - 1) if near[i] >= 0.0 else 0
        columns_per_rad = 1.0 / (bearing[j + 1] - bearing[j])
        on_left = column[j, row[i]]
        du_dc = column[j + 1, row[i]] - on_left
        # Beside it a vertical may have ended.
        shown = near[i] >= 0.0 and near[i] <= last and abs(du_dc) < np.inf
        crossing[i] = on_left + (place[i] - bearing[j]) * columns_per_rad * du_dc
        by_a[i] *= du_dc * columns_per_rad
        by_b[i] = by_a[i] * height[i]
        if not shown:
            crossing[i] = np.nan
            by_a[i] = 0.0
            by_b[i] = 0.0


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"}, forceinline=True)
def _weighted_sums(
    grey: NDArray[np.uint8], first: NDArray[np.float32], second: NDArray[np.float32]
) -> tuple[np.float32, np.float32]:
    """Grey values by two sets of weights of sum 0."""
    one = other = np.float32(0.0)
    for k in range(len(grey)):
        value = np.float32(grey[k]) - MIDDLE_GREY
        one += first[k] * value
        other += second[k] * value
    return one, other


@njit(cache=True, error_model="numpy", forceinline=True)
def _see_rows(
    image: NDArray[np.uint8], row: NDArray[np.int32], crossing: FloatArray,
    weights: NDArray[np.float32], seen: FloatArray,
) -> int:  # fmt: skip
    """What two filters see where a line crosses its rows; 0 where windows leave the image.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    row, crossing : (N,) int32, float64
        Rows and columns.
    weights : (2, SUBPIXELS, 2 half) float32
        Of the filters.
    seen : (3, N) float64
        Sums of both filters; distances of the crossings from the positions they are tabulated for.

    Returns
    -------
    int
        The number of rows whose windows are in the image.
    """
    one, other, off = seen[0], seen[1], seen[2]
    first, second = weights[0], weights[1]
    half = weights.shape[2] // 2
    rightmost = image.shape[1] - 1 - half
    used = 0
    for i in range(len(row)):
        x = crossing[i]
        one[i] = other[i] = off[i] = 0.0
        if x > half and x < rightmost:
            j = int(x)
            node = int((x - j) * SUBPIXELS)
            grey = image[row[i], j - half + 1 : j + half + 1]
            one[i], other[i] = _weighted_sums(grey, first[node], second[node])
            off[i] = x - j - (node + 0.5) / SUBPIXELS
            used += 1
    return used


@njit(cache=True, error_model="numpy")
def _newton_sums(
    slope: FloatArray, bend: FloatArray, off: FloatArray, by_a: FloatArray, by_b: FloatArray
) -> tuple[float, float, float, float, float, float, float, float]:
    """Gradient, Hessian, and the sum of the rows' own gradients' products, by a and b."""
    g_a = g_b = h_aa = h_ab = h_bb = m_aa = m_ab = m_bb = 0.0
    for i in range(len(slope)):
        own = slope[i] + off[i] * bend[i]
        own_a, own_b = own * by_a[i], own * by_b[i]
        g_a += own_a
        g_b += own_b
        h_aa += bend[i] * by_a[i] * by_a[i]
        h_ab += bend[i] * by_a[i] * by_b[i]
        h_bb += bend[i] * by_b[i] * by_b[i]
        m_aa += own_a * own_a
        m_ab += own_a * own_b
        m_bb += own_b * own_b
    return g_a, g_b, h_aa, h_ab, h_bb, m_aa, m_ab, m_bb


@njit(cache=True, error_model="numpy", forceinline=True)
def newton_step(
    image: NDArray[np.uint8], crossings: Crossings, weights: NDArray[np.float32], sign: float
) -> NewtonStep:
    """The step to where a line's rows have the largest response together.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    crossings : Crossings
        Where the line crosses its rows.
    weights : (2, SUBPIXELS, 2 half) float32
        Of the response's first and second derivative.
    sign : float
        1 where the image is brighter on the right, else -1.

    Returns
    -------
    NewtonStep
        NaN where there is no maximum at this scale.
    """
    seen, n = crossings.seen, len(crossings.row)
    used = _see_rows(image, crossings.row, crossings.column, weights, seen)
    g_a, g_b, h_aa, h_ab, h_bb, m_aa, m_ab, m_bb = _newton_sums(
        seen[0, :n], seen[1, :n], seen[2, :n], crossings.by_a, crossings.by_b
    )
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


@njit(cache=True, error_model="numpy")
def _move(crossings: Crossings, change_a: float, change_b: float) -> float:
    """Move crossings as the line does; return how far the one that moves most does, pixels."""
    column, by_a, by_b = crossings.column, crossings.by_a, crossings.by_b
    largest = 0.0
    for i in range(len(column)):
        change = change_a * by_a[i] + change_b * by_b[i]
        column[i] += change
        largest = max(largest, abs(change))
    return largest


@njit(cache=True, error_model="numpy", forceinline=True)
def _climb(
    image: NDArray[np.uint8], crossings: Crossings, filters: StepFilters, sign: float,
    middle: float, pixel: float,
) -> NewtonStep:  # fmt: skip
    """All steps of a line together, as far as they lead, and its covariance after the last."""
    a = b = 0.0
    aa = ab = bb = np.nan
    moved_px = np.inf
    for step in range(len(filters.farthest)):
        again = step > 0 and filters.begin[step] == filters.begin[step - 1]
        if again and moved_px <= _STILL_PX:
            continue
        taps, begin = 2 * filters.half[step], filters.begin[step]
        weights = filters.derivatives[begin : begin + 2 * SUBPIXELS * taps]
        newton = newton_step(image, crossings, weights.reshape(2, SUBPIXELS, taps), sign)
        # Where there is no maximum at this scale, the result of the coarser ones is kept.
        change = abs(newton.change_a + newton.change_b * middle)
        if not change <= filters.farthest[step] * pixel:
            break
        a += newton.change_a
        b += newton.change_b
        aa, ab, bb = newton.aa, newton.ab, newton.bb
        moved_px = _move(crossings, newton.change_a, newton.change_b)
    return NewtonStep(a, b, aa, ab, bb)


@njit(cache=True, error_model="numpy", forceinline=True)
def refine_lines(
    image: NDArray[np.uint8], strip: Strip, tracks: LineTracks, lines: Eigenlines,
    filters: StepFilters,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Move lines to where the grey values are steepest along all of their rows together.

    Newton's method on the sum, over a track's rows, of the derivative-of-Gaussian response at the
    sub-pixel column at which the line crosses the row. The filter is evaluated there, not
    interpolated: no maximum is drawn towards whole pixels. The covariance is that of the maximum
    under noise that is independent from row to row, taken from the rows' own gradients (a sandwich
    estimator), so it needs no model of the noise.

    Where a line crosses the rows is computed once; the steps move the crossings in proportion to
    their derivatives.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    strip, tracks, lines, filters
        The table, the tracks, lines through them, and the filters of each step.

    Returns
    -------
    line, covariance, shift_px, contrast, sharpness
        See `LineFits`; NaN (sharpness 1) where no step was made.
    """
    count = len(tracks.polarity)
    line = np.full((count, 2), np.nan)
    covariance = np.full((count, 2, 2), np.nan)
    shift_px = np.full(count, np.nan)
    contrast = np.full(count, np.nan)
    sharpness = np.ones(count)
    scratch = np.empty((9, len(image)))
    for t in range(count):
        if not math.isfinite(lines.line[t, 0]):
            continue
        sign, middle, pixel = tracks.polarity[t], lines.middle[t], lines.pixel[t]
        crossings = _cross_rows(strip, tracks, lines, t, scratch)
        steps = _climb(image, crossings, filters, sign, middle, pixel)
        if np.isnan(steps.aa):
            continue
        line[t, 0] = lines.line[t, 0] + steps.change_a
        line[t, 1] = lines.line[t, 1] + steps.change_b
        covariance[t, 0, 0] = steps.aa
        covariance[t, 0, 1] = covariance[t, 1, 0] = steps.ab
        covariance[t, 1, 1] = steps.bb
        shift_px[t] = abs(steps.change_a + steps.change_b * middle) / pixel
        seen = crossings.seen
        rows = _see_rows(image, crossings.row, crossings.column, filters.heights, seen)
        n = len(crossings.row)
        fine, coarse = seen[0, :n].sum(), seen[1, :n].sum()
        contrast[t] = sign * fine / rows if rows > 0 else 0.0
        sharp = fine / coarse if sign * coarse > 0.0 else 1.0
        sharpness[t] = min(max(sharp, 0.0), 1.0)
    return line, covariance, shift_px, contrast, sharpness
