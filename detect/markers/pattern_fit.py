"""Phase 3, last part: the whole marker fitted to the grey values.

The four edges of a small marker give little information, but its cells have edges, too. Given a
candidate pattern, the whole marker is fitted at once, by robust least squares: corners, light, blur
(the model of `detect.markers.pattern_model`, its grey values clipped at 0 and 255). Each cell by
itself then confirms or refutes the pattern.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.edges import LEAST_NOISE, OUTLIER, robust_sigma
from detect.markers.homography import corners_by_homography, inverse_3x3, square_homography
from detect.markers.lens import Picture
from detect.markers.pattern_model import (
    BLACK_AT,
    BLUR_AT,
    LIGHT_NUMBERS,
    PARAMETERS,
    TONE_AT,
    WHITE_AT,
    Pattern,
    blurred_blackness,
    confine_blur,
    corner_signs,
    light_level,
    place_on_marker,
)
from detect.markers.pattern_pixels import PixelBox, Samples, Seam, pixel_box, select_pixels
from detect.markers.pattern_residuals import MarkerFrame, Residuals, cell_values, inflation_of
from detect.markers.templates import Templates
from detect.positive_definite import invert_positive, solve_positive

FloatArray = NDArray[np.float64]

#: Width of the seam round the marker that is fitted: blurs and pixels, at most a cell's size.
_SEAM_BLURS = 2.5
_SEAM_PX = 0.5
_LEAST_SEAM_PX = 1.2
#: How far a corner may move from where the edges meet, pixels or cells, the greater.
_REACH_PX = 1.5
_REACH_CELLS = 0.75

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
#: Whether there is one, its corners, their covariances, the cells' whiteness and its standard
#: deviation, covariance uu, uv, vv of the blur (px^2), contrast, standard deviation of the
#: residuals (grey levels), explained share.
_Estimate: TypeAlias = tuple[
    bool, FloatArray, FloatArray, tuple[FloatArray, FloatArray], FloatArray, float, float, float
]


class Effort(NamedTuple):
    """About how many pixels a fit uses at most, and how many steps it takes."""

    pixels: int
    steps: int


#: A first look is enough to see whether it may be that marker.
FIRST_LOOK, WHOLE_FIT = Effort(450, 5), Effort(3000, 12)


class Levels(NamedTuple):
    """What a fit begins with: grey levels of black and white, standard deviation of the blur."""

    black: float
    white: float
    blur_px: float


class PatternFit(NamedTuple):
    """A marker fitted to the grey values.

    Attributes
    ----------
    corners : (4, 2) float64
        Straight pixels, in the order of the corners given.
    covariance : (4, 2, 2) float64
        Of each corner, pixels squared.
    cells, cell_sigma : (G * G,) float64
        Whiteness of each cell of the grid, as the grey values have it, and its standard deviation
        due to noise.
    border : (B,) float64
        Whiteness of the other cells of the square.
    misfit : float
        Standard deviation of what is left over beyond the image's noise, in contrasts.
    explained : float
        Explained share of the grey values' variance, noise aside.
    blur_px : float
        Mean standard deviation of the blur.
    blur_cells : float
        Standard deviation of the blur along the marker's axes, the greater, in cells.
    """

    corners: FloatArray
    covariance: FloatArray
    cells: FloatArray
    cell_sigma: FloatArray
    border: FloatArray
    misfit: float
    explained: float
    blur_px: float
    blur_cells: float


class _Start(NamedTuple):
    """Initial values of a fit, the pixels that it uses, and its limits."""

    corners: FloatArray
    levels: Levels
    box: PixelBox
    seam: Seam
    steps: int
    reach_px: float


def fit_marker(
    picture: Picture,
    corners: FloatArray,
    templates: Templates,
    template: int,
    levels: Levels,
    effort: Effort = WHOLE_FIT,
) -> PatternFit | None:
    """Fit a marker of a known pattern.

    Parameters
    ----------
    picture : Picture
        The image.
    corners : (4, 2) float64
        Corners to begin with, straight pixels, clockwise as seen in the image.
    templates : Templates
        The dictionary.
    template : int
        Which of them.
    levels : Levels
        Grey levels and blur to begin with.
    effort : Effort
        How many pixels and steps.

    Returns
    -------
    PatternFit or None
        None if there is no fit near the given corners.
    """
    cell_px = templates.dictionary.cell * _least_side(corners)
    near = _SEAM_BLURS * levels.blur_px + _SEAM_PX
    reach = min(near, max(_LEAST_SEAM_PX, cell_px))
    box = pixel_box(picture, corners, reach)
    if box is None:
        return None
    black = templates.blackness(template)
    pattern = Pattern(templates.lines, black, corner_signs(black))
    reach_px = max(_REACH_PX, _REACH_CELLS * cell_px)
    seam = Seam(reach, near, effort.pixels)
    start = _Start(corners, levels, box, seam, effort.steps, reach_px)
    found, fitted, covariance, (values, sigma), blur, contrast, rest, explained = _fit_pattern(
        picture, pattern, start
    )
    if not found:
        return None
    grid = templates.grid
    outside = np.ones(black.shape, dtype=bool)
    outside[grid, grid] = False
    excess = math.sqrt(max(0.0, rest**2 - max(picture.noise, LEAST_NOISE) ** 2))
    return PatternFit(
        corners=fitted,
        covariance=covariance,
        cells=values[grid, grid].ravel(),
        cell_sigma=sigma[grid, grid].ravel(),
        border=values[outside],
        misfit=excess / max(contrast, 1e-3),
        explained=explained,
        blur_px=math.sqrt(0.5 * (blur[0] + blur[2])),
        blur_cells=_blur_along_axes(fitted, blur) / templates.dictionary.cell,
    )


def _blur_along_axes(corners: FloatArray, covariance: FloatArray) -> float:
    """Standard deviation of the blur in the marker's middle, along its axes, in its widths."""
    h = square_homography(corners)
    w = 0.5 * (h[2, 0] + h[2, 1]) + 1.0
    middle = (0.5 * (h[:2, 0] + h[:2, 1]) + h[:2, 2]) / w
    px_per_width = (h[:2, :2] - np.outer(middle, h[2, :2])) / w
    widths_per_px = np.linalg.inv(px_per_width)
    uu, uv, vv = covariance
    blur = widths_per_px @ np.array([[uu, uv], [uv, vv]]) @ widths_per_px.T
    return float(np.sqrt(np.diag(blur).max()))


