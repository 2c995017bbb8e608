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


@njit(cache=True, error_model="numpy")
def fit_eigenlines(
    bearing: NDArray[np.float64],
    elevation_tan: NDArray[np.float32],
    bounds: NDArray[np.int64],
    row: NDArray[np.int32],
    column: NDArray[np.float64],
    reference: NDArray[np.float64],
    pixel: NDArray[np.float64],
    line: NDArray[np.float64],
    straightness: NDArray[np.float64],
    middle: NDArray[np.float64],
    spread: NDArray[np.float64],
) -> None:
    """Straight lines through tracks, by the eigen-decomposition of their points' scatter.

    Parameters
    ----------
    bearing, elevation_tan
        The table.
    bounds, row, column
        The tracks (see `follow_edges`).
    reference : (T,) float64
        Result: bearing round which each line's chart lies (rad).
    pixel : (T,) float64
        Result: width of a column there (rad).
    line : (T, 2) float64
        Result: a, b of X = a + b Z along the larger eigenvalue's eigenvector; NaN for tracks of
        less than 3 points.
    straightness : (T,) float64
        Result: root of the smaller eigenvalue of the points' covariance, chart units.
    middle, spread : (T,) float64
        Result: mean of the points' Z, and its variance.
    """
    width = bearing.shape[0]
    for t in range(len(bounds) - 1):
        begin, end = bounds[t], bounds[t + 1]
        n = end - begin
        mean_column = 0.0
        for i in range(begin, end):
            mean_column += column[i]
        j = min(max(int(mean_column / n + 0.5), 1), width - 2)
        phi = bearing[j]
        reference[t] = phi
        pixel[t] = 0.5 * abs(bearing[j + 1] - bearing[j - 1])
        line[t, 0] = np.nan
        line[t, 1] = np.nan
        straightness[t] = np.nan
        sum_x = 0.0
        sum_z = 0.0
        sum_xx = 0.0
        sum_xz = 0.0
        sum_zz = 0.0
        for i in range(begin, end):
            j = min(int(column[i]), width - 2)
            f = column[i] - j
            off = (1.0 - f) * bearing[j] + f * bearing[j + 1] - phi
            rise = (1.0 - f) * elevation_tan[row[i], j] + f * elevation_tan[row[i], j + 1]
            x = math.tan(off)
            z = rise / math.cos(off)
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
        straightness[t] = math.sqrt(max(smaller, 0.0))


@njit(cache=True, error_model="numpy")
def _cross_row(
    table_column: NDArray[np.float32],
    bearing: NDArray[np.float64],
    elevation_tan: NDArray[np.float32],
    phi: float,
    a: float,
    b: float,
    v: int,
    near: float,
) -> tuple[float, float, float, float]:
    """Where a line crosses a row, from a strip column near it.

    Returns
    -------
    column : float
        In the strip.
    u : float
        In the image; NaN outside.
    by_a, by_b : float
        Derivatives of u by the line's a and b.
    """
    width = bearing.shape[0]
    j = min(max(int(near), 0), width - 2)
    f = near - j
    rise = (1.0 - f) * elevation_tan[v, j] + f * elevation_tan[v, j + 1]
    # Z depends on X in second order only: one repetition settles it.
    x = a + b * rise
    z = rise * math.sqrt(1.0 + x * x)
    x = a + b * z
    wanted = phi + math.atan(x)
    column = j + (wanted - bearing[j]) / (bearing[j + 1] - bearing[j])
    if not (0.0 <= column <= width - 1.0):
        return near, math.nan, 0.0, 0.0
    j = min(int(column), width - 2)
    per_column = bearing[j + 1] - bearing[j]
    column = j + (wanted - bearing[j]) / per_column
    du_dc = table_column[v, j + 1] - table_column[v, j]
    by_a = du_dc / (per_column * (1.0 + x * x))
    return column, table_column[v, j] + (column - j) * du_dc, by_a, by_a * z


@njit(cache=True, error_model="numpy")
def _gaussian(sigma: float) -> NDArray[np.float64]:
    """(reach + 1,) exp(-k^2 / 2 sigma^2) for k = 0, 1, ... as far as it counts."""
    reach = math.ceil(3.5 * sigma) + 1
    weight = np.empty(reach + 1)
    for k in range(reach + 1):
        weight[k] = math.exp(-0.5 * (k / sigma) ** 2)
    return weight


@njit(cache=True, error_model="numpy")
def _step_height(
    image: NDArray[np.uint8], v: int, u: float, sigma: float, gaussian: NDArray[np.float64]
) -> float:
    """Height of a step at (u, v), brighter on the right, as a derivative of Gaussian sees it."""
    nearest = math.floor(u + 0.5)
    base = float(image[v, nearest])
    inverse = 1.0 / (sigma * sigma)
    off = u - nearest
    # exp(-(k - off)^2 / 2 sigma^2) = exp(-off^2 / 2 sigma^2) exp(off / sigma^2)^k gaussian[k]
    ratio = math.exp(off * inverse)
    right = math.exp(-0.5 * off * off * inverse)
    left = right
    total = 0.0
    for k in range(1, len(gaussian)):
        right *= ratio
        left /= ratio
        total += gaussian[k] * (
            (k - off) * right * (image[v, nearest + k] - base)
            - (k + off) * left * (image[v, nearest - k] - base)
        )
    return total * inverse


