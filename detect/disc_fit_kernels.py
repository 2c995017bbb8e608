"""Compiled fit of a disc, seen through the camera, to the grey values around a candidate.

Model of a grey value at a pixel that sees the floor at distance r from the disc's centre:

    grey = background + contrast * W(z, t),    z = (r - R) / sigma,    t = sigma / R

W is the exact profile of a disc of radius R blurred by a Gaussian of width sigma; sigma is the
blur in pixels times the length of floor per pixel in the direction of the centre. The background
is a plane plus the two saddle terms, which let light fall off across the disc without imitating
one.

Parameters of the fit, in this order: x, y, R (units of the nominal radius, relative to the
candidate), log blur (pixels), contrast, and the five terms of the background.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.disc_model_kernels import chord_pixel, profile_pixel


class FitSettings(NamedTuple):
    """What the fit is told, apart from the image and the candidates."""

    noise: float
    """Standard deviation of the noise, grey levels."""
    reach_radii: float
    """Pixels within this many radii of the candidate are fitted,"""
    reach_px: float
    """and those this near to the disc's edge, pixels,"""
    reach_blurs: float
    """or this many standard deviations of the blur."""
    radius_sigma: float
    """Standard deviation of the radius about the nominal one, relative."""
    blur_px: float
    """The blur about which the fitted one lies (along u), pixels,"""
    blur_sigma: float
    """and the standard deviation of its logarithm."""
    blur_ratio: float
    """Blur along v over blur along u, in pixels: 0.5 in single fields of interlaced frames."""


PARAMETERS = 10
_NONLINEAR = 4
_BACKGROUND = 5

#: Columns of a result.
X, Y, RADIUS, BLUR, CONTRAST, BACKGROUND = range(6)
EXPLAINED, RESIDUAL_VARIANCE, PIXELS = range(6, 9)
COV_XX, COV_XY, COV_YY = range(9, 12)
SECTORS_STEP, SECTORS_GOOD, OUTLINE_DEVIATION = range(12, 15)
RELATIVE_BLUR = 15
ITERATIONS = 16
RESULT_SIZE = 17

#: Columns of the gathered pixels: floor x, y relative to the candidate, d(x, y)/d(u, v), grey
#: value, relative growth of the floor's step from one pixel to the next along the steep axis, and
#: whether the pixel is so near to the disc that it speaks for or against it.
_FX, _FY, _XU, _XV, _YU, _YV, _GREY, _GROWTH, _NEAR = range(9)
PIXEL_COLUMNS = 9

_PIXEL_VARIANCE = 1.0 / 12.0
_SECTORS = 16
#: A disc whose smaller half axis is below this is seen flat: blur reaches across it.
_FLAT_PX = 5.0
#: Pixels within this many radii, or this near to the edge, count in the explained variance.
_NEAR_RADII = 1.45
_NEAR_PX = 2.0
_MAX_ITERATIONS = 25


