"""Compiled loops that judge tracks and gather them to lines: arrays in, arrays out.

Fates are numbers here: places in `detect.verticals.judgement.FATES`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.verticals.bearing import chain_neighbours, join_mixture, wrapped
from detect.verticals.order_kernels import descending
from detect.verticals.sum_kernels import sum_of

ACCEPTED = 0
JOINED = 1
SHORT = 2
NO_MAXIMUM = 3
LITTLE_EVIDENCE = 4
OFF_THE_TRACK = 5
NOT_STRAIGHT = 6
OFF_THE_HORIZON = 7
UNCERTAIN = 8
SOFT = 9
NOT_VERTICAL = 10
SAME_EDGE = 11
BESIDE_A_STRONGER_EDGE = 12


@njit(cache=True, error_model="numpy")
def _chosen(
    fate: NDArray[np.int8], values: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Accepted tracks, and their values."""
    tracks = np.empty(len(fate), np.int64)
    own = np.empty(len(fate))
    n = 0
    for t in range(len(fate)):
        if fate[t] == ACCEPTED:
            tracks[n] = t
            own[n] = values[t]
            n += 1
    return tracks[:n], own[:n]


@njit(cache=True, error_model="numpy")
def _quantile(values: NDArray[np.float64], share: float) -> float:
    """Quantile of at least one value, interpolated linearly."""
    order = descending(values)
    last = len(values) - 1
    place = share * last
    below = int(place)
    lower = values[order[last - below]]
    upper = values[order[max(last - below - 1, 0)]]
    return float(lower + (place - below) * (upper - lower))


@njit(cache=True, error_model="numpy")
def judge_tracks(
    bounds: NDArray[np.int64],
    row: NDArray[np.int32],
    column: NDArray[np.float64],
    score: NDArray[np.float32],
    anchor_row: NDArray[np.float64],
    row_aspect: float,
    pixel: NDArray[np.float64],
    line: NDArray[np.float64],
    covariance: NDArray[np.float64],
    scatter_px: NDArray[np.float64],
    shift_px: NDArray[np.float64],
    contrast: NDArray[np.float64],
    sharpness: NDArray[np.float64],
    least_points: int,
    least_evidence: float,
    largest_shift_px: float,
    largest_scatter_px: float,
    largest_horizon_gap_px: float,
    largest_noise_px: float,
    least_sharpness: float,
    soft_evidence: float,
) -> tuple[NDArray[np.float64], NDArray[np.int8]]:
    """Tell for each track what speaks for it, and whether it can be a vertical, by itself.

    Parameters
    ----------
    bounds, row, column, score
        The tracks (see `detect.verticals.tracks.LineTracks`).
    anchor_row, row_aspect
        The table.
    pixel, line, covariance, scatter_px, shift_px, contrast, sharpness
        Their lines (see `detect.verticals.fit.LineFits`).
    least_points, ..., soft_evidence
        See `detect.line_settings.LineSettings`.

    Returns
    -------
    evidence : (T,) float64
        Scores summed over the track's length in pixel widths. Soft edges are shadows and glare more
        often than the building's: theirs is weakened by the square of their sharpness.
    fate : (T,) int8
        Accepted, or the first reason why not.
    """
    width = len(anchor_row)
    count = len(bounds) - 1
    evidence = np.empty(count)
    fate = np.empty(count, np.int8)
    for t in range(count):
        begin, end = bounds[t], bounds[t + 1]
        total = sum_of(score[begin:end])
        evidence[t] = total * row_aspect * sharpness[t] * sharpness[t]
        near = min(max(int(np.rint(column[begin])), 0), width - 1)
        gap = max(anchor_row[near] - row[end - 1], row[begin] - anchor_row[near]) * row_aspect
        if end - begin < least_points:
            fate[t] = SHORT
        elif not evidence[t] >= least_evidence:
            fate[t] = LITTLE_EVIDENCE
        elif not math.isfinite(line[t, 0]):
            fate[t] = NO_MAXIMUM
        elif not shift_px[t] <= largest_shift_px:
            fate[t] = OFF_THE_TRACK
        elif not scatter_px[t] <= largest_scatter_px:
            fate[t] = NOT_STRAIGHT
        elif not gap <= largest_horizon_gap_px:
            fate[t] = OFF_THE_HORIZON
        elif not math.sqrt(covariance[t, 0, 0]) / pixel[t] <= largest_noise_px:
            fate[t] = UNCERTAIN
        else:
            fate[t] = ACCEPTED
    accepted, sharpnesses = _chosen(fate, sharpness)
    if len(accepted) == 0:
        return evidence, fate
    # How sharp an edge can be depends on the image's focus and motion.
    sharp = least_sharpness * _quantile(sharpnesses, 0.25)
    clear = _quantile(_chosen(fate, contrast)[1], 0.5)
    for t in accepted:
        if sharpness[t] < sharp and contrast[t] < clear and evidence[t] < soft_evidence:
            fate[t] = SOFT
    return evidence, fate


