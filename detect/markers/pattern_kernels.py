"""Compiled fit of a whole marker, cells included, to the grey values.

The model: a pattern of black and white cells on the marker's plane, seen through a homography,
blurred by a Gaussian of any shape (optics, motion and the pixel itself), lit unevenly, its grey
values clipped at 0 and 255. The blurred pattern is exact where the homography is affine over the
width of the blur: each cell is a product of two differences of normal distributions along the
marker's axes, and where the blur is correlated along them the cells' corners contribute what the
bivariate normal distribution has more than the product.
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
from detect.markers.lens_kernels import straightened
from detect.markers.solve_kernels import invert_positive, solve_positive

#: Parameters: 8 of the homography, 6 of white and 6 of black (level, along x, along y, x^2, xy,
#: y^2), 3 of the blur's covariance (uu, uv, vv; px^2), 1 of the tone curve.
PARAMETERS = 24
_LIGHT = 6
_WHITE, _BLACK, _BLUR, _TONE = 8, 14, 20, 23
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

_PIXEL_VARIANCE = 1.0 / 12.0
_LEAST_VARIANCE = 0.07
_LARGEST_VARIANCE = 60.0
_REACH = 3.6
#: Twice the negative exponent beyond which a cell's corner adds nothing: exp(-6) and less.
_FAR_FROM_CORNER = 12.0
_ROOT_HALF = math.sqrt(0.5)
_ROOT_2PI = math.sqrt(2.0 * math.pi)
_MEDIAN_TO_SIGMA = 1.0 / 0.6745
_OUTLIER = 3.0
_LEAST_NOISE = 0.3
_SAMPLED_RESIDUALS = 700
#: Clipped pixels do not count if the model is this near the limit, grey levels, or beyond.
_CLIP_ZONE = 6.0
_CLOSE_ENOUGH_PX = 2e-3
_LEAST_CORRELATION = 0.02
_LARGEST_CORRELATION = 0.96
#: Nodes and weights of Gauss and Legendre's quadrature over (0, 1).
_NODES = np.array([0.1127016653792583, 0.5, 0.8872983346207417])
_WEIGHTS = np.array([0.2777777777777778, 0.4444444444444444, 0.2777777777777778])


@njit(cache=True, error_model="numpy")
def select_pixels(
    image: NDArray[np.uint8],
    grid: NDArray[np.float64],
    step: float,
    corners: NDArray[np.float64],
    box: NDArray[np.int64],
    lines: NDArray[np.float64],
    reach: float,
    near: float,
    limit: int,
    pixels: NDArray[np.int32],
    straight: NDArray[np.float64],
    grey: NDArray[np.float64],
) -> int:
    """Pixels of a marker and of a seam round it.

    Parameters
    ----------
    image, grid, step
        The image and its lens.
    corners : (4, 2) float64
        Straight pixels.
    box : (4,) int64
        First and last column, first and last row to look at (within the image).
    lines : (L,) float64
        Where cells end, in widths of the marker.
    reach : float
        Width of the seam, pixels.
    near : float
        If there are too many pixels, those farther than this from all cells' ends are thinned.
    limit : int
        About how many pixels are wanted at most.
    pixels : (N, 2) int32
        Result: u, v; row by row.
    straight : (N, 2) float64
        Result: straight positions.
    grey : (N,) float64
        Result: grey values.

    Returns
    -------
    int
        How many.
    """
    inverse = inverse_3x3(square_homography(corners))
    area = 0.0
    for k in range(4):
        j = (k + 1) % 4
        area += 0.5 * (corners[k, 0] * corners[j, 1] - corners[j, 0] * corners[k, 1])
    expected = area + reach * 4.0 * math.sqrt(area)
    thin = expected > limit
    every = 1
    if thin:
        # What is near the cells' ends goes on in full where possible.
        side = math.sqrt(area)
        inner = min(1.0, 2.0 * near * len(lines) / side)
        share = 1.0 - (1.0 - inner) ** 2
        every = max(1, math.ceil(expected * (share + 0.1) / limit))
    count = 0
    for v in range(box[2], box[3] + 1):
        for u in range(box[0], box[1] + 1):
            x, y, _, _, _, _ = straightened(grid, step, float(u), float(v))
            q = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
            if q <= 0.0:
                continue
            mx = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) / q
            my = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) / q
            if mx < -1.0 or mx > 2.0 or my < -1.0 or my > 2.0:
                continue
            gx = (
                math.hypot(inverse[0, 0] - mx * inverse[2, 0], inverse[0, 1] - mx * inverse[2, 1])
                / q
            )
            gy = (
                math.hypot(inverse[1, 0] - my * inverse[2, 0], inverse[1, 1] - my * inverse[2, 1])
                / q
            )
            if max(-mx, mx - 1.0) > reach * gx or max(-my, my - 1.0) > reach * gy:
                continue
            if thin:
                hashed = (u * 73856093) ^ (v * 19349663)
                close = False
                for k in range(len(lines)):
                    if abs(mx - lines[k]) < near * gx or abs(my - lines[k]) < near * gy:
                        close = True
                        break
                if hashed % (every if close else 10 * every) != 0:
                    continue
            if count == len(grey):
                return count
            pixels[count, 0] = u
            pixels[count, 1] = v
            straight[count, 0] = x
            straight[count, 1] = y
            grey[count] = image[v, u]
            count += 1
    return count


@njit(cache=True, error_model="numpy", inline="always")
def _profile(
    x: float,
    sigma: float,
    lines: NDArray[np.float64],
    z: NDArray[np.float64],
    cdf: NDArray[np.float64],
    pdf: NDArray[np.float64],
) -> tuple[int, int]:
    """Normal distribution at the cells' ends; returns the cells from, to that have a share."""
    n = len(lines)
    first = 0
    last = n
    for k in range(n):
        t = (lines[k] - x) / sigma
        z[k] = t
        if t <= -_REACH:
            cdf[k] = 0.0
            pdf[k] = 0.0
            first = k
        elif t >= _REACH:
            cdf[k] = 1.0
            pdf[k] = 0.0
            if last == n:
                last = k
        else:
            cdf[k] = 0.5 * (1.0 + math.erf(t * _ROOT_HALF))
            pdf[k] = math.exp(-0.5 * t * t) / _ROOT_2PI
    return first, min(last, n - 1)


