"""Compiled loops of the detector of verticals: arrays in, arrays out.

A *strip* image has a pixel (v, c) for row v of the vertical that crosses the horizon at column c
(see `lut.verticals`): the building's verticals are its columns, whatever the camera's pose and
distortion.

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
def strip_response(
    image: NDArray[np.uint8],
    column: NDArray[np.float32],
    first_row: NDArray[np.int32],
    last_row: NDArray[np.int32],
    across: NDArray[np.float32],
    lever: NDArray[np.float32],
    along: NDArray[np.float32],
    regulariser: float,
    response: NDArray[np.float32],
) -> None:
    """Signed squared correlation of grey value and column, in a window along each vertical.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    column, first_row, last_row
        The table (see `lut.verticals.VerticalTable`).
    across, lever : (2r + 1,) float32
        Weights across the line, of sum 1, and the coordinate that is correlated with the grey
        value, of weighted mean 0 and variance 1.
    along : (2s + 1,) float32
        Weights along the line, of sum 1; cut off and made up for where the vertical ends.
    regulariser : float
        Added to the window's variance (grey values squared).
    response : (H, W) float32
        Result: ``cov |cov| / (variance + regulariser)``, in [-1, 1]; positive where the image is
        brighter on the right; 0 where the window leaves the image.
    """
    height, width = image.shape
    r = (len(across) - 1) // 2
    s = (len(along) - 1) // 2
    part = np.zeros(2 * s + 2, np.float32)
    for k in range(2 * s + 1):
        part[k + 1] = part[k] + along[k]
    mean_strip = np.zeros((height, width), np.float32)
    cov_strip = np.zeros((height, width), np.float32)
    square_strip = np.zeros((height, width), np.float32)
    grey = np.empty(width, np.float32)
    mean = np.zeros(width, np.float32)
    cov = np.zeros(width, np.float32)
    square = np.zeros(width, np.float32)
    for v in range(height):
        # Grey values about 0 keep the small variances exact in single precision.
        for u in range(width):
            grey[u] = np.float32(image[v, u]) - np.float32(128.0)
        centre = across[r]
        for u in range(r, width - r):
            g = grey[u]
            mean[u] = centre * g
            cov[u] = 0.0
            square[u] = centre * g * g
        for k in range(1, r + 1):
            w = across[r + k]
            h = across[r + k] * lever[r + k]
            for u in range(r, width - r):
                left = grey[u - k]
                right = grey[u + k]
                mean[u] += w * (left + right)
                cov[u] += h * (right - left)
                square[u] += w * (left * left + right * right)
        for c in range(width):
            if v < first_row[c] or v > last_row[c]:
                continue
            x = column[v, c]
            j = int(x)
            if j < r or j + 1 > width - 1 - r:
                continue
            f = x - np.float32(j)
            e = np.float32(1.0) - f
            mean_strip[v, c] = e * mean[j] + f * mean[j + 1]
            cov_strip[v, c] = e * cov[j] + f * cov[j + 1]
            square_strip[v, c] = e * square[j] + f * square[j + 1]
    noise = np.float32(regulariser)
    for v in range(height):
        mean[:] = 0.0
        cov[:] = 0.0
        square[:] = 0.0
        for k in range(max(-s, -v), min(s, height - 1 - v) + 1):
            w = along[k + s]
            for c in range(width):
                mean[c] += w * mean_strip[v + k, c]
            for c in range(width):
                cov[c] += w * cov_strip[v + k, c]
            for c in range(width):
                square[c] += w * square_strip[v + k, c]
        for c in range(width):
            response[v, c] = 0.0
            if v < first_row[c] or v > last_row[c]:
                continue
            here = column[v, c]
            if here < r or here >= width - 1 - r:
                continue
            share = part[min(s, last_row[c] - v) + s + 1] - part[max(-s, first_row[c] - v) + s]
            m = mean[c] / share
            h = cov[c] / share
            variance = max(square[c] / share - m * m, np.float32(0.0)) + noise
            response[v, c] = h * abs(h) / variance


@njit(cache=True, error_model="numpy")
def find_starts(
    response: NDArray[np.float32],
    horizon_row: NDArray[np.float64],
    first_row: NDArray[np.int32],
    last_row: NDArray[np.int32],
    band_rows: int,
    spacing_rows: int,
    threshold: float,
    border_rows: int,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Maxima of the response across the strip, on the horizon and on rows above and below it.

    Parameters
    ----------
    response : (H, W) float32
        See `strip_response`.
    horizon_row, first_row, last_row
        The table.
    band_rows, spacing_rows : int
        Rows at the horizon and every `spacing_rows` up to `band_rows` from it are looked at.
    threshold : float
        Least absolute response.
    border_rows : int
        Rows at the image's border that are left out.

    Returns
    -------
    row, column : (N,) int32
        Strip pixels of the maxima.
    score : (N,) float32
        Absolute response there.
    """
    height, width = response.shape
    steps = band_rows // spacing_rows
    row = np.empty(width * (2 * steps + 1), np.int32)
    column = np.empty(len(row), np.int32)
    score = np.empty(len(row), np.float32)
    n = 0
    for c in range(1, width - 1):
        if first_row[c] > last_row[c]:
            continue
        horizon = math.floor(horizon_row[c] + 0.5)
        lowest = max(first_row[c], border_rows)
        highest = min(last_row[c], height - 1 - border_rows)
        for k in range(-steps, steps + 1):
            v = horizon + k * spacing_rows
            if v < lowest or v > highest:
                continue
            here = abs(response[v, c])
            if here < threshold:
                continue
            sign = 1.0 if response[v, c] > 0.0 else -1.0
            if sign * response[v, c - 1] < here and sign * response[v, c + 1] <= here:
                row[n] = v
                column[n] = c
                score[n] = here
                n += 1
    return row[:n], column[:n], score[:n]


