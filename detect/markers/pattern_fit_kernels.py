"""Compiled fit of a whole marker, cells included, to the grey values.

The model is that of `detect.markers.pattern_model_kernels`, its grey values clipped at 0 and 255.
"""

from __future__ import annotations

import math
from typing import NamedTuple

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
    Pattern,
    blurred_blackness,
    confine_blur,
    light_level,
    place_on_marker,
)
from detect.markers.pattern_residual_kernels import (
    MarkerFrame,
    Residuals,
    Samples,
    cell_values,
    inflation_of,
)
from detect.markers.robust_kernels import LEAST_NOISE, OUTLIER, robust_sigma
from detect.positive_definite import invert_positive, solve_positive

#: Standard deviations of the light's slope and bend over half a marker, in contrasts.
_SLOPE_SIGMA = 0.3
_BEND_SIGMA = 0.15
#: Standard deviation of the tone curve's bend, and its largest.
_TONE_SIGMA, _LARGEST_TONE = 0.15, 0.6

_SAMPLED_RESIDUALS = 700
#: Clipped pixels do not count if the model is this near the limit, grey levels, or beyond.
_CLIP_ZONE = 6.0
_CLOSE_ENOUGH_PX = 2e-3
#: Pixels that are needed beyond one for each parameter.
_SPARE_PIXELS = 12


class PatternStart(NamedTuple):
    """Where a fit begins, and its limits.

    Attributes
    ----------
    corners : (4, 2) float64
        Straight pixels.
    black, white : float
        Grey levels.
    blur_px : float
        Standard deviation of the blur.
    noise : float
        Standard deviation of the noise at least, grey levels.
    most_steps : int
        Of the iteration.
    reach_px : float
        Farthest that a corner may move.
    """

    corners: NDArray[np.float64]
    black: float
    white: float
    blur_px: float
    noise: float
    most_steps: int
    reach_px: float


class PatternEstimate(NamedTuple):
    """A fitted marker.

    Attributes
    ----------
    found : bool
        Whether the fit came to a result; nothing else means anything where it did not.
    corners : (4, 2) float64
        Straight pixels.
    covariance : (8, 8) float64
        Of u0 v0 u1 ... v3, pixels squared.
    cells, cell_sigma : (L - 1, L - 1) float64
        Each cell's own whiteness as the grey values have it, 0 black, 1 white, and its standard
        deviation due to noise.
    rest : float
        Robust standard deviation of the residuals, grey levels.
    explained : float
        Explained share of the variance, that of the noise aside.
    agree : float
        Share of the pixels that agree.
    contrast : float
        White less black in the middle, grey levels.
    blur : (3,) float64
        Covariance uu, uv, vv, pixels squared.
    inflation : float
        Factor of the covariance for correlated residuals.
    """

    found: bool
    corners: NDArray[np.float64]
    covariance: NDArray[np.float64]
    cells: NDArray[np.float64]
    cell_sigma: NDArray[np.float64]
    rest: float
    explained: float
    agree: float
    contrast: float
    blur: NDArray[np.float64]
    inflation: float


