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
from detect.vector_code import LANES, WORD
from detect.verticals.refine_vector_kernels import (
    ROWS,
    SUBPIXELS,
    heights,
    move_crossings,
    newton_sums,
)
from detect.verticals.response import Strip
from detect.verticals.response_kernels import MARGIN, STEP
from detect.verticals.tracking import LineTracks

FloatArray = NDArray[np.float64]

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
    """The steps of the refinement, and tables of their filters, one behind the other, each once.

    Attributes
    ----------
    half : (K + 2,) int64
        The filter at a position in pixels i to i + 1 covers ``2 half`` pixels, from i - half + 1.
        The last two are those whose contrasts are compared, a fine and a coarse one.
    begin : (K + 2,) int64
        Where each filter's weights begin: `SUBPIXELS` rows of ``2 half``, and one of zeros.
    height : (N,) float32
        Weights of the step's height; each row has the sum 0.
    derivatives : (2 N,) float32
        Those of its derivatives times sigma^2: `WORD` (`detect.vector_code`) of the
        first, then as many of the second, and so on.
    farthest : (K,) float64
        Largest displacement of the middle of a line by a step, pixels; a larger step is not made,
        nor any after it. Without steps the lines stay as tracked.
    """

    half: NDArray[np.int64]
    begin: NDArray[np.int64]
    height: NDArray[np.float32]
    derivatives: NDArray[np.float32]
    farthest: FloatArray


@lru_cache(maxsize=16)
def refinement_of(settings: LineSettings, steps: int | None = None) -> StepFilters:
    """Filters of the settings' (first) steps and of the two contrasts; how far a step may go."""
    some = settings.refine_steps_px[:steps]
    scales = (*(scale for scale, _ in some), settings.fine_scale_px, settings.coarse_scale_px)
    return step_filters(scales, tuple(distance for _, distance in some))