@njit(cache=True, error_model="numpy")
def _top_of_parabola(left: float, centre: float, right: float) -> float:
    """Offset of the maximum of the parabola through three neighbours."""
    bend = left - 2.0 * centre + right
    return 0.5 * (left - right) / bend if bend < 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def _follow(
    response: NDArray[np.float32],
    bearing: NDArray[np.float64],
    elevation_tan: NDArray[np.float32],
    sign: float,
    start_row: int,
    start_column: float,
    direction: int,
    pitch: float,
    roll: float,
    threshold: float,
    max_gap: int,
    border: int,
    pull: float,
    reach: float,
    out_row: NDArray[np.int32],
    out_column: NDArray[np.float64],
    out_score: NDArray[np.float32],
) -> int:
    """Follow an edge row by row, one way; return how many points were written."""
    height, width = response.shape
    v = start_row
    here = start_column
    n = 0
    gap = 0
    while gap <= max_gap:
        v += direction
        if v < border or v > height - 1 - border:
            break
        j = math.floor(here + 0.5)
        if j < 1 or j > width - 2:
            break
        # A vertical leans by this much in the strip of a tilted camera.
        lean = pitch * math.sin(bearing[j]) - roll * math.cos(bearing[j])
        rise = elevation_tan[v, j] - elevation_tan[v - direction, j]
        if not math.isfinite(rise):
            break
        here += 2.0 * lean * rise / (bearing[j + 1] - bearing[j - 1])
        j = math.floor(here + 0.5)
        if j < 2 or j > width - 3:
            break
        left = sign * response[v, j - 1]
        centre = sign * response[v, j]
        right = sign * response[v, j + 1]
        if left > centre and left > right:
            j -= 1
            right = centre
            centre = left
            left = sign * response[v, j - 1]
        elif right > centre:
            j += 1
            left = centre
            centre = right
            right = sign * response[v, j + 1]
        seen = False
        if centre >= threshold and centre >= left and centre >= right:
            offset = j + _top_of_parabola(left, centre, right) - here
            seen = abs(offset) <= reach
            if seen:
                out_row[n] = v
                out_column[n] = here + offset
                out_score[n] = centre
                n += 1
                here += max(pull, 1.0 / (n + 1.0)) * offset
        gap = 0 if seen else gap + 1
    return n


