"""Bearings and inclinations of lines: from their planes, in both conventions, and joined.

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

from detect.verticals.order_kernels import descending


@njit(cache=True, error_model="numpy")
def wrapped(angle: float) -> float:
    """The angle in [-pi, pi) (rad)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


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
def turned_bearings(
    reference: NDArray[np.float64],
    line: NDArray[np.float64],
    covariance: NDArray[np.float64],
    rotation: NDArray[np.float64],
    pitch: float,
    roll: float,
    building: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bearings of lines after a rotation, and their noise.

    Parameters
    ----------
    reference, line, covariance
        The lines (see `detect.verticals.fit.LineFits`).
    rotation : (3, 3) float64
        What turns the normals of their planes.
    pitch, roll : float
        The tilt under which the lines are seen (rad).
    building : float
        Standard deviation of real verticals about the vertical (rad): the measured lean b is
        replaced by its best estimate, given that it should be that of a vertical up to this, and a,
        which is correlated with it, follows. Infinite to take lines as they are.

    Returns
    -------
    alpha, noise : (T,) float64
        Bearings and their standard deviations (rad).
    """
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
    bearing: NDArray[np.float64],
    elevation_tan: NDArray[np.float32],
    robot_from_camera: NDArray[np.float64],
    bounds: NDArray[np.int64],
    row: NDArray[np.int32],
    column: NDArray[np.float64],
    reference: NDArray[np.float64],
    line: NDArray[np.float64],
    chosen: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where lines cross the first and the last row of their tracks, and how they are inclined.

    Parameters
    ----------
    bearing, elevation_tan, robot_from_camera
        The table.
    bounds, row, column
        The tracks.
    reference, line
        Their lines (see `detect.verticals.fit.LineFits`).
    chosen : (N,) int64
        Which tracks.

    Returns
    -------
    ends : (N, 4) float64
        xtop, ytop, xbottom, ybottom: undistorted normalised coordinates.
    beta : (N,) float64
        Inclinations of the normals of their planes (rad).
    """
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
                moved = (1.0 - f) * elevation_tan[v, j] + f * elevation_tan[v, j + 1]
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
