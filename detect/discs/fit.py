"""Fits a disc, seen through the camera, to the grey values of an image.

A blurred disc is fitted to the pixels around it in one of two ways. As a whole, on a background
with slope and saddle terms (x^2 - y^2 and x y): uneven light, which cannot imitate a disc:

    grey = outside + slope . (x, y) + saddle + contrast * W(x, y, radius, blur)

Or by parts, since partial occlusion, stains and uneven light bias the fit of the whole: each of 16
sectors s has grey levels of its own for the pixels about the edge,

    grey = outside_s + contrast_s * W(x, y, radius, blur) + ramp_s * (r - radius) * grey

so light may vary freely around the disc, and rise or fall across the edge. W is the share of the
disc that a pixel sees (`detect.discs.model`). All parameters but those of W are linear and are
eliminated in every Gauss-Newton step (G. H. Golub and V. Pereyra, SIAM J. Numerical Analysis 10,
1973). The normal equations of centre, radius, and the blur along either image axis remain (motion
blurs along one of them). Radius and the logarithms of the blur have Gaussian priors.

A sector has a lower weight if the model does not explain it, or if its edge is offset from that of
the others and so belongs to another object. Within the remaining sectors, pixels with large
residuals (a cable, a stain) have lower weights. The weights are Tukey's biweights, recomputed in
every step (A. E. Beaton and J. W. Tukey, Technometrics 16, 1974).

Errors of neighbouring pixels are correlated where the model does not fit. For the whole disc, the
correlation of the residuals gives the effective number of pixels. By parts, sectors far from each
other are nearly independent: the covariance is that of the noise plus that of the jackknife that
leaves out neighbouring sectors in turn (H. R. Kuensch, Annals of Statistics 17, 1989).
"""

from __future__ import annotations

import math
import threading
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera.kernels import project_floor_point
from detect.discs.model import (
    BY_BLUR_1,
    BY_BLUR_2,
    BY_RADIUS,
    BY_X,
    BY_Y,
    F32,
    FASTMATH,
    SHARE,
    Blur,
    Disc,
    chord_shares,
    edge_shares,
)
from detect.discs.patch import (
    CAPACITY,
    CHORDS_ALONG_V,
    EDGE,
    PATCH,
    SECTORS,
    Candidate,
    Reach,
    floor_steps,
    gather,
)
from detect.discs.rim import median, within
from redetect.array_types import Float32Array, FloatArray, GreyImage, IntArray, Records
from redetect.compiled import kernel

#: Terms of the normal equations: light common to all pixels, light of each sector, the disc, and
#: last the grey values. The fit by parts begins with `_OUTSIDE`.
_SADDLE, _SADDLE_XY, _SLOPE_Y = range(3)
_OUTSIDE, _SLOPE, _CONTRAST, _BLUR_1, _BLUR_2, _RADIUS, _X, _Y, _GREY = range(3, 12)
_TERMS = 12

#: Steps of the fit; the first ones reject no sector, since the start may be off.
_STEPS, _EARLY = 12, 1
_CONVERGED_STEP = 5e-3  #: The iteration stops after a shorter step, nominal radii.
_LONGEST, _LONGEST_BLUR = 0.2, 0.7  #: Longest step, nominal radii (and log blur).
_MOST_OFF = 0.3  #: Largest offset of a fit by parts from its start, radii.
#: Bounds of the blur, pixels, and of the radius, nominal radii.
_LEAST_BLUR, _MOST_BLUR = 0.1, 8.0
_LEAST_RADIUS, _MOST_RADIUS = 0.4, 2.0
#: Bound of a flat disc's blur: this factor of the blur for which pixels were gathered, plus pixels.
_MOST_GROWTH, _MOST_GROWTH_PX = 1.5, 1.0
#: Prior of the blur, pixels, and the standard deviation of its logarithm.
_BLUR_PX, _BLUR_SIGMA = 0.6, 0.7
#: Lower bounds of a sector: pixels, spread of its shares, contrast relative to the median.
_LEAST_PIXELS, _LEAST_SPREAD, _LEAST_CONTRAST = 6.0, 0.15, 0.4
#: Standard deviation of the ramp of the light across the edge, relative, per radius.
_RAMP_SIGMA = 0.5
#: Least number of sectors, and the weight from which a sector counts.
_LEAST_SECTORS, _COUNTS = 5, 0.1
#: Offset of an edge at which its weight is 0, deviations; lower bound of the deviation, pixels.
_FAR_OFF, _LEAST_OFF_PX = 4.5, 0.05
#: Offset of an edge at which its weight is one half, in the early steps, deviations.
_FAR_EARLY = 2.0
#: Residual at which a pixel's weight is 0, deviations; share of Gaussian variance it leaves.
_FAR_PIXEL, _SHARE_LEFT = 4.0, 0.77
#: Lower bound of a pixel's weight, so that its residual can be recovered.
_LEAST_TRUST = F32(1e-3)
#: Number of neighbouring sectors that the jackknife leaves out at a time, since their errors are
#: correlated; inflation of its variance.
_STRETCH, _INFLATION = 3, 1.6