@njit(cache=True, error_model="numpy")
def weigh_verticals(
    reference: NDArray[np.float64],
    pixel: NDArray[np.float64],
    line: NDArray[np.float64],
    covariance: NDArray[np.float64],
    spread: NDArray[np.float64],
    evidence: NDArray[np.float64],
    fate: NDArray[np.int8],
    building_variance: float,
    bend_px: float,
    lean_noise: float,
    largest_lean_rad: float,
    largest_lean_sigmas: float,
    largest_lean_px: float,
    weight_limit: float,
) -> tuple[
    NDArray[np.int64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
]:
    """What accepted lines say about the tilt.

    Parameters
    ----------
    reference, pixel, line, covariance, spread
        The lines (see `detect.verticals.fit.LineFits`).
    evidence, fate
        Of each track.
    building_variance : float
        Of real verticals about the vertical (rad^2).
    bend_px, ..., weight_limit
        See `detect.line_settings.LineSettings`.

    Returns
    -------
    accepted : (N,) int64
        The accepted tracks.
    normal : (N, 3) float64
        Unit normals of their lines' planes.
    variance, tolerance, weight : (N,) float64
        As `detect.verticals.tilt.consensus` takes them.
    """
    accepted, _ = _chosen(fate, evidence)
    count = len(accepted)
    normal = np.empty((count, 3))
    variance = np.empty(count)
    tolerance = np.empty(count)
    weight = np.empty(count)
    for k in range(count):
        t = accepted[k]
        sine = math.sin(reference[t])
        cosine = math.cos(reference[t])
        a = line[t, 0]
        b = line[t, 1]
        length = math.sqrt(1.0 + a * a + b * b)
        normal[k, 0] = (cosine - a * sine) / length
        normal[k, 1] = (sine + a * cosine) / length
        normal[k, 2] = -b / length
        # One pixel from end to end: 12 = (length / standard deviation of its points)^2.
        per_length = pixel[t] / math.sqrt(12.0 * spread[t])
        noise = covariance[t, 1, 1]
        variance[k] = building_variance + lean_noise * noise + (bend_px * per_length) ** 2
        tolerance[k] = math.sqrt(
            largest_lean_rad**2
            + largest_lean_sigmas**2 * noise
            + (largest_lean_px * per_length) ** 2
        )
        weight[k] = min(0.1 * evidence[t], weight_limit)
    return accepted, normal, variance, tolerance, weight


@njit(cache=True, error_model="numpy")
def share_edges(
    reference: NDArray[np.float64],
    pixel: NDArray[np.float64],
    line: NDArray[np.float64],
    polarity: NDArray[np.float64],
    evidence: NDArray[np.float64],
    accepted: NDArray[np.int64],
    same_edge_px: float,
    variance: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Let the lines of one edge say together as much about the tilt as one.

    Parameters
    ----------
    reference, pixel, line
        The lines (see `detect.verticals.fit.LineFits`).
    polarity, evidence
        Of each track.
    accepted : (N,) int64
        Tracks that may be verticals.
    same_edge_px : float
        See `detect.line_settings.LineSettings`.
    variance, weight : (N,) float64
        Of the accepted tracks (see `weigh_verticals`); changed where an edge has several.

    Returns
    -------
    (N,) int64
        The first of the accepted tracks that are of the same edge.
    """
    count = len(accepted)
    place = np.empty(count)
    strength = np.empty(count)
    for k in range(count):
        t = accepted[k]
        place[k] = reference[t] + math.atan(line[t, 0])
        strength[k] = evidence[t]
    edge = np.full(count, -1, np.int64)
    lines = np.zeros(count, np.int64)
    # From the strongest on, as `group_tracks` does.
    for strongest in descending(strength):
        if edge[strongest] >= 0:
            continue
        near = same_edge_px * pixel[accepted[strongest]]
        sign = polarity[accepted[strongest]]
        first = -1
        for k in range(count):
            if (
                edge[k] < 0
                and polarity[accepted[k]] == sign
                and abs(place[k] - place[strongest]) < near
            ):
                if first < 0:
                    first = k
                edge[k] = first
                lines[first] += 1
    for k in range(count):
        variance[k] *= lines[edge[k]]
        weight[k] /= lines[edge[k]]
    return edge


@njit(cache=True, error_model="numpy")
def group_tracks(
    alpha: NDArray[np.float64],
    pixel: NDArray[np.float64],
    contrast: NDArray[np.float64],
    polarity: NDArray[np.float64],
    evidence: NDArray[np.float64],
    fate: NDArray[np.int8],
    same_edge_px: float,
    join_px: float,
    join_share: float,
    shoulder_px: float,
    shoulder_share: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Gather accepted tracks to lines: one for each edge, close ones together.

    Parameters
    ----------
    alpha : (T,) float64
        Bearings (rad).
    pixel, contrast
        See `detect.verticals.fit.LineFits`.
    polarity, evidence
        Of each track.
    fate : (T,) int8
        Changed for tracks that are left out or joined.
    same_edge_px, ..., shoulder_share
        See `detect.line_settings.LineSettings`.

    Returns
    -------
    members : (M,) int64
        Tracks, line by line from the left; the strongest of each line first.
    bounds : (N + 1,) int64
        Line n's members are ``bounds[n] : bounds[n + 1]``.
    """
    accepted, evidences = _chosen(fate, evidence)
    kept = np.empty(len(accepted), np.int64)
    near_px = np.empty(len(accepted))
    places = np.empty(len(accepted))
    n = 0
    for k in descending(evidences):
        t = accepted[k]
        reason = ACCEPTED
        for s in kept[:n]:
            near = abs(wrapped(alpha[s] - alpha[t])) / pixel[t]
            if polarity[s] == polarity[t] and near < same_edge_px:
                reason = SAME_EDGE
                break
            if (near < join_px and evidence[t] < join_share * evidence[s]) or (
                near < shoulder_px and contrast[t] < shoulder_share * contrast[s]
            ):
                reason = BESIDE_A_STRONGER_EDGE
        fate[t] = reason
        if reason == ACCEPTED:
            kept[n] = t
            places[n] = alpha[t]
            near_px[n] = join_px * pixel[t]
            n += 1
    group = chain_neighbours(places[:n], near_px[:n])
    # Leftmost first; stable: the strongest of each line stays its first.
    by_group = descending(-group.astype(np.float64))
    members = np.empty(n, np.int64)
    for k in range(n):
        members[k] = kept[by_group[k]]
    bounds = np.zeros(n + 1, np.int64)
    count = 0
    for k in range(n):
        if k > 0 and group[by_group[k]] == group[by_group[k - 1]]:
            fate[members[k]] = JOINED
        else:
            count += 1
        bounds[count] = k + 1
    return members, bounds[: count + 1]


@njit(cache=True, error_model="numpy")
def join_tracks(
    alpha: NDArray[np.float64],
    noise: NDArray[np.float64],
    pixel: NDArray[np.float64],
    evidence: NDArray[np.float64],
    members: NDArray[np.int64],
    bounds: NDArray[np.int64],
    sigma_px: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bearings of lines, and their standard deviations: mixtures of those of their tracks.

    Parameters
    ----------
    alpha, noise : (T,) float64
        Bearings of tracks and their noise (rad).
    pixel : (T,) float64
        Width of a pixel (rad).
    evidence : (T,) float64
        Weights of the mixture.
    members, bounds
        See `group_tracks`.
    sigma_px : float
        Standard deviation of an edge about the line of the building that it stands for, pixels.

    Returns
    -------
    alpha, sigma : (N,) float64
        Means and standard deviations of the mixtures (rad).
    """
    count = len(bounds) - 1
    joined = np.empty(count)
    sigma = np.empty(count)
    places = np.empty(len(members))
    deviations = np.empty(len(members))
    weights = np.empty(len(members))
    for n in range(count):
        begin, end = bounds[n], bounds[n + 1]
        for k in range(begin, end):
            t = members[k]
            places[k] = alpha[t]
            weights[k] = evidence[t]
            systematic = sigma_px * pixel[t]
            deviations[k] = math.sqrt(noise[t] * noise[t] + systematic * systematic)
        joined[n], sigma[n] = join_mixture(
            places[begin:end], deviations[begin:end], weights[begin:end]
        )
    return joined, sigma
