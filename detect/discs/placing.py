"""Where a disc is that something hides, stains or lights in part: by its edge, sector by sector.

All of that pulls at the fit of the whole disc. Here the same blurred disc is fitted to the pixels
about its edge alone, and in each of 16 sectors s it has grey levels of its own inside and outside:

    grey = outside_s + contrast_s * W(x, y, radius, blur) + ramp_s * (r - radius) * grey

so light may change round the disc as it likes, and rise or fall across the edge. Levels and ramp
are eliminated in every sector; what remains are normal equations of what all sectors share: the
centre, the radius, and the blur along either axis of the image, for movement blurs along one. A
sector counts less if the model does not explain it, and if it shows the edge elsewhere than the
others do: something else's edge. These weights are Tukey's biweights, found anew in every step
(A. E. Beaton and J. W. Tukey, Technometrics 16, 1974).

The errors of neighbouring pixels are not independent where something touches the rim; those of
sectors apart from each other nearly are. So the covariance is that of the jackknife, leaving out
neighbouring sectors in turn (H. R. Kuensch, Annals of Statistics 17, 1989), plus that of the noise.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera.kernels import project_floor_point
from detect.discs.descent import LEAST_BLUR, MOST_BLUR, blur_of
from detect.discs.fit import RESULT, fit_disc
from detect.discs.model import (
    BY_BLUR,
    BY_RADIUS,
    BY_X,
    BY_Y,
    F32,
    FASTMATH,
    GREY,
    PIXEL_VARIANCE,
    SHARE,
    Blur,
    Disc,
    chord_shares,
    edge_shares,
)
from detect.discs.patch import (
    CHORDS_ALONG_V,
    EDGE,
    SECTORS,
    Candidate,
    FitSettings,
    floor_steps,
    gather_by_sector,
)
from detect.discs.rim import Rim, follow_rim, median, profiles
from redetect.compiled import kernel

if TYPE_CHECKING:
    from detect.discs.judgement import Judgement

FloatArray = NDArray[np.float64]

#: Share of the variance that a fit explains where nothing but a disc and noise is there.
_WELL_EXPLAINED = 0.97
#: From this share of the variance on that it explains, the fit of the whole disc gives the place:
#: where this share of the rim is in view, and where less is.
_WHOLE_RIM, _EXPLAINS_WHOLE, _EXPLAINS_PART = 0.8, 0.9, 0.93
#: A blur that reached this share of the most that a patch allows is fitted again in a wider one.
_AT_BOUND, _MOST_REFITS = 0.98, 2
#: Standard deviation of the radius about that which discs of the image seem to have, relative: of a
#: short arc, place and radius trade off.
_RADIUS_SIGMA = 0.02
#: Pixels this near to the edge are fitted, in pixels or in deviations of the blur.
_REACH_PX, _REACH_BLURS = 3.0, 2.5
#: and none of the disc's middle, nor far from it, radii.
_NEAREST, _FARTHEST = 0.5, 1.5
#: Blur where nothing is known of it, pixels.
_BLUR_PX = 1.0
#: Steps of the fit; the first ones leave no sector out, for the start may be off.
_STEPS, _EARLY = 8, 1
#: Least pixels of a sector, spread of the shares in it, and contrast relative to the median.
_LEAST_PIXELS, _LEAST_SPREAD, _LEAST_CONTRAST = 6.0, 0.15, 0.4
#: Standard deviation of the ramp of the light across the edge, relative, per radius.
_RAMP_SIGMA = 0.5
#: Least number of sectors, and the weight from which one counts.
_LEAST_SECTORS, _COUNTS = 5, 0.1
#: An edge this many deviations off the others has no weight; the least deviation, pixels.
_FAR_OFF, _LEAST_OFF_PX = 4.5, 0.05
#: Before that, one this many deviations off has half the weight.
_FAR_EARLY = 2.0
#: Longest step, nominal radii (and log blur).
_LONGEST, _LONGEST_BLUR = 0.2, 0.7
#: A shorter step is the last, nominal radii.
_ARRIVED = 5e-3
#: The fit ends at most this far from where it starts, radii.
_MOST_OFF = 0.3
#: Share of two rims' squared difference that is added to the covariance.
_DISAGREEMENT = 0.5
#: Sectors that are left out at a time for the covariance, for neighbours err alike; and by how much
#: the variance is larger than what that gives.
_STRETCH, _INFLATION = 3, 1.6
#: A whole disc's fit is final if it explains this much of the variance and the disc is sharper than
#: this (pixels): movement blurs along one axis only, which that fit does not know.
_EXPLAINS_ALL, _SHARP_PX = 0.985, 1.2
#: It is fitted again if the blur is this much longer along one axis.
_MOVED = 1.5
#: Least number of whole discs that give the apparent radius.
_LEAST_WHOLE = 3

#: Of the normal equations of a sector: its two levels, what all sectors share, the grey values.
_OUTSIDE, _RAMP, _CONTRAST, _BLUR_1, _BLUR_2, _RADIUS, _X, _Y, _GREY = range(9)
_TERMS = 9

_MIDDLES = 2.0 * np.pi * (np.arange(SECTORS) + 0.5) / SECTORS
_COSINES, _SINES = np.cos(_MIDDLES), np.sin(_MIDDLES)


class Scene(NamedTuple):
    """An image, and how discs are placed in it."""

    image: NDArray[np.uint8]
    floor_xy: NDArray[np.float32]
    radius: float  # nominal, metres
    settings: FitSettings
    camera_numbers: NDArray[np.float64]


class Start(NamedTuple):
    """Where a fit starts; lengths in metres."""

    x: float
    y: float
    radius: float
    blur_px: float


class Edge(NamedTuple):
    """What all sectors share: a disc, relative to its candidate, nominal radii; and its blur."""

    x: float
    y: float
    radius: float
    blur: Blur


class Sectors(NamedTuple):
    """What each sector says."""

    products: FloatArray
    """(9, 9, SECTORS) normal equations: lower halves; levels and ramp are eliminated."""
    contrast: FloatArray
    """(SECTORS,) grey levels; 0 where there is no edge to be seen."""
    variance: FloatArray
    """(SECTORS,) of the residuals."""
    off_px: FloatArray
    """(SECTORS,) how far outside the circle the edge is."""
    weight: FloatArray
    """(SECTORS,) per variance."""


class Placed(NamedTuple):
    """What became of a disc's sectors."""

    agree: bool
    """On one disc near the start."""
    blur_ratio: float
    """The blur along v over that along u, in pixels."""