@njit(cache=True, error_model="numpy", inline="always")
def _corner_excess(h: float, k: float, sines: NDArray[np.float64], angle: float) -> float:
    """Bivariate normal distribution at (h, k) less the product of its margins.

    Drezner and Wesolowsky, "On the computation of the bivariate normal integral", 1990. `sines`
    are those of the nodes' shares of `angle`, the arc sine of the correlation.
    """
    total = 0.0
    for i in range(3):
        s = sines[i]
        total += _WEIGHTS[i] * math.exp(-(h * h + k * k - 2.0 * h * k * s) / (2.0 * (1.0 - s * s)))
    return total * angle / (2.0 * math.pi)


@njit(cache=True, error_model="numpy")
def _blackness(
    mx: float,
    my: float,
    sx: float,
    sy: float,
    rho: float,
    lines: NDArray[np.float64],
    black: NDArray[np.float64],
    vertex: NDArray[np.float64],
    work: NDArray[np.float64],
) -> tuple[float, float, float, float, float, float]:
    """Blurred pattern (1 black, 0 white) at a place; its derivatives by mx, my, sx, sy, rho."""
    zx, cx, px = work[0], work[1], work[2]
    zy, cy, py = work[3], work[4], work[5]
    x0, x1 = _profile(mx, sx, lines, zx, cx, px)
    y0, y1 = _profile(my, sy, lines, zy, cy, py)
    value, by_x, by_y, by_sx, by_sy = 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(y0, y1):
        wy = cy[j + 1] - cy[j]
        wy_y = -(py[j + 1] - py[j]) / sy
        wy_s = -(zy[j + 1] * py[j + 1] - zy[j] * py[j]) / sy
        row, row_x, row_s = 0.0, 0.0, 0.0
        for i in range(x0, x1):
            if black[j, i] != 0.0:
                row += cx[i + 1] - cx[i]
                row_x -= px[i + 1] - px[i]
                row_s -= zx[i + 1] * px[i + 1] - zx[i] * px[i]
        value += row * wy
        by_x += row_x * wy / sx
        by_sx += row_s * wy / sx
        by_y += row * wy_y
        by_sy += row * wy_s
    by_rho = 0.0
    if abs(rho) > _LEAST_CORRELATION:
        r = min(max(rho, -_LARGEST_CORRELATION), _LARGEST_CORRELATION)
        root = math.sqrt(1.0 - r * r)
        far = _FAR_FROM_CORNER * (1.0 + abs(r))
        angle = math.asin(r)
        sines = work[6]
        for i in range(3):
            sines[i] = math.sin(angle * _NODES[i])
        for j in range(y0, y1 + 1):
            if py[j] == 0.0:
                continue
            for i in range(x0, x1 + 1):
                sign = vertex[j, i]
                if px[i] == 0.0 or sign == 0.0:
                    continue
                h, k = zx[i], zy[j]
                if h * h + k * k > far:
                    continue
                value += sign * _corner_excess(h, k, sines, angle)
                # Of the bivariate distribution less the product of its margins.
                by_h = (
                    sign * px[i] * (0.5 * (1.0 + math.erf((k - r * h) / root * _ROOT_HALF)) - cy[j])
                )
                by_k = (
                    sign * py[j] * (0.5 * (1.0 + math.erf((h - r * k) / root * _ROOT_HALF)) - cx[i])
                )
                by_x -= by_h / sx
                by_y -= by_k / sy
                by_sx -= by_h * h / sx
                by_sy -= by_k * k / sy
                by_rho += (
                    sign * px[i] * math.exp(-0.5 * ((k - r * h) / root) ** 2) / (_ROOT_2PI * root)
                )
    return value, by_x, by_y, by_sx, by_sy, by_rho