_MIDDLES = 2.0 * np.pi * (np.arange(SECTORS) + 0.5) / SECTORS
_COSINES, _SINES = np.cos(_MIDDLES), np.sin(_MIDDLES)
_CHUNK = 256  #: Pixels of which products are summed at a time.

#: Working space of fits, reused from one to the next. Its contents need not be initialised.
WORK = np.dtype([("patch", PATCH), ("rows", np.float32, (_TERMS, CAPACITY))])

#: One working space per thread: memory allocated anew for every image would cause page faults.
_kept = threading.local()


class Scene(NamedTuple):
    """An image and what its fits need."""

    image: GreyImage
    floor_xy: Float32Array
    radius: float  # nominal, metres
    noise: float  # grey levels
    blur_ratio: float  # blur along v over that along u, in pixels
    camera_numbers: FloatArray


class FitSettings(NamedTuple):
    """How discs are fitted."""

    by_parts: bool
    reach: Reach


#: Initial values of a fit, and the prior of the disc's radius (`size`); metres and pixels.
START = np.dtype(
    [("floor_xy", float, 2), ("radius", float), ("blur", float), ("size", float),
     ("size_sigma", float)]
)  # fmt: skip

#: A fitted disc; lengths in metres. If it has not converged, the rest is 0.
FIT = np.dtype(
    [
        ("converged", bool),
        ("floor_xy", float, 2),
        ("radius", float),
        ("blur", float),  # along u, pixels
        ("blur_bound", float),  # the largest blur that the patch allowed
        ("contrast", float),  # grey level inside minus outside (by parts: of the first sector)
        # Share of the variance about the background that the disc explains (of the first sector).
        ("explained", float),
        ("covariance", float, (2, 2)),  # of the centre
        # Inverse variance of the radius from the grey values alone, without the prior.
        ("radius_information", float),
    ],
    align=True,
)


class BlurredDisc(NamedTuple):
    """A disc relative to its candidate, nominal radii, and its blur."""

    x: float
    y: float
    radius: float
    blur: Blur


class Levels(NamedTuple):
    """Estimated light in each of G groups of pixels: all pixels, or the sectors."""

    contrast: FloatArray  #: (G,) grey levels; 0 if no edge is visible.
    variance: FloatArray  #: (G,) of the residuals.
    explained: FloatArray  #: (G,) share of the variance that the disc explains.
    off_px: FloatArray  #: (G,) offset of the edge outwards from the circle, pixels.
    weight: FloatArray  #: (G,) divided by the variance.


@kernel()
def eliminate(matrices: FloatArray, unknowns: range) -> None:
    """Eliminate unknowns from the rows after them of S normal equations (T, T, S), lower halves.

    This leaves the Schur complement. An unknown that no observation depends on changes nothing.
    """
    terms, _, count = matrices.shape
    per_pivot = np.empty(count)
    for k in unknowns:
        for s in range(count):
            per_pivot[s] = 1.0 / matrices[k, k, s] if matrices[k, k, s] > 0.0 else 0.0
        for i in range(k + 1, terms):
            for j in range(k + 1, i + 1):
                for s in range(count):
                    matrices[i, j, s] -= matrices[i, k, s] * per_pivot[s] * matrices[j, k, s]