@kernel()
def eliminate(matrices: FloatArray, k: int) -> None:
    """Eliminate unknown k from the later ones of normal equations, of which the lower half is used.

    `matrices` are (T, T, S), S of them at a time. What is left of the products is that of what the
    eliminated unknowns leave of all others; an unknown that nothing depends on leaves all.
    """
    terms, _, count = matrices.shape
    per_pivot = np.empty(count)
    for s in range(count):
        per_pivot[s] = 1.0 / matrices[k, k, s] if matrices[k, k, s] > 0.0 else 0.0
    for i in range(k + 1, terms):
        for j in range(k + 1, i + 1):
            for s in range(count):
                matrices[i, j, s] -= matrices[i, k, s] * per_pivot[s] * matrices[j, k, s]


@kernel()
def place_by_sectors(scene: Scene, radius: float, start: Start, work: Any, result: Any) -> Placed:
    """Place a disc by those sectors of its edge that agree on one.

    Parameters
    ----------
    scene : Scene
    radius : float
        That discs of the image seem to have (`apparent_radius`), metres.
    start : Start
    work : WORK
        Working space.
    result : RESULT
        Its centre and covariance are replaced where sectors agree.
    """
    patch, given = work.patch, scene.settings
    settings = FitSettings(
        given.noise, 0.0, _REACH_PX, _REACH_BLURS, _RADIUS_SIGMA, given.blur_px, given.blur_sigma,
        given.blur_ratio,
    )  # fmt: skip
    candidate, begin = _candidate_at(scene, radius, start)
    ends = np.empty(SECTORS + 1, np.int64)
    gathered = gather_by_sector(
        scene.image, scene.floor_xy, candidate, settings, begin, (_NEAREST, _FARTHEST), patch, ends
    )
    per_pixel = floor_steps(scene.floor_xy, candidate.u, candidate.v)
    level = float(scene.image[candidate.v, candidate.u])
    expected = Edge(0.0, 0.0, 1.0, blur_of(gathered.shape, given.blur_px, given.blur_ratio))
    blur = blur_of(gathered.shape, start.blur_px, given.blur_ratio)
    edge, normal = Edge(begin.x, begin.y, begin.radius, blur), np.zeros((_TERMS, _TERMS, 1))
    sectors = Sectors(
        np.zeros((_TERMS, _TERMS, SECTORS)), np.zeros(SECTORS), np.zeros(SECTORS),
        np.zeros(SECTORS), np.zeros(SECTORS),
    )  # fmt: skip
    movement = np.zeros(_TERMS)
    for step in range(_STEPS):
        disc = Disc(edge.x, edge.y, edge.radius, 0.0)
        if gathered.shape == EDGE:
            edge_shares(patch, gathered.n, disc, edge.blur)
        else:
            chord_shares(patch, gathered.n, disc, edge.blur)
        _write_rows(patch, gathered.n, edge, level, work.by_sector)
        _multiply(work.by_sector, ends, sectors.products)
        _eliminate_levels(sectors, per_pixel, settings.noise)
        if _weigh(sectors, step < _EARLY, settings.noise) < _LEAST_SECTORS:
            return Placed(False, given.blur_ratio)
        _add_up(sectors, edge, expected, settings, normal)
        _solve(normal.copy(), movement)
        is_short = math.hypot(movement[_X], movement[_Y]) < _ARRIVED
        if step == _STEPS - 1 or (step > _EARLY and is_short):
            break
        edge = _moved(edge, movement)
    ratio = edge.blur.second / edge.blur.first
    ratio = 1.0 / ratio if gathered.shape == CHORDS_ALONG_V else ratio
    x, y = edge.x + movement[_X], edge.y + movement[_Y]
    xx, xy, yy = _covariance(sectors, normal)
    near = math.hypot(x - begin.x, y - begin.y) <= _MOST_OFF
    if not (near and 0.0 < xx * yy - xy * xy < math.inf):  # sectors in a row fix no centre
        return Placed(False, ratio)
    floor_xy = scene.floor_xy[candidate.v, candidate.u]
    result.x, result.y = floor_xy[0] + radius * x, floor_xy[1] + radius * y
    area = radius * radius
    result.cov_xx, result.cov_xy, result.cov_yy = area * xx, area * xy, area * yy
    return Placed(True, ratio)


