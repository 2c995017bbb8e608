"""Bearings, inclinations and ends of lines: from their planes, in both conventions.

A line's row holds its ends in undistorted normalised image coordinates. The plane through the
camera's centre and both ends has a unit normal n in the robot frame; beta = asin(n_z). alpha is the
bearing of the horizontal direction in the plane with normal R n, where R undoes the tilt
(`detect.verticals.tilt`). The data set's own rows were made with R's inverse, which adds the tilt
instead of removing it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.verticals.refinement import LineFits
from detect.verticals.response import Strip
from detect.verticals.tracking import LineTracks

FloatArray = NDArray[np.float64]


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
