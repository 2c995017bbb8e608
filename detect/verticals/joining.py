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
from detect.verticals.tilt import TiltEstimate, level_matrix
from detect.verticals.tracking import LineTracks
from landmarks import wrap_angle


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
    accepted = np.flatnonzero(judged.fate == ACCEPTED)
    strongest_first = accepted[np.argsort(-judged.evidence[accepted], kind="stable")]
    alpha, noise = _bearings(judged.fits, strongest_first, judged.tilt, settings)
    fate = _left_out(strongest_first, alpha, tracks.polarity, judged, settings)
    judged.fate[strongest_first] = fate
    kept = np.flatnonzero(fate == ACCEPTED)
    pixel = judged.fits.pixel_rad[strongest_first]
    group = chain_neighbours(alpha[kept], settings.join_px * pixel[kept])
    # Leftmost first; stable: the strongest of each line stays its first.
    order = np.argsort(group, kind="stable")
    kept = kept[order]
    bounds = np.concatenate([[0], np.cumsum(np.bincount(group))])
    first, members = bounds[:-1], strongest_first[kept]
    later = np.ones(len(members), np.bool_)
    later[first] = False
    judged.fate[members[later]] = JOINED
    equal = settings.joined == "equal"
    weight = np.ones(len(members)) if equal else judged.evidence[members]
    deviation = np.hypot(noise[kept], settings.sigma_px * pixel[kept])
    joined, sigma = join_mixtures(alpha[kept], deviation, weight, first)
    ends, beta = _ends_of_lines(strip, tracks, judged.fits, members)
    if equal:
        count = np.diff(bounds)
        ends = np.add.reduceat(ends, first) / count[:, None]
        beta = np.add.reduceat(beta, first) / count
    else:
        ends, beta = ends[first], beta[first]
    return Lines(ends, joined, beta, sigma, noise[kept][first], members, bounds)


def _bearings(
    fits: LineFits, tracks: NDArray[np.intp], tilt: TiltEstimate | None, settings: LineSettings
) -> tuple[FloatArray, FloatArray]:
    """Levelled bearings of tracks, and their standard deviations due to noise.

    Where the tilt is known, the measured lean b is replaced by its best estimate, given that it
    should be that of a vertical up to `building_deg`, and a, which is correlated with it, follows.
    """
    sine, cosine = np.sin(fits.reference_rad[tracks]), np.cos(fits.reference_rad[tracks])
    a, b = fits.line[tracks].T
    covariance = fits.covariance[tracks]
    variance, rotation = covariance[:, 0, 0], np.eye(3)
    if tilt is not None and settings.alpha == "level":
        rotation = level_matrix(tilt.pitch_rad, tilt.roll_rad)
        building = math.radians(settings.building_deg)
        gain = covariance[:, 0, 1] / (covariance[:, 1, 1] + building * building)
        a = a - gain * (b - (tilt.pitch_rad * sine - tilt.roll_rad * cosine))
        variance = variance - gain * covariance[:, 0, 1]
    elif tilt is not None:
        rotation = level_matrix(-tilt.pitch_rad, -tilt.roll_rad)
    # Of the plane's two level directions (n_y, -n_x) is the one ahead of the camera.
    x, y = rotation[:2] @ np.stack([cosine - a * sine, sine + a * cosine, -b])
    return np.arctan2(y, x), np.sqrt(variance)


def _left_out(
    tracks: NDArray[np.intp], alpha: FloatArray, polarity: FloatArray, judged: Judgement,
    settings: LineSettings,
) -> NDArray[np.int8]:  # fmt: skip
    """Fates of tracks, the strongest first, as stronger ones allow: accepted, or why not."""
    near_px = np.abs(wrap_angle(alpha[:, None] - alpha)) / judged.fits.pixel_rad[tracks][:, None]
    evidence, contrast = judged.evidence[tracks], judged.fits.contrast[tracks]
    sign = polarity[tracks]
    same = (sign[:, None] == sign) & (near_px < settings.same_edge_px)
    faint = evidence[:, None] < settings.join_share * evidence
    beside = (near_px < settings.join_px) & faint
    fainter = contrast[:, None] < settings.shoulder_share * contrast
    beside |= (near_px < settings.shoulder_px) & fainter
    fate = np.empty(len(tracks), np.int8)
    _suppress(same, beside, fate)
    return fate


@njit(cache=True, error_model="numpy")
def _suppress(same: NDArray[np.bool_], beside: NDArray[np.bool_], fate: NDArray[np.int8]) -> None:
    """Keep each that is neither the same as, nor beside, one of those that are kept before it."""
    for t in range(len(fate)):
        fate[t] = ACCEPTED
        for s in range(t):
            if fate[s] == ACCEPTED and same[t, s]:
                fate[t] = SAME_EDGE
                break
            if fate[s] == ACCEPTED and beside[t, s]:
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
    order = np.argsort(-alpha, kind="stable")
    near = distance[order]
    apart = alpha[order[:-1]] - alpha[order[1:]] >= np.minimum(near[:-1], near[1:])
    group = np.zeros(len(alpha), np.int64)
    group[order[1:]] = np.cumsum(apart)
    return group


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
    count = np.diff(first, append=len(alpha))
    share = weight / np.repeat(np.add.reduceat(weight, first), count)
    off = wrap_angle(alpha - np.repeat(alpha[first], count))
    mean = np.add.reduceat(share * off, first)
    off -= np.repeat(mean, count)
    variance = np.add.reduceat(share * (sigma * sigma + off * off), first)
    return wrap_angle(alpha[first] + mean), np.sqrt(variance)


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
