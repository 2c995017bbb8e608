"""Mean square error of a tilt on which verticals agree.

Least squares assume that errors of lines are independent. Lines of a real building have common
errors: both edges of a board that leans, the folds of a curtain, a row of trees. And some frames
show carpentry, others clutter. The mean square error of a tilt t is therefore taken over a
posterior

    p(t, s) ~ p(t) p(s) prod_k [(1 - q) T3(z_k(t); v_k + s^2) + q Cauchy(z_k(t); c)]

of the tilt and of the scatter s of verticals about the vertical, where z_k(t) is the inclination
of line k levelled by t, v_k the variance of its measurement, T3 Student's density of three degrees
of freedom, and q the share of lines that are no verticals. For s each edge counts by itself; given
s, all lines within `TOGETHER_RAD` of bearing count as a single one, since they lean together. The
sums are over a polar grid round the tilt, stretched according to the information.

Student's density for errors whose scale is not known: K. L. Lange, R. J. A. Little and J. M. G.
Taylor, Robust Statistical Modeling Using the t Distribution, JASA 84 (1989).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: Scatter of verticals about the vertical (rad), and how often it is about that.
SCATTER_RAD = (math.radians(0.05), math.radians(0.2), math.radians(0.6))
SCATTER_SHARE = (0.2, 0.4, 0.4)
#: Lines whose bearings differ less than this lean together (rad).
TOGETHER_RAD = 0.15
#: Half width at half height of the inclinations of lines that are no verticals (rad).
STRAY_RAD = math.radians(1.0)

#: The grid: directions, and radii from the smallest to the largest (rad).
_DIRECTIONS, _RADII = 12, 10
_NEAREST, _FARTHEST = math.radians(0.02), math.radians(6.0)
#: The grid is stretched by no more than this.
_SLENDEREST = 0.1
_GROWTH = (_FARTHEST / _NEAREST) ** (1.0 / (_RADII - 1))
_RADIUS = _NEAREST * _GROWTH ** np.arange(_RADII)
#: Areas of the cells of a ring, and of the one in the middle, bounded half way between radii.
_BOUND = _NEAREST * _GROWTH ** (np.arange(_RADII + 1) - 0.5)
_AREA = np.pi * np.diff(_BOUND**2) / _DIRECTIONS
_AREA_IN_THE_MIDDLE = np.pi * _BOUND[0] ** 2
_COS = np.cos(2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS)
_SIN = np.sin(2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS)
_POINTS = _DIRECTIONS * _RADII + 1


@njit(cache=True, error_model="numpy")
def descending(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of numbers, the largest first; of equal ones the first is first.

    Numba's own sorting takes seconds to compile.

    Parameters
    ----------
    values : (N,) float64
        None of them NaN.

    Returns
    -------
    (N,) int64
    """
    count = len(values)
    order = np.empty(count, np.int64)
    merged = np.empty(count, np.int64)
    for i in range(count):
        order[i] = i
    run = 1
    while run < count:
        for begin in range(0, count, 2 * run):
            middle = min(begin + run, count)
            end = min(middle + run, count)
            left = begin
            right = middle
            for to in range(begin, end):
                if left < middle and (right >= end or values[order[left]] >= values[order[right]]):
                    merged[to] = order[left]
                    left += 1
                else:
                    merged[to] = order[right]
                    right += 1
        order, merged = merged, order
        run *= 2
    return order


@njit(cache=True, error_model="numpy")
def gather_lines(
    bearing: NDArray[np.float64], weight: NDArray[np.float64], together: float
) -> NDArray[np.int64]:
    """Groups of lines that are near the strongest of those that are in no group yet.

    Parameters
    ----------
    bearing, weight : (N,) float64
        Bearings (rad), and strengths.
    together : float
        How near (rad).

    Returns
    -------
    (N,) int64
        The strongest line of the group of each.
    """
    group = np.full(len(bearing), -1, np.int64)
    for strongest in descending(weight):
        if group[strongest] < 0:
            for k in range(len(bearing)):
                if group[k] < 0 and abs(bearing[k] - bearing[strongest]) < together:
                    group[k] = strongest
    return group


