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

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.disc_model_kernels import chord_pixel, profile_pixel
from detect.disc_outline_kernels import (
    EDGE_COLUMNS,
    ERROR,
    PER_RADIUS,
    SHARE,
    correlated_area,
    outline_statistics,
)
from detect.disc_patch_kernels import (
    FX,
    FY,
    GREY,
    GROWTH,
    NEAR,
    PIXEL_COLUMNS,
    XU,
    XV,
    YU,
    YV,
    FitSettings,
    gather_pixels,
)

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


_PIXEL_VARIANCE = 1.0 / 12.0
_MAX_ITERATIONS = 25


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
    n, flat = gather_pixels(image, floor_xy, u0, v0, radius, blur_guess, settings, pixels)
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
        x = pixels[i, FX]
        y = pixels[i, FY]
        row[0] = 1.0
        row[1] = x
        row[2] = y
        row[3] = x * x - y * y
        row[4] = x * y
        for j in range(_BACKGROUND):
            gradient[j] += row[j] * pixels[i, GREY]
            for k in range(j + 1):
                normal[j, k] += row[j] * row[k]
    for j in range(_BACKGROUND):
        normal[j, j] += 1e-9 * n
    if not _solve(normal, gradient, _BACKGROUND, lower):
        return False
    total = 0.0
    for i in range(n):
        x = pixels[i, FX]
        y = pixels[i, FY]
        grey = gradient[0] + gradient[1] * x + gradient[2] * y
        grey += gradient[3] * (x * x - y * y) + gradient[4] * x * y
        total += pixels[i, NEAR] * (pixels[i, GREY] - grey) ** 2

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
            x = pixels[i, FX] - p[0]
            y = pixels[i, FY] - p[1]
            xu = pixels[i, XU]
            xv = pixels[i, XV]
            yu = pixels[i, YU]
            yv = pixels[i, YV]
            if flat == 0:
                w, dx, dy, dr, db = profile_pixel(
                    x, y, xu, xv, yu, yv, p[2], blur, blur_v, sigma_u, sigma_v,
                    profile, z_limit, t_limit,
                )  # fmt: skip
            elif flat == 1:
                w, dx, dy, dr, db = chord_pixel(
                    x, y, xv, yv, xu, yu, pixels[i, GROWTH], p[2],
                    blur_v, blur, sigma_v, sigma_u, nodes, weights,
                )  # fmt: skip
            else:
                w, dx, dy, dr, db = chord_pixel(
                    x, y, xu, yu, xv, yv, pixels[i, GROWTH], p[2],
                    blur, blur_v, sigma_u, sigma_v, nodes, weights,
                )  # fmt: skip
            xb = pixels[i, FX]
            yb = pixels[i, FY]
            grey = p[4] * w + p[5] + p[6] * xb + p[7] * yb
            grey += p[8] * (xb * xb - yb * yb) + p[9] * xb * yb
            error = pixels[i, GREY] - grey
            residual += error * error
            near_residual += pixels[i, NEAR] * error * error
            row[0] = p[4] * dx
            row[1] = p[4] * dy
            row[2] = p[4] * dr
            row[3] = p[4] * db
            row[4] = w
            edge[i, SHARE] = w
            edge[i, PER_RADIUS] = row[2]
            edge[i, ERROR] = error
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
    variance = max(out[RESIDUAL_VARIANCE], noise * noise) * correlated_area(edge, n)
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
    out[SECTORS_STEP], out[SECTORS_GOOD], out[OUTLINE_DEVIATION], out[RELATIVE_BLUR] = (
        outline_statistics(
            pixels, edge, n, best,
            math.sqrt(out[BLUR] ** 2 + _PIXEL_VARIANCE),
            math.sqrt((blur_ratio * out[BLUR]) ** 2 + _PIXEL_VARIANCE),
        )
    )  # fmt: skip
    return True


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
    edge = np.empty((capacity, EDGE_COLUMNS))
    for i in range(n):
        fitted[i] = _fit(
            image, floor_xy, columns[i], rows[i], radius, profile, z_limit, t_limit,
            nodes, weights, settings, blur_guess[i], pixels, edge, results[i],
        )  # fmt: skip
    return results, fitted