@kernel()
def _candidate_at(scene: Scene, radius: float, start: Start) -> tuple[Candidate, Disc]:
    """The pixel nearest to a start, and the disc relative to it."""
    pixel_u, pixel_v = project_floor_point(scene.camera_numbers, start.x, start.y)
    height, width = scene.image.shape
    u, v = min(max(round(pixel_u), 1), width - 2), min(max(round(pixel_v), 1), height - 2)
    x, y = start.x - scene.floor_xy[v, u, 0], start.y - scene.floor_xy[v, u, 1]
    disc = Disc(x / radius, y / radius, start.radius / radius, math.log(start.blur_px))
    return Candidate(u, v, radius, start.blur_px), disc


@kernel(fastmath=FASTMATH)
def _write_rows(patch: Any, n: int, edge: Edge, level: float, rows: NDArray[np.float32]) -> None:
    """The derivatives by all unknowns, and the grey values (above `level`), for n pixels."""
    design = patch.design
    variance_1 = F32(edge.blur.first**2 + PIXEL_VARIANCE)
    variance_2 = F32(edge.blur.second**2 + PIXEL_VARIANCE)
    x0, y0, r0, black = F32(edge.x), F32(edge.y), F32(edge.radius), F32(-level)
    for i in range(n):
        x, y = patch.x[i] - x0, patch.y[i] - y0
        weight = patch.weight[i]
        rows[_OUTSIDE, i] = weight
        # Light that changes across the edge changes what either side gives back of it.
        rows[_RAMP, i] = weight * (math.sqrt(x * x + y * y) - r0) * (design[GREY, i] - black)
        rows[_CONTRAST, i] = weight * design[SHARE, i]
        # Which part of the blur across the edge is along the first axis.
        g_1 = patch.x1[i] * x + patch.y1[i] * y
        g_2 = patch.x2[i] * x + patch.y2[i] * y
        by_1, by_2 = variance_1 * g_1 * g_1, variance_2 * g_2 * g_2
        part = by_1 / (by_1 + by_2 + F32(1e-12))
        rows[_BLUR_1, i] = weight * part * design[BY_BLUR, i]
        rows[_BLUR_2, i] = weight * (F32(1.0) - part) * design[BY_BLUR, i]
        rows[_RADIUS, i] = weight * design[BY_RADIUS, i]
        rows[_X, i] = weight * design[BY_X, i]
        rows[_Y, i] = weight * design[BY_Y, i]
        rows[_GREY, i] = weight * design[GREY, i]


