"""Compiled intersections of a quadrangle's fitted edges."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.edge_kernels import EdgeFits


@njit(cache=True, error_model="numpy")
def corners_of_edges(
    corners: NDArray[np.float64],
    edges: EdgeFits,
    refined: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> bool:
    """Intersections of the fitted edges, and their covariances.

    Parameters
    ----------
    corners : (4, 2) float64
        The corners that the edges' offsets are relative to.
    edges : EdgeFits
        From `detect.markers.edge_kernels.fit_edges`.
    refined : (4, 2) float64
        Result.
    covariance : (4, 2, 2) float64
        Result, pixels squared.

    Returns
    -------
    bool
        Whether all four edges intersect.
    """
    normal = np.empty((4, 2))
    level = np.empty(4)
    for k in range(4):
        p0 = corners[k]
        p1 = corners[(k + 1) % 4]
        length = math.hypot(p1[0] - p0[0], p1[1] - p0[1])
        tx, ty = (p1[0] - p0[0]) / length, (p1[1] - p0[1]) / length
        # Outward normal (ty, -tx); the fitted line runs through the shifted ends.
        b0 = edges.offset[k] - edges.turn[k]
        b1 = edges.offset[k] + edges.turn[k]
        ax, ay = p0[0] + b0 * ty, p0[1] - b0 * tx
        bx, by = p1[0] + b1 * ty, p1[1] - b1 * tx
        span = math.hypot(bx - ax, by - ay)
        normal[k, 0] = (by - ay) / span
        normal[k, 1] = -(bx - ax) / span
        level[k] = normal[k, 0] * ax + normal[k, 1] * ay
    for k in range(4):
        j = (k + 3) % 4
        determinant = normal[j, 0] * normal[k, 1] - normal[j, 1] * normal[k, 0]
        if abs(determinant) < 0.05:
            return False
        x = (level[j] * normal[k, 1] - level[k] * normal[j, 1]) / determinant
        y = (normal[j, 0] * level[k] - normal[k, 0] * level[j]) / determinant
        refined[k, 0] = x
        refined[k, 1] = y
        # Each line's variance at the corner moves it along the other line.
        covariance[k] = 0.0
        for which in range(2):
            e = j if which == 0 else k
            o = k if which == 0 else j
            q0 = corners[e]
            q1 = corners[(e + 1) % 4]
            length = math.hypot(q1[0] - q0[0], q1[1] - q0[1])
            s = ((x - q0[0]) * (q1[0] - q0[0]) + (y - q0[1]) * (q1[1] - q0[1])) / length / (
                0.5 * length
            ) - 1.0
            variance = edges.var_offset[e] + 2.0 * s * edges.covar[e] + s * s * edges.var_turn[e]
            mx = normal[o, 1] / determinant
            my = -normal[o, 0] / determinant
            covariance[k, 0, 0] += variance * mx * mx
            covariance[k, 0, 1] += variance * mx * my
            covariance[k, 1, 1] += variance * my * my
        covariance[k, 1, 0] = covariance[k, 0, 1]
    return True
