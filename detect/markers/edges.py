"""Fits a blurred step to the grey values along each of a marker's four edges.

A straight step between two grey levels, which change along the edge, by robust least squares of all
pixels near the expected place except near the corners. Everything happens at straight positions
(see `detect.markers.lens`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.homography import project, square_homography
from detect.markers.lens import Picture, bent, middle_pixel, straightened
from detect.positive_definite import invert_positive, solve_positive

FloatArray = NDArray[np.float64]

#: Residuals beyond this many standard deviations lose weight.
OUTLIER = 3.0
#: Grey values are rounded: noise is never below this, grey levels.
LEAST_NOISE = 0.3

_MEDIAN_TO_SIGMA = 1.0 / 0.6745
#: Of a step: offset and turn (px), dark and light grey level, the light's change along the edge,
#: the blur's logarithm, the light's change across the edge, the dark's along it.
_PARAMETERS = 8
_LEAST_PIXELS = 12
_LEAST_BLUR = 0.25
_LARGEST_BLUR = 8.0
_WIDE_STEPS = 5
_STEPS = 12
#: Largest standard deviation of what a step leaves over, in its contrast.
_LARGEST_REST = 0.6
_ROOT_HALF = math.sqrt(0.5)
_ROOT_2PI = math.sqrt(2.0 * math.pi)
_SEGMENTS = 8
#: Number of places across an edge at which its search may begin.
_SPLITS = 14
#: Standard deviation of the light's change across an edge, in contrasts per pixel.
_LIGHT_SLOPE = 0.004
_SAMPLED_RESIDUALS = 400


class EdgeFits(NamedTuple):
    """The fitted steps of a quadrangle's four edges; each attribute is (4,) float64.

    Attributes
    ----------
    offset, turn
        From the given line outwards, in its middle, and the change from there to its end, pixels.
    var_offset, covar, var_turn
        Their variances and covariance, pixels squared.
    dark, light
        Grey levels, inside and outside.
    blur
        Standard deviation, the pixel's own included, pixels.
    support
        Share of the length where the step is there.
    """

    offset: FloatArray
    turn: FloatArray
    var_offset: FloatArray
    covar: FloatArray
    var_turn: FloatArray
    dark: FloatArray
    light: FloatArray
    blur: FloatArray
    support: FloatArray


class EdgeSearch(NamedTuple):
    """How edges are searched for.

    Attributes
    ----------
    capture : float
        How far the edges may be from the rough ones, pixels.
    border : float
        Thickness of the black border, in widths of the marker.
    blur_guess : float
        Standard deviation of the blur, pixels.
    most_pixels : int
        About how many pixels are used per edge; of more, whole columns (rows) are left out.
    close_enough : float
        Steps smaller than this end the iteration, pixels.
    """

    capture: float
    border: float
    blur_guess: float
    most_pixels: int
    close_enough: float


class _Band(NamedTuple):
    """The surroundings of a line from p0 to p1, of which pixels within margin of an end are out."""

    p0: FloatArray
    p1: FloatArray
    inwards: float
    outwards: float
    margin: float
    stride: int


class _EdgePixels(NamedTuple):
    """Pixels near a line: where along (-1 to 1), how far out (px), grey value."""

    along: FloatArray
    across: FloatArray
    grey: FloatArray


class _Normal(NamedTuple):
    """Normal equations of the step's parameters, with the residuals that they come from."""

    matrix: FloatArray
    right: FloatArray
    residual: FloatArray


@njit(cache=True, error_model="numpy")
def fit_edges(picture: Picture, corners: FloatArray, search: EdgeSearch, edges: EdgeFits) -> bool:
    """Fit a blurred step to each of four edges.

    Parameters
    ----------
    picture : Picture
        The image.
    corners : (4, 2) float64
        Rough corners, clockwise as seen in the image, straight pixels.
    search : EdgeSearch
        How far and how closely.
    edges : EdgeFits
        Result.

    Returns
    -------
    bool
        Whether all four were fitted.
    """
    guess = middle_pixel(picture.lens, corners)
    thickness = _border_thickness(corners, search.border)
    for k in range(4):
        p0 = corners[k]
        p1 = corners[(k + 1) % 4]
        length = math.hypot(p1[0] - p0[0], p1[1] - p0[1])
        reach = min(search.capture, max(1.2, thickness[k]))
        inwards = min(reach, max(1.0, 0.85 * thickness[k]))
        margin = min(max(1.0, 0.7 * reach), 0.2 * length)
        stride = max(1, int(length * (inwards + reach) / search.most_pixels))
        pixels = _pixels_along(picture, guess, _Band(p0, p1, inwards, reach, margin, stride))
        if not _fit_step(pixels, reach, picture.noise, search, edges, k):
            return False
    return True