@njit(cache=True, error_model="numpy")
def fit_pattern(samples: Samples, pattern: Pattern, start: PatternStart) -> PatternEstimate:
    """Robust least squares of a pattern to grey values.

    Parameters
    ----------
    samples : Samples
        From `detect.markers.pattern_pixel_kernels.select_pixels`.
    pattern : Pattern
    start : PatternStart

    Returns
    -------
    PatternEstimate
    """
    count = len(samples.grey)
    if count < PARAMETERS + _SPARE_PIXELS:
        return _not_found()
    centre_x = start.corners[:, 0].mean()
    centre_y = start.corners[:, 1].mean()
    at = start.corners.copy()
    size = 1.0
    for k in range(4):
        at[k, 0] -= centre_x
        at[k, 1] -= centre_y
        size = max(size, math.hypot(at[k, 0], at[k, 1]))
    p = np.zeros(PARAMETERS)
    p[WHITE_AT] = start.white
    p[BLACK_AT] = start.black
    p[BLUR_AT] = p[BLUR_AT + 2] = start.blur_px**2
    confine_blur(p)
    blur_guess = p[BLUR_AT]
    least = max(start.noise, LEAST_NOISE)
    left = Residuals(
        np.empty(count),
        np.ones(count),
        np.zeros((count, PARAMETERS + 1)),
        np.empty((7, len(pattern.lines))),
    )
    normal = np.empty((PARAMETERS, PARAMETERS))
    right = np.empty(PARAMETERS)
    change = np.empty(PARAMETERS)
    squares = np.empty((PARAMETERS + 1, PARAMETERS + 1))
    scale = -1.0
    last_move = math.inf
    homography = square_homography(at)
    frame = MarkerFrame(homography, inverse_3x3(homography), centre_x, centre_y, size)
    for iteration in range(start.most_steps + 1):
        _linearise(samples, pattern, frame, p, scale, left)
        _accumulate_squares(left.rows, squares)
        normal[:] = squares[:PARAMETERS, :PARAMETERS]
        right[:] = squares[:PARAMETERS, PARAMETERS]
        scale = robust_sigma(left.residual, count, _SAMPLED_RESIDUALS, least)
        _add_priors(normal, right, p, scale, blur_guess)
        if iteration == start.most_steps or last_move < _CLOSE_ENOUGH_PX:
            break
        if not solve_positive(normal, right, change):
            return _not_found()
        move = corners_by_homography(frame.homography) @ change[:8]
        last_move = np.abs(move).max()
        limit = 0.35 * start.reach_px
        shrink = min(1.0, limit / last_move) if last_move > 0.0 else 1.0
        for k in range(4):
            at[k, 0] += shrink * move[2 * k]
            at[k, 1] += shrink * move[2 * k + 1]
            off_x = at[k, 0] + centre_x - start.corners[k, 0]
            off_y = at[k, 1] + centre_y - start.corners[k, 1]
            if math.hypot(off_x, off_y) > start.reach_px:
                return _not_found()
        for i in range(8, PARAMETERS):
            p[i] += change[i]
        p[TONE_AT] = min(max(p[TONE_AT], -_LARGEST_TONE), _LARGEST_TONE)
        largest_blur = blur_guess + (1.0 + 2.0 * blur_guess)
        p[BLUR_AT] = min(p[BLUR_AT], largest_blur)
        p[BLUR_AT + 2] = min(p[BLUR_AT + 2], largest_blur)
        confine_blur(p)
        homography = square_homography(at)
        frame = MarkerFrame(homography, inverse_3x3(homography), centre_x, centre_y, size)
    return _estimate(samples, pattern, frame, p, left, normal, at, start.noise)


@njit(cache=True, error_model="numpy")
def _not_found() -> PatternEstimate:
    none = np.empty((0, 0))
    return PatternEstimate(
        False, none, none, none, none, np.nan, np.nan, np.nan, np.nan, np.empty(0), np.nan
    )


@njit(cache=True, error_model="numpy")
def _linearise(
    samples: Samples,
    pattern: Pattern,
    frame: MarkerFrame,
    p: NDArray[np.float64],
    scale: float,
    left: Residuals,
) -> None:
    """Residuals, weights and weighted derivatives of all pixels; a scale below 0 weighs none."""
    h = frame.homography
    for k in range(len(samples.grey)):
        x = samples.straight[k, 0] - frame.centre_x
        y = samples.straight[k, 1] - frame.centre_y
        at = place_on_marker(frame.inverse, x, y, p)
        d, d_x, d_y, d_sx, d_sy, d_rho = blurred_blackness(at, pattern, left.profiles)
        lx = x / frame.size
        ly = y / frame.size
        white = light_level(p, WHITE_AT, lx, ly)
        dark = light_level(p, BLACK_AT, lx, ly)
        light = 1.0 - d
        toned = light + p[TONE_AT] * light * d
        value = dark + (white - dark) * toned
        grey = samples.grey[k]
        g = left.rows[k]
        # A clipped grey value says no more than that the light was at least (at most) that.
        if (grey > 254.5 and value > 255.0 - _CLIP_ZONE) or (grey < 0.5 and value < _CLIP_ZONE):
            left.residual[k] = 0.0
            left.weight[k] = 1.0
            g[:] = 0.0
            continue
        r = grey - value
        weight = 1.0
        if scale > 0.0 and abs(r) > OUTLIER * scale:
            weight = (OUTLIER * scale / r) ** 2
        left.residual[k] = r
        left.weight[k] = weight
        # d(value)/d(blackness), and from there on by the chain rule.
        slope = -(white - dark) * (1.0 + p[TONE_AT] * (1.0 - 2.0 * light))
        gu = slope * (d_x * at.x_u + d_y * at.y_u)
        gv = slope * (d_x * at.x_v + d_y * at.y_v)
        w = h[2, 0] * at.x + h[2, 1] * at.y + 1.0
        # The pattern moves with the homography: against its own gradient.
        g[0] = -gu * at.x / w
        g[1] = -gu * at.y / w
        g[2] = -gu / w
        g[3] = -gv * at.x / w
        g[4] = -gv * at.y / w
        g[5] = -gv / w
        moved = (gu * x + gv * y) / w
        g[6] = moved * at.x
        g[7] = moved * at.y
        for first, share in ((WHITE_AT, toned), (BLACK_AT, 1.0 - toned)):
            g[first] = share
            g[first + 1] = share * lx
            g[first + 2] = share * ly
            g[first + 3] = share * lx * lx
            g[first + 4] = share * lx * ly
            g[first + 5] = share * ly * ly
        # sigma_x^2, sigma_y^2 and their covariance are linear in the blur's.
        sx, sy = at.sigma_x, at.sigma_y
        fx = slope * (d_sx - d_rho * at.correlation / sx) / (2.0 * sx)
        fy = slope * (d_sy - d_rho * at.correlation / sy) / (2.0 * sy)
        fxy = slope * d_rho / (sx * sy)
        g[BLUR_AT] = fx * at.x_u * at.x_u + fy * at.y_u * at.y_u + fxy * at.x_u * at.y_u
        g[BLUR_AT + 1] = 2.0 * (fx * at.x_u * at.x_v + fy * at.y_u * at.y_v) + fxy * (
            at.x_u * at.y_v + at.x_v * at.y_u
        )
        g[BLUR_AT + 2] = fx * at.x_v * at.x_v + fy * at.y_v * at.y_v + fxy * at.x_v * at.y_v
        g[TONE_AT] = (white - dark) * light * d
        g[PARAMETERS] = r
        if weight != 1.0:
            root = math.sqrt(weight)
            for i in range(PARAMETERS + 1):
                g[i] *= root


