"""The vote of verticals for a tilt, compiled."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.verticals.order_kernels import descending


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"}, forceinline=True)
def _votes(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    weight: NDArray[np.float64],
    pitch: float,
    roll: float,
) -> float:
    """Votes of lines, whose normals are given in units of their tolerances, for a tilt."""
    votes = 0.0
    for line in range(len(weight)):
        off = z[line] + pitch * y[line] - roll * x[line]
        votes += weight[line] * max(1.0 - off * off, 0.0)
    return votes


@njit(cache=True, error_model="numpy")
def vote_for_tilt(
    normal: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    weight: NDArray[np.float64],
    proposer: NDArray[np.int64],
    limit: float,
    prior: float,
) -> tuple[float, float]:
    """Pitch and roll that the largest weight of lines agrees with.

    Each pair of proposers gives the tilt that makes both vertical; a line votes for it with its
    weight, less the farther it is from vertical.

    Parameters
    ----------
    normal : (N, 3) float64
        Unit normals of the lines' planes, robot frame.
    tolerance : (N,) float64
        Largest inclination after compensation (rad).
    weight : (N,) float64
        Votes of a line that is exactly vertical.
    proposer : (M,) int64
        Lines whose pairs are tried; no tilt is tried as well.
    limit : float
        Largest absolute pitch and roll (rad).
    prior : float
        Standard deviation of the tilt (rad): a tilt t loses t^2 / (2 prior^2) votes.

    Returns
    -------
    pitch, roll : float
        The tilt (rad); the first of those with the most votes.
    """
    best_pitch = 0.0
    best_roll = 0.0
    best = -math.inf
    x = normal[:, 0] / tolerance
    y = normal[:, 1] / tolerance
    z = normal[:, 2] / tolerance
    for i in range(-1, len(proposer)):
        for k in range(i + 1, len(proposer) if i >= 0 else 1):
            pitch = 0.0
            roll = 0.0
            if i >= 0:
                m = proposer[i]
                n = proposer[k]
                # n_z + pitch n_y - roll n_x = 0 for both.
                determinant = normal[m, 0] * normal[n, 1] - normal[m, 1] * normal[n, 0]
                if determinant == 0.0:
                    continue
                pitch = (normal[m, 2] * normal[n, 0] - normal[m, 0] * normal[n, 2]) / determinant
                roll = (normal[m, 2] * normal[n, 1] - normal[m, 1] * normal[n, 2]) / determinant
                if not (abs(pitch) <= limit and abs(roll) <= limit):
                    continue
            votes = -0.5 * (pitch * pitch + roll * roll) / (prior * prior)
            votes += _votes(x, y, z, weight, pitch, roll)
            if votes > best:
                best = votes
                best_pitch = pitch
                best_roll = roll
    return best_pitch, best_roll


@njit(cache=True, error_model="numpy")
def level_matrix(pitch: float, roll: float) -> NDArray[np.float64]:
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
    rotation[0, 1] = second * pitch * roll
    rotation[0, 2] = first * roll
    rotation[1, 0] = second * pitch * roll
    rotation[1, 1] = 1.0 - second * pitch * pitch
    rotation[1, 2] = -first * pitch
    rotation[2, 0] = -first * roll
    rotation[2, 1] = first * pitch
    rotation[2, 2] = 1.0 - second * squared
    return rotation


@njit(cache=True, error_model="numpy")
def refine_tilt(
    normal: NDArray[np.float64],
    variance: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    pitch: float,
    roll: float,
    prior: float,
    softening: float,
    repetitions: int,
) -> tuple[float, float, NDArray[np.float64], NDArray[np.bool_]]:
    """Least squares of a tilt over the lines that agree with it, repeated.

    Parameters
    ----------
    normal, tolerance
        See `vote_for_tilt`.
    variance : (N,) float64
        Of the inclinations that verticals show (rad^2).
    pitch, roll : float
        To begin with (rad).
    prior : float
        Standard deviation of the tilt (rad).
    softening : float
        Standard deviations from which on a line's pull no longer grows (Cauchy's weights).
    repetitions : int
        How often.

    Returns
    -------
    pitch, roll : float
        The tilt (rad).
    covariance : (2, 2) float64
        Of it (rad^2).
    agrees : (N,) bool
        Lines that are vertical under it.
    """
    count = len(variance)
    covariance = np.zeros((2, 2))
    covariance[0, 0] = prior * prior
    covariance[1, 1] = prior * prior
    agrees = np.empty(count, np.bool_)
    for repetition in range(repetitions + 1):
        rotation = level_matrix(pitch, roll)
        pp = 1.0 / (prior * prior)
        pr = 0.0
        rr = pp
        gradient_p = pitch / (prior * prior)
        gradient_r = roll / (prior * prior)
        for i in range(count):
            x = 0.0
            y = 0.0
            z = 0.0
            for k in range(3):
                x += rotation[0, k] * normal[i, k]
                y += rotation[1, k] * normal[i, k]
                z += rotation[2, k] * normal[i, k]
            agrees[i] = abs(z) <= tolerance[i]
            if agrees[i]:
                # A line of furniture or a shadow among few lines must not pull.
                weight = 1.0 / (variance[i] + (z / softening) ** 2)
                pp += weight * y * y
                pr -= weight * y * x
                rr += weight * x * x
                gradient_p += weight * y * z
                gradient_r -= weight * x * z
        if repetition == repetitions:
            break
        determinant = pp * rr - pr * pr
        covariance[0, 0] = rr / determinant
        covariance[0, 1] = -pr / determinant
        covariance[1, 0] = -pr / determinant
        covariance[1, 1] = pp / determinant
        pitch -= covariance[0, 0] * gradient_p + covariance[0, 1] * gradient_r
        roll -= covariance[1, 0] * gradient_p + covariance[1, 1] * gradient_r
    return pitch, roll, covariance, agrees


@njit(cache=True, error_model="numpy")
def cover_strays(
    normal: NDArray[np.float64],
    variance: NDArray[np.float64],
    edge: NDArray[np.int64],
    agrees: NDArray[np.bool_],
    pitch: float,
    roll: float,
    prior: float,
    softening: float,
    share: float,
    stray: float,
) -> NDArray[np.float64]:
    """Covariance of a tilt when any one of the edges may be no vertical.

    A stray edge that alone tells a part of the tilt is not seen by the others: it pulls the tilt
    until it agrees. The tilt is therefore taken for a mixture: of that of all edges and those of
    all but one, weighed by how well the others predict the edge left out and how well a stray
    would be. Where the others tell the tilt as well, nothing changes.

    Parameters
    ----------
    normal, variance, pitch, roll, prior, softening
        See `refine_tilt`.
    edge : (N,) int64
        The first line of the edge that each belongs to.
    agrees : (N,) bool
        Lines that the tilt is of.
    share : float
        Of edges that are strays, less than 1.
    stray : float
        Half width at half height of the inclinations of strays, distributed as Cauchy's (rad).

    Returns
    -------
    (2, 2) float64
        Mean square deviation from the given tilt (rad^2).
    """
    count = len(variance)
    rotation = level_matrix(pitch, roll)
    # What the lines of each edge add to the information, and sums over them.
    sums = np.zeros((count, 10))
    pp = 1.0 / (prior * prior)
    pr = 0.0
    rr = pp
    gradient_p = pitch / (prior * prior)
    gradient_r = roll / (prior * prior)
    for i in range(count):
        if not agrees[i]:
            continue
        x = 0.0
        y = 0.0
        z = 0.0
        for k in range(3):
            x += rotation[0, k] * normal[i, k]
            y += rotation[1, k] * normal[i, k]
            z += rotation[2, k] * normal[i, k]
        weight = 1.0 / (variance[i] + (z / softening) ** 2)
        own = sums[edge[i]]
        own[0] += weight * y * y
        own[1] -= weight * y * x
        own[2] += weight * x * x
        own[3] += weight * y * z
        own[4] -= weight * x * z
        own[5] += y
        own[6] -= x
        own[7] += z
        own[8] += variance[i]
        own[9] += 1.0
    for first in range(count):
        pp += sums[first, 0]
        pr += sums[first, 1]
        rr += sums[first, 2]
        gradient_p += sums[first, 3]
        gradient_r += sums[first, 4]
    total = 1.0
    determinant = pp * rr - pr * pr
    cover_pp = rr / determinant
    cover_pr = -pr / determinant
    cover_rr = pp / determinant
    for first in range(count):
        own = sums[first]
        lines = own[9]
        if lines == 0.0:
            continue
        # All but this edge.
        other_pp = pp - own[0]
        other_pr = pr - own[1]
        other_rr = rr - own[2]
        other_p = gradient_p - own[3]
        other_r = gradient_r - own[4]
        mean_p = own[5] / lines
        mean_r = own[6] / lines
        mean_off = own[7] / lines
        # The lines of an edge share what it tells.
        mean_variance = own[8] / (lines * lines)
        determinant = other_pp * other_rr - other_pr * other_pr
        own_pp = other_rr / determinant
        own_pr = -other_pr / determinant
        own_rr = other_pp / determinant
        change_p = -(own_pp * other_p + own_pr * other_r)
        change_r = -(own_pr * other_p + own_rr * other_r)
        # How the others predict the inclination of this one.
        left = mean_off + mean_p * change_p + mean_r * change_r
        predicted = (
            mean_variance
            + mean_p * mean_p * own_pp
            + 2.0 * mean_p * mean_r * own_pr
            + mean_r * mean_r * own_rr
        )
        # Beyond that it is a stray.
        exponent = min(0.5 * left * left / predicted, 50.0)
        as_stray = 1.0 / (math.pi * stray * (1.0 + (left / stray) ** 2))
        odds = share / (1.0 - share) * as_stray
        odds *= math.sqrt(2.0 * math.pi * predicted) * math.exp(exponent)
        total += odds
        cover_pp += odds * (own_pp + change_p * change_p)
        cover_pr += odds * (own_pr + change_p * change_r)
        cover_rr += odds * (own_rr + change_r * change_r)
    covariance = np.empty((2, 2))
    covariance[0, 0] = cover_pp / total
    covariance[0, 1] = cover_pr / total
    covariance[1, 0] = covariance[0, 1]
    covariance[1, 1] = cover_rr / total
    return covariance


@njit(cache=True, error_model="numpy")
def agree_on_tilt(
    normal: NDArray[np.float64],
    variance: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    weight: NDArray[np.float64],
    edge: NDArray[np.int64],
    proposers: int,
    limit: float,
    prior: float,
    softening: float,
    repetitions: int,
    stray_share: float,
    stray: float,
) -> tuple[float, float, NDArray[np.float64], NDArray[np.bool_]]:
    """The tilt that most lines vote for, refined; parameters and results as of these three.

    Pairs of the `proposers` lines of the largest weight propose.
    """
    strongest = descending(weight)[:proposers]
    pitch, roll = vote_for_tilt(normal, tolerance, weight, strongest, limit, prior)
    pitch, roll, covariance, agrees = refine_tilt(
        normal, variance, tolerance, pitch, roll, prior, softening, repetitions
    )
    if stray_share > 0.0:
        covariance = cover_strays(
            normal, variance, edge, agrees, pitch, roll, prior, softening, stray_share, stray
        )
    return pitch, roll, covariance, agrees