@njit(cache=True, error_model="numpy")
def _border_thickness(corners: FloatArray, border: float) -> FloatArray:
    """(4,) thickness of the black border in the middle of each edge, pixels."""
    homography = square_homography(corners)
    result = np.empty(4)
    for k in range(4):
        mx = 0.5 if k % 2 == 0 else (1.0 - border if k == 1 else border)
        my = 0.5 if k % 2 == 1 else (border if k == 0 else 1.0 - border)
        x, y, _ = project(homography, mx, my)
        p0 = corners[k]
        p1 = corners[(k + 1) % 4]
        length = math.hypot(p1[0] - p0[0], p1[1] - p0[1])
        result[k] = abs((x - p0[0]) * (p1[1] - p0[1]) - (y - p0[1]) * (p1[0] - p0[0])) / length
    return result


@njit(cache=True, error_model="numpy")
def _pixels_along(picture: Picture, guess: tuple[float, float], band: _Band) -> _EdgePixels:
    """The pixels of a band, but every `stride`-th of the image's columns or rows only."""
    image, lens = picture.grey, picture.lens
    p0, p1, inwards, outwards = band.p0, band.p1, band.inwards, band.outwards
    height, width = image.shape
    length = math.hypot(p1[0] - p0[0], p1[1] - p0[1])
    most = int((length + 4.0) * (inwards + outwards + 2.0)) + 64
    along, across, grey = np.empty(most), np.empty(most), np.empty(most)
    tx, ty = (p1[0] - p0[0]) / length, (p1[1] - p0[1]) / length
    u0, v0 = bent(lens, p0[0], p0[1], guess)
    u1, v1 = bent(lens, p1[0], p1[1], guess)
    if not (math.isfinite(u0 + v0) and math.isfinite(u1 + v1)):
        return _EdgePixels(along[:0], across[:0], grey[:0])
    flat = abs(u1 - u0) >= abs(v1 - v0)
    # A rough width of the band along the other axis; the test below is exact.
    pad = 1.5 * max(inwards, outwards) + 2.0
    if flat:
        begin, end = min(u0, u1), max(u0, u1)
        slope = (v1 - v0) / (u1 - u0)
        limit_a, limit_b = width, height
    else:
        begin, end = min(v0, v1), max(v0, v1)
        slope = (u1 - u0) / (v1 - v0)
        limit_a, limit_b = height, width
    count = 0
    half = 0.5 * length
    for a in range(max(0, int(begin - pad)), min(limit_a, int(end + pad) + 2), band.stride):
        middle = v0 + slope * (a - u0) if flat else u0 + slope * (a - v0)
        for b in range(max(0, int(middle - pad)), min(limit_b, int(middle + pad) + 2)):
            u, v = (a, b) if flat else (b, a)
            x, y, _, _, _, _ = straightened(lens, float(u), float(v))
            dx, dy = x - p0[0], y - p0[1]
            s = dx * tx + dy * ty
            d = dx * ty - dy * tx
            if s < band.margin or s > length - band.margin or d < -inwards or d > outwards:
                continue
            if count == most:
                return _EdgePixels(along, across, grey)
            along[count] = (s - half) / half
            across[count] = d
            grey[count] = image[v, u]
            count += 1
    return _EdgePixels(along[:count], across[:count], grey[:count])


@njit(cache=True, error_model="numpy")
def _best_split(across: FloatArray, grey: FloatArray, reach: float) -> tuple[float, float, float]:
    """How far out the grey values are best split in two, and the means on both sides.

    The split that explains most variance (Otsu's criterion), of those with the dark side inside.
    """
    n = np.zeros(_SPLITS)
    total = np.zeros(_SPLITS)
    for k in range(len(grey)):
        b = min(max(int((across[k] / reach + 1.0) * 0.5 * _SPLITS), 0), _SPLITS - 1)
        n[b] += 1.0
        total[b] += grey[k]
    all_n = n.sum()
    all_total = total.sum()
    best, at, low, high = 0.0, 0.0, 0.0, 0.0
    n_in, total_in = 0.0, 0.0
    for b in range(_SPLITS - 1):
        n_in += n[b]
        total_in += total[b]
        n_out = all_n - n_in
        if n_in < 3.0 or n_out < 3.0:
            continue
        inside = total_in / n_in
        outside = (all_total - total_in) / n_out
        between = (outside - inside) ** 2 * n_in * n_out
        if outside > inside and between > best:
            best = between
            at = ((b + 1.0) * 2.0 / _SPLITS - 1.0) * reach
            low = inside
            high = outside
    return at, low, high