def _least_side(corners: FloatArray) -> float:
    """Least distance of opposite edges' middles, pixels."""
    middles = 0.5 * (corners + np.roll(corners, -1, axis=0))
    return float(min(np.hypot(*(middles[0] - middles[2])), np.hypot(*(middles[1] - middles[3]))))


@njit(cache=True, error_model="numpy")
def _fit_pattern(picture: Picture, pattern: Pattern, start: _Start) -> _Estimate:
    """Robust least squares of a pattern to grey values, by the Gauss-Newton method."""
    samples = select_pixels(picture, start.corners, pattern.lines, start.box, start.seam)
    count = len(samples.grey)
    if count < PARAMETERS + _SPARE_PIXELS:
        return _not_found()
    centre = np.array([start.corners[:, 0].mean(), start.corners[:, 1].mean()])
    at = start.corners - centre
    size = 1.0
    for k in range(4):
        size = max(size, math.hypot(at[k, 0], at[k, 1]))
    p = np.zeros(PARAMETERS)
    p[WHITE_AT] = start.levels.white
    p[BLACK_AT] = start.levels.black
    p[BLUR_AT] = p[BLUR_AT + 2] = start.levels.blur_px**2
    confine_blur(p)
    blur_guess = p[BLUR_AT]
    least = max(picture.noise, LEAST_NOISE)
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
    frame = _frame_at(at, centre, size)
    for iteration in range(start.steps + 1):
        _linearise(samples, pattern, frame, p, scale, left)
        _accumulate_squares(left.rows, squares)
        normal[:] = squares[:PARAMETERS, :PARAMETERS]
        right[:] = squares[:PARAMETERS, PARAMETERS]
        scale = robust_sigma(left.residual, _SAMPLED_RESIDUALS, least)
        _add_priors(normal, right, p, scale, blur_guess)
        if iteration == start.steps or last_move < _CLOSE_ENOUGH_PX:
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
            off_x = at[k, 0] + centre[0] - start.corners[k, 0]
            off_y = at[k, 1] + centre[1] - start.corners[k, 1]
            if math.hypot(off_x, off_y) > start.reach_px:
                return _not_found()
        p[8:] += change[8:]
        p[TONE_AT] = min(max(p[TONE_AT], -_LARGEST_TONE), _LARGEST_TONE)
        largest_blur = blur_guess + (1.0 + 2.0 * blur_guess)
        p[BLUR_AT] = min(p[BLUR_AT], largest_blur)
        p[BLUR_AT + 2] = min(p[BLUR_AT + 2], largest_blur)
        confine_blur(p)
        frame = _frame_at(at, centre, size)
    return _estimate(samples, pattern, frame, p, left, normal, at, picture.noise)


