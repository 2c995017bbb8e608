"""Joining: one line for each edge, close ones together; their bearings, inclinations and ends.

Of accepted tracks, from the strongest on, those of the same edge as a stronger one and those beside
a much stronger one are left out; neighbours closer than `join_px` are one line. Its bearing is the
mean of the mixture of its tracks' Gaussians, sum of w_k N(alpha_k, noise_k^2 + (sigma_px pixel)^2),
and its standard deviation that of the mixture.

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
from numba import njit
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.verticals.judgement import (
    ACCEPTED,
    BESIDE_A_STRONGER_EDGE,
    JOINED,
    SAME_EDGE,
    Judgement,
)
from detect.verticals.refinement import LineFits
from detect.verticals.response import FloatArray, Strip
from detect.verticals.tilt import level_matrix
from detect.verticals.tracking import LineTracks


class Lines(NamedTuple):
    """The lines of an image, the leftmost first.

    Attributes
    ----------
    ends : (N, 4) float64
        xtop, ytop, xbottom, ybottom: undistorted normalised coordinates.
    alpha_rad, beta_rad : (N,) float64
        Bearings, and inclinations of the normals of their planes.
    sigma_rad, noise_rad : (N,) float64
        Standard deviations of the bearings, and the part of them due to noise.
    members : (M,) int64
        Tracks, line by line; the strongest of each line first.
    bounds : (N + 1,) int64
        Line n's members are ``bounds[n] : bounds[n + 1]``.
    """

    ends: FloatArray
    alpha_rad: FloatArray
    beta_rad: FloatArray
    sigma_rad: FloatArray
    noise_rad: FloatArray
    members: NDArray[np.int64]
    bounds: NDArray[np.int64]


def lines_of_tracks(
    strip: Strip, tracks: LineTracks, judged: Judgement, settings: LineSettings
) -> Lines:
    """Lines of accepted tracks; the fate of tracks that are left out or joined is changed."""
    fits, evidence, tilt = judged.fits, judged.evidence, judged.tilt
    accepted = np.flatnonzero(judged.fate == ACCEPTED)
    strongest_first = accepted[np.argsort(-evidence[accepted], kind="stable")]
    pitch, roll = (tilt.pitch_rad, tilt.roll_rad) if tilt is not None else (0.0, 0.0)
    level = settings.alpha == "level"
    turn = 1.0 if level else -1.0
    building = math.radians(settings.building_deg) if level and tilt is not None else math.inf
    alpha, noise = np.empty((2, len(evidence)))
    _bearings(
        fits, strongest_first, level_matrix(turn * pitch, turn * roll), (pitch, roll), building,
        alpha, noise,
    )  # fmt: skip
    limits = _Limits(
        float(settings.same_edge_px),
        float(settings.join_px),
        float(settings.join_share),
        float(settings.shoulder_px),
        float(settings.shoulder_share),
    )
    _leave_out(strongest_first, alpha, tracks.polarity, judged.fits, evidence, limits, judged.fate)
    kept = strongest_first[judged.fate[strongest_first] == ACCEPTED]
    pixel = fits.pixel_rad[kept]
    group = chain_neighbours(alpha[kept], settings.join_px * pixel)
    # Leftmost first; stable: the strongest of each line stays its first.
    order = np.argsort(group, kind="stable")
    members, pixel = kept[order], pixel[order]
    count = np.bincount(group)
    bounds = np.zeros(len(count) + 1, np.int64)
    np.cumsum(count, out=bounds[1:])
    first = bounds[:-1]
    judged.fate[members] = JOINED
    judged.fate[members[first]] = ACCEPTED
    equal = settings.joined == "equal"
    weight = np.ones(len(members)) if equal else evidence[members]
    deviation = np.hypot(noise[members], settings.sigma_px * pixel)
    joined, sigma = join_mixtures(alpha[members], deviation, weight, first)
    ends, beta = _ends_of_lines(strip, tracks, fits, members)
    if equal:
        ends = np.add.reduceat(ends, first) / count[:, None]
        beta = np.add.reduceat(beta, first) / count
    else:
        ends, beta = ends[first], beta[first]
    return Lines(ends, joined, beta, sigma, noise[members[first]], members, bounds)


class _Limits(NamedTuple):
    """Limits for leaving out tracks; see `detect.line_settings.LineSettings`."""

    same_edge_px: float
    join_px: float
    join_share: float
    shoulder_px: float
    shoulder_share: float


@njit(cache=True, error_model="numpy")
def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True, error_model="numpy")
def _bearings(
    fits: LineFits, tracks: NDArray[np.int64], rotation: FloatArray, tilt: tuple[float, float],
    building: float, alpha: FloatArray, noise: FloatArray,
) -> None:  # fmt: skip
    """Levelled bearings of tracks, and their standard deviations due to noise.

    The measured lean b is replaced by its best estimate, given that it should be that of a vertical
    under the tilt up to the standard deviation `building`, and a, which is correlated with it,
    follows.
    """
    for t in tracks:
        sine, cosine = math.sin(fits.reference_rad[t]), math.cos(fits.reference_rad[t])
        a, b, covariance = fits.line[t, 0], fits.line[t, 1], fits.covariance[t]
        gain = covariance[0, 1] / (covariance[1, 1] + building * building)
        a -= gain * (b - (tilt[0] * sine - tilt[1] * cosine))
        # Of the plane's two level directions (n_y, -n_x) is the one ahead of the camera.
        n_x, n_y = cosine - a * sine, sine + a * cosine
        x = rotation[0, 0] * n_x + rotation[0, 1] * n_y - rotation[0, 2] * b
        y = rotation[1, 0] * n_x + rotation[1, 1] * n_y - rotation[1, 2] * b
        alpha[t] = math.atan2(y, x)
        noise[t] = math.sqrt(covariance[0, 0] - gain * covariance[0, 1])


@njit(cache=True, error_model="numpy")
def _leave_out(
    tracks: NDArray[np.int64], alpha: FloatArray, polarity: FloatArray, fits: LineFits,
    evidence: FloatArray, limits: _Limits, fate: NDArray[np.int8],
) -> None:  # fmt: skip
    """Leave out tracks, from the strongest on, on the same edge as a stronger one or beside it."""
    pixel, contrast = fits.pixel_rad, fits.contrast
    for k in range(len(tracks)):
        t = tracks[k]
        for s in tracks[:k]:
            if fate[s] != ACCEPTED:
                continue
            near_px = abs(_wrapped(alpha[t] - alpha[s])) / pixel[t]
            if polarity[t] == polarity[s] and near_px < limits.same_edge_px:
                fate[t] = SAME_EDGE
                break
            faint = evidence[t] < limits.join_share * evidence[s]
            fainter = contrast[t] < limits.shoulder_share * contrast[s]
            if (near_px < limits.join_px and faint) or (near_px < limits.shoulder_px and fainter):
                fate[t] = BESIDE_A_STRONGER_EDGE


def chain_neighbours(alpha: FloatArray, distance: FloatArray) -> NDArray[np.int64]:
    """Number the groups of bearings whose neighbours are close.

    Parameters
    ----------
    alpha : (N,) float64
        Bearings (rad).
    distance : (N,) float64
        Two neighbours belong together if they are closer than the smaller of their two distances.

    Returns
    -------
    (N,) int64
        The group of each, counted from 0 at the largest bearing (leftmost in the image).
    """
    group = np.zeros(len(alpha), np.int64)
    _number_groups(alpha, distance, np.argsort(-alpha, kind="stable"), group)
    return group


@njit(cache=True, error_model="numpy")
def _number_groups(
    alpha: FloatArray, distance: FloatArray, order: NDArray[np.int64], group: NDArray[np.int64]
) -> None:
    number = 0
    for k in range(1, len(order)):
        left, right = order[k - 1], order[k]
        number += alpha[left] - alpha[right] >= min(distance[left], distance[right])
        group[right] = number


@njit(cache=True, error_model="numpy")
def join_mixtures(
    alpha: FloatArray, sigma: FloatArray, weight: FloatArray, first: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Means and standard deviations of mixtures of Gaussians of bearings.

    Parameters
    ----------
    alpha, sigma : (M,) float64
        Means and standard deviations of the components (rad), one mixture after the other; all
        means of one are within half a turn.
    weight : (M,) float64
        Their weights, not negative, of any sum.
    first : (N,) int64
        The first component of each mixture.

    Returns
    -------
    alpha, sigma : (N,) float64
        Of the mixtures (rad).
    """
    mean, deviation = np.empty(len(first)), np.empty(len(first))
    for n in range(len(first)):
        begin, end = first[n], first[n + 1] if n + 1 < len(first) else len(alpha)
        total = off = square = 0.0
        for k in range(begin, end):
            total += weight[k]
            off += weight[k] * _wrapped(alpha[k] - alpha[begin])
        off /= total
        for k in range(begin, end):
            own = _wrapped(alpha[k] - alpha[begin]) - off
            square += weight[k] * (sigma[k] * sigma[k] + own * own)
        mean[n], deviation[n] = _wrapped(alpha[begin] + off), math.sqrt(square / total)
    return mean, deviation