@njit(cache=True, error_model="numpy")
def _fit_step(
    pixels: _EdgePixels, reach: float, noise: float, search: EdgeSearch, out: EdgeFits, k: int
) -> bool:
    """Robust least squares of a blurred step, which becomes edge k of the results.

    The first steps of the iteration move a wide blur, which sees far, in place and levels only;
    then the levels alone are adapted to the blur expected; then all is free.
    """
    count = len(pixels.grey)
    if count < _LEAST_PIXELS:
        return False
    # Inside is darker, beyond what noise does.
    split, low, high = _best_split(pixels.across, pixels.grey, reach)
    if not high > low + 0.3 * noise:
        return False
    log_guess = math.log(search.blur_guess)
    wide = max(0.6 * reach, search.blur_guess)
    p = np.zeros(_PARAMETERS)
    p[0], p[2], p[3], p[5] = split, low, high, math.log(wide)
    least = max(noise, LEAST_NOISE)
    normal = _Normal(np.empty((_PARAMETERS, _PARAMETERS)), np.empty(_PARAMETERS), np.empty(count))
    change = np.empty(_PARAMETERS)
    inverse = np.empty((_PARAMETERS, _PARAMETERS))
    scale = -1.0
    converged = False
    free_steps = 0
    for iteration in range(_WIDE_STEPS + _STEPS):
        wide_now = iteration < _WIDE_STEPS and wide > 1.2 * search.blur_guess
        if not wide_now:
            free_steps += 1
        if iteration == _WIDE_STEPS or (iteration == 0 and not wide_now):
            p[5] = log_guess
        outlier = OUTLIER * scale if free_steps > 2 else math.inf
        weight_sum, rest = _linearise(pixels, p, outlier, normal)
        scale = robust_sigma(normal.residual, _SAMPLED_RESIDUALS, least)
        _add_priors(normal, p, scale, log_guess)
        if wide_now or free_steps == 1:
            # Place and levels only: the rest would follow what is not the edge. Then levels alone,
            # with the narrow blur: those of the wide one are off.
            for i in range(_PARAMETERS):
                if not (i == 2 or i == 3 or (wide_now and i < 2)):
                    normal.matrix[i, :] = 0.0
                    normal.matrix[:, i] = 0.0
                    normal.matrix[i, i] = 1.0
                    normal.right[i] = 0.0
        for i in range(2):
            normal.matrix[i, i] += 1e-9 * (1.0 + normal.matrix[i, i])
        if not solve_positive(normal.matrix, normal.right, change):
            return False
        largest = max(abs(change[0]), abs(change[1]))
        change[:2] *= min(1.0, 0.6 * reach / largest) if largest > 0.0 else 1.0
        change[5] = min(max(change[5], -0.7), 0.7)
        p += change
        p[5] = min(max(p[5], math.log(_LEAST_BLUR)), math.log(_LARGEST_BLUR))
        if abs(p[0]) + abs(p[1]) > 2.0 * reach:
            return False
        if wide_now:
            if iteration + 1 < _WIDE_STEPS and largest < 0.05:
                # Close: go on with the blur free.
                wide = search.blur_guess
                p[5] = log_guess
        elif largest < search.close_enough and free_steps > 2:
            converged = True
            break
    if not converged and iteration + 1 < _WIDE_STEPS + _STEPS:
        return False
    if not invert_positive(normal.matrix, inverse):
        return False
    variance = max(rest / max(weight_sum - _PARAMETERS, 1.0), least * least)
    out.offset[k], out.turn[k] = p[0], p[1]
    out.var_offset[k] = variance * inverse[0, 0]
    out.covar[k] = variance * inverse[0, 1]
    out.var_turn[k] = variance * inverse[1, 1]
    out.dark[k], out.light[k] = p[2], p[3]
    out.blur[k] = math.exp(p[5])
    out.support[k] = _support(pixels, p)
    numbers = p.sum() + inverse[:2, :2].sum() + variance + scale
    return bool(np.isfinite(numbers) and scale < _LARGEST_REST * (p[3] - p[2]))


