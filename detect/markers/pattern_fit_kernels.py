"""Compiled fit of a whole marker, cells included, to the grey values.

The model is that of `detect.markers.pattern_model_kernels`, its grey values clipped at 0 and 255.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.homography_kernels import (
    corners_by_homography,
    inverse_3x3,
    square_homography,
)
from detect.markers.pattern_model_kernels import (
    BLACK_AT,
    BLUR_AT,
    LIGHT_NUMBERS,
    PARAMETERS,
    TONE_AT,
    WHITE_AT,
    blurred_blackness,
    confine_blur,
    corner_signs,
    light_level,
    place_on_marker,
)
from detect.markers.pattern_residual_kernels import cell_values, inflation_of
from detect.markers.robust_kernels import LEAST_NOISE, OUTLIER, robust_sigma
from detect.positive_definite import invert_positive, solve_positive

#: Standard deviations of the light's slope and bend over half a marker, in contrasts.
_SLOPE_SIGMA = 0.3
_BEND_SIGMA = 0.15

#: What `fit_pattern` returns beside corners and covariance: robust standard deviation of what is
#: left over, explained share of variance (of all but the noise), share of the pixels that agree,
#: contrast in the middle, black there, blur uu, uv, vv, tone, iterations, inflation of the
#: covariance by correlated rests.
REST, EXPLAINED, AGREE, CONTRAST, BLACK, BLUR_UU, BLUR_UV, BLUR_VV, TONE, STEPS, INFLATION = range(
    11
)
FIT_NUMBERS = 11

_SAMPLED_RESIDUALS = 700
#: Clipped pixels do not count if the model is this near the limit, grey levels, or beyond.
_CLIP_ZONE = 6.0
_CLOSE_ENOUGH_PX = 2e-3


@njit(cache=True, error_model="numpy")
def fit_pattern(
    pixels: NDArray[np.int32],
    straight: NDArray[np.float64],
    grey: NDArray[np.float64],
    count: int,
    start: NDArray[np.float64],
    lines: NDArray[np.float64],
    black: NDArray[np.float64],
    levels: NDArray[np.float64],
    noise: float,
    most_steps: int,
    cell_reach: float,
    corners: NDArray[np.float64],
    covariance: NDArray[np.float64],
    cells: NDArray[np.float64],
    cell_sigma: NDArray[np.float64],
    numbers: NDArray[np.float64],
) -> bool:
    """Robust least squares of a pattern to grey values.

    Parameters
    ----------
    pixels, straight, grey, count
        From `detect.markers.pattern_pixel_kernels.select_pixels`.
    start : (4, 2) float64
        Corners to begin with, straight pixels.
    lines : (L,) float64
        Where cells end, in widths of the marker, from 0 to 1; along both axes.
    black : (L - 1, L - 1) float64
        1 where the pattern is black.
    levels : (3,) float64
        Black, white and blur (px) to begin with.
    noise : float
        Standard deviation of the noise at least, grey levels.
    most_steps : int
        Of the iteration.
    cell_reach : float
        Farthest that a corner may move, pixels.
    corners : (4, 2) float64
        Result: corners, straight pixels.
    covariance : (8, 8) float64
        Result: of u0 v0 u1 ... v3, pixels squared.
    cells : (L - 1, L - 1) float64
        Result: each cell's own whiteness as the grey values have it, 0 black, 1 white.
    cell_sigma : (L - 1, L - 1) float64
        Result: its standard deviation due to noise.
    numbers : (FIT_NUMBERS,) float64
        Result: see the module's indices.

    Returns
    -------
    bool
        Whether the fit came to a result.
    """
    n_cells = len(lines) - 1
    if count < PARAMETERS + 12:
        return False
    vertex = corner_signs(black)
    work = np.empty((7, len(lines)))
    centre_x = start[:, 0].mean()
    centre_y = start[:, 1].mean()
    at = start.copy()
    for k in range(4):
        at[k, 0] -= centre_x
        at[k, 1] -= centre_y
    size = 1.0
    for k in range(4):
        size = max(size, math.hypot(at[k, 0], at[k, 1]))
    p = np.zeros(PARAMETERS)
    p[WHITE_AT] = levels[1]
    p[BLACK_AT] = levels[0]
    p[BLUR_AT] = p[BLUR_AT + 2] = levels[2] ** 2
    confine_blur(p)
    blur_guess = p[BLUR_AT]
    least = max(noise, LEAST_NOISE)
    residual = np.empty(count)
    weights = np.ones(count)
    normal = np.empty((PARAMETERS, PARAMETERS))
    right = np.empty(PARAMETERS)
    change = np.empty(PARAMETERS)
    inverse_normal = np.empty((PARAMETERS, PARAMETERS))
    rows = np.zeros((count, PARAMETERS + 1))
    squares = np.empty((PARAMETERS + 1, PARAMETERS + 1))
    scale = -1.0
    steps = 0
    last_move = math.inf
    for iteration in range(most_steps + 1):
        steps = iteration
        final = iteration == most_steps or last_move < _CLOSE_ENOUGH_PX
        homography = square_homography(at)
        inverse = inverse_3x3(homography)
        for k in range(count):
            x = straight[k, 0] - centre_x
            y = straight[k, 1] - centre_y
            mx, my, ax, ay, bx, by, sx, sy, rho = place_on_marker(inverse, x, y, p)
            d, d_x, d_y, d_sx, d_sy, d_rho = blurred_blackness(
                mx, my, sx, sy, rho, lines, black, vertex, work
            )
            lx = x / size
            ly = y / size
            white = light_level(p, WHITE_AT, lx, ly)
            dark = light_level(p, BLACK_AT, lx, ly)
            light = 1.0 - d
            toned = light + p[TONE_AT] * light * d
            value = dark + (white - dark) * toned
            r = grey[k] - value
            # A clipped grey value says no more than that the light was at least (at most) that.
            clipped = (grey[k] > 254.5 and value > 255.0 - _CLIP_ZONE) or (
                grey[k] < 0.5 and value < _CLIP_ZONE
            )
            if clipped:
                r = 0.0
            residual[k] = r
            if clipped:
                weights[k] = 1.0
                rows[k] = 0.0
                continue
            weight = 1.0
            if scale > 0.0 and abs(r) > OUTLIER * scale:
                weight = (OUTLIER * scale / r) ** 2
            weights[k] = weight
            # d(value)/d(blackness), and from there on by the chain rule.
            g = rows[k]
            slope = -(white - dark) * (1.0 + p[TONE_AT] * (1.0 - 2.0 * light))
            gu = slope * (d_x * ax + d_y * bx)
            gv = slope * (d_x * ay + d_y * by)
            w = homography[2, 0] * mx + homography[2, 1] * my + 1.0
            # The pattern moves with the homography: against its own gradient.
            g[0] = -gu * mx / w
            g[1] = -gu * my / w
            g[2] = -gu / w
            g[3] = -gv * mx / w
            g[4] = -gv * my / w
            g[5] = -gv / w
            moved = (gu * x + gv * y) / w
            g[6] = moved * mx
            g[7] = moved * my
            for first, share in ((WHITE_AT, toned), (BLACK_AT, 1.0 - toned)):
                g[first] = share
                g[first + 1] = share * lx
                g[first + 2] = share * ly
                g[first + 3] = share * lx * lx
                g[first + 4] = share * lx * ly
                g[first + 5] = share * ly * ly
            # sx^2, sy^2 and rho sx sy are linear in the blur's covariance.
            fx = slope * (d_sx - d_rho * rho / sx) / (2.0 * sx)
            fy = slope * (d_sy - d_rho * rho / sy) / (2.0 * sy)
            fxy = slope * d_rho / (sx * sy)
            g[BLUR_AT] = fx * ax * ax + fy * bx * bx + fxy * ax * bx
            g[BLUR_AT + 1] = 2.0 * (fx * ax * ay + fy * bx * by) + fxy * (ax * by + ay * bx)
            g[BLUR_AT + 2] = fx * ay * ay + fy * by * by + fxy * ay * by
            g[TONE_AT] = (white - dark) * light * d
            g[PARAMETERS] = r
            if weight != 1.0:
                root = math.sqrt(weight)
                for i in range(PARAMETERS + 1):
                    g[i] *= root
        _accumulate_squares(rows, squares)
        normal[:] = squares[:PARAMETERS, :PARAMETERS]
        right[:] = squares[:PARAMETERS, PARAMETERS]
        scale = robust_sigma(residual, count, _SAMPLED_RESIDUALS, least)
        variance = scale * scale
        contrast = max(abs(p[WHITE_AT] - p[BLACK_AT]), scale)
        # Weak knowledge, in the same measure as the grey values: light changes little over a
        # marker, the blur is round and about what was guessed, the tone curve nearly straight.
        for first in (WHITE_AT, BLACK_AT):
            for i in range(first + 1, first + LIGHT_NUMBERS):
                sigma = _SLOPE_SIGMA if i < first + 3 else _BEND_SIGMA
                prior = variance / (sigma * contrast) ** 2
                normal[i, i] += prior
                right[i] -= prior * p[i]
        for i in (BLUR_AT, BLUR_AT + 2):
            prior = variance / (1.0 * blur_guess + 0.1) ** 2
            normal[i, i] += prior
            right[i] -= prior * (p[i] - blur_guess)
        prior = variance / (0.5 * blur_guess + 0.05) ** 2
        normal[BLUR_AT + 1, BLUR_AT + 1] += prior
        right[BLUR_AT + 1] -= prior * p[BLUR_AT + 1]
        prior = variance / 0.15**2
        normal[TONE_AT, TONE_AT] += prior
        right[TONE_AT] -= prior * p[TONE_AT]
        for i in range(PARAMETERS):
            normal[i, i] *= 1.0 + 1e-10
        if final:
            break
        if not solve_positive(normal, right, change):
            return False
        by_homography = corners_by_homography(homography)
        move = by_homography @ change[:8]
        last_move = np.abs(move).max()
        limit = 0.35 * cell_reach
        shrink = min(1.0, limit / last_move) if last_move > 0.0 else 1.0
        for k in range(4):
            at[k, 0] += shrink * move[2 * k]
            at[k, 1] += shrink * move[2 * k + 1]
        for i in range(8, PARAMETERS):
            p[i] += change[i]
        p[TONE_AT] = min(max(p[TONE_AT], -0.6), 0.6)
        largest_blur = 1.0 + 2.0 * blur_guess
        p[BLUR_AT] = min(p[BLUR_AT], blur_guess + largest_blur)
        p[BLUR_AT + 2] = min(p[BLUR_AT + 2], blur_guess + largest_blur)
        confine_blur(p)
        for k in range(4):
            if (
                math.hypot(at[k, 0] + centre_x - start[k, 0], at[k, 1] + centre_y - start[k, 1])
                > cell_reach
            ):
                return False

    if not invert_positive(normal, inverse_normal):
        return False
    rest, weight_sum, agree = 0.0, 0.0, 0.0
    plain, mean, square = 0.0, 0.0, 0.0
    for k in range(count):
        rest += weights[k] * residual[k] ** 2
        weight_sum += weights[k]
        plain += residual[k] ** 2
        mean += grey[k]
        square += grey[k] ** 2
        if weights[k] > 0.5:
            agree += 1.0
    mean /= count
    total = max(square - count * mean * mean, 1e-9)
    variance = max(rest / max(weight_sum - PARAMETERS, 1.0), least * least)
    inflation = inflation_of(pixels, residual, weights, count)
    by_homography = corners_by_homography(square_homography(at))
    covariance[:] = (
        variance * inflation * (by_homography @ inverse_normal[:8, :8].copy() @ by_homography.T)
    )
    for k in range(4):
        corners[k, 0] = at[k, 0] + centre_x
        corners[k, 1] = at[k, 1] + centre_y
    numbers[REST] = math.sqrt(variance)
    numbers[EXPLAINED] = 1.0 - max(0.0, plain - count * noise * noise) / total
    numbers[AGREE] = agree / count
    numbers[CONTRAST] = p[WHITE_AT] - p[BLACK_AT]
    numbers[BLACK] = p[BLACK_AT]
    numbers[BLUR_UU] = p[BLUR_AT]
    numbers[BLUR_UV] = p[BLUR_AT + 1]
    numbers[BLUR_VV] = p[BLUR_AT + 2]
    numbers[TONE] = p[TONE_AT]
    numbers[STEPS] = steps
    numbers[INFLATION] = inflation
    cell_values(
        straight, count, centre_x, centre_y, size, inverse, p, lines, black, residual, weights,
        variance, work, cells, cell_sigma,
    )  # fmt: skip
    if not (np.all(np.isfinite(covariance)) and np.all(np.isfinite(corners))):
        return False
    for k in range(8):
        if covariance[k, k] <= 0.0:
            return False
    return n_cells > 0


@njit(cache=True, error_model="numpy")
def _accumulate_squares(rows: NDArray[np.float64], squares: NDArray[np.float64]) -> None:
    """rows.T @ rows; a library's product would wake threads that cost more than they give."""
    n = rows.shape[1]
    squares[:] = 0.0
    for k in range(rows.shape[0]):
        row = rows[k]
        for i in range(n):
            factor = row[i]
            into = squares[i]
            for j in range(n):
                into[j] += factor * row[j]
