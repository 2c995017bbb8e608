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
from functools import lru_cache
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
from detect.verticals.response import Strip
from detect.verticals.tilt import level_matrix
from detect.verticals.tilt_error import descending
from detect.verticals.tracking import LineTracks

FloatArray = NDArray[np.float64]


class JoiningLimits(NamedTuple):
    """Limits for joining lines; see `detect.line_settings.LineSettings`.

    `equal` is whether joined lines count the same, `turn` 1 to undo the tilt and -1 to apply it
    once more, `building_rad` see `turned_bearings`.
    """

    same_edge_px: float
    join_px: float
    join_share: float
    shoulder_px: float
    shoulder_share: float
    sigma_px: float
    equal: bool
    turn: float
    building_rad: float


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


@lru_cache(maxsize=16)
def joining_of(settings: LineSettings) -> JoiningLimits:
    """Limits for joining lines."""
    level = settings.alpha == "level"
    return JoiningLimits(
        same_edge_px=float(settings.same_edge_px),
        join_px=float(settings.join_px),
        join_share=float(settings.join_share),
        shoulder_px=float(settings.shoulder_px),
        shoulder_share=float(settings.shoulder_share),
        sigma_px=float(settings.sigma_px),
        equal=settings.joined == "equal",
        turn=1.0 if level else -1.0,
        building_rad=math.radians(settings.building_deg) if level else math.inf,
    )


@njit(cache=True, error_model="numpy")
def lines_of_tracks(
    strip: Strip, tracks: LineTracks, judged: Judgement, limits: JoiningLimits
) -> Lines:
    """Lines of accepted tracks.

    The fate of tracks that are left out or joined is changed.
    """
    fits, evidence, tilt = judged.fits, judged.evidence, judged.tilt
    count = len(evidence)
    tilted = not np.isnan(tilt.pitch_rad)
    pitch = tilt.pitch_rad if tilted else 0.0
    roll = tilt.roll_rad if tilted else 0.0
    rotation = level_matrix(limits.turn * pitch, limits.turn * roll)
    building = limits.building_rad if tilted else np.inf
    alpha, noise = turned_bearings(fits, rotation, pitch, roll, building)
    members, bounds = group_tracks(alpha, tracks.polarity, judged, limits)
    weight = np.ones(count) if limits.equal else evidence
    joined, sigma = join_tracks(
        alpha, noise, fits.pixel_rad, weight, members, bounds, limits.sigma_px
    )
    own_ends, own_beta = ends_of_lines(strip, tracks, fits, members)
    ends = np.empty((len(joined), 4))
    beta = np.empty(len(joined))
    for n in range(len(joined)):
        # The first member of a line is its strongest.
        first = bounds[n]
        last = bounds[n + 1] if limits.equal else first + 1
        for k in range(4):
            ends[n, k] = own_ends[first:last, k].mean()
        beta[n] = own_beta[first:last].mean()
    return Lines(ends, joined, beta, sigma, noise[members[bounds[:-1]]], members, bounds)