@njit(cache=True, error_model="numpy")
def _gather(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    radius: float,
    blur: float,
    settings: FitSettings,
    pixels: NDArray[np.float64],
) -> tuple[int, int]:
    """Collect the pixels round a candidate whose blur is about `blur`, as the settings say.

    Returns their number, and how the disc is seen: 0 face on, 1 flat along v, 2 flat along u.
    """
    height, width = image.shape
    u1 = min(max(u0, 1), width - 2)
    v1 = min(max(v0, 1), height - 2)
    xu = 0.5 * (floor_xy[v1, u1 + 1, 0] - floor_xy[v1, u1 - 1, 0])
    yu = 0.5 * (floor_xy[v1, u1 + 1, 1] - floor_xy[v1, u1 - 1, 1])
    xv = 0.5 * (floor_xy[v1 + 1, u1, 0] - floor_xy[v1 - 1, u1, 0])
    yv = 0.5 * (floor_xy[v1 + 1, u1, 1] - floor_xy[v1 - 1, u1, 1])
    area = abs(xu * yv - xv * yu)
    if not area > 1e-14:
        return 0, 0
    flat = 0
    if max(math.hypot(xu, yu), math.hypot(xv, yv)) * _FLAT_PX > radius:
        flat = 1 if math.hypot(xv, yv) >= math.hypot(xu, yu) else 2
    # The window around the outline's ellipse, with room for perspective.
    limit = settings.reach_radii * radius
    ratio = settings.blur_ratio
    room = 1.35 * limit / area
    beyond_u = max(settings.reach_px, settings.reach_blurs * blur)
    beyond_v = max(settings.reach_px, settings.reach_blurs * blur * ratio)
    half_u = min(int(room * math.hypot(xv, yv) + beyond_u) + 1, width)
    half_v = min(int(room * math.hypot(xu, yu) + beyond_v) + 1, height)
    step = 1
    while (2 * half_u // step + 1) * (2 * half_v // step + 1) > pixels.shape[0]:
        step += 1
    x0 = floor_xy[v0, u0, 0]
    y0 = floor_xy[v0, u0, 1]
    count = 0
    for v in range(max(1, v0 - half_v), min(height - 1, v0 + half_v + 1), step):
        for u in range(max(1, u0 - half_u), min(width - 1, u0 + half_u + 1), step):
            x = float(floor_xy[v, u, 0] - x0)
            y = float(floor_xy[v, u, 1] - y0)
            r = math.sqrt(x * x + y * y)
            if not r < 4.0 * limit:
                continue
            xu = 0.5 * (floor_xy[v, u + 1, 0] - floor_xy[v, u - 1, 0])
            yu = 0.5 * (floor_xy[v, u + 1, 1] - floor_xy[v, u - 1, 1])
            xv = 0.5 * (floor_xy[v + 1, u, 0] - floor_xy[v - 1, u, 0])
            yv = 0.5 * (floor_xy[v + 1, u, 1] - floor_xy[v - 1, u, 1])
            gu = (xu * x + yu * y) / max(r, 1e-12)
            gv = (xv * x + yv * y) / max(r, 1e-12)
            per_px = math.hypot(gu, gv)
            per_blur = blur * math.hypot(gu, ratio * gv)
            off_edge = r - radius
            if (
                r > limit
                and not off_edge <= settings.reach_px * per_px
                and not off_edge <= settings.reach_blurs * per_blur
            ):
                continue
            near = r <= _NEAR_RADII * radius or off_edge <= _NEAR_PX * per_px
            pixels[count, _NEAR] = 1.0 if near else 0.0
            pixels[count, _FX] = x / radius
            pixels[count, _FY] = y / radius
            pixels[count, _XU] = xu / radius
            pixels[count, _XV] = xv / radius
            pixels[count, _YU] = yu / radius
            pixels[count, _YV] = yv / radius
            pixels[count, _GREY] = image[v, u]
            pixels[count, _GROWTH] = 0.0
            if flat == 1:
                before = math.hypot(
                    floor_xy[v, u, 0] - floor_xy[v - 1, u, 0],
                    floor_xy[v, u, 1] - floor_xy[v - 1, u, 1],
                )
                after = math.hypot(
                    floor_xy[v + 1, u, 0] - floor_xy[v, u, 0],
                    floor_xy[v + 1, u, 1] - floor_xy[v, u, 1],
                )
                pixels[count, _GROWTH] = 2.0 * (after - before) / (after + before)
            elif flat == 2:
                before = math.hypot(
                    floor_xy[v, u, 0] - floor_xy[v, u - 1, 0],
                    floor_xy[v, u, 1] - floor_xy[v, u - 1, 1],
                )
                after = math.hypot(
                    floor_xy[v, u + 1, 0] - floor_xy[v, u, 0],
                    floor_xy[v, u + 1, 1] - floor_xy[v, u, 1],
                )
                pixels[count, _GROWTH] = 2.0 * (after - before) / (after + before)
            count += 1
    return count, flat


@njit(cache=True, error_model="numpy")
def _solve(
    a: NDArray[np.float64], b: NDArray[np.float64], n: int, lower: NDArray[np.float64]
) -> bool:
    """Solve the symmetric positive definite a x = b in place of b (Cholesky)."""
    for i in range(n):
        for j in range(i + 1):
            s = a[i, j]
            for k in range(j):
                s -= lower[i, k] * lower[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                lower[i, i] = math.sqrt(s)
            else:
                lower[i, j] = s / lower[j, j]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= lower[i, k] * b[k]
        b[i] = s / lower[i, i]
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= lower[k, i] * b[k]
        b[i] = s / lower[i, i]
    return True


@njit(cache=True, error_model="numpy")
def _fit(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    radius: float,
    profile: NDArray[np.float64],
    z_limit: float,
    t_limit: float,
    nodes: NDArray[np.float64],
    weights: NDArray[np.float64],
    settings: FitSettings,
    blur_guess: float,
    pixels: NDArray[np.float64],
    edge: NDArray[np.float64],
    out: NDArray[np.float64],
) -> bool:
    """Fit one candidate; see `fit_discs`."""
    n_linear = 1 + _BACKGROUND
    out[:] = 0.0
    noise = settings.noise
    n, flat = _gather(image, floor_xy, u0, v0, radius, blur_guess, settings, pixels)
    out[PIXELS] = n
    if n < PARAMETERS + 4:
        return False
    sigma_r = settings.radius_sigma
    log_blur = math.log(settings.blur_px)
    sigma_blur = settings.blur_sigma
    blur_ratio = settings.blur_ratio

    p = np.zeros(PARAMETERS)
    best = np.zeros(PARAMETERS)
    p[2] = 1.0
    p[3] = log_blur
    row = np.zeros(PARAMETERS)
    normal = np.zeros((PARAMETERS, PARAMETERS))
    kept = np.zeros((PARAMETERS, PARAMETERS))
    damped = np.zeros((PARAMETERS, PARAMETERS))
    lower = np.zeros((PARAMETERS, PARAMETERS))
    gradient = np.zeros(PARAMETERS)
    kept_gradient = np.zeros(PARAMETERS)
    step = np.zeros(PARAMETERS)

    # Without a disc: the background alone, the measure of what there is to explain.
    for i in range(n):
        x = pixels[i, _FX]
        y = pixels[i, _FY]
        row[0] = 1.0
        row[1] = x
        row[2] = y
        row[3] = x * x - y * y
        row[4] = x * y
        for j in range(_BACKGROUND):
            gradient[j] += row[j] * pixels[i, _GREY]
            for k in range(j + 1):
                normal[j, k] += row[j] * row[k]
    for j in range(_BACKGROUND):
        normal[j, j] += 1e-9 * n
    if not _solve(normal, gradient, _BACKGROUND, lower):
        return False
    total = 0.0
    for i in range(n):
        x = pixels[i, _FX]
        y = pixels[i, _FY]
        grey = gradient[0] + gradient[1] * x + gradient[2] * y
        grey += gradient[3] * (x * x - y * y) + gradient[4] * x * y
        total += pixels[i, _NEAR] * (pixels[i, _GREY] - grey) ** 2

    cost = math.inf
    residual = 0.0
    near_residual = 0.0
    damping = 1e-3
    linear_start = True
    iteration = 0
    while iteration < _MAX_ITERATIONS:
        normal[:] = 0.0
        gradient[:] = 0.0
        residual = 0.0
        near_residual = 0.0
        blur = math.exp(p[3])
        blur_v = blur * blur_ratio
        sigma_u = math.sqrt(blur * blur + _PIXEL_VARIANCE)
        sigma_v = math.sqrt(blur_v * blur_v + _PIXEL_VARIANCE)
        for i in range(n):
            x = pixels[i, _FX] - p[0]
            y = pixels[i, _FY] - p[1]
            xu = pixels[i, _XU]
            xv = pixels[i, _XV]
            yu = pixels[i, _YU]
            yv = pixels[i, _YV]
            if flat == 0:
                w, dx, dy, dr, db = profile_pixel(
                    x, y, xu, xv, yu, yv, p[2], blur, blur_v, sigma_u, sigma_v,
                    profile, z_limit, t_limit,
                )  # fmt: skip
            elif flat == 1:
                w, dx, dy, dr, db = chord_pixel(
                    x, y, xv, yv, xu, yu, pixels[i, _GROWTH], p[2],
                    blur_v, blur, sigma_v, sigma_u, nodes, weights,
                )  # fmt: skip
            else:
                w, dx, dy, dr, db = chord_pixel(
                    x, y, xu, yu, xv, yv, pixels[i, _GROWTH], p[2],
                    blur, blur_v, sigma_u, sigma_v, nodes, weights,
                )  # fmt: skip
            xb = pixels[i, _FX]
            yb = pixels[i, _FY]
            grey = p[4] * w + p[5] + p[6] * xb + p[7] * yb
            grey += p[8] * (xb * xb - yb * yb) + p[9] * xb * yb
            error = pixels[i, _GREY] - grey
            residual += error * error
            near_residual += pixels[i, _NEAR] * error * error
            row[0] = p[4] * dx
            row[1] = p[4] * dy
            row[2] = p[4] * dr
            row[3] = p[4] * db
            row[4] = w
            edge[i, 0] = w
            edge[i, 1] = row[2]
            edge[i, 2] = error
            row[5] = 1.0
            row[6] = xb
            row[7] = yb
            row[8] = xb * xb - yb * yb
            row[9] = xb * yb
            for j in range(PARAMETERS):
                gradient[j] += row[j] * error
                for k in range(j + 1):
                    normal[j, k] += row[j] * row[k]
        variance = max(residual / (n - PARAMETERS), noise * noise)
        # Weak prior knowledge of radius and blur keeps tiny and blurred discs determined.
        prior_r = (p[2] - 1.0) / sigma_r
        prior_blur = (p[3] - log_blur) / sigma_blur
        now = residual + variance * (prior_r * prior_r + prior_blur * prior_blur)
        normal[2, 2] += variance / (sigma_r * sigma_r)
        normal[3, 3] += variance / (sigma_blur * sigma_blur)
        gradient[2] -= variance * prior_r / sigma_r
        gradient[3] -= variance * prior_blur / sigma_blur
        for j in range(PARAMETERS):
            normal[j, j] += 1e-9 * n
        if linear_start:
            # First the grey levels alone, with the disc where the candidate is.
            for j in range(n_linear):
                step[j] = gradient[_NONLINEAR + j]
                for k in range(j + 1):
                    damped[j, k] = normal[_NONLINEAR + j, _NONLINEAR + k]
            if not _solve(damped, step, n_linear, lower):
                return False
            for j in range(n_linear):
                p[_NONLINEAR + j] = step[j]
            linear_start = False
            continue
        iteration += 1
        if now <= cost:
            converged = cost - now <= 1e-4 * variance
            cost = now
            best[:] = p
            kept[:] = normal
            kept_gradient[:] = gradient
            damping = max(0.2 * damping, 1e-7)
            if converged:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
        for j in range(PARAMETERS):
            step[j] = kept_gradient[j]
            for k in range(j + 1):
                damped[j, k] = kept[j, k]
            damped[j, j] *= 1.0 + damping
        if not _solve(damped, step, PARAMETERS, lower):
            return False
        length = math.hypot(step[0], step[1])
        shorten = min(1.0, 0.3 / length) if length > 0.0 else 1.0
        for j in range(PARAMETERS):
            p[j] = best[j] + shorten * step[j]
        p[2] = min(max(p[2], 0.4), 2.0)
        p[3] = min(max(p[3], math.log(0.1)), math.log(8.0))
    if not cost < math.inf:
        return False

    # `edge` may belong to a rejected step: only the sectors use it.
    out[X] = floor_xy[v0, u0, 0] + best[0] * radius
    out[Y] = floor_xy[v0, u0, 1] + best[1] * radius
    out[RADIUS] = best[2] * radius
    out[BLUR] = math.exp(best[3])
    out[CONTRAST] = best[4]
    out[BACKGROUND] = best[5]
    out[EXPLAINED] = 1.0 - min(near_residual / max(total, 1e-12), 1.0)
    out[RESIDUAL_VARIANCE] = residual / (n - PARAMETERS)
    out[ITERATIONS] = iteration
    variance = max(out[RESIDUAL_VARIANCE], noise * noise) * _correlated_area(edge, n)
    for axis in range(2):
        step[:] = 0.0
        step[axis] = 1.0
        for j in range(PARAMETERS):
            for k in range(j + 1):
                damped[j, k] = kept[j, k]
        if not _solve(damped, step, PARAMETERS, lower):
            return False
        if axis == 0:
            out[COV_XX] = variance * step[0] * radius * radius
            out[COV_XY] = variance * step[1] * radius * radius
        else:
            out[COV_YY] = variance * step[1] * radius * radius
    _sectors(pixels, edge, n, best, blur_ratio, out)
    return True


@njit(cache=True, error_model="numpy")
def _correlated_area(edge: NDArray[np.float64], n: int) -> float:
    """How many pixels go with one independent residual, from the correlation of neighbours.

    White noise gives 1. Where the model does not fit (texture, reflections, a disc that is none)
    the residuals hang together, and their number overstates what they tell: for a first-order
    process of correlation c by (1 + c) / (1 - c) in either direction.
    """
    product = 0.0
    square = 0.0
    for i in range(n - 1):
        # Pixels were gathered row by row: the next one is nearly always the right neighbour.
        product += edge[i, 2] * edge[i + 1, 2]
        square += edge[i, 2] * edge[i, 2]
    if not square > 0.0:
        return 1.0
    # By chance alone the correlation of n residuals scatters by 1 / sqrt(n).
    correlation = min(max(product / square - 1.5 / math.sqrt(n), 0.0), 0.8)
    return ((1.0 + correlation) / (1.0 - correlation)) ** 2


@njit(cache=True, error_model="numpy")
def _sectors(
    pixels: NDArray[np.float64],
    edge: NDArray[np.float64],
    n: int,
    p: NDArray[np.float64],
    blur_ratio: float,
    out: NDArray[np.float64],
) -> None:
    """How evenly the edge goes round: in each sector its step and how far it is from the circle.

    The step is the regression of the grey values on the model's, relative to the whole disc's; the
    distance is the Gauss-Newton step of the radius from that sector's residuals alone.
    """
    sums = np.zeros((_SECTORS, 7))
    for i in range(n):
        x = pixels[i, _FX] - p[0]
        y = pixels[i, _FY] - p[1]
        if x * x + y * y < 0.09 * p[2] * p[2]:
            continue
        w = edge[i, 0]
        # What is left of the grey value when the background is taken off.
        grey = edge[i, 2] + p[4] * w
        k = int((math.atan2(y, x) / (2.0 * math.pi) + 1.0) * _SECTORS) % _SECTORS
        sums[k, 0] += 1.0
        sums[k, 1] += w
        sums[k, 2] += w * w
        sums[k, 3] += grey
        sums[k, 4] += w * grey
        sums[k, 5] += edge[i, 1] * edge[i, 2]
        sums[k, 6] += edge[i, 1] * edge[i, 1]
    blurs = 0.0
    weights = 0.0
    sigma_u = math.sqrt(math.exp(2.0 * p[3]) + _PIXEL_VARIANCE)
    sigma_v = math.sqrt(math.exp(2.0 * p[3]) * blur_ratio * blur_ratio + _PIXEL_VARIANCE)
    for i in range(n):
        x = pixels[i, _FX] - p[0]
        y = pixels[i, _FY] - p[1]
        r = math.sqrt(x * x + y * y) + 1e-12
        gu = (pixels[i, _XU] * x + pixels[i, _YU] * y) / r
        gv = (pixels[i, _XV] * x + pixels[i, _YV] * y) / r
        weight = abs(edge[i, 1])
        blurs += weight * min(math.hypot(sigma_u * gu, sigma_v * gv) / p[2], 2.5)
        weights += weight
    out[RELATIVE_BLUR] = blurs / max(weights, 1e-12)
    seen = 0
    steps = 0.0
    good = 0
    deviation = 0.0
    strongest = 0.0
    for k in range(_SECTORS):
        strongest = max(strongest, sums[k, 6])
    for k in range(_SECTORS):
        if sums[k, 0] < 3.0:
            continue
        spread = sums[k, 2] - sums[k, 1] * sums[k, 1] / sums[k, 0]
        if spread < 0.15:
            continue
        seen += 1
        relative = (sums[k, 4] - sums[k, 1] * sums[k, 3] / sums[k, 0]) / spread / p[4]
        steps += min(max(relative, -1.0), 1.0)
        if relative > 0.4:
            good += 1
        # Sectors with little edge in them say little about its place.
        offset = sums[k, 5] / (sums[k, 6] + 0.1 * strongest)
        deviation += min(offset * offset, 0.25)
    if seen > 0:
        out[SECTORS_STEP] = steps / seen
        out[SECTORS_GOOD] = good / seen
        out[OUTLINE_DEVIATION] = math.sqrt(deviation / seen)


@njit(cache=True, error_model="numpy")
def fit_discs(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    radius: float,
    profile: NDArray[np.float64],
    z_limit: float,
    t_limit: float,
    nodes: NDArray[np.float64],
    weights: NDArray[np.float64],
    settings: FitSettings,
    blur_guess: NDArray[np.float64],
    capacity: int,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Fit a disc at each candidate.

    Parameters
    ----------
    image : (H, W) uint8
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    columns, rows : (N,) int64
        The candidates' pixels.
    radius : float
        Nominal radius, metres.
    profile, z_limit, t_limit
        `detect.disc_profile`.
    nodes, weights : (K,) float64
        Gauss-Hermite quadrature for a standard normal distribution.
    settings : FitSettings
    blur_guess : (N,) float64
        About how blurred each candidate is (along u), pixels: how far out pixels are gathered.
    capacity : int
        Most pixels to use for one candidate; of larger ones every second, third ... is used.

    Returns
    -------
    results : (N, RESULT_SIZE) float64
        Columns as named at the top of this module.
    fitted : (N,) bool
        Where the fit came to a result.
    """
    n = len(columns)
    results = np.zeros((n, RESULT_SIZE))
    fitted = np.zeros(n, np.bool_)
    pixels = np.empty((capacity, PIXEL_COLUMNS))
    edge = np.empty((capacity, 3))
    for i in range(n):
        fitted[i] = _fit(
            image, floor_xy, columns[i], rows[i], radius, profile, z_limit, t_limit,
            nodes, weights, settings, blur_guess[i], pixels, edge, results[i],
        )  # fmt: skip
    return results, fitted
