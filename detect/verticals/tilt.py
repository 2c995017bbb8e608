"""Tilt consensus: the camera's tilt from the visible verticals, and its mean square error.

A calibration gives the mounting of the camera on the robot, not the robot's tilt: the robot pitches
and rolls on its springs, and the mounting itself drifts. Verticals determine the tilt: the plane of
the camera's centre and a vertical has a normal n that is level when rotated by the tilt:

    (R n)_z = 0,    R = exp([pitch, roll, 0]x)    (robot frame: X left, Y backward, Z up)

R maps directions measured with the calibrated mounting to level ones. (DLR Spatial Cognition data
set report, line detection; the data set's own rows apply the inverse of this rotation.) The tilt is
the one on which most lines agree, refined by least squares with Cauchy weights.

Least squares assumes that errors of lines are independent. Lines of a real building have common
errors: both edges of a leaning board, the folds of a curtain, a row of trees. And some frames show
carpentry, others clutter. The mean square error of a tilt t is therefore taken over a posterior

    p(t, s) ~ p(t) p(s) prod_k [(1 - q) T3(z_k(t); v_k + s^2) + q Cauchy(z_k(t); c)]

of the tilt and of the scatter s of verticals about the vertical, where z_k(t) is the inclination
of line k levelled by t, v_k the variance of its measurement, T3 the density of Student's t with
three degrees of freedom, and q the share of lines that are not vertical. For s each edge counts
separately; given s, all lines within `TOGETHER_RAD` of bearing count as one, since they lean
together. Sums are over a polar grid around the tilt, stretched according to the information.

Student's t distribution for errors of unknown scale: K. L. Lange, R. J. A. Little and J. M. G.
Taylor, Robust Statistical Modeling Using the t Distribution, JASA 84 (1989).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from detect.line_settings import LineNumbers
from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.compiled import kernel

#: Number of times the tilt is estimated again from the lines that agree with it.
REFINEMENTS = 6
SOFTENING = 2.0  #: Scale of the Cauchy weights, standard deviations.

#: Values of the scatter of verticals about the vertical (rad), and their prior probabilities.
SCATTER_RAD = (math.radians(0.05), math.radians(0.2), math.radians(0.6))
SCATTER_SHARE = (0.2, 0.4, 0.4)
TOGETHER_RAD = 0.15  #: Lines whose bearings differ less than this lean together (rad).
#: Half width at half maximum of the inclinations of lines that are not vertical (rad).
STRAY_RAD = math.radians(1.0)

_SLENDEREST = 0.1  #: Least ratio of the axes of the stretched grid.


def _polar_grid(directions: int, radii: int, nearest: float, farthest: float) -> FloatArray:
    """(3, N) positions x, y of a grid around 0 and the areas of its cells."""
    growth = (farthest / nearest) ** (1.0 / (radii - 1))
    radius = nearest * growth ** np.arange(radii)
    # Cells are bounded halfway between radii.
    bound = nearest * growth ** (np.arange(radii + 1) - 0.5)
    area = np.pi * np.diff(bound**2) / directions
    angle = 2.0 * np.pi * np.arange(directions) / directions
    x, y = np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))
    cells = np.stack([x.ravel(), y.ravel(), np.repeat(area, directions)])
    return np.column_stack([[0.0, 0.0, np.pi * bound[0] ** 2], cells])


_GRID = _polar_grid(12, 10, math.radians(0.02), math.radians(6.0))


class TiltEstimate(NamedTuple):
    """Pitch and roll of one frame."""

    #: Rotation vector (pitch, roll, 0) about the robot's X and Y that levels measured directions
    #: (rad)
    pitch_rad: float
    roll_rad: float
    covariance: FloatArray  # (2, 2) of (pitch, roll) (rad^2)
    lines: int  # number of verticals that agree with it


class Verticals(NamedTuple):
    """Constraints of the tilt by lines that may be verticals."""

    #: (N, 3) unit normals, in the calibrated robot frame, of planes through camera and line
    normal: FloatArray
    variance: FloatArray  # (N,) of the normals' inclinations, for verticals (rad^2)
    #: (N,) largest inclinations with which the lines count as vertical (rad)
    tolerance: FloatArray
    weight: FloatArray  # (N,) votes of each line, at least 0


def with_error(
    tilt: TiltEstimate, lines: Verticals, edge: IntArray, numbers: LineNumbers
) -> TiltEstimate:
    """The tilt with its mean square error as covariance, unless the settings disable that.

    `edge` gives each line a representative line, the same for all lines on an edge.
    """
    if numbers.stray_share == 0.0:
        return tilt
    place = tilt.pitch_rad, tilt.roll_rad
    prior = math.radians(numbers.tilt_prior_deg)
    error = _error_of_tilt(lines, edge, place, prior, numbers.stray_share, _GRID)
    return tilt._replace(covariance=error)


@kernel()
def strongest_first(strength: FloatArray) -> IntArray:
    """Indices of values in decreasing order; of equal values the first comes first."""
    order = np.empty(len(strength), np.int64)
    for i in range(len(strength)):
        k = i
        while k > 0 and strength[order[k - 1]] < strength[i]:
            order[k] = order[k - 1]
            k -= 1
        order[k] = i
    return order


@kernel()
def agree_on_tilt(lines: Verticals, numbers: LineNumbers) -> tuple[TiltEstimate, BoolArray]:
    """Estimate the tilt from the largest consistent set of lines.

    Its covariance is that of least squares; `lines` is 0 if too few agree. Also returns (N,)
    whether lines are vertical under that tilt or, without an estimate, under zero tilt.
    """
    agrees, covariance = np.empty(len(lines.weight), np.bool_), np.empty((2, 2))
    pitch, roll = _vote_for_tilt(lines, numbers)
    prior = math.radians(numbers.tilt_prior_deg)
    pitch, roll = _refine_tilt(lines, pitch, roll, prior, covariance, agrees)
    count = 0  # np.count_nonzero takes longer to compile than this kernel
    for agreeing in agrees:
        count += int(agreeing)
    largest = max(abs(pitch), abs(roll))
    if count < numbers.least_lines or largest > math.radians(numbers.largest_tilt_deg):
        count = 0
        for i in range(len(agrees)):
            agrees[i] = abs(lines.normal[i, 2]) <= lines.tolerance[i]
    return TiltEstimate(pitch, roll, covariance, count), agrees


@kernel()
def _vote_for_tilt(lines: Verticals, numbers: LineNumbers) -> tuple[float, float]:
    """Pitch and roll on which lines of the largest total weight agree; of equal ones the first.

    Each pair of proposing lines gives the tilt that makes both vertical; a line votes for it with
    its weight, less the farther it is from vertical. A tilt t loses t^2 / (2 prior^2) votes. Zero
    tilt is tried as well.
    """
    normal, weight = lines.normal, lines.weight
    limit, prior = math.radians(numbers.largest_tilt_deg), math.radians(numbers.tilt_prior_deg)
    proposers = strongest_first(weight)[: numbers.proposers]
    most = 1 + len(proposers) * (len(proposers) - 1) // 2
    pitch, roll, votes = np.empty(most), np.empty(most), np.empty(most)
    pitch[0] = roll[0] = 0.0
    count = 1
    for i in range(len(proposers)):
        for k in range(i + 1, len(proposers)):
            m, n = proposers[i], proposers[k]
            # n_z + pitch n_y - roll n_x = 0 for both.
            determinant = normal[m, 0] * normal[n, 1] - normal[m, 1] * normal[n, 0]
            if determinant == 0.0:
                continue
            p = (normal[m, 2] * normal[n, 0] - normal[m, 0] * normal[n, 2]) / determinant
            r = (normal[m, 2] * normal[n, 1] - normal[m, 1] * normal[n, 2]) / determinant
            if abs(p) <= limit and abs(r) <= limit:
                pitch[count], roll[count] = p, r
                count += 1
    for k in range(count):
        votes[k] = -0.5 * (pitch[k] * pitch[k] + roll[k] * roll[k]) / (prior * prior)
    for i in range(len(weight)):
        share = 1.0 / lines.tolerance[i]
        x, y, z = share * normal[i, 0], share * normal[i, 1], share * normal[i, 2]
        for k in range(count):
            off = z + pitch[k] * y - roll[k] * x
            votes[k] += weight[i] * max(1.0 - off * off, 0.0)
    best = 0
    for k in range(count):
        if votes[k] > votes[best]:
            best = k
    return pitch[best], roll[best]


@kernel()
def _refine_tilt(
    lines: Verticals, pitch: float, roll: float, prior: float, covariance: FloatArray,
    agrees: BoolArray,
) -> tuple[float, float]:  # fmt: skip
    """Refine a tilt by repeated least squares over the lines that agree with it."""
    normal, variance, tolerance = lines.normal, lines.variance, lines.tolerance
    for repetition in range(REFINEMENTS + 1):
        rotation = levelling_rotation(pitch, roll)
        pp = rr = 1.0 / (prior * prior)
        pr = 0.0
        gradient_p, gradient_r = pitch * pp, roll * rr
        for i in range(len(agrees)):
            x = y = z = 0.0
            for k in range(3):
                x += rotation[0, k] * normal[i, k]
                y += rotation[1, k] * normal[i, k]
                z += rotation[2, k] * normal[i, k]
            agrees[i] = abs(z) <= tolerance[i]
            if agrees[i]:
                # Among few lines, one of furniture or a shadow must not bias the tilt.
                weight = 1.0 / (variance[i] + (z / SOFTENING) ** 2)
                pp += weight * y * y
                pr -= weight * y * x
                rr += weight * x * x
                gradient_p += weight * y * z
                gradient_r -= weight * x * z
        if repetition == REFINEMENTS:
            break
        determinant = pp * rr - pr * pr
        covariance[0, 0], covariance[1, 1] = rr / determinant, pp / determinant
        covariance[0, 1] = covariance[1, 0] = -pr / determinant
        pitch -= covariance[0, 0] * gradient_p + covariance[0, 1] * gradient_r
        roll -= covariance[1, 0] * gradient_p + covariance[1, 1] * gradient_r
    return pitch, roll


@kernel()
def levelling_rotation(pitch: float, roll: float) -> FloatArray:
    """(3, 3) rotation exp([pitch, roll, 0]x)."""
    squared = pitch * pitch + roll * roll
    angle = math.sqrt(squared)
    # sin(x) / x and (1 - cos(x)) / x^2.
    first = 1.0 - squared / 6.0
    second = 0.5 - squared / 24.0
    if angle > 1e-3:
        first = math.sin(angle) / angle
        second = 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    rotation = np.empty((3, 3))
    rotation[0, 0] = 1.0 - second * roll * roll
    rotation[1, 1] = 1.0 - second * pitch * pitch
    rotation[2, 2] = 1.0 - second * squared
    rotation[0, 1] = rotation[1, 0] = second * pitch * roll
    rotation[0, 2], rotation[2, 0] = first * roll, -first * roll
    rotation[1, 2], rotation[2, 1] = -first * pitch, first * pitch
    return rotation


@kernel()
def group_around_strongest(
    place: FloatArray, reach: FloatArray, strength: FloatArray, kind: FloatArray
) -> IntArray:
    """Group lines of one kind around the strongest line that is in no group yet.

    Parameters are (N,) positions, radii of the groups, strengths and kinds. Returns (N,) the first
    line of each line's group.
    """
    group = np.full(len(place), -1)
    for strongest in strongest_first(strength):
        if group[strongest] >= 0:
            continue
        first = -1
        for k in range(len(group)):
            near = abs(place[k] - place[strongest]) < reach[strongest]
            if group[k] < 0 and kind[k] == kind[strongest] and near:
                if first < 0:
                    first = k
                group[k] = first
    return group


@kernel()
def merge_lines(lines: Verticals, group: IntArray) -> FloatArray:
    """(G, 4) mean normals of groups of lines, and the variances of their inclinations.

    Lines are weighted by the inverse of their variance plus the middle scatter; the returned
    variances do not include scatter.
    """
    merged, total = np.zeros((len(group), 4)), np.zeros(len(group))
    for k in range(len(group)):
        share, to = 1.0 / (lines.variance[k] + SCATTER_RAD[1] ** 2), merged[group[k]]
        total[group[k]] += share
        for i in range(3):
            to[i] += share * lines.normal[k, i]
        to[3] += share * share * lines.variance[k]
    groups = 0
    for k in range(len(group)):
        if total[k] > 0.0:
            for i in range(3):
                merged[groups, i] = merged[k, i] / total[k]
            merged[groups, 3] = merged[k, 3] / (total[k] * total[k])
            groups += 1
    return merged[:groups]


@kernel()
def _error_of_tilt(
    lines: Verticals, edge: IntArray, tilt: tuple[float, float], prior: float,
    stray_share: float, grid: FloatArray,
) -> FloatArray:  # fmt: skip
    """(2, 2) mean square error of a tilt over the posterior of all lines."""
    count = len(edge)
    bearing = np.empty(count)
    for k in range(count):
        bearing[k] = math.atan2(lines.normal[k, 1], lines.normal[k, 0])
    reach, kind = np.full(count, TOGETHER_RAD), np.zeros(count)
    together = group_around_strongest(bearing, reach, lines.weight, kind)
    edges, groups = merge_lines(lines, edge), merge_lines(lines, together)
    xx, xy, yy = _stretch(groups, tilt, prior)
    n = grid.shape[1]
    pitch, roll, before, density = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        pitch[i] = tilt[0] + xx * grid[0, i] + xy * grid[1, i]
        roll[i] = tilt[1] + xy * grid[0, i] + yy * grid[1, i]
        squared = pitch[i] * pitch[i] + roll[i] * roll[i]
        before[i] = grid[2, i] * math.exp(-0.5 * squared / (prior * prior))
    pp = pr = rr = total = 0.0
    for m in range(len(SCATTER_RAD)):
        share = SCATTER_SHARE[m]
        share *= _posterior(before, pitch, roll, edges, SCATTER_RAD[m], stray_share, density)
        total += share
        share /= _posterior(before, pitch, roll, groups, SCATTER_RAD[m], stray_share, density)
        for i in range(n):
            p, r, weight = pitch[i] - tilt[0], roll[i] - tilt[1], share * density[i]
            pp += weight * p * p
            pr += weight * p * r
            rr += weight * r * r
    error = np.empty((2, 2))
    error[0, 0], error[1, 1] = pp / total, rr / total
    error[0, 1] = error[1, 0] = pr / total
    return error


@kernel()
def _stretch(
    groups: FloatArray, tilt: tuple[float, float], prior: float
) -> tuple[float, float, float]:
    """Symmetric matrix that maps a circle to the posterior's ellipse, its larger axis 1."""
    pp = rr = 1.0 / (prior * prior)
    pr = 0.0
    for k in range(len(groups)):
        x, y = groups[k, 0], groups[k, 1]
        off = groups[k, 2] + tilt[0] * y - tilt[1] * x
        weight = 1.0 / (groups[k, 3] + SCATTER_RAD[1] ** 2 + 0.25 * off * off)
        pp += weight * y * y
        pr -= weight * x * y
        rr += weight * x * x
    # Of [[a, b], [b, d]] the eigenvalues are middle +- half, the axis of the first at this angle.
    half, middle = math.hypot(0.5 * (pp - rr), pr), 0.5 * (pp + rr)
    shortest = max(math.sqrt((middle - half) / (middle + half)), _SLENDEREST)
    angle = 0.5 * math.atan2(2.0 * pr, pp - rr)
    # The direction that is known best is the ellipse's short axis.
    c, s = math.cos(angle), math.sin(angle)
    return shortest * c * c + s * s, (shortest - 1.0) * c * s, shortest * s * s + c * c


@kernel()
def _posterior(
    before: FloatArray, pitch: FloatArray, roll: FloatArray, lines: FloatArray, scatter: float,
    stray_share: float, density: FloatArray,
) -> float:  # fmt: skip
    """Densities of tilts from the prior and from lines with some scatter; returns their sum."""
    for i in range(len(before)):
        density[i] = before[i]
    of_stray = stray_share / (math.pi * STRAY_RAD) * SCATTER_RAD[1]
    per_stray = 1.0 / STRAY_RAD**2
    for k in range(len(lines)):
        per_variance = 1.0 / (3.0 * (lines[k, 3] + scatter * scatter))
        # Scaled so that products of a hundred factors stay in range.
        of_vertical = (1.0 - stray_share) * 2.0 / math.pi * math.sqrt(per_variance) * SCATTER_RAD[1]
        x, y, z = lines[k, 0], lines[k, 1], lines[k, 2]
        for i in range(len(density)):
            off = z + pitch[i] * y - roll[i] * x
            student, cauchy = 1.0 + off * off * per_variance, 1.0 + off * off * per_stray
            student *= student
            density[i] *= (of_vertical * cauchy + of_stray * student) / (student * cauchy)
    total = 0.0
    for i in range(len(density)):
        total += density[i]
    return total
