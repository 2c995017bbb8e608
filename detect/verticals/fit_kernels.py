"""Compiled loops that fit lines to tracks: arrays in, arrays out.

Lines are described in the chart round a reference bearing phi: a direction at bearing phi + d whose
elevation has tangent e is X = tan(d), Z = e / cos(d). There every line is straight, X = a + b Z; a
is the tangent of its bearing at the horizon relative to phi, b its lean.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.verticals.group_kernels import MARGIN, STEP
from detect.verticals.step_filters import SUBPIXELS
from detect.verticals.vector_kernels import LANES, WORD, slope_and_bend, sum_of_products

_Floats = NDArray[np.float64]

#: Up to here series of tangents and arc tangents are as good as these.
_SMALL = 0.1
#: A step is not repeated where it moved no row farther than this, pixels.
_STILL_PX = 0.02


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
    bearing: NDArray[np.float64],
    elevation: NDArray[np.float32],
    bounds: NDArray[np.int64],
    row: NDArray[np.int32],
    column: NDArray[np.float64],
    score: NDArray[np.float32],
    least_points: int,
    least_score: float,
) -> tuple[_Floats, _Floats, _Floats, _Floats, _Floats, _Floats, _Floats, _Floats]:
    """Straight lines through tracks, by the eigen-decomposition of their points' scatter.

    Parameters
    ----------
    bearing
        The table's.
    elevation
        See `detect.verticals.strip.Strip.rise`.
    bounds, row, column, score
        The tracks (see `follow_edges`).
    least_points, least_score : int, float
        Tracks of fewer points, or of a smaller sum of scores, are left alone.

    Returns
    -------
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
        mean_column = 0.0
        total = 0.0
        for i in range(begin, end):
            mean_column += column[i]
            total += score[i]
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
        widest = 0.0
        for i in range(begin, end):
            j = min(int(column[i]), width - 2)
            f = column[i] - j
            off[i] = (1.0 - f) * bearing[j] + f * bearing[j + 1] - phi
            rise[i] = (1.0 - f) * elevation[j, row[i]] + f * elevation[j + 1, row[i]]
            widest = max(widest, abs(off[i]))
        # Near the chart's origin in a loop that becomes vectors.
        near = end if widest <= _SMALL else begin
        for i in range(begin, near):
            x, secant = _short_tan_and_secant(off[i])
            z = rise[i] * secant
            sum_x += x
            sum_z += z
            sum_xx += x * x
            sum_xz += x * z
            sum_zz += z * z
        for i in range(near, end):
            x = math.tan(off[i])
            z = rise[i] / math.cos(off[i])
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
    return reference, pixel, line, scatter_px, middle, spread, rise, off


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"}, forceinline=True)
def refine_lines(
    image: NDArray[np.uint8],
    strip: NDArray[np.float32],
    bearing: NDArray[np.float64],
    sign: NDArray[np.float64],
    bounds: NDArray[np.int64],
    row: NDArray[np.int32],
    column: NDArray[np.float64],
    reference: NDArray[np.float64],
    pixel: NDArray[np.float64],
    middle: NDArray[np.float64],
    rise: NDArray[np.float64],
    point_off: NDArray[np.float64],
    half: NDArray[np.int64],
    begin_of: NDArray[np.int64],
    height_weights: NDArray[np.float32],
    first_weights: NDArray[np.float32],
    second_weights: NDArray[np.float32],
    farthest: NDArray[np.float64],
    tracked_line: NDArray[np.float64],
) -> tuple[_Floats, _Floats, _Floats, _Floats, _Floats]:
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
    strip
        See `detect.verticals.strip.Strip.column`.
    bearing
        The table's.
    sign, bounds, row, column
        The tracks (see `follow_edges`).
    reference, pixel, middle, rise, point_off
        See `fit_eigenlines`.
    half, begin_of, height_weights, first_weights, second_weights
        Filters (see `detect.verticals.step_filters.StepFilters`): of each step of Newton's method,
        and two whose contrasts are compared, a fine and a coarse one.
    farthest : (K,) float64
        How far a step may take the middle of a line, pixels; one that would go farther is not made,
        nor any after it.
    tracked_line : (T, 2) float64
        a, b of the lines to begin with; NaN for those that are left alone.

    Returns
    -------
    line : (T, 2) float64
        a, b; NaN where no step was made.
    covariance : (T, 2, 2) float64
        Of a, b; NaN as above.
    shift_px : (T,) float64
        How far the steps took the middle of the line, pixels.
    contrast : (T,) float64
        Height of the step, grey values, as the fine filter sees it; NaN as above.
    sharpness : (T,) float64
        That contrast relative to the one that the coarse filter sees, at most 1; 1 as above.
    """
    count = len(sign)
    line = np.full((count, 2), np.nan)
    covariance = np.full((count, 2, 2), np.nan)
    shift_px = np.full(count, np.nan)
    contrast = np.full(count, np.nan)
    sharpness = np.ones(count)
    height, width = image.shape
    grey_values = image.reshape(-1)
    crossing = np.empty(height)
    by_a = np.empty(height)
    by_b = np.empty(height)
    turn = np.empty(height)
    height_of = np.empty(height)
    turn_by_a = np.empty(height)
    off = np.empty(height)
    weight = np.empty(height)
    first = np.empty(height)
    second = np.empty(height)
    at_pixel = np.empty(height, np.int64)
    at_weight = np.empty(height, np.int64)
    for t in range(len(sign)):
        begin, end = bounds[t], bounds[t + 1]
        a = tracked_line[t, 0]
        b = tracked_line[t, 1]
        refined = False
        if not math.isfinite(a):
            continue
        phi = reference[t]
        n = end - begin
        widest = 0.0
        # Again in loops of which the first, the long one, becomes vectors.
        for i in range(n):
            # Z depends on X in second order only: one repetition settles it.
            x = a + b * rise[begin + i]
            z = rise[begin + i] * math.sqrt(1.0 + x * x)
            x = a + b * z
            widest = max(widest, abs(x))
            turn[i] = _arctan_series(x)
            height_of[i] = z
            turn_by_a[i] = 1.0 / (1.0 + x * x)
        if widest > _SMALL:
            for i in range(n):
                turn[i] = math.atan(a + b * height_of[i])
        j = min(max(int(column[begin]), 1), width - 2)
        columns_about = 2.0 / (bearing[j + 1] - bearing[j - 1])
        for i in range(n):
            v = row[begin + i]
            # To a hundredth of a column; it decides which of them it lies between.
            at = column[begin + i] + (turn[i] - point_off[begin + i]) * columns_about
            crossing[i] = math.nan
            by_a[i] = 0.0
            by_b[i] = 0.0
            if 0.0 <= at <= width - 1.0:
                j = min(int(at), width - 2)
                columns_per_rad = 1.0 / (bearing[j + 1] - bearing[j])
                at = (phi + turn[i] - bearing[j]) * columns_per_rad
                group = j // STEP
                base = min(max(group * STEP - MARGIN, 0), width - LANES)
                place = (group * height + v) * LANES + j - base
                du_dc = strip[place + 1] - strip[place]
                # Beside it a vertical may have ended.
                if math.isfinite(du_dc):
                    crossing[i] = strip[place] + at * du_dc
                    by_a[i] = du_dc * columns_per_rad * turn_by_a[i]
                    by_b[i] = by_a[i] * height_of[i]
        largest_change = math.inf
        for step in range(len(farthest)):
            if step > 0 and begin_of[step] == begin_of[step - 1] and largest_change <= _STILL_PX:
                continue
            reach = half[step]
            hessian_aa = 0.0
            hessian_ab = 0.0
            hessian_bb = 0.0
            gradient_a = 0.0
            gradient_b = 0.0
            meat_aa = 0.0
            meat_ab = 0.0
            meat_bb = 0.0
            # In three loops, of which the compiler turns the first and the last into vectors.
            shown = 0.0
            for i in range(n):
                u = crossing[i]
                inside = (u > reach) & (u < width - 1 - reach)
                u = u if inside else float(reach)
                whole = int(u)
                node = int((u - whole) * SUBPIXELS)
                # From the tabulated position to the crossing.
                off[i] = u - whole - (node + 0.5) / SUBPIXELS
                weight[i] = 1.0 if inside else 0.0
                shown += weight[i]
                at_pixel[i] = row[begin + i] * width + whole - reach + 1
                at_weight[i] = begin_of[step] + node * 2 * reach
            for i in range(n):
                first[i], second[i] = slope_and_bend(
                    grey_values, at_pixel[i], first_weights, second_weights, at_weight[i],
                    2 * reach // WORD,
                )  # fmt: skip
            for i in range(n):
                bend = sign[t] * weight[i] * second[i]
                slope = sign[t] * weight[i] * first[i] + off[i] * bend
                hessian_aa += bend * by_a[i] * by_a[i]
                hessian_ab += bend * by_a[i] * by_b[i]
                hessian_bb += bend * by_b[i] * by_b[i]
                slope_a = slope * by_a[i]
                slope_b = slope * by_b[i]
                gradient_a += slope_a
                gradient_b += slope_b
                meat_aa += slope_a * slope_a
                meat_ab += slope_a * slope_b
                meat_bb += slope_b * slope_b
            used = int(shown)
            determinant = hessian_aa * hessian_bb - hessian_ab * hessian_ab
            # No maximum here at this scale: what the coarser ones found stands.
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
            largest_change = 0.0
            for i in range(n):
                change = change_a * by_a[i] + change_b * by_b[i]
                crossing[i] += change
                largest_change = max(largest_change, abs(change))
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
        used = 0
        margin = max(half[-2], half[-1])
        for i in range(n):
            u = crossing[i]
            if not (u > margin and u < width - 1 - margin):
                continue
            whole = int(u)
            at_pixel[used] = row[begin + i] * width + whole + 1
            at_weight[used] = int((u - whole) * SUBPIXELS)
            used += 1
        fine_height = sum_of_products(
            grey_values, at_pixel, height_weights, at_weight, used, begin_of[-2], half[-2]
        )
        coarse_height = sum_of_products(
            grey_values, at_pixel, height_weights, at_weight, used, begin_of[-1], half[-1]
        )
        contrast[t] = sign[t] * fine_height / used if used > 0 else 0.0
        sharp = fine_height / coarse_height if sign[t] * coarse_height > 0.0 else 1.0
        sharpness[t] = min(max(sharp, 0.0), 1.0)
    return line, covariance, shift_px, contrast, sharpness