@njit(cache=True, error_model="numpy")
def refine_lines(
    image: NDArray[np.uint8],
    table_column: NDArray[np.float32],
    bearing: NDArray[np.float64],
    elevation_tan: NDArray[np.float32],
    sign: NDArray[np.float64],
    bounds: NDArray[np.int64],
    row: NDArray[np.int32],
    column: NDArray[np.float64],
    reference: NDArray[np.float64],
    pixel: NDArray[np.float64],
    middle: NDArray[np.float64],
    scales: NDArray[np.float64],
    farthest: NDArray[np.float64],
    fine: float,
    coarse: float,
    line: NDArray[np.float64],
    covariance: NDArray[np.float64],
    contrast: NDArray[np.float64],
    sharpness: NDArray[np.float64],
    refined: NDArray[np.bool_],
) -> None:
    """Move lines to where the grey values are steepest along all of their rows together.

    Newton's method on the sum, over a track's rows, of the derivative-of-Gaussian response at the
    sub-pixel column at which the line crosses the row. The filter is evaluated there, not
    interpolated: no maximum is drawn towards whole pixels. The covariance is that of the maximum
    under noise that is independent from row to row, taken from the rows' own gradients (a sandwich
    estimator), so it needs no model of the noise.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    table_column, bearing, elevation_tan
        The table.
    sign, bounds, row, column
        The tracks (see `follow_edges`).
    reference, pixel, middle
        See `fit_eigenlines`.
    scales : (K,) float64
        Width of the Gaussian in each step of Newton's method, pixels.
    farthest : (K,) float64
        How far a step may take the middle of a line, pixels; one that would go farther is not made,
        nor any after it.
    fine, coarse : float
        Widths of the Gaussians whose contrasts are compared, pixels.
    line : (T, 2) float64
        a, b of the lines; changed.
    covariance : (T, 2, 2) float64
        Result: of a, b.
    contrast : (T,) float64
        Result: height of the step, grey values, as the fine filter sees it.
    sharpness : (T,) float64
        Result: that contrast relative to the one that the coarse filter sees.
    refined : (T,) bool
        Result: whether at least one step was made.
    """
    width = image.shape[1]
    at = np.empty(image.shape[0], np.float64)
    fine_gaussian = _gaussian(fine)
    coarse_gaussian = _gaussian(coarse)
    margin = len(coarse_gaussian) - 1
    for t in range(len(sign)):
        begin, end = bounds[t], bounds[t + 1]
        refined[t] = False
        covariance[t] = np.nan
        contrast[t] = np.nan
        sharpness[t] = np.nan
        a = line[t, 0]
        b = line[t, 1]
        if not math.isfinite(a):
            continue
        phi = reference[t]
        for i in range(begin, end):
            at[i - begin] = column[i]
        for step in range(len(scales)):
            inverse = 1.0 / (scales[step] * scales[step])
            gaussian = _gaussian(scales[step])
            reach = len(gaussian) - 1
            hessian_aa = 0.0
            hessian_ab = 0.0
            hessian_bb = 0.0
            gradient_a = 0.0
            gradient_b = 0.0
            meat_aa = 0.0
            meat_ab = 0.0
            meat_bb = 0.0
            used = 0
            for i in range(begin, end):
                v = row[i]
                at[i - begin], u, by_a, by_b = _cross_row(
                    table_column, bearing, elevation_tan, phi, a, b, v, at[i - begin]
                )
                if not (u > reach and u < width - 1 - reach):
                    continue
                nearest = math.floor(u + 0.5)
                base = float(image[v, nearest])
                off = u - nearest
                # The Gaussian's values as in `_step_height`.
                ratio = math.exp(off * inverse)
                right = math.exp(-0.5 * off * off * inverse)
                left = right
                first = 0.0
                second = 0.0
                for k in range(1, reach + 1):
                    right *= ratio
                    left /= ratio
                    above = gaussian[k] * right * (image[v, nearest + k] - base)
                    below = gaussian[k] * left * (image[v, nearest - k] - base)
                    d = k - off
                    q = d * d * inverse
                    first += (q - 1.0) * above
                    second += (q - 3.0) * d * inverse * above
                    d = k + off
                    q = d * d * inverse
                    first += (q - 1.0) * below
                    second -= (q - 3.0) * d * inverse * below
                first *= sign[t]
                second *= sign[t]
                hessian_aa += second * by_a * by_a
                hessian_ab += second * by_a * by_b
                hessian_bb += second * by_b * by_b
                gradient_a += first * by_a
                gradient_b += first * by_b
                meat_aa += first * first * by_a * by_a
                meat_ab += first * first * by_a * by_b
                meat_bb += first * first * by_b * by_b
                used += 1
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
            refined[t] = True
        line[t, 0] = a
        line[t, 1] = b
        if not refined[t]:
            continue
        fine_height = 0.0
        coarse_height = 0.0
        used = 0
        for i in range(begin, end):
            v = row[i]
            at[i - begin], u, by_a, by_b = _cross_row(
                table_column, bearing, elevation_tan, phi, a, b, v, at[i - begin]
            )
            if u > margin and u < width - 1 - margin:
                fine_height += _step_height(image, v, u, fine, fine_gaussian)
                coarse_height += _step_height(image, v, u, coarse, coarse_gaussian)
                used += 1
        contrast[t] = sign[t] * fine_height / used if used > 0 else 0.0
        sharpness[t] = fine_height / coarse_height if sign[t] * coarse_height > 0.0 else 1.0
