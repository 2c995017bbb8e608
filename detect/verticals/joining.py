"""Joins tracks to lines, one for each edge, and computes bearings, inclinations and ends.

From the strongest on, accepted tracks suppress others of the same edge and much weaker ones beside
them; of the rest, neighbours closer than `join_px` become one line. Its bearing is the mean of the
mixture of its tracks' Gaussians, sum of w_k N(alpha_k, noise_k^2 + (sigma_px pixel)^2), and its
standard deviation that of the mixture.

A line's row holds its ends in undistorted normalised image coordinates. The plane through the
camera's centre and both ends has a unit normal n in the robot frame; beta = asin(n_z). alpha is the
bearing of the horizontal direction in the plane with normal R n, where R undoes the tilt
(`detect.verticals.tilt`). The data set's own rows were made with R's inverse, which adds the tilt
instead of removing it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineNumbers
from detect.verticals.judgement import JudgedTracks, Outcome, accepted_tracks
from detect.verticals.refinement import LineFits
from detect.verticals.response import Strip
from detect.verticals.tilt import levelling_rotation, strongest_first
from detect.verticals.tracking import LineTracks
from redetect.angles import wrapped
from redetect.array_types import FloatArray, IntArray
from redetect.compiled import kernel

#: A fainter line has at most this share of the other's contrast.
_FAINTER = 0.5


class Lines(NamedTuple):
    """The lines of an image, the leftmost first."""

    ends: FloatArray  # (N, 4) xtop, ytop, xbottom, ybottom: undistorted normalised coordinates
    #: (N,) bearings, and inclinations of the normals of their planes
    alpha_rad: FloatArray
    beta_rad: FloatArray
    sigma_rad: FloatArray  # (N,) standard deviations of the bearings
    members: IntArray  # (M,) tracks, line by line; the strongest of each line first
    bounds: IntArray  # (N + 1,) line n's members are ``bounds[n] : bounds[n + 1]``


def lines_of_tracks(
    strip: Strip, tracks: LineTracks, judged: JudgedTracks, numbers: LineNumbers
) -> Lines:
    """Lines of accepted tracks; updates the outcomes of tracks that are suppressed or joined."""
    tilt = (judged.tilt.pitch_rad, judged.tilt.roll_rad) if judged.tilt is not None else (0.0, 0.0)
    if judged.tilt is None or not numbers.level:
        numbers = numbers._replace(building_deg=math.inf)
    return _join(strip, tracks, judged.fits, judged.evidence, judged.outcome, tilt, numbers)


@kernel()
def _join(
    strip: Strip, tracks: LineTracks, fits: LineFits, evidence: FloatArray,
    outcome: NDArray[np.int8], tilt: tuple[float, float], numbers: LineNumbers,
) -> Lines:  # fmt: skip
    chosen = accepted_tracks(outcome)
    chosen = chosen[strongest_first(evidence[chosen])]
    alpha, noise = _bearings(fits, chosen, tilt, numbers)
    _leave_out(chosen, alpha, tracks.polarity, fits, evidence, numbers, outcome)
    chosen = chosen[accepted_tracks(outcome[chosen])]
    count = len(chosen)
    group = chain_neighbours(alpha[chosen], _reach(fits.pixel_rad[chosen], numbers))
    # The strongest track of each line stays its first.
    bounds = np.zeros(count + 1, np.int64)
    members, lines, n = np.empty(count, np.int64), 0, 0
    while n < count:
        for k in range(count):
            if group[k] == lines:
                members[n] = chosen[k]
                outcome[members[n]] = Outcome.JOINED
                n += 1
        outcome[members[bounds[lines]]] = Outcome.ACCEPTED
        lines += 1
        bounds[lines] = n
    bounds = bounds[: lines + 1]
    bearing, deviation, weight = np.empty(count), np.empty(count), np.ones(count)
    for n in range(count):
        t = members[n]
        bearing[n] = alpha[t]
        deviation[n] = math.hypot(noise[t], numbers.sigma_px * fits.pixel_rad[t])
        if not numbers.joined_equally:
            weight[n] = evidence[t]
    joined, sigma = join_mixtures(bearing, deviation, weight, bounds)
    ends, beta = np.zeros((lines, 4)), np.zeros(lines)
    for n in range(lines):
        first = bounds[n]
        after = bounds[n + 1] if numbers.joined_equally else first + 1
        for k in range(first, after):
            t, share = members[k], 1.0 / (after - first)
            # The inclination of the plane's normal.
            a, b = fits.line[t, 0], fits.line[t, 1]
            beta[n] -= share * math.asin(b / math.sqrt(1.0 + a * a + b * b))
            for end in range(2):
                right, down = _end_of_line(strip, tracks, fits, t, end)
                ends[n, 2 * end] += share * right
                ends[n, 2 * end + 1] += share * down
    return Lines(ends, joined, beta, sigma, members, bounds)


@kernel()
def _reach(pixel_rad: FloatArray, numbers: LineNumbers) -> FloatArray:
    """Bearings of lines with these widths of a pixel are joined if closer than this (rad)."""
    per_pixel, constant = 0.0, numbers.join_rad
    if math.isnan(constant):
        per_pixel, constant = numbers.join_px, 0.0
    reach: FloatArray = per_pixel * pixel_rad + constant
    return reach


@kernel()
def _bearings(
    fits: LineFits, tracks: IntArray, tilt: tuple[float, float], numbers: LineNumbers
) -> tuple[FloatArray, FloatArray]:
    """Levelled bearings of some tracks, and their standard deviations due to noise.

    The measured lean b is combined with its prior, the lean of a vertical under the tilt with the
    standard deviation `building_deg`; a, which is correlated with b, is updated accordingly.
    """
    alpha, noise = np.empty(len(fits.line)), np.empty(len(fits.line))
    turn = 1.0 if numbers.level else -1.0
    rotation = levelling_rotation(turn * tilt[0], turn * tilt[1])
    for t in tracks:
        sine, cosine = math.sin(fits.reference_rad[t]), math.cos(fits.reference_rad[t])
        a, b, covariance = fits.line[t, 0], fits.line[t, 1], fits.covariance[t]
        gain = covariance[0, 1] / (covariance[1, 1] + math.radians(numbers.building_deg) ** 2)
        a -= gain * (b - (tilt[0] * sine - tilt[1] * cosine))
        # Of the plane's two level directions, (n_y, -n_x) is the one ahead of the camera.
        n_x, n_y = cosine - a * sine, sine + a * cosine
        x = rotation[0, 0] * n_x + rotation[0, 1] * n_y - rotation[0, 2] * b
        y = rotation[1, 0] * n_x + rotation[1, 1] * n_y - rotation[1, 2] * b
        alpha[t] = math.atan2(y, x)
        noise[t] = math.sqrt(covariance[0, 0] - gain * covariance[0, 1])
    return alpha, noise


@kernel()
def _leave_out(
    tracks: IntArray, alpha: FloatArray, polarity: FloatArray, fits: LineFits,
    evidence: FloatArray, numbers: LineNumbers, outcome: NDArray[np.int8],
) -> None:  # fmt: skip
    """Suppress tracks, from the strongest on, on the same edge as a stronger one or beside it."""
    pixel, contrast, reach = fits.pixel_rad, fits.contrast, _reach(fits.pixel_rad, numbers)
    for k in range(len(tracks)):
        t = tracks[k]
        for s in tracks[:k]:
            if outcome[s] != Outcome.ACCEPTED:
                continue
            off = abs(wrapped(alpha[t] - alpha[s]))
            near_px = off / pixel[t]
            if polarity[t] == polarity[s] and near_px < numbers.same_edge_px:
                outcome[t] = Outcome.SAME_EDGE
                break
            faint = evidence[t] < numbers.join_share * evidence[s]
            fainter = contrast[t] < _FAINTER * contrast[s]
            if (off < reach[t] and faint) or (near_px < numbers.shoulder_px and fainter):
                outcome[t] = Outcome.BESIDE_A_STRONGER_EDGE


@kernel()
def chain_neighbours(alpha: FloatArray, distance: FloatArray) -> IntArray:
    """(N,) group indices of bearings (N,), from 0 at the largest one (leftmost in the image).

    Neighbours are in the same group if they are closer than the smaller of their distances (N,).
    """
    group, order = np.zeros(len(alpha), np.int64), strongest_first(alpha)
    for k in range(1, len(order)):
        left, right = order[k - 1], order[k]
        apart = alpha[left] - alpha[right] >= min(distance[left], distance[right])
        group[right] = group[left] + (1 if apart else 0)
    return group


@kernel()
def join_mixtures(
    alpha: FloatArray, sigma: FloatArray, weight: FloatArray, bounds: IntArray
) -> tuple[FloatArray, FloatArray]:
    """(N,) means and standard deviations of mixtures of Gaussians of bearings (rad).

    Mixture n has the components ``bounds[n] : bounds[n + 1]`` of the (M,); their means are within
    half a turn, their weights not negative and not necessarily normalised.
    """
    mean, deviation = np.empty(len(bounds) - 1), np.empty(len(bounds) - 1)
    for n in range(len(mean)):
        begin, end = bounds[n], bounds[n + 1]
        total = off = square = 0.0
        for k in range(begin, end):
            total += weight[k]
            off += weight[k] * wrapped(alpha[k] - alpha[begin])
        off /= total
        for k in range(begin, end):
            own = wrapped(alpha[k] - alpha[begin]) - off
            square += weight[k] * (sigma[k] * sigma[k] + own * own)
        mean[n], deviation[n] = wrapped(alpha[begin] + off), math.sqrt(square / total)
    return mean, deviation


@kernel()
def _end_of_line(
    strip: Strip, tracks: LineTracks, fits: LineFits, t: int, end: int
) -> tuple[float, float]:
    """Undistorted normalised coordinates of a line's crossing with its first or last row."""
    bearing, elevation, rotation = strip.bearing, strip.rise, strip.robot_from_camera
    phi, a, b = fits.reference_rad[t], fits.line[t, 0], fits.line[t, 1]
    last = len(bearing) - 1
    i = tracks.bounds[t + end] - end
    v, near = tracks.row[i], tracks.column[i]
    x = z = rise = 0.0
    for _ in range(3):
        j = min(max(int(near), 0), last - 1)
        f = near - j
        moved = (1.0 - f) * elevation[j, v] + f * elevation[j + 1, v]
        # At the verticals' own ends the neighbouring column may end a row earlier.
        if math.isfinite(moved):
            rise = moved
        # Z depends on X in second order only: one repetition suffices.
        x = a + b * rise
        z = rise * math.sqrt(1.0 + x * x)
        x = a + b * z
        moved = j + (phi + math.atan(x) - bearing[j]) / (bearing[j + 1] - bearing[j])
        if math.isfinite(moved):
            near = min(max(moved, 0.0), float(last))
    left, back = math.cos(phi) * x + math.sin(phi), math.sin(phi) * x - math.cos(phi)
    right = left * rotation[0, 0] + back * rotation[1, 0] + z * rotation[2, 0]
    down = left * rotation[0, 1] + back * rotation[1, 1] + z * rotation[2, 1]
    forward = left * rotation[0, 2] + back * rotation[1, 2] + z * rotation[2, 2]
    return right / forward, down / forward