@njit(cache=True, error_model="numpy")
def _linearise(
    pixels: _EdgePixels, p: FloatArray, outlier: float, normal: _Normal
) -> tuple[float, float]:
    """Normal equations about p; returns the sums of the weights and of the weighted squares."""
    along, across, grey = pixels.along, pixels.across, pixels.grey
    matrix, right = normal.matrix, normal.right
    jacobian = np.empty(_PARAMETERS)
    matrix[:] = 0.0
    right[:] = 0.0
    blur = math.exp(p[5])
    weight_sum = 0.0
    rest = 0.0
    for n in range(len(grey)):
        z = (across[n] - p[0] - p[1] * along[n]) / blur
        share = 0.5 * (1.0 + math.erf(z * _ROOT_HALF))
        density = math.exp(-0.5 * z * z) / _ROOT_2PI
        out_px = z * blur
        top = p[3] + p[4] * along[n] + p[6] * out_px
        bottom = p[2] + p[7] * along[n]
        step = top - bottom
        r = grey[n] - (bottom + step * share)
        normal.residual[n] = r
        weight = (outlier / r) ** 2 if abs(r) > outlier else 1.0
        slope = -step * density / blur - p[6] * share
        jacobian[0] = slope
        jacobian[1] = slope * along[n]
        jacobian[2] = 1.0 - share
        jacobian[3] = share
        jacobian[4] = share * along[n]
        jacobian[5] = -step * density * z
        jacobian[6] = share * out_px
        jacobian[7] = (1.0 - share) * along[n]
        for i in range(_PARAMETERS):
            right[i] += weight * jacobian[i] * r
            for j in range(i, _PARAMETERS):
                matrix[i, j] += weight * jacobian[i] * jacobian[j]
        weight_sum += weight
        rest += weight * r * r
    for i in range(_PARAMETERS):
        for j in range(i):
            matrix[i, j] = matrix[j, i]
    return weight_sum, rest


@njit(cache=True, error_model="numpy")
def _add_priors(normal: _Normal, p: FloatArray, scale: float, log_guess: float) -> None:
    """Weak priors: light changes little along an edge; the blur is about what was guessed."""
    variance = scale * scale
    contrast = max(abs(p[3] - p[2]), scale)
    for i, sigma, expected in (
        (4, 0.3 * contrast, 0.0),
        (7, 0.3 * contrast, 0.0),
        (6, _LIGHT_SLOPE * contrast, 0.0),
        (5, 0.5, log_guess),
    ):
        prior = variance / (sigma * sigma)
        normal.matrix[i, i] += prior
        normal.right[i] -= prior * (p[i] - expected)


@njit(cache=True, error_model="numpy")
def robust_sigma(residual: FloatArray, sampled: int, least: float) -> float:
    """Standard deviation of residuals (N,) by the median of their magnitudes, at least `least`.

    Of more residuals than about `sampled` every second, third, ... is used.
    """
    stride = max(1, len(residual) // sampled)
    return max(least, _MEDIAN_TO_SIGMA * float(np.median(np.abs(residual[::stride]))))


@njit(cache=True, error_model="numpy")
def _support(pixels: _EdgePixels, p: FloatArray) -> float:
    """Share of the segments of an edge whose own step is at least half the fitted one."""
    along, across, grey = pixels.along, pixels.across, pixels.grey
    inside = np.zeros(_SEGMENTS)
    outside = np.zeros(_SEGMENTS)
    n_inside = np.zeros(_SEGMENTS)
    n_outside = np.zeros(_SEGMENTS)
    for k in range(len(grey)):
        d = across[k] - p[0] - p[1] * along[k]
        segment = min(int((along[k] + 1.0) * 0.5 * _SEGMENTS), _SEGMENTS - 1)
        if d < -0.5:
            inside[segment] += grey[k]
            n_inside[segment] += 1.0
        elif d > 0.5:
            outside[segment] += grey[k]
            n_outside[segment] += 1.0
    there, known = 0.0, 0.0
    for k in range(_SEGMENTS):
        if n_inside[k] > 0.0 and n_outside[k] > 0.0:
            known += 1.0
            if outside[k] / n_outside[k] - inside[k] / n_inside[k] > 0.5 * (p[3] - p[2]):
                there += 1.0
    return there / known if known > 0.0 else 0.0