@njit(cache=True, error_model="numpy")
def follow_edges(
    response: NDArray[np.float32],
    bearing: NDArray[np.float64],
    elevation_tan: NDArray[np.float32],
    start_row: NDArray[np.int32],
    start_column: NDArray[np.int32],
    pitch: float,
    roll: float,
    threshold: float,
    max_gap: int,
    border: int,
    pull: float,
    reach: float,
) -> tuple[
    NDArray[np.float64],
    NDArray[np.int64],
    NDArray[np.int32],
    NDArray[np.float64],
    NDArray[np.float32],
]:
    """Follow edges up and down from starts; a start on an edge already followed is left out.

    Parameters
    ----------
    response : (H, W) float32
        See `strip_response`.
    bearing, elevation_tan
        The table.
    start_row, start_column : (N,) int32
        Strip pixels to start from, in this order.
    pitch, roll : float
        Tilt that the edges are expected to show (rad); 0 for none.
    threshold : float
        Least absolute response of a point.
    max_gap : int
        Rows without a point that are bridged.
    border : int
        Rows at the image's border that are left out.
    pull : float
        Part of a point's offset by which the expected position of the next one moves; more for the
        first points, whose mean it is. 1 follows any curve, small values only verticals.
    reach : float
        Largest offset of a point from its expected position, columns.

    Returns
    -------
    sign : (T,) float64
        Polarity of each track: 1 where the image is brighter on the right, -1 on the left.
    bounds : (T + 1,) int64
        Track t's points are ``bounds[t] : bounds[t + 1]``, from top to bottom.
    row, column, score : (P,) int32, float64, float32
        The points: row and sub-pixel column in the strip, absolute response.
    """
    height, width = response.shape
    followed = np.zeros((2, height, width), np.bool_)
    capacity = 64 * height
    row = np.empty(capacity, np.int32)
    column = np.empty(capacity, np.float64)
    score = np.empty(capacity, np.float32)
    sign = np.empty(len(start_row), np.float64)
    bounds = np.zeros(len(start_row) + 1, np.int64)
    up_row = np.empty(height, np.int32)
    up_column = np.empty(height, np.float64)
    up_score = np.empty(height, np.float32)
    tracks = 0
    n = 0
    for start in range(len(start_row)):
        v = start_row[start]
        c = start_column[start]
        polarity = 1.0 if response[v, c] > 0.0 else -1.0
        layer = 0 if polarity > 0.0 else 1
        if followed[layer, v, c]:
            continue
        if n + height > capacity:
            capacity *= 2
            grown_row = np.empty(capacity, np.int32)
            grown_row[:n] = row[:n]
            row = grown_row
            grown_column = np.empty(capacity, np.float64)
            grown_column[:n] = column[:n]
            column = grown_column
            grown_score = np.empty(capacity, np.float32)
            grown_score[:n] = score[:n]
            score = grown_score
        centre = polarity * response[v, c]
        at = c + _top_of_parabola(
            polarity * response[v, c - 1], centre, polarity * response[v, c + 1]
        )
        above = _follow(
            response, bearing, elevation_tan, polarity, v, at, -1, pitch, roll,
            threshold, max_gap, border, pull, reach, up_row, up_column, up_score,
        )  # fmt: skip
        for i in range(above):
            row[n + i] = up_row[above - 1 - i]
            column[n + i] = up_column[above - 1 - i]
            score[n + i] = up_score[above - 1 - i]
        n += above
        row[n] = v
        column[n] = at
        score[n] = centre
        n += 1
        n += _follow(
            response, bearing, elevation_tan, polarity, v, at, 1, pitch, roll,
            threshold, max_gap, border, pull, reach, row[n:], column[n:], score[n:],
        )  # fmt: skip
        for i in range(bounds[tracks], n):
            j = math.floor(column[i] + 0.5)
            for k in range(max(0, j - 1), min(width, j + 2)):
                followed[layer, row[i], k] = True
        sign[tracks] = polarity
        tracks += 1
        bounds[tracks] = n
    return sign[:tracks], bounds[: tracks + 1], row[:n], column[:n], score[:n]


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
def _step_height(image: NDArray[np.uint8], v: int, u: float, sigma: float, reach: int) -> float:
    """Height of a step at (u, v), brighter on the right, as a derivative of Gaussian sees it."""
    nearest = math.floor(u + 0.5)
    base = float(image[v, nearest])
    inverse = 1.0 / (sigma * sigma)
    total = 0.0
    for k in range(-reach, reach + 1):
        d = nearest + k - u
        total += d * math.exp(-0.5 * d * d * inverse) * (float(image[v, nearest + k]) - base)
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
    fine_reach = math.ceil(3.5 * fine) + 1
    coarse_reach = math.ceil(3.5 * coarse) + 1
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
            reach = math.ceil(3.5 * scales[step]) + 1
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
                first = 0.0
                second = 0.0
                for k in range(-reach, reach + 1):
                    d = nearest + k - u
                    q = d * d * inverse
                    weighted = math.exp(-0.5 * q) * (float(image[v, nearest + k]) - base)
                    first += (q - 1.0) * weighted
                    second += (q - 3.0) * d * inverse * weighted
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
            if u > coarse_reach and u < width - 1 - coarse_reach:
                fine_height += _step_height(image, v, u, fine, fine_reach)
                coarse_height += _step_height(image, v, u, coarse, coarse_reach)
                used += 1
        contrast[t] = sign[t] * fine_height / used if used > 0 else 0.0
        sharpness[t] = fine_height / coarse_height if sign[t] * coarse_height > 0.0 else 1.0