@njit(cache=True, error_model="numpy")
def _ends_of_lines(
    strip: Strip, tracks: LineTracks, fits: LineFits, chosen: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Where lines cross the first and the last row of their tracks, and how they are inclined.

    Returns
    -------
    ends : (N, 4) float64
        xtop, ytop, xbottom, ybottom: undistorted normalised coordinates.
    beta : (N,) float64
        Inclinations of the normals of their planes (rad).
    """
    bearing, elevation, robot_from_camera = strip.bearing, strip.rise, strip.robot_from_camera
    bounds, row, column = tracks.bounds, tracks.row, tracks.column
    reference, line = fits.reference_rad, fits.line
    width = len(bearing)
    ends = np.empty((len(chosen), 4))
    beta = np.empty(len(chosen))
    for n in range(len(chosen)):
        t = chosen[n]
        phi = reference[t]
        a = line[t, 0]
        b = line[t, 1]
        beta[n] = -math.asin(b / math.sqrt(1.0 + a * a + b * b))
        for end in range(2):
            i = bounds[t] if end == 0 else bounds[t + 1] - 1
            v = row[i]
            near = column[i]
            x = 0.0
            z = 0.0
            rise = 0.0
            for _ in range(3):
                j = min(max(int(near), 0), width - 2)
                f = near - j
                moved = (1.0 - f) * elevation[j, v] + f * elevation[j + 1, v]
                # At the verticals' own ends the neighbouring column may end a row earlier.
                if math.isfinite(moved):
                    rise = moved
                # Z depends on X in second order only: one repetition settles it.
                x = a + b * rise
                z = rise * math.sqrt(1.0 + x * x)
                x = a + b * z
                moved = j + (phi + math.atan(x) - bearing[j]) / (bearing[j + 1] - bearing[j])
                if math.isfinite(moved):
                    near = min(max(moved, 0.0), width - 1.0)
            left = math.cos(phi) * x + math.sin(phi)
            back = math.sin(phi) * x - math.cos(phi)
            right = (
                left * robot_from_camera[0, 0]
                + back * robot_from_camera[1, 0]
                + z * robot_from_camera[2, 0]
            )
            down = (
                left * robot_from_camera[0, 1]
                + back * robot_from_camera[1, 1]
                + z * robot_from_camera[2, 1]
            )
            forward = (
                left * robot_from_camera[0, 2]
                + back * robot_from_camera[1, 2]
                + z * robot_from_camera[2, 2]
            )
            ends[n, 2 * end] = right / forward
            ends[n, 2 * end + 1] = down / forward
    return ends, beta