@njit(cache=True, error_model="numpy")
def _frame_at(at: FloatArray, centre: FloatArray, size: float) -> MarkerFrame:
    homography = square_homography(at)
    return MarkerFrame(homography, inverse_3x3(homography), centre[0], centre[1], size)


@njit(cache=True, error_model="numpy")
def _not_found() -> _Estimate:
    none = np.empty((0, 0))
    empty = np.empty((0, 0, 0))
    return False, none, empty, (none, none), np.empty(0), math.nan, math.nan, math.nan


@njit(cache=True, error_model="numpy")
def _linearise(
    samples: Samples,
    pattern: Pattern,
    frame: MarkerFrame,
    p: FloatArray,
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
    normal: FloatArray,
    right: FloatArray,
    p: FloatArray,
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
    p: FloatArray,
    left: Residuals,
    normal: FloatArray,
    at: FloatArray,
    noise: float,
) -> _Estimate:
    """Corners, covariance and figures of a fit that has come to its end."""
    inverse_normal = np.empty((PARAMETERS, PARAMETERS))
    if not invert_positive(normal, inverse_normal):
        return _not_found()
    count = len(samples.grey)
    rest, weight_sum, plain, mean, square = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        rest += left.weight[k] * left.residual[k] ** 2
        weight_sum += left.weight[k]
        plain += left.residual[k] ** 2
        mean += samples.grey[k]
        square += samples.grey[k] ** 2
    mean /= count
    total = max(square - count * mean * mean, 1e-9)
    least = max(noise, LEAST_NOISE)
    variance = max(rest / max(weight_sum - PARAMETERS, 1.0), least * least)
    by_homography = corners_by_homography(frame.homography)
    whole = (
        variance * inflation_of(samples.pixel, left)
        * (by_homography @ inverse_normal[:8, :8].copy() @ by_homography.T)
    )  # fmt: skip
    corners = np.empty((4, 2))
    covariance = np.empty((4, 2, 2))
    for k in range(4):
        corners[k, 0] = at[k, 0] + frame.centre_x
        corners[k, 1] = at[k, 1] + frame.centre_y
        covariance[k] = whole[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        if not (covariance[k, 0, 0] > 0.0 and covariance[k, 1, 1] > 0.0):
            return _not_found()
    if not (np.all(np.isfinite(whole)) and np.all(np.isfinite(corners))):
        return _not_found()
    cells = cell_values(samples, pattern, frame, p, left, variance)
    explained = 1.0 - max(0.0, plain - count * noise * noise) / total
    blur = p[BLUR_AT : BLUR_AT + 3].copy()
    contrast = p[WHITE_AT] - p[BLACK_AT]
    return True, corners, covariance, cells, blur, contrast, math.sqrt(variance), explained


@njit(cache=True, error_model="numpy")
def _accumulate_squares(rows: FloatArray, squares: FloatArray) -> None:
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