@kernel(fastmath=FASTMATH)
def _multiply(rows: NDArray[np.float32], ends: NDArray[np.int64], products: FloatArray) -> None:
    """Sums of products of rows in each sector, lower halves."""
    for s in range(SECTORS):
        # Three by three at a time: each value that is loaded is used three times.
        for a in range(0, _TERMS, 3):
            for b in range(0, a + 1, 3):
                s00 = s01 = s02 = s10 = s11 = s12 = s20 = s21 = s22 = F32(0.0)
                for i in range(np.uint64(ends[s]), np.uint64(ends[s + 1])):
                    a0, a1, a2 = rows[a, i], rows[a + 1, i], rows[a + 2, i]
                    b0, b1, b2 = rows[b, i], rows[b + 1, i], rows[b + 2, i]
                    s00, s01, s02 = s00 + a0 * b0, s01 + a0 * b1, s02 + a0 * b2
                    s10, s11, s12 = s10 + a1 * b0, s11 + a1 * b1, s12 + a1 * b2
                    s20, s21, s22 = s20 + a2 * b0, s21 + a2 * b1, s22 + a2 * b2
                for j, row in enumerate(((s00, s01, s02), (s10, s11, s12), (s20, s21, s22))):
                    for k, total in enumerate(row):
                        products[a + j, b + k, s] = total


@kernel()
def _eliminate_levels(
    sectors: Sectors, per_pixel: tuple[float, float, float, float], noise: float
) -> None:
    """Eliminate levels and ramp of each sector; its contrast, residuals, and where its edge is."""
    by = sectors.products
    for s in range(SECTORS):
        by[_RAMP, _RAMP, s] += (noise / _RAMP_SIGMA) ** 2
    eliminate(by, _OUTSIDE)
    spread = by[_CONTRAST, _CONTRAST].copy()
    for k in range(_RAMP, _BLUR_1):
        eliminate(by, k)
    for s in range(SECTORS):
        pixels = by[_OUTSIDE, _OUTSIDE, s]
        sectors.contrast[s] = 0.0
        if pixels < _LEAST_PIXELS or spread[s] < _LEAST_SPREAD:
            continue
        contrast = by[_GREY, _CONTRAST, s] / by[_CONTRAST, _CONTRAST, s]
        sectors.contrast[s] = contrast
        sectors.variance[s] = by[_GREY, _GREY, s] / (pixels - 3.0)
        per_u = per_pixel[0] * _COSINES[s] + per_pixel[1] * _SINES[s]
        per_v = per_pixel[2] * _COSINES[s] + per_pixel[3] * _SINES[s]
        off = by[_GREY, _RADIUS, s] / (contrast * by[_RADIUS, _RADIUS, s])
        sectors.off_px[s] = off / math.hypot(per_u, per_v)