@njit(cache=True, error_model="numpy")
def group_tracks(
    alpha: FloatArray, polarity: FloatArray, judged: Judgement, limits: JoiningLimits
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Gather accepted tracks to lines: one for each edge, close ones together.

    Parameters
    ----------
    alpha, polarity : (T,) float64
        Bearings (rad); 1 where the image is brighter on the right.
    judged : Judgement
        The fate of tracks that are left out or joined is changed.
    limits
        See there.

    Returns
    -------
    members, bounds
        See `Lines`.
    """
    pixel, contrast = judged.fits.pixel_rad, judged.fits.contrast
    evidence, fate = judged.evidence, judged.fate
    accepted = np.flatnonzero(fate == ACCEPTED)
    kept = np.empty(len(accepted), np.int64)
    near_px = np.empty(len(accepted))
    places = np.empty(len(accepted))
    n = 0
    for k in descending(evidence[accepted]):
        t = accepted[k]
        reason = ACCEPTED
        for s in kept[:n]:
            near = abs(wrapped(alpha[s] - alpha[t])) / pixel[t]
            if polarity[s] == polarity[t] and near < limits.same_edge_px:
                reason = SAME_EDGE
                break
            if (near < limits.join_px and evidence[t] < limits.join_share * evidence[s]) or (
                near < limits.shoulder_px and contrast[t] < limits.shoulder_share * contrast[s]
            ):
                reason = BESIDE_A_STRONGER_EDGE
        fate[t] = reason
        if reason == ACCEPTED:
            kept[n] = t
            places[n] = alpha[t]
            near_px[n] = limits.join_px * pixel[t]
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
def chain_neighbours(
    alpha: NDArray[np.float64], distance: NDArray[np.float64]
) -> NDArray[np.int64]:
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
    order = descending(alpha)
    group = np.zeros(len(alpha), np.int64)
    number = 0
    for k in range(1, len(alpha)):
        left = order[k - 1]
        right = order[k]
        if alpha[left] - alpha[right] >= min(distance[left], distance[right]):
            number += 1
        group[right] = number
    return group


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
        Standard deviation of an edge about the line of the building that it shows, pixels.

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


@njit(cache=True, error_model="numpy")
def join_mixture(
    alpha: NDArray[np.float64], sigma: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[float, float]:
    """Mean and standard deviation of a mixture of Gaussians of bearings.

    Parameters
    ----------
    alpha, sigma : (N,) float64
        Means and standard deviations of the components (rad); all means within half a turn.
    weight : (N,) float64
        Their weights, not negative, of any sum.

    Returns
    -------
    alpha, sigma : float
        Of the mixture (rad).
    """
    total = 0.0
    mean = 0.0
    for k in range(len(alpha)):
        total += weight[k]
        mean += weight[k] * wrapped(alpha[k] - alpha[0])
    mean /= total
    variance = 0.0
    for k in range(len(alpha)):
        off = wrapped(alpha[k] - alpha[0]) - mean
        variance += weight[k] * (sigma[k] * sigma[k] + off * off)
    return wrapped(alpha[0] + mean), math.sqrt(variance / total)


@njit(cache=True, error_model="numpy")
def wrapped(angle: float) -> float:
    """The angle in [-pi, pi) (rad)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True, error_model="numpy")
def turned_bearings(
    fits: LineFits, rotation: FloatArray, pitch: float, roll: float, building: float
) -> tuple[FloatArray, FloatArray]:
    """Bearings of lines after a rotation, and their noise.

    Parameters
    ----------
    fits : LineFits
        The lines.
    rotation : (3, 3) float64
        The rotation of the normals of their planes.
    pitch, roll : float
        The tilt under which the lines are seen (rad).
    building : float
        Standard deviation of real verticals about the vertical (rad): the measured lean b is
        replaced by its best estimate, given that it should be that of a vertical up to this, and a,
        which is correlated with it, follows. Infinite: lines are not changed.

    Returns
    -------
    alpha, noise : (T,) float64
        Bearings and their standard deviations (rad).
    """
    reference, line, covariance = fits.reference_rad, fits.line, fits.covariance
    alpha = np.empty(len(reference))
    noise = np.empty(len(reference))
    for t in range(len(reference)):
        sine = math.sin(reference[t])
        cosine = math.cos(reference[t])
        a = line[t, 0]
        b = line[t, 1]
        gain = covariance[t, 0, 1] / (covariance[t, 1, 1] + building * building)
        a -= gain * (b - (pitch * sine - roll * cosine))
        noise[t] = math.sqrt(covariance[t, 0, 0] - gain * covariance[t, 0, 1])
        left = cosine - a * sine
        back = sine + a * cosine
        x = rotation[0, 0] * left + rotation[0, 1] * back - rotation[0, 2] * b
        y = rotation[1, 0] * left + rotation[1, 1] * back - rotation[1, 2] * b
        # Of the plane's two level directions (n_y, -n_x) is the one ahead of the camera.
        alpha[t] = math.atan2(y, x)
    return alpha, noise


@njit(cache=True, error_model="numpy")
def ends_of_lines(
    strip: Strip, tracks: LineTracks, fits: LineFits, chosen: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Where lines cross the first and the last row of their tracks, and how they are inclined.

    Parameters
    ----------
    strip, tracks, fits
        The table, the tracks, their lines.
    chosen : (N,) int64
        Which tracks.

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