@njit(cache=True, error_model="numpy")
def _add_priors(
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    p: NDArray[np.float64],
    scale: float,
    blur_guess: float,
) -> None:
    """Weak prior knowledge, in the same measure as the grey values.

    Light changes little over a marker, the blur is round and about what was guessed, the tone
    curve nearly straight.
    """
    variance = scale * scale
    contrast = max(abs(p[WHITE_AT] - p[BLACK_AT]), scale)
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
    prior = variance / _TONE_SIGMA**2
    normal[TONE_AT, TONE_AT] += prior
    right[TONE_AT] -= prior * p[TONE_AT]
    for i in range(PARAMETERS):
        normal[i, i] *= 1.0 + 1e-10


@njit(cache=True, error_model="numpy")
def _estimate(
    samples: Samples,
    pattern: Pattern,
    frame: MarkerFrame,
    p: NDArray[np.float64],
    left: Residuals,
    normal: NDArray[np.float64],
    at: NDArray[np.float64],
    noise: float,
) -> PatternEstimate:
    """Corners, covariance and figures of a fit that has come to its end."""
    inverse_normal = np.empty((PARAMETERS, PARAMETERS))
    if not invert_positive(normal, inverse_normal):
        return _not_found()
    count = len(samples.grey)
    rest, weight_sum, agree = 0.0, 0.0, 0.0
    plain, mean, square = 0.0, 0.0, 0.0
    for k in range(count):
        rest += left.weight[k] * left.residual[k] ** 2
        weight_sum += left.weight[k]
        plain += left.residual[k] ** 2
        mean += samples.grey[k]
        square += samples.grey[k] ** 2
        if left.weight[k] > 0.5:
            agree += 1.0
    mean /= count
    total = max(square - count * mean * mean, 1e-9)
    least = max(noise, LEAST_NOISE)
    variance = max(rest / max(weight_sum - PARAMETERS, 1.0), least * least)
    inflation = inflation_of(samples.pixel, left)
    by_homography = corners_by_homography(frame.homography)
    covariance = (
        variance * inflation * (by_homography @ inverse_normal[:8, :8].copy() @ by_homography.T)
    )
    corners = np.empty((4, 2))
    for k in range(4):
        corners[k, 0] = at[k, 0] + frame.centre_x
        corners[k, 1] = at[k, 1] + frame.centre_y
    if not (np.all(np.isfinite(covariance)) and np.all(np.isfinite(corners))):
        return _not_found()
    for k in range(8):
        if covariance[k, k] <= 0.0:
            return _not_found()
    cells, cell_sigma = cell_values(samples, pattern, frame, p, left, variance)
    explained = 1.0 - max(0.0, plain - count * noise * noise) / total
    return PatternEstimate(
        True, corners, covariance, cells, cell_sigma, math.sqrt(variance), explained,
        agree / count, p[WHITE_AT] - p[BLACK_AT], p[BLUR_AT : BLUR_AT + 3].copy(), inflation,
    )  # fmt: skip


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