@kernel()
def _weigh(sectors: Sectors, early: bool, noise: float) -> int:
    """Weigh the sectors; returns how many count."""
    contrast, variance, off_px = sectors.contrast, sectors.variance, sectors.off_px
    chosen, some = np.zeros(SECTORS, np.bool_), np.empty(SECTORS)
    total = 0.0
    for s in range(SECTORS):
        total += contrast[s]
        sectors.weight[s] = 0.0
    sign = 1.0 if total > 0.0 else -1.0
    for s in range(SECTORS):
        chosen[s] = sign * contrast[s] > 0.0
        some[s] = sign * contrast[s]
    least = _LEAST_CONTRAST * _median_of(some, chosen)
    for s in range(SECTORS):
        chosen[s] = chosen[s] and sign * contrast[s] >= least
    usual = max(_median_of(variance, chosen), noise * noise)
    middle = _median_of(off_px, chosen)
    for s in range(SECTORS):
        some[s] = abs(off_px[s] - middle)
    spread = max(1.4826 * _median_of(some, chosen), _LEAST_OFF_PX)
    count = 0
    for s in range(SECTORS):
        if chosen[s]:
            far = off_px[s] / spread
            if early:
                weight = 1.0 / (1.0 + (far / _FAR_EARLY) ** 2)
            else:
                weight = max(1.0 - (far / _FAR_OFF) ** 2, 0.0) ** 2
            weight *= usual / max(variance[s], usual)
            count += weight > _COUNTS
            sectors.weight[s] = weight / usual
    return count


@kernel()
def _median_of(values: FloatArray, chosen: NDArray[np.bool_]) -> float:
    """Median of the chosen values, 0 if there are none."""
    some, count = np.empty(len(values)), 0
    for k in range(len(values)):
        if chosen[k]:
            some[count] = values[k]
            count += 1
    return median(some[:count]) if count > 0 else 0.0


@kernel()
def _add_up(
    sectors: Sectors, edge: Edge, expected: Edge, settings: FitSettings, normal: FloatArray
) -> None:
    """The normal equations of the step of the edge, of all sectors and what is expected of it.

    Those of the sectors become what they add: derivatives are by the shares, so times the contrast.
    """
    for a in range(_BLUR_1, _TERMS):
        for b in range(_BLUR_1, min(a, _Y) + 1):
            total = 0.0
            for s in range(SECTORS):
                contrast = sectors.contrast[s]
                scale = sectors.weight[s] * contrast * (1.0 if a == _GREY else contrast)
                sectors.products[a, b, s] *= scale
                total += sectors.products[a, b, s]
            normal[a, b, 0] = total
    _expect(normal, _RADIUS, settings.radius_sigma, expected.radius - edge.radius)
    for k, blur, usual in (
        (_BLUR_1, edge.blur.first, expected.blur.first),
        (_BLUR_2, edge.blur.second, expected.blur.second),
    ):
        _expect(normal, k, settings.blur_sigma, math.log(usual / blur))


@kernel()
def _expect(normal: FloatArray, k: int, sigma: float, off: float) -> None:
    normal[k, k, 0] += 1.0 / sigma**2
    normal[_GREY, k, 0] += off / sigma**2


@kernel(forceinline=True)
def _inverse(normal: FloatArray, s: int) -> tuple[float, float, float]:
    """Covariance (xx, xy, yy) of the centre where everything else is eliminated."""
    xx, xy, yy = normal[_X, _X, s], normal[_Y, _X, s], normal[_Y, _Y, s]
    per_area = 1.0 / (xx * yy - xy * xy)
    return per_area * yy, -per_area * xy, per_area * xx


@kernel()
def _solve(normal: FloatArray, movement: FloatArray) -> None:
    """Solve the normal equations (9, 9, 1), which are overwritten."""
    for k in range(_BLUR_1, _GREY):
        eliminate(normal, k)
    for k in range(_Y, _BLUR_1 - 1, -1):
        rest = normal[_GREY, k, 0]
        for i in range(k + 1, _GREY):
            rest -= normal[i, k, 0] * movement[i]
        movement[k] = rest / normal[k, k, 0]