@njit(cache=True, error_model="numpy")
def corner_signs(black: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n + 1, n + 1) mixed differences of a pattern (n, n): what its corners weigh."""
    n = black.shape[0]
    padded = np.zeros((n + 2, n + 2))
    padded[1 : n + 1, 1 : n + 1] = black
    result = np.empty((n + 1, n + 1))
    for j in range(n + 1):
        for i in range(n + 1):
            result[j, i] = padded[j, i] - padded[j, i + 1] - padded[j + 1, i] + padded[j + 1, i + 1]
    return result


@njit(cache=True, error_model="numpy", inline="always")
def _place(
    inverse: NDArray[np.float64],
    x: float,
    y: float,
    p: NDArray[np.float64],
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Place on the marker, gradients there, blur along its axes: mx my ax ay bx by sx sy rho."""
    q = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
    mx = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) / q
    my = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) / q
    ax = (inverse[0, 0] - mx * inverse[2, 0]) / q
    ay = (inverse[0, 1] - mx * inverse[2, 1]) / q
    bx = (inverse[1, 0] - my * inverse[2, 0]) / q
    by = (inverse[1, 1] - my * inverse[2, 1]) / q
    uu, uv, vv = p[_BLUR], p[_BLUR + 1], p[_BLUR + 2]
    sx = math.sqrt(ax * ax * uu + 2.0 * ax * ay * uv + ay * ay * vv)
    sy = math.sqrt(bx * bx * uu + 2.0 * bx * by * uv + by * by * vv)
    rho = (ax * bx * uu + (ax * by + ay * bx) * uv + ay * by * vv) / (sx * sy)
    return mx, my, ax, ay, bx, by, sx, sy, rho


@njit(cache=True, error_model="numpy", inline="always")
def _level(p: NDArray[np.float64], first: int, x: float, y: float) -> float:
    """Grey level of white or black at a place."""
    along_x = x * (p[first + 1] + x * p[first + 3] + y * p[first + 4])
    along_y = y * (p[first + 2] + y * p[first + 5])
    return float(p[first] + along_x + along_y)


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