@njit(cache=True, error_model="numpy")
def vote_for_tilt(
    normal: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    weight: NDArray[np.float64],
    proposer: NDArray[np.int64],
    limit: float,
    prior: float,
) -> tuple[float, float]:
    """Pitch and roll that the largest weight of lines agrees with.

    Each pair of proposers gives the tilt that makes both vertical; a line votes for it with its
    weight, less the farther it is from vertical.

    Parameters
    ----------
    normal : (N, 3) float64
        Unit normals of the lines' planes, robot frame.
    tolerance : (N,) float64
        Largest inclination after compensation (rad).
    weight : (N,) float64
        Votes of a line that is exactly vertical.
    proposer : (M,) int64
        Lines whose pairs are tried; no tilt is tried as well.
    limit : float
        Largest absolute pitch and roll (rad).
    prior : float
        Standard deviation of the tilt (rad): a tilt t loses t^2 / (2 prior^2) votes.

    Returns
    -------
    pitch, roll : float
        The tilt (rad); the first of those with the most votes.
    """
    best_pitch = 0.0
    best_roll = 0.0
    best = -math.inf
    for i in range(-1, len(proposer)):
        for k in range(i + 1, len(proposer) if i >= 0 else 1):
            pitch = 0.0
            roll = 0.0
            if i >= 0:
                m = proposer[i]
                n = proposer[k]
                # n_z + pitch n_y - roll n_x = 0 for both.
                determinant = normal[m, 0] * normal[n, 1] - normal[m, 1] * normal[n, 0]
                if determinant == 0.0:
                    continue
                pitch = (normal[m, 2] * normal[n, 0] - normal[m, 0] * normal[n, 2]) / determinant
                roll = (normal[m, 2] * normal[n, 1] - normal[m, 1] * normal[n, 2]) / determinant
                if not (abs(pitch) <= limit and abs(roll) <= limit):
                    continue
            votes = -0.5 * (pitch * pitch + roll * roll) / (prior * prior)
            for line in range(len(weight)):
                off = normal[line, 2] + pitch * normal[line, 1] - roll * normal[line, 0]
                off /= tolerance[line]
                if off * off < 1.0:
                    votes += weight[line] * (1.0 - off * off)
            if votes > best:
                best = votes
                best_pitch = pitch
                best_roll = roll
    return best_pitch, best_roll