@kernel()
def _moved(edge: Edge, step: FloatArray) -> Edge:
    """The edge after a step, within limits."""
    return Edge(
        edge.x + _within(step[_X], _LONGEST),
        edge.y + _within(step[_Y], _LONGEST),
        edge.radius + _within(step[_RADIUS], _LONGEST),
        Blur(_scaled(edge.blur.first, step[_BLUR_1]), _scaled(edge.blur.second, step[_BLUR_2])),
    )


@kernel()
def _within(step: float, longest: float) -> float:
    return min(max(step, -longest), longest)


@kernel()
def _scaled(blur: float, step: float) -> float:
    return min(max(blur * math.exp(_within(step, _LONGEST_BLUR)), LEAST_BLUR), MOST_BLUR)


@kernel()
def _covariance(sectors: Sectors, normal: FloatArray) -> tuple[float, float, float]:
    """Covariance (xx, xy, yy) of the centre, by leaving out neighbouring sectors."""
    some = np.empty((_TERMS, _TERMS, SECTORS))
    for a in range(_BLUR_1, _TERMS):
        for b in range(_BLUR_1, min(a, _Y) + 1):
            for s in range(SECTORS):
                some[a, b, s] = normal[a, b, 0]
                for k in range(_STRETCH):
                    some[a, b, s] -= sectors.products[a, b, (s + k) % SECTORS]
    for k in range(_BLUR_1, _X):
        eliminate(some, k)
        eliminate(normal, k)
    centres = np.empty((SECTORS, 2))
    mean_x = mean_y = 0.0
    count = 0
    for s in range(SECTORS):
        xx, xy, yy = _inverse(some, s)
        x, y = some[_GREY, _X, s], some[_GREY, _Y, s]
        centres[s, 0], centres[s, 1] = xx * x + xy * y, xy * x + yy * y
        mean_x, mean_y = mean_x + centres[s, 0] / SECTORS, mean_y + centres[s, 1] / SECTORS
        count += sectors.weight[s] > 0.0
    xx = xy = yy = 0.0
    for s in range(SECTORS):
        x, y = centres[s, 0] - mean_x, centres[s, 1] - mean_y
        xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
    noise_xx, noise_xy, noise_yy = _inverse(normal, 0)
    scale = _INFLATION * (count - _STRETCH) / (count * _STRETCH)
    return scale * xx + noise_xx, scale * xy + noise_xy, scale * yy + noise_yy


@kernel(inline="always")
def place_fitted(scene: Scene, radius: float, work: Any, result: Any) -> None:
    """Place a disc that was fitted as a whole by its sectors, where these are more certain.

    Movement blurs an image along one axis, mostly: with what the sectors say of the blur along
    either, the whole disc is fitted once more.
    """
    if result.explained >= _EXPLAINS_ALL and result.blur < _SHARP_PX:
        return
    start = Start(result.x, result.y, result.radius, result.blur)
    others = np.zeros(2, RESULT)
    by_sectors, again = others[0], others[1]
    placed = place_by_sectors(scene, radius, start, work, by_sectors)
    given = scene.settings
    longer = placed.blur_ratio / given.blur_ratio
    if max(longer, 1.0 / longer) >= _MOVED:
        settings = FitSettings(
            given.noise, given.reach_radii, given.reach_px, given.reach_blurs, given.radius_sigma,
            given.blur_px, given.blur_sigma, placed.blur_ratio,
        )  # fmt: skip
        candidate, disc = _candidate_at(scene, radius, start)
        image, floor_xy = scene.image, scene.floor_xy
        if fit_disc(image, floor_xy, candidate, settings, disc, work, again):
            _place_if_better(again, result)
    if placed.agree:
        _place_if_better(by_sectors, result)


@kernel()
def _place_if_better(other: Any, result: Any) -> None:
    """Take over a place whose covariance is smaller."""
    area = result.cov_xx * result.cov_yy - result.cov_xy**2
    if other.cov_xx * other.cov_yy - other.cov_xy**2 < area:
        result.x, result.y = other.x, other.y
        result.cov_xx, result.cov_xy, result.cov_yy = other.cov_xx, other.cov_xy, other.cov_yy