@kernel()
def fit_discs(scene: Scene, starts: Records, settings: FitSettings, work: Any) -> Records:
    """Fit N discs, from (N,) `START`: (N,) `FIT`. `work` is the working space, a `WORK`."""
    fits = np.zeros(len(starts), FIT)
    for k in range(len(starts)):
        _fit_disc(scene, starts[k], settings, work, fits[k])
    return fits


# Inlined by Numba: only then do a kernel that was just compiled and one that was loaded from the
# cache agree to the last digit.
@kernel(inline="always")
def _fit_disc(scene: Scene, start: Any, settings: FitSettings, work: Any, fit: Any) -> None:
    """Fit one disc, and write it into `fit`."""
    patch, rows, by_parts = work.patch, work.rows, settings.by_parts
    radius_sigma = start.size_sigma / start.size
    candidate, begin = _candidate_at(scene, start)
    shape, ends = gather(
        scene.image, scene.floor_xy, candidate, scene.blur_ratio, settings.reach, begin, patch
    )
    if ends[SECTORS] == 0:
        return
    per_pixel = floor_steps(scene.floor_xy, candidate.u, candidate.v)
    level = float(scene.image[candidate.v, candidate.u])
    most_blur = _MOST_BLUR
    if shape != EDGE:
        most_blur = min(_MOST_GROWTH * start.blur + _MOST_GROWTH_PX, _MOST_BLUR)
    usual = BlurredDisc(0.0, 0.0, 1.0, _blur_of(shape, _BLUR_PX, scene.blur_ratio))
    blur = _blur_of(shape, start.blur, scene.blur_ratio)
    edge = BlurredDisc(begin.x, begin.y, begin.radius, blur)
    parts = ends if by_parts else ends[::SECTORS].copy()
    groups = len(parts) - 1
    zeros = np.zeros((5, groups))
    levels = Levels(zeros[0], zeros[1], zeros[2], zeros[3], zeros[4])
    grouped, normal = np.zeros((_TERMS, _TERMS, groups)), np.zeros((_TERMS, _TERMS, 1))
    movement, first = np.zeros(_GREY), _OUTSIDE if by_parts else 0
    patch.trust[: ends[SECTORS]] = 1.0
    for step in range(_STEPS):
        disc = Disc(edge.x, edge.y, edge.radius)
        if shape == EDGE:
            edge_shares(patch, ends[SECTORS], disc, edge.blur)
        else:
            chord_shares(patch, ends[SECTORS], disc, edge.blur)
        _write_rows(patch, ends[SECTORS], edge, level, by_parts, rows)
        _multiply(rows, parts, first, grouped)
        _eliminate_levels(grouped, levels, by_parts, per_pixel, scene.noise)
        if by_parts:
            if _weigh(levels, step < _EARLY, scene.noise) < _LEAST_SECTORS:
                return
            _trust(patch, rows, ends, grouped, levels, scene.noise)
        elif not abs(levels.contrast[0]) > 0.0:
            return
        _scale(grouped, levels)
        _add_up(grouped, edge, usual, radius_sigma, normal)
        solve(normal.copy(), movement)
        edge = _moved(edge, movement, most_blur)
        moved = max(math.hypot(movement[_X], movement[_Y]), abs(movement[_RADIUS]))
        if moved < _CONVERGED_STEP and step > _EARLY:
            break
    reduced = normal.copy()
    eliminate(reduced, range(_BLUR_1, _RADIUS))
    information = _radius_information(reduced) - 1.0 / radius_sigma**2
    eliminate(reduced, range(_RADIUS, _X))
    noise = _inverse(reduced, 0)
    if by_parts:
        xx, xy, yy = _covariance_by_parts(grouped, levels, normal, noise)
    else:
        unknowns = np.zeros(_GREY)
        _multiply(rows, parts, first, grouped)  # again, as they were before the elimination
        solve(grouped, unknowns)
        area = _correlated_area(patch, rows, ends[SECTORS], unknowns)
        xx, xy, yy = area * noise[0], area * noise[1], area * noise[2]
    information *= (noise[0] + noise[2]) / (xx + yy)
    near = math.hypot(edge.x - begin.x, edge.y - begin.y) <= _MOST_OFF or not by_parts
    if not (near and 0.0 < xx * yy - xy * xy < math.inf):  # adjacent sectors alone fix no centre
        return
    unit, floor_xy = start.size, scene.floor_xy[candidate.v, candidate.u]
    fit.converged = True
    fit.floor_xy[0], fit.floor_xy[1] = floor_xy[0] + unit * edge.x, floor_xy[1] + unit * edge.y
    fit.radius = unit * edge.radius
    fit.blur = edge.blur.second if shape == CHORDS_ALONG_V else edge.blur.first
    fit.blur_bound, fit.contrast, fit.explained = most_blur, levels.contrast[0], levels.explained[0]
    fit.covariance[0, 0], fit.covariance[1, 1] = unit**2 * xx, unit**2 * yy
    fit.covariance[0, 1] = fit.covariance[1, 0] = unit**2 * xy
    fit.radius_information = max(information, 0.0) / unit**2


