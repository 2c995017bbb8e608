"""Phase 3, last part: fit of the whole marker to the grey values.

The four edges of a small marker give little information, but its cells have edges, too. Given a
candidate pattern, the whole marker is fitted at once, by robust least squares: corners, light, blur
(the model of `detect.markers.pattern_model`, its grey values clipped at 0 and 255). Each cell
separately then confirms or contradicts the pattern.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from detect.markers import geometry
from detect.markers.dictionaries import Templates
from detect.markers.edges import RefinedQuadrangle
from detect.markers.geometry import Picture
from detect.markers.pattern_model import (
    BLACK,
    BLUR,
    HOMOGRAPHY,
    PARAMETERS,
    TONE,
    WHITE,
    Linearised,
    Pattern,
    Samples,
    cell_sums,
    linearise,
    pattern_of,
)
from redetect.array_types import FloatArray, IntArray

#: Width of the margin around the marker that is fitted: blurs and pixels, at most a cell's size.
_SEAM_BLURS, _SEAM_PX, _LEAST_SEAM_PX = 2.5, 0.5, 1.2
#: If squared residuals in the margin are this many times those inside, the fit excludes it and
#: this depth inside the marker: blurs, at most a share of a cell's size.
_SEAM_RATIO, _DEPTH_BLURS, _DEPTH_CELLS = 2.0, 2.0, 0.5
#: Largest motion of a corner from the intersection of edges (pixels or cells, the larger), and in
#: one step, as a share of that.
_REACH_PX, _REACH_CELLS, _STEP_REACHES = 1.5, 0.75, 0.35
#: Prior standard deviations of the light's slope and curvature over half a marker, in contrasts,
#: and of the tone curve's curvature; the largest of the latter.
_SLOPE_SIGMA, _BEND_SIGMA, _TONE_SIGMA, _TONES = 0.3, 0.15, 0.15, (-0.6, 3.0)
#: Limits of the variance of the blur along any direction, px^2; the lower is about a pixel's own.
_LEAST_VARIANCE, _LARGEST_VARIANCE = 0.07, 60.0
_CLOSE_ENOUGH_PX = 2e-3
#: Residuals beyond this many standard deviations are down-weighted.
_OUTLIER = 3.0
#: Grey values are rounded: noise is never below this, grey levels.
_LEAST_NOISE = 0.3
#: Least number of pixels in excess of the number of parameters.
_SPARE_PIXELS = 12
#: Approximate largest number of pixels in a fit, and its number of steps: a coarse fit is enough to
#: decide whether it may be that marker.
_COARSE, _FULL = (450, 5), (3000, 12)


class PatternFit(NamedTuple):
    """A marker fitted to the grey values."""

    corners: FloatArray  # (4, 2) straight pixels, in the order of the given corners
    covariance: FloatArray  # (4, 2, 2) of each corner, pixels squared
    cells: FloatArray  # (G * G,) measured whiteness of each cell of the grid
    cell_sigma: FloatArray  # (G * G,) its standard deviation due to noise
    border: FloatArray  # (B,) whiteness of the square's other cells
    misfit: float  # standard deviation of residuals in excess of the noise, in contrasts
    explained: float  # share of the grey values' variance that is explained, noise aside
    blur_px: float  # mean standard deviation of the blur
    blur_cells: float  # the larger one along the marker's axes, in cells
    surrounded: bool  # whether there is enough white around it for its outer edges to be used
    toned: FloatArray  # (4, 2) shifts of corners by the centroids of edges, due to the tone curve


def fit_marker(
    picture: Picture,
    start: RefinedQuadrangle,
    templates: Templates,
    template: int,
    *,
    coarse: bool = False,
) -> PatternFit | None:
    """Fit a marker of a known pattern by the Gauss-Newton method, starting from its edges.

    None if there is no such marker nearby.
    """
    most_pixels, steps = _COARSE if coarse else _FULL
    corners, blur_px = start.corners, start.blur_px
    middles = 0.5 * (corners + np.roll(corners, -1, axis=0))
    cell_px = templates.dictionary.cell * float(np.hypot(*(middles[:2] - middles[2:]).T).min())
    pattern = pattern_of(templates.lines, templates.blackness(template))
    near = _SEAM_BLURS * blur_px + _SEAM_PX
    reach = min(near, max(_LEAST_SEAM_PX, cell_px))
    noise = max(picture.noise, _LEAST_NOISE)
    reach_px = max(_REACH_PX, _REACH_CELLS * cell_px)
    centre = corners.mean(axis=0)
    start = start._replace(corners=corners - centre)
    samples = solution = None
    surrounded = False
    for margin in (reach, -min(_DEPTH_BLURS * blur_px, _DEPTH_CELLS * cell_px)):
        some = _samples(picture, corners, pattern.lines, margin, near, most_pixels)
        if some is None or len(some.grey) < PARAMETERS + _SPARE_PIXELS:
            break
        found = _solved(some, pattern, start, noise, reach_px, steps)
        if found is None:
            break
        samples, solution = some, found
        surrounded = margin > 0.0 and not _seam_differs(found[1])
        if surrounded:
            break
    if samples is None or solution is None:
        return None
    p, linear, inverse = solution
    energy = linear.weight * linear.residual**2
    variance = max(energy.sum() / max(linear.weight.sum() - PARAMETERS, 1.0), noise**2)
    homography = _homography_of(p)
    by_homography = geometry.corners_by_homography(homography)
    whole = by_homography @ inverse[HOMOGRAPHY, HOMOGRAPHY] @ by_homography.T
    whole *= variance * _inflation(samples.pixel, linear)
    if not (np.all(np.isfinite(whole)) and np.all(np.diag(whole) > 0.0)):
        return None
    products, squares = cell_sums(pattern, linear)
    with np.errstate(divide="ignore", invalid="ignore"):
        cells = np.where(squares > 0.0, 1.0 - pattern.black + products / squares, 0.5)
        sigma = np.sqrt(variance / squares)
    outside = np.ones(cells.shape, dtype=bool)
    outside[templates.grid, templates.grid] = False
    # Concave tone curves move centroids of edges towards black; a convex one is ink that spread.
    blur = np.median([linear.at.sigma_x, linear.at.sigma_y], axis=1)
    inset = max(p[TONE], 0.0) / (1.0 + 0.5 * max(p[TONE], 0.0)) / math.sqrt(math.pi) * blur
    inner = np.diag([*(1.0 - 2.0 * inset), 1.0])
    inner[:2, 2] = inset
    contrast = max(float(p[WHITE.start] - p[BLACK.start]), 1e-3)
    unexplained = float(np.mean(linear.residual**2)) - picture.noise**2
    return PatternFit(
        corners=geometry.corners_of(homography) + centre,
        covariance=np.einsum("kikj->kij", whole.reshape(4, 2, 4, 2)),
        cells=cells[templates.grid, templates.grid].ravel(),
        cell_sigma=sigma[templates.grid, templates.grid].ravel(),
        border=cells[outside],
        misfit=math.sqrt(variance - noise**2) / contrast,
        explained=1.0 - max(0.0, unexplained) / max(float(np.var(samples.grey)), 1e-9),
        blur_px=math.sqrt(0.5 * (p[BLUR][0] + p[BLUR][2])),
        blur_cells=float(blur.max()) / templates.dictionary.cell,
        surrounded=surrounded,
        toned=geometry.corners_of(homography @ inner) - geometry.corners_of(homography),
    )


def _solved(
    samples: Samples,
    pattern: Pattern,
    start: RefinedQuadrangle,
    noise: float,
    reach_px: float,
    steps: int,
) -> tuple[FloatArray, Linearised, FloatArray] | None:
    """Parameters, residuals and inverse normal matrix of the best fit, if there is one.

    Weak priors: light changes little over a marker, the blur is nearly isotropic and close to its
    initial estimate, the tone curve is nearly straight.
    """
    corners = start.corners
    blur_guess = min(max(start.blur_px**2, _LEAST_VARIANCE), _LARGEST_VARIANCE)
    p = np.zeros(PARAMETERS)
    p[BLUR] = blur_guess, 0.0, blur_guess
    expected = p.copy()
    p[HOMOGRAPHY] = geometry.square_homography(corners).flat[:8]
    p[WHITE.start], p[BLACK.start] = np.median(start.light), np.median(start.dark)
    sigma = np.full(PARAMETERS, np.inf)
    sigma[BLUR] = blur_guess + 0.1, 0.5 * blur_guess + 0.05, blur_guess + 0.1
    sigma[TONE] = _TONE_SIGMA
    light = np.array([np.inf, _SLOPE_SIGMA, _SLOPE_SIGMA, _BEND_SIGMA, _BEND_SIGMA, _BEND_SIGMA])
    outlier, moved = math.inf, math.inf
    for step in range(steps + 1):
        homography = _homography_of(p)
        linear = linearise(samples, pattern, p, _inverse(homography), outlier)
        scale = robust_sigma(linear.residual, noise)
        outlier = _OUTLIER * scale
        sigma[WHITE] = sigma[BLACK] = light * max(abs(p[WHITE.start] - p[BLACK.start]), scale)
        prior = (scale / sigma) ** 2
        weighted = linear.jacobian * linear.weight
        inverse = _inverse(weighted @ linear.jacobian.T + np.diag(prior))
        if step == steps or moved < _CLOSE_ENOUGH_PX:
            break
        change = inverse @ (weighted @ linear.residual + prior * (expected - p))
        moved = float(np.abs(geometry.corners_by_homography(homography) @ change[HOMOGRAPHY]).max())
        change[HOMOGRAPHY] *= min(1.0, _STEP_REACHES * reach_px / max(moved, 1e-9))
        p = p + change
        off = geometry.corners_of(_homography_of(p)) - corners
        if not np.hypot(*off.T).max() <= reach_px:
            return None
        p[TONE] = min(max(p[TONE], _TONES[0]), _TONES[1])
        # The blur's variances are clamped in all directions.
        values, vectors = np.linalg.eigh(p[BLUR][[0, 1, 1, 2]].reshape(2, 2))
        largest = min(1.0 + 3.0 * blur_guess, _LARGEST_VARIANCE)
        confined = (vectors * np.clip(values, _LEAST_VARIANCE, largest)) @ vectors.T
        p[BLUR] = confined.flat[[0, 1, 3]]
    return p, linear, inverse


def _seam_differs(linear: Linearised) -> bool:
    """Whether the surroundings are not as white as the model although the marker is as modelled."""
    x, y = np.abs(linear.at.x - 0.5) - 0.5, np.abs(linear.at.y - 0.5) - 0.5
    seam = (x > linear.at.sigma_x) | (y > linear.at.sigma_y)
    squares, inside = linear.residual**2, (x < 0.0) & (y < 0.0)
    return bool(
        squares[seam].sum() * inside.sum() > _SEAM_RATIO * squares[inside].sum() * seam.sum()
    )


def robust_sigma(residual: FloatArray, least: float) -> float:
    """Standard deviation of residuals (N,) from their median magnitude, at least `least`."""
    return max(least, float(np.median(np.abs(residual))) / 0.6745)


def _inverse(matrix: FloatArray) -> FloatArray:
    """The inverse of a matrix; NaN if it is singular."""
    try:
        return np.asarray(np.linalg.inv(matrix), np.float64)
    except np.linalg.LinAlgError:
        return np.full_like(matrix, np.nan)


def _homography_of(p: FloatArray) -> FloatArray:
    return np.append(p[HOMOGRAPHY], 1.0).reshape(3, 3)


def _inflation(pixel: IntArray, linear: Linearised) -> float:
    """Factor of the covariance for residuals that are correlated between neighbouring pixels.

    With a significant correlation rho to its neighbours in a row (decaying geometrically), each
    counts as (1 - rho) / (1 + rho) of an independent one; rows and columns alike.
    """
    weighted = linear.residual * np.sqrt(linear.weight)
    energy = max(float(np.mean(weighted**2)), 1e-12)
    column, row = (pixel - pixel.min(axis=0)).T
    image = np.full((row.max() + 1, column.max() + 1), np.nan)
    image[row, column] = weighted
    factor = 1.0
    for products in (image[:, 1:] * image[:, :-1], image[1:] * image[:-1]):
        known = products[np.isfinite(products)]
        if len(known) > 20:
            rho = np.clip(known.mean() / energy - 2.0 / math.sqrt(len(known)), 0.0, 0.8)
            factor *= (1.0 + rho) / (1.0 - rho)
    return factor


def _samples(
    picture: Picture, corners: FloatArray, lines: FloatArray, reach: float, near: float, most: int
) -> Samples | None:
    """Pixels of a marker and of a margin of `reach` pixels around it; None if it leaves the image.

    If there are too many, those within `near` pixels of cells' boundaries (`lines`) are preferred.
    """
    along = np.linspace(0.0, 1.0, 5)[:, None, None]
    outline = (1.0 - along) * corners + along * np.roll(corners, -1, axis=0)
    pixels = picture.distort(outline.reshape(-1, 2))
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    last = np.array(picture.grey.shape[::-1]) - 1
    if not (np.all(low >= 0.0) and np.all(high <= last)):
        return None
    pad = 1.5 * max(reach, 0.0) + 2.0
    begin, end = np.maximum(0, (low - pad).astype(int)), np.minimum(last, (high + pad).astype(int))
    # Every n-th pixel is used, and far from boundaries every 10 n-th, chosen by a hash.
    area = abs(geometry.signed_area(corners))
    side = math.sqrt(area)
    expected = area + reach * 4.0 * side
    share = 1.0 - (1.0 - min(1.0, 2.0 * near * len(lines) / side)) ** 2
    every = math.ceil(expected * (share + 0.1) / most) if expected > most else 1
    u, v = np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(begin, end)))
    hashed = (u * 73856093) ^ (v * 19349663)
    some = hashed % every == 0
    pixel, hashed = np.stack([u[some], v[some]], axis=-1), hashed[some]
    straight = picture.straight[pixel[:, 1], pixel[:, 0]].astype(np.float64)
    inverse = _inverse(geometry.square_homography(corners))
    projected = straight @ inverse[:, :2].T + inverse[:, 2]
    q = projected[:, 2:]
    place = projected[:, :2] / q
    # Widths of the marker per pixel, along its axes.
    widths = np.hypot(*(inverse[:2, k] - place * inverse[2, k] for k in (0, 1))) / q
    inside = np.abs(place - 0.5) <= np.minimum(0.5 + reach * widths, 1.5)
    used = np.all(inside & (q > 0.0), axis=1)
    if expected > most:
        apart = np.abs(place[:, :, None] - lines).min(axis=-1)
        used &= np.any(apart < near * widths, axis=1) | (hashed % (10 * every) == 0)
    pixel, straight = pixel[used], straight[used]
    centre = corners.mean(axis=0)
    size = max(1.0, float(np.hypot(*(corners - centre).T).max()))
    grey = picture.grey[pixel[:, 1], pixel[:, 0]].astype(np.float64)
    u, v = (straight - centre).T / size
    light = np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v])
    return Samples(pixel, straight - centre, grey, light)