def step_filters(sigmas_px: tuple[float, ...], farthest_px: tuple[float, ...]) -> StepFilters:
    """Tables for Gaussians of some widths, pixels, in this order."""
    halves, tables = [], []
    # Equal ones share a table.
    widths = list(dict.fromkeys(sigmas_px))
    for sigma in widths:
        half = 4 * math.ceil(_REACH * sigma / 4.0)
        halves.append(half)
        position = (np.arange(SUBPIXELS)[:, None] + 0.5) / SUBPIXELS
        d = np.arange(-half + 1, half + 1) - position
        q = (d / sigma) ** 2
        gaussian = np.exp(-0.5 * q)
        weights = np.stack(
            [d / sigma**2 * gaussian, (q - 1.0) * gaussian, (q - 3.0) * d / sigma**2 * gaussian]
        )
        # Windows that are cut off must not depend on the image's brightness.
        weights -= weights.mean(axis=-1, keepdims=True)
        weights = np.pad(weights, [(0, 0), (0, 1), (0, 0)])
        tables.append(weights.reshape(3, -1))
    height, first, second = np.concatenate(tables, axis=-1).astype(np.float32)
    begins = np.concatenate([[0], np.cumsum([(SUBPIXELS + 1) * 2 * half for half in halves])])
    which = [widths.index(sigma) for sigma in sigmas_px]
    return StepFilters(
        half=np.array(halves, np.int64)[which],
        begin=begins.astype(np.int64)[which],
        height=height,
        derivatives=np.stack([first.reshape(-1, WORD), second.reshape(-1, WORD)], 1).reshape(-1),
        farthest=np.array(farthest_px, np.float64),
    )


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def fit_eigenlines(
    strip: Strip, tracks: LineTracks, least_points: int, least_score: float
) -> Eigenlines:
    """Straight lines through tracks, by the eigen-decomposition of their points' scatter.

    Tracks of fewer points, or of a smaller sum of scores, are left alone.
    """
    bearing, elevation = strip.bearing, strip.rise
    bounds, row, column, score = tracks.bounds, tracks.row, tracks.column, tracks.score
    count = len(bounds) - 1
    reference = np.empty(count)
    pixel = np.empty(count)
    line = np.empty((count, 2))
    scatter_px = np.empty(count)
    middle = np.empty(count)
    spread = np.empty(count)
    rise = np.empty(len(row))
    off = np.empty(len(row))
    width = bearing.shape[0]
    for t in range(len(bounds) - 1):
        begin, end = bounds[t], bounds[t + 1]
        n = end - begin
        # Views, so that the compiler knows that indices are not negative.
        own_row = row[begin:end]
        own_column = column[begin:end]
        own_score = score[begin:end]
        own_rise = rise[begin:end]
        own_off = off[begin:end]
        mean_column = 0.0
        total = 0.0
        for i in range(n):
            mean_column += own_column[i]
            total += own_score[i]
        j = min(max(int(mean_column / n + 0.5), 1), width - 2)
        phi = bearing[j]
        reference[t] = phi
        pixel[t] = 0.5 * abs(bearing[j + 1] - bearing[j - 1])
        line[t, 0] = np.nan
        line[t, 1] = np.nan
        scatter_px[t] = np.nan
        middle[t] = np.nan
        spread[t] = np.nan
        if n < least_points or total < least_score:
            continue
        sum_x = 0.0
        sum_z = 0.0
        sum_xx = 0.0
        sum_xz = 0.0
        sum_zz = 0.0
        wide = 0
        for i in range(n):
            j = min(int(own_column[i]), width - 2)
            f = own_column[i] - j
            own_off[i] = (1.0 - f) * bearing[j] + f * bearing[j + 1] - phi
            own_rise[i] = (1.0 - f) * elevation[j, own_row[i]] + f * elevation[j + 1, own_row[i]]
            wide += abs(own_off[i]) > _SMALL
        # Near the chart's origin in a loop that becomes vectors.
        near = n if wide == 0 else 0
        for i in range(near):
            x, secant = _short_tan_and_secant(own_off[i])
            z = own_rise[i] * secant
            sum_x += x
            sum_z += z
            sum_xx += x * x
            sum_xz += x * z
            sum_zz += z * z
        for i in range(near, n):
            x = math.tan(own_off[i])
            z = own_rise[i] / math.cos(own_off[i])
            sum_x += x
            sum_z += z
            sum_xx += x * x
            sum_xz += x * z
            sum_zz += z * z
        mean_x = sum_x / n
        mean_z = sum_z / n
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


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"}, forceinline=True)
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
    columns_of, bearing = strip.column, strip.bearing
    sign, bounds, row, column = tracks.polarity, tracks.bounds, tracks.row, tracks.column
    reference, pixel, middle, rise = lines.reference, lines.pixel, lines.middle, lines.rise
    point_off, tracked_line = lines.off, lines.line
    half, begin_of, farthest = filters.half, filters.begin, filters.farthest
    height_weights, derivatives = filters.height, filters.derivatives
    count = len(sign)
    line = np.full((count, 2), np.nan)
    covariance = np.full((count, 2, 2), np.nan)
    shift_px = np.full(count, np.nan)
    contrast = np.full(count, np.nan)
    sharpness = np.ones(count)
    height, width = image.shape
    grey_values = image.reshape(-1)
    # Up to a whole number of vectors, behind the last row.
    crossing = np.empty(height + ROWS)
    by_a = np.empty(height + ROWS)
    by_b = np.empty(height + ROWS)
    row_begin = np.empty(height + ROWS, np.int32)
    near = np.empty(height, np.int32)
    turn = np.empty(height)
    height_of = np.empty(height)
    turn_by_a = np.empty(height)
    bearings = np.empty(height)
    next_bearings = np.empty(height)
    columns = np.empty(height, np.float32)
    next_columns = np.empty(height, np.float32)
    for t in range(len(sign)):
        begin, end = bounds[t], bounds[t + 1]
        a = tracked_line[t, 0]
        b = tracked_line[t, 1]
        refined = False
        if not math.isfinite(a):
            continue
        phi = reference[t]
        n = end - begin
        # Views, so that the compiler knows that indices are not negative.
        own_row = row[begin:end]
        own_column = column[begin:end]
        own_rise = rise[begin:end]
        own_off = point_off[begin:end]
        # In loops that become vectors, all but one; that is why it is counted, not maximised.
        wide = 0
        for i in range(n):
            # Z depends on X in second order only: one repetition settles it.
            x = a + b * own_rise[i]
            z = own_rise[i] * math.sqrt(1.0 + x * x)
            x = a + b * z
            wide += abs(x) > _SMALL
            turn[i] = _arctan_series(x)
            height_of[i] = z
            turn_by_a[i] = 1.0 / (1.0 + x * x)
        if wide > 0:
            for i in range(n):
                turn[i] = math.atan(a + b * height_of[i])
        j = min(max(int(own_column[0]), 1), width - 2)
        columns_about = 2.0 / (bearing[j + 1] - bearing[j - 1])
        rightmost = np.float64(width - 1)
        for i in range(n):
            # To a hundredth of a column; it decides between which columns it is.
            at = own_column[i] + (turn[i] - own_off[i]) * columns_about
            inside = (at >= 0.0) & (at <= rightmost)
            near[i] = np.int32(at if inside else -1.0)
        for i in range(n):
            v = own_row[i]
            row_begin[i] = v * width
            j = min(max(near[i], 0), width - 2)
            bearings[i] = bearing[j]
            next_bearings[i] = bearing[j + 1]
            group = j // STEP
            base = min(max(group * STEP - MARGIN, 0), width - LANES)
            place = (group * height + v) * LANES + j - base
            columns[i] = columns_of[place]
            next_columns[i] = columns_of[place + 1]
        for i in range(n):
            columns_per_rad = 1.0 / (next_bearings[i] - bearings[i])
            at = (phi + turn[i] - bearings[i]) * columns_per_rad
            du_dc = next_columns[i] - columns[i]
            # Beside it a vertical may have ended.
            shown = (near[i] >= 0) & (abs(du_dc) < np.inf)
            crossing[i] = columns[i] + at * du_dc if shown else np.nan
            moved = du_dc * columns_per_rad * turn_by_a[i]
            by_a[i] = moved if shown else 0.0
            by_b[i] = moved * height_of[i] if shown else 0.0
        blocks = (n + ROWS - 1) // ROWS
        for i in range(n, blocks * ROWS):
            row_begin[i] = 0
            crossing[i] = np.nan
            by_a[i] = 0.0
            by_b[i] = 0.0
        largest_change = math.inf
        for step in range(len(farthest)):
            if step > 0 and begin_of[step] == begin_of[step - 1] and largest_change <= _STILL_PX:
                continue
            reach = half[step]
            sums = newton_sums(
                grey_values, row_begin, crossing, by_a, by_b, blocks, derivatives,
                2 * begin_of[step], reach, float(reach), float(width - 1 - reach),
            )  # fmt: skip
            hessian_aa = sign[t] * sums[0]
            hessian_ab = sign[t] * sums[1]
            hessian_bb = sign[t] * sums[2]
            gradient_a = sign[t] * sums[3]
            gradient_b = sign[t] * sums[4]
            meat_aa = sums[5]
            meat_ab = sums[6]
            meat_bb = sums[7]
            used = int(sums[8])
            determinant = hessian_aa * hessian_bb - hessian_ab * hessian_ab
            # No maximum here at this scale: the result of the coarser ones is kept.
            if used < 5 or not (hessian_aa < 0.0 and determinant > 1e-12 * hessian_aa * hessian_bb):
                break
            inverse_aa = hessian_bb / determinant
            inverse_ab = -hessian_ab / determinant
            inverse_bb = hessian_aa / determinant
            change_a = -(inverse_aa * gradient_a + inverse_ab * gradient_b)
            change_b = -(inverse_ab * gradient_a + inverse_bb * gradient_b)
            if abs(change_a + change_b * middle[t]) > farthest[step] * pixel[t]:
                break
            a += change_a
            b += change_b
            largest_change = move_crossings(crossing, by_a, by_b, blocks, change_a, change_b)
            left_aa = inverse_aa * meat_aa + inverse_ab * meat_ab
            left_ab = inverse_aa * meat_ab + inverse_ab * meat_bb
            left_ba = inverse_ab * meat_aa + inverse_bb * meat_ab
            left_bb = inverse_ab * meat_ab + inverse_bb * meat_bb
            # Two parameters were fitted to the same rows.
            scale = used / (used - 2.0)
            covariance[t, 0, 0] = scale * (left_aa * inverse_aa + left_ab * inverse_ab)
            covariance[t, 0, 1] = scale * (left_aa * inverse_ab + left_ab * inverse_bb)
            covariance[t, 1, 0] = covariance[t, 0, 1]
            covariance[t, 1, 1] = scale * (left_ba * inverse_ab + left_bb * inverse_bb)
            refined = True
        if not refined:
            continue
        line[t, 0] = a
        line[t, 1] = b
        moved = a - tracked_line[t, 0] + (b - tracked_line[t, 1]) * middle[t]
        shift_px[t] = abs(moved) / pixel[t]
        margin = max(half[-2], half[-1])
        fine_height, coarse_height, rows = heights(
            grey_values, row_begin, crossing, blocks, height_weights, begin_of[-2], half[-2],
            begin_of[-1], half[-1], float(margin), float(width - 1 - margin),
        )  # fmt: skip
        contrast[t] = sign[t] * fine_height / rows if rows > 0.0 else 0.0
        sharp = fine_height / coarse_height if sign[t] * coarse_height > 0.0 else 1.0
        sharpness[t] = min(max(sharp, 0.0), 1.0)
    return line, covariance, shift_px, contrast, sharpness