@njit(cache=True, error_model="numpy")
def merge_lines(
    normal: NDArray[np.float64], variance: NDArray[np.float64], group: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean normals of groups of lines, and the variances of their inclinations.

    Parameters
    ----------
    normal : (N, 3) float64
        Unit normals of the lines' planes.
    variance : (N,) float64
        Of their inclinations (rad^2).
    group : (N,) int64
        One of the lines, the same for all of a group.

    Returns
    -------
    normal : (G, 3) float64
        Means, weighed by how well lines are measured beside the middle scatter.
    variance : (G,) float64
        Of their inclinations, without scatter (rad^2).
    """
    count = len(group)
    weights = np.zeros(count)
    normals = np.zeros((count, 3))
    variances = np.zeros(count)
    for k in range(count):
        weight = 1.0 / (variance[k] + SCATTER_RAD[1] ** 2)
        weights[group[k]] += weight
        normals[group[k]] += weight * normal[k]
        variances[group[k]] += weight * weight * variance[k]
    groups = np.flatnonzero(weights)
    for g in groups:
        normals[g] /= weights[g]
        variances[g] /= weights[g] ** 2
    return normals[groups], variances[groups]


@njit(cache=True, error_model="numpy")
def _stretch(
    normal: NDArray[np.float64],
    variance: NDArray[np.float64],
    tilt: tuple[float, float],
    prior: float,
) -> tuple[float, float, float]:
    """Symmetric matrix that turns a circle into the posterior's ellipse, its larger axis 1."""
    pp = rr = 1.0 / (prior * prior)
    pr = 0.0
    for k in range(len(variance)):
        x, y = normal[k, 0], normal[k, 1]
        z = normal[k, 2] + tilt[0] * y - tilt[1] * x
        weight = 1.0 / (variance[k] + SCATTER_RAD[1] ** 2 + 0.25 * z * z)
        pp += weight * y * y
        pr -= weight * x * y
        rr += weight * x * x
    # Of [[a, b], [b, d]] the eigenvalues are middle +- half, the axis of the first at this angle.
    half = math.hypot(0.5 * (pp - rr), pr)
    middle = 0.5 * (pp + rr)
    shortest = max(math.sqrt((middle - half) / (middle + half)), _SLENDEREST)
    angle = 0.5 * math.atan2(2.0 * pr, pp - rr)
    # The direction that is known best is the ellipse's short axis.
    c, s = math.cos(angle), math.sin(angle)
    return shortest * c * c + s * s, (shortest - 1.0) * c * s, shortest * s * s + c * c


@njit(cache=True, error_model="numpy")
def _multiply_likelihood(
    density: NDArray[np.float64],
    pitch: NDArray[np.float64],
    roll: NDArray[np.float64],
    normal: NDArray[np.float64],
    variance: NDArray[np.float64],
    scatter: float,
    stray_share: float,
) -> None:
    """Multiply densities of tilts by the likelihood of the lines."""
    of_stray = stray_share / (math.pi * STRAY_RAD)
    for k in range(len(variance)):
        three_variances = 3.0 * (variance[k] + scatter * scatter)
        of_vertical = (1.0 - stray_share) * 2.0 / (math.pi * math.sqrt(three_variances))
        x, y, z = normal[k, 0], normal[k, 1], normal[k, 2]
        for i in range(_POINTS):
            off = z + pitch[i] * y - roll[i] * x
            student = 1.0 / (1.0 + off * off / three_variances)
            cauchy = of_stray / (1.0 + off * off / STRAY_RAD**2)
            # In units in which products of a hundred stay in range.
            density[i] *= (of_vertical * student * student + cauchy) * SCATTER_RAD[1]


@njit(cache=True, error_model="numpy")
def error_of_tilt(
    normal: NDArray[np.float64],
    variance: NDArray[np.float64],
    weight: NDArray[np.float64],
    edge: NDArray[np.int64],
    tilt: tuple[float, float],
    prior: float,
    stray_share: float,
) -> NDArray[np.float64]:
    """Mean square error of a tilt, over what its lines and those that disagree say.

    Parameters
    ----------
    normal : (N, 3) float64
        Unit normals of the lines' planes, robot frame.
    variance : (N,) float64
        Of the measured inclinations (rad^2).
    weight : (N,) float64
        Votes of each line.
    edge : (N,) int64
        One of the lines, the same for all of an edge.
    tilt : (float, float)
        Pitch and roll (rad).
    prior : float
        Standard deviation of the tilt before anything is seen (rad).
    stray_share : float
        Share of lines that are no verticals, less than 1.

    Returns
    -------
    (2, 2) float64
        Of pitch and roll (rad^2).
    """
    edge_normal, edge_variance = merge_lines(normal, variance, edge)
    bearing = np.arctan2(normal[:, 1], normal[:, 0])
    group_normal, group_variance = merge_lines(
        normal, variance, gather_lines(bearing, weight, TOGETHER_RAD)
    )
    pp, pr, rr = _stretch(group_normal, group_variance, tilt, prior)
    pitch, roll, area = np.empty(_POINTS), np.empty(_POINTS), np.empty(_POINTS)
    pitch[0], roll[0], area[0] = tilt[0], tilt[1], _AREA_IN_THE_MIDDLE
    for i in range(_RADII):
        for k in range(_DIRECTIONS):
            at = 1 + i * _DIRECTIONS + k
            pitch[at] = tilt[0] + _RADIUS[i] * (pp * _COS[k] + pr * _SIN[k])
            roll[at] = tilt[1] + _RADIUS[i] * (pr * _COS[k] + rr * _SIN[k])
            area[at] = _AREA[i]
    before = area * np.exp(-0.5 * (pitch * pitch + roll * roll) / (prior * prior))
    error = np.zeros((2, 2))
    total = 0.0
    for m in range(len(SCATTER_RAD)):
        of_edges, of_groups = before.copy(), before.copy()
        _multiply_likelihood(
            of_edges, pitch, roll, edge_normal, edge_variance, SCATTER_RAD[m], stray_share
        )
        _multiply_likelihood(
            of_groups, pitch, roll, group_normal, group_variance, SCATTER_RAD[m], stray_share
        )
        share = SCATTER_SHARE[m] * of_edges.sum()
        total += share
        share /= of_groups.sum()
        for i in range(_POINTS):
            p, r = pitch[i] - tilt[0], roll[i] - tilt[1]
            error[0, 0] += share * of_groups[i] * p * p
            error[0, 1] += share * of_groups[i] * p * r
            error[1, 1] += share * of_groups[i] * r * r
    error[1, 0] = error[0, 1]
    return error / total
