"""Edges and corners with sub-pixel precision: phase 3, first part.

A blurred step between two grey levels is fitted along each edge of a rough quadrangle, to all
pixels near it except near the corners. The fitted edges meet in the corners, whose covariances
follow from theirs. Everything happens at straight positions (see `detect.markers.geometry`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.markers.geometry import Picture, is_convex
from detect.positive_definite import invert_positive, solve_positive
from redetect.array_types import FloatArray, GreyImage
from redetect.compiled import kernel

#: Cause of rejection, as it is counted.
NO_EDGE = "edge not found"

#: Residuals beyond this many standard deviations lose weight.
OUTLIER = 3.0
#: Grey values are rounded: noise is never below this, grey levels.
LEAST_NOISE = 0.3
_MEDIAN_TO_SIGMA = 1.0 / 0.6745

#: Of each pass, if the edges are a start or the result: about how many pixels per edge are used (of
#: more, whole columns or rows are left out), and steps that end the iteration, pixels.
_QUICK_PASSES = ((100, 0.02), (250, 0.02))
_PASSES = ((100, 0.02), (1500, 0.002), (1500, 0.002))
#: Corners that a later pass moves less than this are where they are.
_CLOSE_ENOUGH_PX = 0.05
_FIRST_BLUR_PX = 0.9
#: After the first pass an edge is searched within this many of its blurs, and this many pixels;
#: with fewer rows of pixels on each side than the last number more would be unknown than there are.
_REACH_BLURS, _REACH_PX, _LEAST_REACH_PX = 2.5, 0.8, 2.2
#: Corners that move farther than this (in capture ranges) left their quadrangle.
_LARGEST_MOVE = 2.5

#: Of a step: offset and turn (px), dark and light grey level, the blur's logarithm, the light's
#: change along and across the edge, the dark's along it.
_PARAMETERS = 8
_LEAST_PIXELS = 12
_LEAST_BLUR, _LARGEST_BLUR = 0.25, 8.0
#: First all pixels weigh alike, then as their residuals suggest; steps of each round.
_ROUNDS, _STEPS = 2, 8
#: Standard deviations of the blur's logarithm; of the light's change along half an edge, and across
#: it per pixel, both in contrasts.
_BLUR_SIGMA, _ALONG_SIGMA, _ACROSS_SIGMA = 0.5, 0.3, 0.004
#: Standard deviation of what a step leaves over, in its contrast: expected, and largest.
_NO_OUTLIER = 1e9
_FIRST_REST, _LARGEST_REST = 0.2, 0.6
#: Places across an edge, and turns of it (in reaches), at which a fit may begin.
_SPLITS, _TURNS = 14, (0.0, -0.3, 0.3, -0.6, 0.6)
_SEGMENTS = 8


class RefinedQuadrangle(NamedTuple):
    """A quadrangle whose edges were fitted; edge k goes from corner k to corner k + 1."""

    corners: FloatArray  # (4, 2) straight pixels, clockwise as seen in the image
    covariance: FloatArray  # (4, 2, 2) of each corner, from its two edges, pixels squared
    dark: FloatArray  # (4,) grey level inside each edge
    light: FloatArray  # (4,) grey level outside
    blur: FloatArray  # (4,) standard deviation, the pixel's own included, pixels
    support: FloatArray  # (4,) share of the length where the step is seen


class _Search(NamedTuple):
    """How edges are searched for."""

    noise: float  # standard deviation, grey levels
    capture: float  # how far they may be from the rough ones, pixels
    border: float  # thickness of the black border, in widths of the marker
    blur: float  # expected standard deviation, pixels
    pixels: int
    close_enough: float


class _Band(NamedTuple):
    """Where an edge is searched for."""

    start: FloatArray  # (2,) straight pixels
    end: FloatArray
    seen_start: FloatArray  # (2,) pixels of the image
    seen_end: FloatArray
    inwards: float  # how far, pixels
    reach: float  # how far outwards, pixels
    stride: int  # of columns (rows) one is used


class _Pixels(NamedTuple):
    """Pixels near an edge."""

    along: FloatArray  # -1 to 1
    across: FloatArray  # outwards, pixels
    grey: FloatArray


class _Step(NamedTuple):
    """A fitted step: how far outwards the line given is to be moved at its ends, pixels."""

    start: float
    end: float
    var_start: float
    var_end: float
    dark: float
    light: float
    blur: float
    support: float


class _Linearised(NamedTuple):
    """Normal equations about some parameters, and sums over the pixels there."""

    matrix: FloatArray
    right: FloatArray
    cost: float
    weight: float
    squares: float
    residual: FloatArray


_NO_STEP = _Step(*(math.nan,) * 8)


def refine_quadrangle(
    picture: Picture,
    rough: FloatArray,
    outline: FloatArray,
    border: float,
    capture_px: float,
    *,
    quick: bool = False,
) -> RefinedQuadrangle | None:
    """Fit the edges of a quadrangle (4, 2), clockwise at straight pixels, to the image.

    `outline` are its corners in the image, `border` widths of the marker the black border's
    thickness. Edges are within `capture_px` of the rough ones; with `quick` they are good enough to
    begin the fit of the whole marker with. None if an edge is not there, or the edges make no
    convex quadrangle near the rough one.
    """
    refined: RefinedQuadrangle | None = None
    if not np.all(np.isfinite(outline)):
        return None
    corners, reach, blur = rough, capture_px, _FIRST_BLUR_PX
    for pixels, close_enough in _QUICK_PASSES if quick else _PASSES:
        search = _Search(max(picture.noise, LEAST_NOISE), reach, border, blur, pixels, close_enough)
        seen, last = outline + (corners - rough), refined
        refined = _fit_edges(picture.grey, picture.straight, corners, seen, search)
        # What is not there is NaN.
        moved_far = not np.abs(refined.corners - rough).max() <= _LARGEST_MOVE * capture_px
        if moved_far or not is_convex(refined.corners):
            return None
        if last is not None and np.abs(refined.corners - corners).max() < _CLOSE_ENOUGH_PX:
            break
        corners = refined.corners
        blur = min(max(float(np.median(refined.blur)), 0.3), 6.0)
        reach = max(_REACH_BLURS * blur + _REACH_PX, _LEAST_REACH_PX)
    return refined


@kernel()
def _fit_edges(
    grey: GreyImage,
    straight: NDArray[np.float32],
    corners: FloatArray,
    seen: FloatArray,
    search: _Search,
) -> RefinedQuadrangle:
    """Fit the four edges between corners, seen at some pixels; NaN if one is not there."""
    found = RefinedQuadrangle(
        np.full((4, 2), np.nan), np.zeros((4, 2, 2)),
        np.empty(4), np.empty(4), np.empty(4), np.empty(4),
    )  # fmt: skip
    lines, variance = np.empty((4, 3)), np.empty((4, 2))
    for k in range(4):
        p0, p1 = corners[k], corners[(k + 1) % 4]
        outwards = np.array([p1[1] - p0[1], p0[0] - p1[0]]) / math.hypot(
            p1[0] - p0[0], p1[1] - p0[1]
        )
        # The border is in proportion to the height over the edge.
        across = p0 - 0.5 * (corners[(k + 2) % 4] + corners[(k + 3) % 4])
        thickness = search.border * (across[0] * outwards[0] + across[1] * outwards[1])
        reach = min(search.capture, max(1.2, thickness))
        inwards = min(reach, max(1.0, 0.85 * thickness))
        stride = max(
            1, int(math.hypot(p1[0] - p0[0], p1[1] - p0[1]) * (inwards + reach) / search.pixels)
        )
        ends = _Band(p0, p1, seen[k], seen[(k + 1) % 4], inwards, reach, stride)
        pixels = _pixels_along(grey, straight, ends)
        step = _fit_step(pixels, reach, search)
        if math.isnan(step.start):
            return found
        found.dark[k], found.light[k] = step.dark, step.light
        found.blur[k], found.support[k] = step.blur, step.support
        variance[k, 0], variance[k, 1] = step.var_start, step.var_end
        a, b = p0 + step.start * outwards, p1 + step.end * outwards
        # Unit normal and distance from the origin.
        x, y, from_origin = a[1] - b[1], b[0] - a[0], a[0] * b[1] - a[1] * b[0]
        length = math.hypot(x, y)
        lines[k, 0], lines[k, 1], lines[k, 2] = x / length, y / length, from_origin / length
    for k in range(4):
        a, b = lines[k - 1], lines[k]
        sine = a[0] * b[1] - a[1] * b[0]
        found.corners[k, 0] = (a[1] * b[2] - a[2] * b[1]) / sine
        found.corners[k, 1] = (a[2] * b[0] - a[0] * b[2]) / sine
        # A line that moves takes the corner along the other line.
        for line, spread in ((b, variance[k - 1, 1]), (a, variance[k, 0])):
            along = -line[1] / sine, line[0] / sine
            for i in range(2):
                for j in range(2):
                    found.covariance[k, i, j] += spread * (along[i] * along[j])
    return found


@kernel()
def _fit_step(pixels: _Pixels, reach: float, search: _Search) -> _Step:
    """Robust least squares of a blurred step; NaN if there is none.

    By the Levenberg-Marquardt method, from the best split of the grey values in two.
    """
    if len(pixels.grey) < _LEAST_PIXELS:
        return _NO_STEP
    noise = search.noise
    offset, turn, dark, light = _best_split(pixels, reach)
    if not light > dark + 0.3 * noise:
        return _NO_STEP
    expected = np.array([0.0, 0.0, dark, light, math.log(search.blur), 0.0, 0.0, 0.0])
    p = expected.copy()
    p[0], p[1] = offset, turn
    change = np.empty(_PARAMETERS)
    scale, outlier = _FIRST_REST * (light - dark), _NO_OUTLIER
    sigma = np.full(_PARAMETERS, math.inf)
    sigma[4] = _BLUR_SIGMA
    for _ in range(_ROUNDS):
        contrast = p[3] - p[2]
        sigma[5], sigma[7] = _ALONG_SIGMA * contrast, _ALONG_SIGMA * contrast
        sigma[6] = _ACROSS_SIGMA * contrast
        prior = (scale / sigma) ** 2
        here = _linearise(pixels, p, expected, prior, outlier)
        damping = 1e-3
        for _ in range(_STEPS):
            damped = here.matrix.copy()
            for i in range(_PARAMETERS):
                damped[i, i] += damping * here.matrix[i, i]
            if not solve_positive(damped, here.right, change):
                return _NO_STEP
            trial = p + change
            trial[4] = min(max(trial[4], math.log(_LEAST_BLUR)), math.log(_LARGEST_BLUR))
            there = _linearise(pixels, trial, expected, prior, outlier)
            if there.cost < here.cost:
                p, here = trial, there
                damping *= 0.1
            else:
                damping *= 10.0
            if abs(change[0]) + abs(change[1]) < search.close_enough:
                break
        scale = robust_sigma(here.residual, noise)
        outlier = OUTLIER * scale
        if abs(p[0]) + abs(p[1]) > 2.0 * reach or not scale < _LARGEST_REST * (p[3] - p[2]):
            return _NO_STEP
    inverse = np.empty((_PARAMETERS, _PARAMETERS))
    if not invert_positive(here.matrix, inverse):
        return _NO_STEP
    variance = max(here.squares / max(here.weight - _PARAMETERS, 1.0), noise * noise)
    apart = variance * (inverse[0, 0] + inverse[1, 1])
    shared = variance * 2.0 * inverse[0, 1]
    return _Step(
        p[0] - p[1], p[0] + p[1], apart - shared, apart + shared,
        p[2], p[3], math.exp(p[4]), _support(pixels, p),
    )  # fmt: skip


@kernel()
def _pixels_along(grey: GreyImage, straight: NDArray[np.float32], band: _Band) -> _Pixels:
    """Pixels near a line but not near its ends; of many, only some columns (rows)."""
    height, width = grey.shape
    start, end = band.seen_start, band.seen_end
    line = band.end - band.start
    length = math.hypot(line[0], line[1])
    tx, ty = line / length
    margin = min(max(1.0, 0.7 * band.reach), 0.2 * length)
    # Along the axis a that the line goes along rather than b; the test below is exact.
    a, b = (0, 1) if abs(end[0] - start[0]) >= abs(end[1] - start[1]) else (1, 0)
    most_a, most_b = (width, height) if a == 0 else (height, width)
    slope = (end[b] - start[b]) / (end[a] - start[a])
    pad = 1.5 * band.reach + 2.0
    first = max(0, int(min(start[a], end[a]) - pad))
    last = min(most_a, int(max(start[a], end[a]) + pad) + 2)
    most = max(0, last - first) * (int(2.0 * pad) + 4)
    along, across, values = np.empty(most), np.empty(most), np.empty(most)
    count = 0
    for i in range(first, last, band.stride):
        middle = start[b] + slope * (i - start[a])
        for j in range(max(0, int(middle - pad)), min(most_b, int(middle + pad) + 2)):
            u, v = (i, j) if a == 0 else (j, i)
            x, y = straight[v, u, 0] - band.start[0], straight[v, u, 1] - band.start[1]
            s, d = x * tx + y * ty, x * ty - y * tx
            if margin <= s <= length - margin and -band.inwards <= d <= band.reach:
                along[count], across[count] = 2.0 * s / length - 1.0, d
                values[count] = grey[v, u]
                count += 1
    return _Pixels(along[:count], across[:count], values[:count])


@kernel()
def _best_split(pixels: _Pixels, reach: float) -> tuple[float, float, float, float]:
    """Offset and turn of the line that splits the grey values best, and the means on both sides.

    It explains most variance (Otsu's criterion), of those with the dark side inside.
    """
    best, result = 0.0, (0.0, 0.0, 0.0, 0.0)
    for share in _TURNS:
        n, total = np.zeros(_SPLITS), np.zeros(_SPLITS)
        for k in range(len(pixels.grey)):
            place = pixels.across[k] / reach - share * pixels.along[k]
            b = min(max(int((place + 1.0) * 0.5 * _SPLITS), 0), _SPLITS - 1)
            n[b] += 1.0
            total[b] += pixels.grey[k]
        n_in, total_in = 0.0, 0.0
        for b in range(_SPLITS - 1):
            n_in += n[b]
            total_in += total[b]
            n_out = n.sum() - n_in
            if n_in < 3.0 or n_out < 3.0:
                continue
            dark, light = total_in / n_in, (total.sum() - total_in) / n_out
            between = (light - dark) ** 2 * n_in * n_out
            if light > dark and between > best:
                best = between
                offset = ((b + 1.0) * 2.0 / _SPLITS - 1.0) * reach
                result = (offset, share * reach, dark, light)
    return result


@kernel()
def _linearise(
    pixels: _Pixels, p: FloatArray, expected: FloatArray, prior: FloatArray, outlier: float
) -> _Linearised:
    """Normal equations about p with the weights of prior knowledge, and the robust cost."""
    along, blur = pixels.along, math.exp(p[4])
    count = len(along)
    residual, weight, jacobian = np.empty(count), np.ones(count), np.empty((_PARAMETERS, count))
    squares = log_weights = 0.0
    for n in range(count):
        out = pixels.across[n] - p[0] - p[1] * along[n]
        z = out / blur
        share = 0.5 * (1.0 + math.erf(z * math.sqrt(0.5)))
        density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
        dark = p[2] + p[7] * along[n]
        step = p[3] + p[5] * along[n] + p[6] * out - dark
        residual[n] = pixels.grey[n] - dark - step * share
        if abs(residual[n]) > outlier:
            weight[n] = (outlier / residual[n]) ** 2
            log_weights += math.log(weight[n])
        squares += weight[n] * residual[n] ** 2
        slope = -step * density / blur - p[6] * share
        jacobian[0, n], jacobian[1, n] = slope, slope * along[n]
        jacobian[2, n], jacobian[3, n], jacobian[4, n] = 1.0 - share, share, -step * density * z
        jacobian[5, n], jacobian[6, n] = share * along[n], share * out
        jacobian[7, n] = (1.0 - share) * along[n]
    weighted = weight * jacobian
    matrix = weighted @ jacobian.T
    for i in range(_PARAMETERS):
        matrix[i, i] += prior[i]
    off = expected - p
    return _Linearised(
        matrix,
        prior * off + weighted @ residual,
        np.sum(prior * off**2) + squares - outlier**2 * log_weights,
        np.sum(weight),
        squares,
        residual,
    )


@kernel()
def robust_sigma(residual: FloatArray, least: float) -> float:
    """Standard deviation of residuals (N,) by the median of their magnitudes, at least `least`."""
    return max(least, _MEDIAN_TO_SIGMA * float(np.median(np.abs(residual))))


@kernel()
def _support(pixels: _Pixels, p: FloatArray) -> float:
    """Share of the segments of an edge whose own step is at least half the fitted one."""
    # Those of the inside are even.
    count, total = np.zeros(2 * _SEGMENTS), np.zeros(2 * _SEGMENTS)
    for n in range(len(pixels.along)):
        out = pixels.across[n] - p[0] - p[1] * pixels.along[n]
        if abs(out) > 0.5:
            segment = min(int((pixels.along[n] + 1.0) * 0.5 * _SEGMENTS), _SEGMENTS - 1)
            place = 2 * segment + (out > 0.0)
            count[place] += 1.0
            total[place] += pixels.grey[n]
    known = large = 0
    for k in range(0, 2 * _SEGMENTS, 2):
        if count[k] > 0.0 and count[k + 1] > 0.0:
            known += 1
            step = total[k + 1] / count[k + 1] - total[k] / count[k]
            large += step > 0.5 * (p[3] - p[2])
    return large / known if known > 0 else 0.0