@kernel(inline="always")
def _candidate_at(scene: Scene, start: Any) -> tuple[Candidate, Disc]:
    """The pixel nearest to a start, and the disc relative to it."""
    floor_x, floor_y = start.floor_xy[0], start.floor_xy[1]
    pixel_u, pixel_v = project_floor_point(scene.camera_numbers, floor_x, floor_y)
    height, width = scene.image.shape
    u, v = min(max(round(pixel_u), 1), width - 2), min(max(round(pixel_v), 1), height - 2)
    x, y = floor_x - scene.floor_xy[v, u, 0], floor_y - scene.floor_xy[v, u, 1]
    disc = Disc(x / start.size, y / start.size, start.radius / start.size)
    return Candidate(u, v, start.size, start.blur), disc


@kernel(forceinline=True)
def _blur_of(shape: int, blur: float, ratio: float) -> Blur:
    """A blur (along u, pixels), converted to the axes of a patch of the given shape."""
    return Blur(blur * ratio, blur) if shape == CHORDS_ALONG_V else Blur(blur, blur * ratio)


@kernel(forceinline=True, fastmath=FASTMATH)
def _write_rows(
    patch: Any, n: int, edge: BlurredDisc, level: float, by_parts: bool, rows: Float32Array
) -> None:
    """Write the derivatives by all unknowns, and the grey values (above `level`), of n pixels."""
    shares = patch.shares
    x0, y0, r0, black = F32(edge.x), F32(edge.y), F32(edge.radius), F32(-level)
    for i in range(n):
        x, y = patch.x[i] - x0, patch.y[i] - y0
        weight, grey = patch.weight[i] * patch.trust[i], patch.grey[i]
        rows[_SADDLE, i] = weight * (x * x - y * y)
        rows[_SADDLE_XY, i] = weight * x * y
        rows[_SLOPE_Y, i] = weight * y
        rows[_OUTSIDE, i] = weight
        # Illumination that changes across the edge scales the grey values of both sides.
        ramp = (math.sqrt(x * x + y * y) - r0) * (grey - black)
        rows[_SLOPE, i] = weight * (ramp if by_parts else x)
        rows[_CONTRAST, i] = weight * shares[SHARE, i]
        rows[_BLUR_1, i] = weight * shares[BY_BLUR_1, i]
        rows[_BLUR_2, i] = weight * shares[BY_BLUR_2, i]
        rows[_RADIUS, i] = weight * shares[BY_RADIUS, i]
        rows[_X, i] = weight * shares[BY_X, i]
        rows[_Y, i] = weight * shares[BY_Y, i]
        rows[_GREY, i] = weight * grey


@kernel(forceinline=True, fastmath=FASTMATH)
def _multiply(rows: Float32Array, ends: IntArray, first: int, products: FloatArray) -> None:
    """Sums of products of rows in each part, lower halves, from term `first` on."""
    products[:] = 0.0
    for s in range(products.shape[2]):
        # In chunks, because of the rounding of long sums, and for the processor's cache.
        for begin in range(ends[s], ends[s + 1], _CHUNK):
            end = min(begin + _CHUNK, ends[s + 1])
            for a in range(first, _TERMS):
                for b in range(first, a + 1):
                    total = F32(0.0)
                    for i in range(np.uint64(begin), np.uint64(end)):
                        total += rows[a, i] * rows[b, i]
                    products[a, b, s] += total


