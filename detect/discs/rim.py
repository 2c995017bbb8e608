"""The rim of a disc, direction by direction: how much of a circle of the right size is visible.

The fit of a whole disc (`detect.discs.fit`) has to explain every grey value near it, so a door's
edge in front of the disc, a cable across it or a sheet of paper beside it counts as evidence
against the disc. A person follows the rim instead: where it is visible it lies on one circle of
known size, elsewhere something hides it. This module does the same. From the centre of a candidate,
grey values are sampled outwards on the floor in `DIRECTIONS` directions. In each, the rim is where
the grey value changes most from the disc's to the floor's. A circle is fitted to these points by
least squares, outliers are removed, and the fit is repeated until the set of inliers stays the same
(from several starts, because occlusion shifts the centre of the candidate).

The idea of a circle that a minority of points cannot move comes from M. A. Fischler and
R. C. Bolles, Random Sample Consensus, CACM 24 (1981). Points are few and the starts are close, so
fixed starts work as well as random samples, and are deterministic.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera.kernels import project_floor_point
from detect.discs.model import F32
from redetect.array_types import Float32Array, FloatArray, GreyImage, Records
from redetect.compiled import kernel

DIRECTIONS = 32  #: Directions from the centre of a candidate.
STEPS = 32  #: Steps along each of the `DIRECTIONS` in which the rim is searched.
#: Where the search along a direction begins and ends, in nominal radii.
NEAREST, FARTHEST = 0.35, 1.65
LEAST_STEP = 0.35  #: Least step of the grey value, as a share of the disc's contrast.
#: Tolerance of a point on the circle: a share of the radius plus a number of pixels.
TOLERANCE_RADII, TOLERANCE_PX = 0.04, 0.4
#: Relative standard deviation of the prior on the radius: for finding the circle (the calibrated
#: height may be off by some percent), and for placing it (a short arc does not fix the radius).
RADIUS_SIGMA, PLACING_SIGMA = 0.06, 0.03
#: Standard deviation of a point of the rim along its direction, pixels.
POINT_SIGMA_PX = 0.25
LEAST_POINTS = 6  #: Least number of points on a circle.
#: Least number of points for placing a circle; its steps, and the deviations that make an outlier.
LEAST_TRUSTED = 8
_PLACING_STEPS, _FAR_OFF = 4, 2.5
_CORRELATED_POINTS = 1.5  #: Number of neighbouring points with a common error.
#: Distance of the circle's starts from the candidate, nominal radii; the first is the candidate.
_START = 0.3
_STARTS = 9
_START_X, _START_Y = (
    np.append(0.0, _START * of(2.0 * np.pi * np.arange(_STARTS - 1) / (_STARTS - 1)))
    for of in (np.cos, np.sin)
)
_POINTS_PER_SIGMA = 0.5  #: Penalty, in points, for each squared deviation of the radius.
_PER_POINT = 0.5  #: Log-odds that each point on a circle adds to it.
#: Number of steps from each start, and the longest step, nominal radii.
_ITERATIONS = 8
_LONGEST_STEP = 0.3
_CONVERGED_STEP = 1e-4  #: Iteration stops at a shorter step with the same inliers, nominal radii.
#: A circle with this share of the points is the best: the other starts are skipped.
_CERTAINLY_BEST = 0.9

_ANGLES = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
COS, SIN = np.cos(_ANGLES), np.sin(_ANGLES)
#: Weights of a parabola's start, middle and end at the steps.
_SHARES = np.linspace(NEAREST, FARTHEST, STEPS) / FARTHEST
_BEGIN, _MIDDLE, _END = (
    weight.astype(np.float32)
    for weight in (
        (1.0 - _SHARES) * (1.0 - 2.0 * _SHARES),
        4.0 * _SHARES * (1.0 - _SHARES),
        _SHARES * (2.0 * _SHARES - 1.0),
    )
)


#: The rim of a candidate; without a circle, place and radius are those of the profiles.
RIM = np.dtype(
    [
        ("agreeing", float),  # share of all directions in which the rim is on the circle
        ("runs", float),  # number of gaps: two or more neighbouring directions in which it is not
        # Root mean square distance of the points on the circle from it, in tolerances.
        ("scatter", float),
        ("step", float),  # mean step on the circle, grey levels inside minus outside
        ("floor_xy", float, 2),  # centre, metres
        ("radius", float),  # metres
        ("covariance", float, (2, 2)),  # of the centre, from the scatter of the points
        ("radius_px", float),  # geometric mean over the directions, pixels
        # Offset to another plausible circle, metres: its square has to be added to the covariance.
        ("doubt", float, 2),
    ]
)


class Profiles(NamedTuple):
    """Grey values along the directions from N points on the floor."""

    floor_xy: FloatArray  #: (N, 2) the points, metres.
    radius: FloatArray  #: (N,) nominal radii, metres.
    grey: Float32Array  #: (N, DIRECTIONS, STEPS) NaN outside the image.
    #: (N, DIRECTIONS) Length of a radius in the image in each direction, pixels.
    pixels_per_radius: FloatArray

    def where(self, chosen: NDArray[Any]) -> Profiles:
        """The profiles that indices or a mask select."""
        return Profiles(*(values[chosen] for values in self))


@kernel()
def profiles(
    image: GreyImage, camera_numbers: FloatArray, floor_xy: FloatArray, radius: FloatArray
) -> Profiles:
    """Grey values along the directions from (N, 2) points on the floor, metres.

    `radius` (N,) holds the nominal radii; `camera_numbers` as in `camera.kernels.camera_numbers`.
    """
    grey = np.empty((len(floor_xy), DIRECTIONS, STEPS), np.float32)
    scale = np.empty((len(floor_xy), DIRECTIONS))
    for i in range(len(floor_xy)):
        x, y = floor_xy[i, 0], floor_xy[i, 1]
        _sample(image, camera_numbers, x, y, radius[i], grey[i], scale[i])
    return Profiles(floor_xy, radius, grey, scale)


@kernel()
def _sample(
    image: GreyImage, camera_numbers: FloatArray, x: float, y: float, radius: float,
    grey: Float32Array, scale: FloatArray,
) -> None:  # fmt: skip
    """Write the profiles from one point."""
    pixels, (height, width) = image.reshape(-1), image.shape
    right, bottom = F32(width - 1), F32(height - 1)
    inside, first = np.empty(STEPS, np.bool_), np.empty(STEPS, np.int32)
    across, down = np.empty(STEPS, np.float32), np.empty(STEPS, np.float32)
    # Unsigned, so that no code for negative indices is generated.
    below, one = np.uint64(width), np.uint64(1)
    u0, v0 = project_floor_point(camera_numbers, x, y)
    half = 0.5 * FARTHEST
    for k in range(DIRECTIONS):
        # A parabola approximates the image of a direction to well below a tenth of a pixel.
        dx, dy = radius * COS[k], radius * SIN[k]
        u1, v1 = project_floor_point(camera_numbers, x + half * dx, y + half * dy)
        u2, v2 = project_floor_point(camera_numbers, x + FARTHEST * dx, y + FARTHEST * dy)
        du, dv = u1 - u0, v1 - v0
        scale[k] = math.sqrt(du * du + dv * dv) / half
        for m in range(STEPS):
            u = _BEGIN[m] * F32(u0) + _MIDDLE[m] * F32(u1) + _END[m] * F32(u2)
            v = _BEGIN[m] * F32(v0) + _MIDDLE[m] * F32(v1) + _END[m] * F32(v2)
            inside[m] = (u >= F32(0.0)) & (u < right) & (v >= F32(0.0)) & (v < bottom)
            column, row = np.int32(u), np.int32(v)
            across[m], down[m] = u - F32(column), v - F32(row)
            first[m] = row * np.int32(width) + column
        for m in range(STEPS):
            grey[k, m] = math.nan
            if inside[m]:
                at = np.uint64(np.uint32(first[m]))
                upper, lower = F32(pixels[at]), F32(pixels[at + below])
                upper += across[m] * (F32(pixels[at + one]) - upper)
                lower += across[m] * (F32(pixels[at + below + one]) - lower)
                grey[k, m] = upper + down[m] * (lower - upper)


@kernel()
def rim_points(
    grey: Float32Array, pixels_per_radius: FloatArray, contrast: float
) -> tuple[FloatArray, FloatArray]:
    """Find where the grey value changes most from the disc's to the floor's in each direction.

    From (DIRECTIONS, STEPS) grey values about one point and their (DIRECTIONS,) pixels per radius,
    returns (DIRECTIONS,) distances from the centre, nominal radii, NaN if no step reaches
    `LEAST_STEP` of the contrast (grey levels inside minus outside), and the steps there.
    """
    distance, step = np.empty(DIRECTIONS), np.zeros(DIRECTIONS)
    per_step = (FARTHEST - NEAREST) / (STEPS - 1)
    sign = 1.0 if contrast > 0.0 else -1.0
    change = np.empty(STEPS)
    for k in range(DIRECTIONS):
        distance[k] = math.nan
        # The step is taken over two pixels, and at least over a sixth of the radius.
        reach = max(2, round(1.0 / (pixels_per_radius[k] * per_step)))
        reach = min(reach, STEPS // 4)
        best = -1
        for m in range(STEPS):
            change[m] = -math.inf
            if reach <= m < STEPS - reach:
                value = sign * (grey[k, m - reach] - grey[k, m + reach])
                if value == value:
                    change[m] = value
                    if best < 0 or value > change[best]:
                        best = m
        if best < 0 or change[best] < LEAST_STEP * abs(contrast):
            continue
        shift = 0.0
        if 0 < best < STEPS - 1:
            before, after = change[best - 1], change[best + 1]
            bend = 2.0 * change[best] - before - after
            if 0.0 < bend < math.inf:
                shift = min(max(0.5 * (after - before) / bend, -0.5), 0.5)
        distance[k] = NEAREST + (best + shift) * per_step
        step[k] = sign * change[best]
    return distance, step


class Circle(NamedTuple):
    """A circle relative to a candidate, nominal radii."""

    x: float
    y: float
    radius: float
    cov_xx: float  #: Covariance of the centre, for points as scattered as `POINT_SIGMA_PX`.
    cov_xy: float
    cov_yy: float


@kernel()
def fit_circle(
    x: FloatArray, y: FloatArray, weight: FloatArray, circle: Circle, radius_sigma: float
) -> Circle:
    """One Gauss-Newton step of centre and radius to weighted points, from a circle near them.

    Points to be ignored have weight 0; the radius has the prior 1 +- `radius_sigma`.
    """
    s_x = s_y = s_w = s_xx = s_xy = s_yy = 0.0
    r_x = r_y = r_w = 0.0
    # No branches, so that the loop is vectorised.
    for k in range(np.uint64(len(x))):
        dx, dy = x[k] - circle.x, y[k] - circle.y
        d = math.sqrt(dx * dx + dy * dy) + 1e-12
        per_d, w = 1.0 / d, weight[k]
        dx, dy = per_d * dx, per_d * dy
        off = w * (d - circle.radius)
        s_w += w
        s_x += w * dx
        s_y += w * dy
        s_xx += w * dx * dx
        s_xy += w * dx * dy
        s_yy += w * dy * dy
        r_w += off
        r_x += off * dx
        r_y += off * dy
    prior = 1.0 / radius_sigma**2
    s_w += prior
    r_w += prior * (1.0 - circle.radius)
    s_xx += 1e-9
    s_yy += 1e-9
    # The inverse of [[xx, xy, x], [xy, yy, y], [x, y, w]] by its cofactors.
    xx, xy, yy = s_yy * s_w - s_y * s_y, s_x * s_y - s_xy * s_w, s_xx * s_w - s_x * s_x
    xw, yw = s_xy * s_y - s_yy * s_x, s_xy * s_x - s_xx * s_y
    ww = s_xx * s_yy - s_xy * s_xy
    scale = 1.0 / (s_xx * xx + s_xy * xy + s_x * xw)
    return Circle(
        circle.x + within(scale * (xx * r_x + xy * r_y + xw * r_w), _LONGEST_STEP),
        circle.y + within(scale * (xy * r_x + yy * r_y + yw * r_w), _LONGEST_STEP),
        circle.radius + within(scale * (xw * r_x + yw * r_y + ww * r_w), _LONGEST_STEP),
        scale * xx,
        scale * xy,
        scale * yy,
    )


@kernel(forceinline=True)
def _outwards(x: float, y: float, circle: Circle) -> float:
    """Distance of a point from the circle, negative inside it. (`math.hypot` is much slower.)"""
    x, y = x - circle.x, y - circle.y
    return math.sqrt(x * x + y * y) - circle.radius


@kernel()
def within(step: float, longest: float) -> float:
    """The step, or one of the longest length."""
    return min(max(step, -longest), longest)


@kernel(forceinline=True)
def _choose(
    x: FloatArray,
    y: FloatArray,
    weight: FloatArray,
    tolerance: FloatArray,
    circle: Circle,
    wide: float,
    chosen: FloatArray,
) -> tuple[int, bool]:
    """Write the inliers' weights, 0 for outliers, into `chosen`; their number, and any change.

    Points with weight 0 are missing.
    """
    count = changed = 0
    for k in range(np.uint64(len(x))):
        off = abs(_outwards(x[k], y[k], circle))
        now = weight[k] if off < wide * tolerance[k] else 0.0
        count += 1 if now > 0.0 else 0
        changed |= 1 if now != chosen[k] else 0
        chosen[k] = now
    return count, changed != 0


@kernel()
def best_circle(
    x: FloatArray, y: FloatArray, weight: FloatArray, tolerance: FloatArray, best_chosen: FloatArray
) -> tuple[Circle, int, tuple[float, float]]:
    """The circle with most inliers, their number, and the offset to another plausible circle.

    The points (DIRECTIONS,) are relative to the candidate, nominal radii; those with weight 0 are
    missing. Inliers are closer to the circle than their tolerance; `best_chosen` receives the
    weights of the best circle's inliers, 0 for the others. The square of the offset has to be added
    to the covariance of the centre.
    """
    points = 0
    for k in range(DIRECTIONS):
        points += weight[k] > 0.0
    chosen = np.zeros(DIRECTIONS)
    best = Circle(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    best_count, best_score = 0, 0.0
    ends, scores = np.zeros((_STARTS, 2)), np.full(_STARTS, -np.inf)
    for start in range(_STARTS):
        circle = Circle(_START_X[start], _START_Y[start], 1.0, 0.0, 0.0, 0.0)
        count, _ = _choose(x, y, weight, tolerance, circle, 2.5, chosen)
        for i in range(_ITERATIONS):
            if count < LEAST_POINTS:
                break
            before = circle
            circle = fit_circle(x, y, chosen, before, RADIUS_SIGMA)
            count, changed = _choose(x, y, weight, tolerance, circle, 1.6 if i < 2 else 1.0, chosen)
            moved = max(abs(circle.x - before.x), abs(circle.y - before.y))
            if i > 2 and not changed and moved < _CONVERGED_STEP:
                break
        if count < LEAST_POINTS:
            continue
        # By the prior on the radius, a circle of another size needs more points.
        score = count - _POINTS_PER_SIGMA * ((circle.radius - 1.0) / RADIUS_SIGMA) ** 2
        ends[start, 0], ends[start, 1], scores[start] = circle.x, circle.y, score
        if score > best_score:
            best_count, best_score = count, score
            best = circle
            for k in range(DIRECTIONS):
                best_chosen[k] = chosen[k]
            # A circle with more points than this would share most of them: it is the same one.
            if score >= _CERTAINLY_BEST * points:
                break
    # Of the circles found from other starts, the one that adds most.
    doubt = 0.0, 0.0
    for start in range(_STARTS):
        odds = math.exp(_PER_POINT * (scores[start] - best_score))
        share = math.sqrt(odds / (1.0 + odds))
        dx, dy = share * (ends[start, 0] - best.x), share * (ends[start, 1] - best.y)
        if dx * dx + dy * dy > doubt[0] ** 2 + doubt[1] ** 2:
            doubt = dx, dy
    return best, best_count, doubt


@kernel()
def follow_rims(
    image: GreyImage, camera_numbers: FloatArray, radial: Profiles, contrast: FloatArray
) -> Records:
    """Trace the rims in profiles from points near the centres of N candidates: (N,) `RIM`.

    `contrast` (N,) is approximately that of discs to the floor, grey levels. Without a circle,
    `agreeing` is 0.
    """
    rims = np.zeros(len(contrast), RIM)
    for i in range(len(contrast)):
        _follow_rim(image, camera_numbers, radial, i, contrast[i], rims[i])
    return rims


@kernel()
def _follow_rim(
    image: GreyImage, camera_numbers: FloatArray, radial: Profiles, i: int, contrast: float,
    rim: Any,
) -> None:  # fmt: skip
    """Trace the rim in profiles `i`, and write it into `rim`."""
    x, y, radius = radial.floor_xy[i, 0], radial.floor_xy[i, 1], radial.radius[i]
    scale = radial.pixels_per_radius[i]
    distance, step = rim_points(radial.grey[i], scale, contrast)
    at_x, at_y = np.zeros(DIRECTIONS), np.zeros(DIRECTIONS)
    weight, tolerance = np.zeros(DIRECTIONS), np.zeros(DIRECTIONS)
    log_px = 0.0
    for k in range(DIRECTIONS):
        log_px += math.log(scale[k]) / DIRECTIONS
        tolerance[k] = TOLERANCE_RADII + TOLERANCE_PX / scale[k]
        if distance[k] == distance[k]:
            at_x[k], at_y[k] = distance[k] * COS[k], distance[k] * SIN[k]
            weight[k] = (scale[k] / POINT_SIGMA_PX) ** 2
    chosen = np.zeros(DIRECTIONS)
    best, best_count, doubt = best_circle(at_x, at_y, weight, tolerance, chosen)
    rim.floor_xy[0], rim.floor_xy[1], rim.radius, rim.radius_px = x, y, radius, math.exp(log_px)
    if best_count < LEAST_POINTS:
        return
    height, width = image.shape
    squares = mean = 0.0
    outside = np.zeros(DIRECTIONS, np.bool_)
    for k in range(DIRECTIONS):
        if chosen[k] > 0.0:
            squares += (_outwards(at_x[k], at_y[k], best) / tolerance[k]) ** 2
            mean += step[k]
        else:
            rim_x = x + radius * (best.x + best.radius * COS[k])
            rim_y = y + radius * (best.y + best.radius * SIN[k])
            u, v = project_floor_point(camera_numbers, rim_x, rim_y)
            outside[k] = not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0)
    for k in range(DIRECTIONS):
        # A gap follows a direction that agrees, and has at least two that do not.
        last, following = (k - 1) % DIRECTIONS, (k + 1) % DIRECTIONS
        hidden = chosen[k] == 0.0 and chosen[following] == 0.0 and not outside[k]
        rim.runs += 1.0 if hidden and chosen[last] > 0.0 else 0.0
    rim.agreeing, rim.scatter = best_count / DIRECTIONS, math.sqrt(squares / best_count)
    rim.step, rim.radius = mean / best_count, radius * best.radius
    best = _placed(at_x, at_y, chosen, best)
    area = _CORRELATED_POINTS * radius * radius
    rim.floor_xy[0], rim.floor_xy[1] = x + radius * best.x, y + radius * best.y
    rim.covariance[0, 0], rim.covariance[1, 1] = area * best.cov_xx, area * best.cov_yy
    rim.covariance[0, 1] = rim.covariance[1, 0] = area * best.cov_xy
    rim.doubt[0], rim.doubt[1] = radius * doubt[0], radius * doubt[1]


@kernel()
def _placed(x: FloatArray, y: FloatArray, chosen: FloatArray, circle: Circle) -> Circle:
    """Refit the circle to the inner points of each visible arc.

    At the ends of an arc, the edge of the occluding object biases the rim's points. Outliers by the
    median absolute deviation are left out.
    """
    trusted, count = np.zeros(DIRECTIONS), 0
    for k in range(DIRECTIONS):
        if chosen[(k - 1) % DIRECTIONS] > 0.0 and chosen[(k + 1) % DIRECTIONS] > 0.0:
            trusted[k] = chosen[k]
        count += trusted[k] > 0.0
    if count < LEAST_TRUSTED:
        for k in range(DIRECTIONS):
            trusted[k] = chosen[k]
    off, of_trusted = np.empty(DIRECTIONS), np.empty(DIRECTIONS)
    for _ in range(_PLACING_STEPS):
        circle = fit_circle(x, y, trusted, circle, PLACING_SIGMA)
        n = 0
        for k in range(DIRECTIONS):
            off[k] = math.sqrt(trusted[k]) * abs(_outwards(x[k], y[k], circle))
            if trusted[k] > 0.0:
                of_trusted[n] = off[k]
                n += 1
        limit = max(_FAR_OFF * 1.4826 * median(of_trusted[:n]), 1.0)
        for k in range(DIRECTIONS):
            if off[k] > limit and n > LEAST_TRUSTED:
                trusted[k] = 0.0
                n -= 1
    return circle


@kernel()
def median(values: FloatArray) -> float:
    """Median of some values, which are sorted in place. (NumPy's takes much longer to compile.)"""
    count = len(values)
    for i in range(1, count):
        value = values[i]
        k = i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    return float(0.5 * (values[(count - 1) // 2] + values[count // 2]))