@njit(cache=True, error_model="numpy")
def _confine_blur(p: NDArray[np.float64]) -> None:
    """Keep the blur's covariance between what a pixel does and what is still an image."""
    mean = 0.5 * (p[_BLUR] + p[_BLUR + 2])
    half = 0.5 * (p[_BLUR] - p[_BLUR + 2])
    spread = math.sqrt(half * half + p[_BLUR + 1] ** 2)
    high = min(max(mean + spread, _LEAST_VARIANCE), _LARGEST_VARIANCE)
    low = min(max(mean - spread, _LEAST_VARIANCE), _LARGEST_VARIANCE)
    if spread > 0.0:
        c, s = half / spread, p[_BLUR + 1] / spread
    else:
        c, s = 1.0, 0.0
    new_mean, new_half = 0.5 * (high + low), 0.5 * (high - low)
    p[_BLUR] = new_mean + new_half * c
    p[_BLUR + 2] = new_mean - new_half * c
    p[_BLUR + 1] = new_half * s


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
        From `select_pixels`.
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
    p[_WHITE] = levels[1]
    p[_BLACK] = levels[0]
    p[_BLUR] = p[_BLUR + 2] = levels[2] ** 2
    _confine_blur(p)
    blur_guess = p[_BLUR]
    least = max(noise, _LEAST_NOISE)
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
            mx, my, ax, ay, bx, by, sx, sy, rho = _place(inverse, x, y, p)
            d, d_x, d_y, d_sx, d_sy, d_rho = _blackness(
                mx, my, sx, sy, rho, lines, black, vertex, work
            )
            lx = x / size
            ly = y / size
            white = _level(p, _WHITE, lx, ly)
            dark = _level(p, _BLACK, lx, ly)
            light = 1.0 - d
            toned = light + p[_TONE] * light * d
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
            if scale > 0.0 and abs(r) > _OUTLIER * scale:
                weight = (_OUTLIER * scale / r) ** 2
            weights[k] = weight
            # d(value)/d(blackness), and from there on by the chain rule.
            g = rows[k]
            slope = -(white - dark) * (1.0 + p[_TONE] * (1.0 - 2.0 * light))
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
            for first, share in ((_WHITE, toned), (_BLACK, 1.0 - toned)):
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
            g[_BLUR] = fx * ax * ax + fy * bx * bx + fxy * ax * bx
            g[_BLUR + 1] = 2.0 * (fx * ax * ay + fy * bx * by) + fxy * (ax * by + ay * bx)
            g[_BLUR + 2] = fx * ay * ay + fy * by * by + fxy * ay * by
            g[_TONE] = (white - dark) * light * d
            g[PARAMETERS] = r
            if weight != 1.0:
                root = math.sqrt(weight)
                for i in range(PARAMETERS + 1):
                    g[i] *= root
        _accumulate_squares(rows, squares)
        normal[:] = squares[:PARAMETERS, :PARAMETERS]
        right[:] = squares[:PARAMETERS, PARAMETERS]
        stride = max(1, count // _SAMPLED_RESIDUALS)
        scale = max(least, _MEDIAN_TO_SIGMA * float(np.median(np.abs(residual[:count:stride]))))
        variance = scale * scale
        contrast = max(abs(p[_WHITE] - p[_BLACK]), scale)
        # Weak knowledge, in the same measure as the grey values: light changes little over a
        # marker, the blur is round and about what was guessed, the tone curve nearly straight.
        for first in (_WHITE, _BLACK):
            for i in range(first + 1, first + _LIGHT):
                sigma = _SLOPE_SIGMA if i < first + 3 else _BEND_SIGMA
                prior = variance / (sigma * contrast) ** 2
                normal[i, i] += prior
                right[i] -= prior * p[i]
        for i in (_BLUR, _BLUR + 2):
            prior = variance / (1.0 * blur_guess + 0.1) ** 2
            normal[i, i] += prior
            right[i] -= prior * (p[i] - blur_guess)
        prior = variance / (0.5 * blur_guess + 0.05) ** 2
        normal[_BLUR + 1, _BLUR + 1] += prior
        right[_BLUR + 1] -= prior * p[_BLUR + 1]
        prior = variance / 0.15**2
        normal[_TONE, _TONE] += prior
        right[_TONE] -= prior * p[_TONE]
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
        p[_TONE] = min(max(p[_TONE], -0.6), 0.6)
        largest_blur = 1.0 + 2.0 * blur_guess
        p[_BLUR] = min(p[_BLUR], blur_guess + largest_blur)
        p[_BLUR + 2] = min(p[_BLUR + 2], blur_guess + largest_blur)
        _confine_blur(p)
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
    inflation = _inflation(pixels, residual, weights, count)
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
    numbers[CONTRAST] = p[_WHITE] - p[_BLACK]
    numbers[BLACK] = p[_BLACK]
    numbers[BLUR_UU] = p[_BLUR]
    numbers[BLUR_UV] = p[_BLUR + 1]
    numbers[BLUR_VV] = p[_BLUR + 2]
    numbers[TONE] = p[_TONE]
    numbers[STEPS] = steps
    numbers[INFLATION] = inflation
    _cell_values(
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
def _cell_values(
    straight: NDArray[np.float64],
    count: int,
    centre_x: float,
    centre_y: float,
    size: float,
    inverse: NDArray[np.float64],
    p: NDArray[np.float64],
    lines: NDArray[np.float64],
    black: NDArray[np.float64],
    residual: NDArray[np.float64],
    weights: NDArray[np.float64],
    variance: float,
    work: NDArray[np.float64],
    cells: NDArray[np.float64],
    cell_sigma: NDArray[np.float64],
) -> None:
    """Whiteness of each cell by a matched filter on the residuals: all the others as fitted.

    Unlike the geometry's, these sums do not spare outliers: a cell that is not what it should be
    must show.
    """
    n = len(lines) - 1
    top = np.zeros((n, n))
    bottom = np.zeros((n, n))
    for k in range(count):
        x = straight[k, 0] - centre_x
        y = straight[k, 1] - centre_y
        mx, my, _, _, _, _, sx, sy, _ = _place(inverse, x, y, p)
        x0, x1 = _profile(mx, sx, lines, work[0], work[1], work[2])
        y0, y1 = _profile(my, sy, lines, work[3], work[4], work[5])
        white = _level(p, _WHITE, x / size, y / size)
        dark = _level(p, _BLACK, x / size, y / size)
        for j in range(y0, y1):
            wy = (work[4, j + 1] - work[4, j]) * (white - dark)
            for i in range(x0, x1):
                share = wy * (work[1, i + 1] - work[1, i])
                top[j, i] += share * residual[k]
                bottom[j, i] += share * share
    for j in range(n):
        for i in range(n):
            if bottom[j, i] > 0.0:
                cells[j, i] = 1.0 - black[j, i] + top[j, i] / bottom[j, i]
                cell_sigma[j, i] = math.sqrt(variance / bottom[j, i])
            else:
                cells[j, i] = 0.5
                cell_sigma[j, i] = math.inf


@njit(cache=True, error_model="numpy")
def _inflation(
    pixels: NDArray[np.int32],
    residual: NDArray[np.float64],
    weights: NDArray[np.float64],
    count: int,
) -> float:
    """How much less a pixel tells for what is left over being alike at neighbouring pixels.

    A pixel's residual that is correlated with its neighbours' by rho along a row (geometrically
    falling off) counts as (1 - rho) / (1 + rho) of an independent one; rows and columns alike. Only
    what stands out of chance counts.
    """
    first_u = pixels[0, 0]
    last_u = pixels[0, 0]
    for k in range(count):
        first_u = min(first_u, pixels[k, 0])
        last_u = max(last_u, pixels[k, 0])
    width = last_u - first_u + 1
    above = np.zeros(width)
    above_row = np.full(width, -10)
    along, along_n, down, down_n = 0.0, 0, 0.0, 0
    energy, energy_n = 0.0, 0
    for k in range(count):
        u = pixels[k, 0] - first_u
        v = pixels[k, 1]
        r = residual[k] * math.sqrt(weights[k])
        energy += r * r
        energy_n += 1
        if u > 0 and above_row[u - 1] == v:
            along += r * above[u - 1]
            along_n += 1
        if above_row[u] == v - 1:
            down += r * above[u]
            down_n += 1
        above[u] = r
        above_row[u] = v
    if energy <= 0.0:
        return 1.0
    mean_energy = energy / energy_n
    factor = 1.0
    for total, n in ((along, along_n), (down, down_n)):
        if n > 20:
            rho = total / n / mean_energy - 2.0 / math.sqrt(n)
            rho = min(max(rho, 0.0), 0.8)
            factor *= (1.0 + rho) / (1.0 - rho)
    return factor