@kernel(inline="always")
def _eliminate_levels(
    grouped: FloatArray, levels: Levels, by_parts: bool,
    per_pixel: tuple[float, float, float, float], noise: float,
) -> None:  # fmt: skip
    """Eliminate the light of each group; estimate its contrast, residuals and edge offset."""
    groups = grouped.shape[2]
    pixels = grouped[_OUTSIDE, _OUTSIDE].copy()
    if by_parts:
        for s in range(groups):
            grouped[_SLOPE, _SLOPE, s] += (noise / _RAMP_SIGMA) ** 2
    eliminate(grouped, range(_OUTSIDE if by_parts else 0, _SLOPE))
    spread = grouped[_CONTRAST, _CONTRAST].copy()
    eliminate(grouped, range(_SLOPE, _CONTRAST))
    without = grouped[_GREY, _GREY].copy()
    eliminate(grouped, range(_CONTRAST, _BLUR_1))
    for s in range(groups):
        levels.contrast[s] = levels.weight[s] = levels.explained[s] = 0.0
        if pixels[s] < _LEAST_PIXELS or spread[s] < _LEAST_SPREAD:
            continue
        contrast = grouped[_GREY, _CONTRAST, s] / grouped[_CONTRAST, _CONTRAST, s]
        levels.contrast[s] = contrast
        residual = max(grouped[_GREY, _GREY, s], 0.0)
        levels.explained[s] = 1.0 - residual / max(without[s], 1e-9)
        if by_parts:
            levels.variance[s] = residual / (_SHARE_LEFT * (pixels[s] - 3.0))
            per_u = per_pixel[0] * _COSINES[s] + per_pixel[1] * _SINES[s]
            per_v = per_pixel[2] * _COSINES[s] + per_pixel[3] * _SINES[s]
            off = grouped[_GREY, _RADIUS, s] / (contrast * grouped[_RADIUS, _RADIUS, s])
            levels.off_px[s] = off / math.hypot(per_u, per_v)
        else:
            freedom = pixels[s] - (_GREY - 1)  # the priors of both blurs count as one more pixel
            levels.contrast[s] = contrast if freedom >= 4.0 else 0.0
            levels.variance[s] = max(residual / max(freedom, 1.0), noise * noise)
            levels.weight[s] = 1.0 / levels.variance[s]


@kernel(inline="always")
def _weigh(levels: Levels, early: bool, noise: float) -> int:
    """Weight the sectors; returns how many count."""
    variance, off_px, weight = levels.variance, levels.off_px, levels.weight
    some, total = np.empty(SECTORS), 0.0
    for s in range(SECTORS):
        total += levels.contrast[s]
    sign = 1.0 if total > 0.0 else -1.0
    for s in range(SECTORS):
        some[s] = sign * levels.contrast[s]
        weight[s] = 1.0 if some[s] > 0.0 else 0.0
    least = _LEAST_CONTRAST * _median_of(some, weight)
    for s in range(SECTORS):
        weight[s] = weight[s] if some[s] >= least else 0.0
    usual = max(_median_of(variance, weight), noise * noise)
    middle = _median_of(off_px, weight)
    for s in range(SECTORS):
        some[s] = abs(off_px[s] - middle)
    spread = max(1.4826 * _median_of(some, weight), _LEAST_OFF_PX)
    count = 0
    for s in range(SECTORS):
        if weight[s] > 0.0:
            far = off_px[s] / spread
            if early:
                weight[s] = 1.0 / (1.0 + (far / _FAR_EARLY) ** 2)
            else:
                weight[s] = max(1.0 - (far / _FAR_OFF) ** 2, 0.0) ** 2
            weight[s] *= usual / max(variance[s], usual)
            count += weight[s] > _COUNTS
            weight[s] /= usual
    return count