@kernel(inline="always")
def place_by_rim(scene: Scene, radius: float, rim: Rim, work: Any, result: Any) -> bool:
    """Place a disc of which the rim is known: by its sectors, or where they differ by the points.

    Returns whether the sectors agree.
    """
    start = Start(rim.x, rim.y, rim.radius, _BLUR_PX)
    agree = place_by_sectors(scene, radius, start, work, result).agree
    if not agree:
        result.x, result.y = rim.x, rim.y
        result.cov_xx, result.cov_xy, result.cov_yy = rim.cov_xx, rim.cov_xy, rim.cov_yy
    _add_square(result, 1.0, rim.doubt_x, rim.doubt_y)
    return agree


@kernel()
def _add_square(result: Any, share: float, x: float, y: float) -> None:
    """Add a share of the square of (x, y), metres, to the covariance of a result."""
    result.cov_xx += share * x * x
    result.cov_xy += share * x * y
    result.cov_yy += share * y * y


@kernel()
def place_discs(scene: Scene, discs: Judgement, work: Any) -> Any:
    """Place discs by fits: those that are wholly in view, then the others, of the same size.

    Parameters
    ----------
    scene : Scene
    discs : Judgement
        Of N discs.
    work : WORK
        Working space.

    Returns
    -------
    (N,) RESULT
    """
    count = len(discs.step)
    results, radii = np.zeros(count, RESULT), np.empty(count)
    whole = np.zeros(count, np.bool_)
    clear = 0
    for k in range(count):
        whole[k] = _fit_whole(scene, discs, k, work, results[k])
        if whole[k] and results[k].explained >= _WELL_EXPLAINED:
            radii[clear] = results[k].radius
            clear += 1
    radius = apparent_radius(scene.radius, radii[:clear])
    for k in range(count):
        if whole[k]:
            place_fitted(scene, radius, work, results[k])
        elif not place_by_rim(scene, radius, _rim_of(scene, discs, k, radius), work, results[k]):
            _add_square(results[k], _DISAGREEMENT, discs.doubt[k, 0], discs.doubt[k, 1])
    return results


@kernel()
def _rim_of(scene: Scene, discs: Judgement, k: int, radius: float) -> Rim:
    x, y = discs.seen_from[k, 0], discs.seen_from[k, 1]
    seen = profiles(scene.image, scene.camera_numbers, x, y, radius)
    return follow_rim(scene.image, scene.camera_numbers, seen, discs.step[k])


@kernel()
def _fit_whole(scene: Scene, discs: Judgement, k: int, work: Any, result: Any) -> bool:
    """Fit the whole disc of a rim; whether that explains what is seen."""
    x, y = discs.floor_xy[k]
    start, blur = Start(x, y, discs.radius[k], _BLUR_PX), _BLUR_PX
    for _ in range(1 + _MOST_REFITS):
        at, disc = _candidate_at(scene, scene.radius, start)
        candidate = Candidate(at.u, at.v, at.radius, blur)
        if not fit_disc(scene.image, scene.floor_xy, candidate, scene.settings, disc, work, result):
            return False
        if result.blur <= _AT_BOUND * result.blur_bound:
            break
        # Too blurred for its patch: once more, in a wider one.
        start, blur = Start(result.x, result.y, result.radius, result.blur), result.blur_bound
    least = _EXPLAINS_WHOLE if discs.agreeing[k] >= _WHOLE_RIM else _EXPLAINS_PART
    return bool(result.explained >= least and result.contrast * discs.step[k] > 0.0)


@kernel()
def apparent_radius(nominal: float, radii: NDArray[np.float64]) -> float:
    """The radius that discs of an image seem to have, by those that are wholly in view.

    All are larger or smaller where the camera hangs lower or higher than calibrated. The radius of
    a part of a disc trades with its place, so it has to be known otherwise.
    """
    if len(radii) < _LEAST_WHOLE:
        return nominal
    return median(radii)