@kernel(forceinline=True, fastmath=FASTMATH)
def _trust(
    patch: Any, rows: Float32Array, ends: IntArray, grouped: FloatArray,
    levels: Levels, noise: float,
) -> None:  # fmt: skip
    """Weight the pixels of the sectors that count by their residuals."""
    usual = max(_median_of(levels.variance, levels.weight), noise * noise)
    per_limit = F32(1.0 / (_FAR_PIXEL**2 * usual))
    for s in range(SECTORS):
        if not levels.weight[s] > 0.0:
            patch.trust[ends[s] : ends[s + 1]] = 1.0
            continue
        contrast = levels.contrast[s]
        slope = grouped[_GREY, _SLOPE, s] - contrast * grouped[_CONTRAST, _SLOPE, s]
        slope /= grouped[_SLOPE, _SLOPE, s]
        outside = grouped[_GREY, _OUTSIDE, s] - contrast * grouped[_CONTRAST, _OUTSIDE, s]
        outside -= slope * grouped[_SLOPE, _OUTSIDE, s]
        outside /= grouped[_OUTSIDE, _OUTSIDE, s]
        a, b, c = F32(outside), F32(slope), F32(contrast)
        for i in range(np.uint64(ends[s]), np.uint64(ends[s + 1])):
            rest = rows[_GREY, i] - a * rows[_OUTSIDE, i] - b * rows[_SLOPE, i]
            rest = (rest - c * rows[_CONTRAST, i]) / patch.trust[i]
            patch.trust[i] = max(F32(1.0) - rest * rest * per_limit, _LEAST_TRUST)


@kernel()
def _median_of(values: FloatArray, weight: FloatArray) -> float:
    """Median of the values with a weight, 0 if there are none."""
    some, count = np.empty(len(values)), 0
    for k in range(len(values)):
        if weight[k] > 0.0:
            some[count] = values[k]
            count += 1
    return median(some[:count]) if count > 0 else 0.0


@kernel(inline="always")
def _scale(grouped: FloatArray, levels: Levels) -> None:
    """Weight the groups' equations of the disc; by the chain rule, times the contrast."""
    for a in range(_BLUR_1, _TERMS):
        for b in range(_BLUR_1, min(a, _Y) + 1):
            for s in range(grouped.shape[2]):
                contrast = levels.contrast[s]
                scale = levels.weight[s] * contrast * (1.0 if a == _GREY else contrast)
                grouped[a, b, s] *= scale


@kernel(inline="always")
def _add_up(
    grouped: FloatArray, edge: BlurredDisc, usual: BlurredDisc, radius_sigma: float,
    normal: FloatArray,
) -> None:  # fmt: skip
    """The normal equations of the edge's step: the sum of all groups, plus the priors."""
    for a in range(_BLUR_1, _TERMS):
        for b in range(_BLUR_1, min(a, _Y) + 1):
            normal[a, b, 0] = np.sum(grouped[a, b])
    for k, sigma, off in (
        (_RADIUS, radius_sigma, usual.radius - edge.radius),
        (_BLUR_1, _BLUR_SIGMA, math.log(usual.blur.first / edge.blur.first)),
        (_BLUR_2, _BLUR_SIGMA, math.log(usual.blur.second / edge.blur.second)),
    ):
        normal[k, k, 0] += 1.0 / sigma**2
        normal[_GREY, k, 0] += off / sigma**2


@kernel()
def solve(normal: FloatArray, unknowns: FloatArray) -> None:
    """Solve normal equations (T, T, 1), lower half, whose last row is the right side.

    They are overwritten. Of the T - 1 unknowns, those on which no observation depends become 0.
    """
    last = len(unknowns)
    eliminate(normal, range(last))
    for k in range(last - 1, -1, -1):
        rest = normal[last, k, 0]
        for i in range(k + 1, last):
            rest -= normal[i, k, 0] * unknowns[i]
        unknowns[k] = rest / normal[k, k, 0] if normal[k, k, 0] > 0.0 else 0.0


@kernel(inline="always")
def _moved(edge: BlurredDisc, step: FloatArray, most_blur: float) -> BlurredDisc:
    """The edge after a step, within limits."""
    radius = edge.radius + within(step[_RADIUS], _LONGEST)
    x, y = edge.x + within(step[_X], _LONGEST), edge.y + within(step[_Y], _LONGEST)
    first = _scaled(edge.blur.first, step[_BLUR_1], most_blur)
    second = _scaled(edge.blur.second, step[_BLUR_2], most_blur)
    return BlurredDisc(x, y, min(max(radius, _LEAST_RADIUS), _MOST_RADIUS), Blur(first, second))


@kernel(inline="always")
def _scaled(blur: float, step: float, most: float) -> float:
    return min(max(blur * math.exp(within(step, _LONGEST_BLUR)), _LEAST_BLUR), most)


@kernel(inline="always")
def _inverse(normal: FloatArray, s: int) -> tuple[float, float, float]:
    """Covariance (xx, xy, yy) of the centre after all other unknowns are eliminated."""
    xx, xy, yy = normal[_X, _X, s], normal[_Y, _X, s], normal[_Y, _Y, s]
    per_area = 1.0 / (xx * yy - xy * xy)
    return per_area * yy, -per_area * xy, per_area * xx


@kernel(inline="always")
def _radius_information(normal: FloatArray) -> float:
    """Inverse variance of the radius, from the normal equations of radius and centre."""
    xx, xy, yy = normal[_X, _X, 0], normal[_Y, _X, 0], normal[_Y, _Y, 0]
    x, y = normal[_X, _RADIUS, 0], normal[_Y, _RADIUS, 0]
    by_centre = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
    return float(normal[_RADIUS, _RADIUS, 0] - by_centre)


@kernel(forceinline=True, fastmath=FASTMATH)
def _correlated_area(patch: Any, rows: Float32Array, n: int, unknowns: FloatArray) -> float:
    """Number of pixels per independent residual, from the correlation of neighbours.

    White noise gives 1. Where the model does not fit (texture, reflections, not a disc), residuals
    are correlated and overstate their information: for a first-order process of correlation c by
    the factor (1 + c) / (1 - c) in either direction.
    """
    residual = rows[_GREY, :n].copy()
    for k in range(_GREY):
        value = F32(unknowns[k])
        for i in range(n):
            residual[i] -= value * rows[k, i]
    product = square = pairs = F32(0.0)
    for i in range(1, n):
        linked = F32(1.0) if patch.pixel[i] == patch.pixel[i - 1] + np.uint32(1) else F32(0.0)
        here, before = residual[i], residual[i - 1]
        product += linked * here * before
        square += linked * (here * here + before * before)
        pairs += linked
    if not square > 0.0:
        return 1.0
    # By chance alone the correlation of n residuals scatters by 1 / sqrt(n).
    correlation = min(max(2.0 * product / square - 1.5 / math.sqrt(pairs), 0.0), 0.8)
    return float(((1.0 + correlation) / (1.0 - correlation)) ** 2)


@kernel(inline="always")
def _covariance_by_parts(
    products: FloatArray, levels: Levels, normal: FloatArray, noise: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Covariance (xx, xy, yy) of the centre: that of the noise plus that of the jackknife."""
    left_out = np.empty((_TERMS, _TERMS, SECTORS))
    for a in range(_BLUR_1, _TERMS):
        for b in range(_BLUR_1, min(a, _Y) + 1):
            for s in range(SECTORS):
                left_out[a, b, s] = normal[a, b, 0]
                for k in range(_STRETCH):
                    left_out[a, b, s] -= products[a, b, (s + k) % SECTORS]
    eliminate(left_out, range(_BLUR_1, _X))
    centres = np.empty((SECTORS, 2))
    mean_x = mean_y = 0.0
    count = 0
    for s in range(SECTORS):
        xx, xy, yy = _inverse(left_out, s)
        x, y = left_out[_GREY, _X, s], left_out[_GREY, _Y, s]
        centres[s, 0], centres[s, 1] = xx * x + xy * y, xy * x + yy * y
        mean_x, mean_y = mean_x + centres[s, 0] / SECTORS, mean_y + centres[s, 1] / SECTORS
        count += levels.weight[s] > 0.0
    xx = xy = yy = 0.0
    for s in range(SECTORS):
        x, y = centres[s, 0] - mean_x, centres[s, 1] - mean_y
        xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
    scale = _INFLATION * (count - _STRETCH) / (count * _STRETCH)
    return scale * xx + noise[0], scale * xy + noise[1], scale * yy + noise[2]


def working_space() -> NDArray[Any]:
    """(1,) `WORK`: the working space of the calling thread's fits."""
    if not hasattr(_kept, "space"):
        _kept.space = np.zeros(1, WORK)
    space: NDArray[Any] = _kept.space
    return space
