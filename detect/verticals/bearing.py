"""Bearings and inclinations of lines: from their planes, in both conventions, and joined.

A line's row holds its ends in undistorted normalised image coordinates. The plane through the
camera's centre and both ends has a unit normal n in the robot frame; beta = asin(n_z). alpha is the
bearing of the horizontal direction in the plane with normal R n, where R undoes the tilt
(`detect.verticals.tilt`). The data set's own rows were made with R's inverse, which adds the tilt
instead of removing it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from detect.verticals.tilt import TiltEstimate, level_rotation

FloatArray = NDArray[np.float64]


def plane_normals(ends: ArrayLike, robot_from_camera: ArrayLike) -> FloatArray:
    """Unit normals of the planes through the camera's centre and lines.

    Parameters
    ----------
    ends : (..., 4) array_like
        xtop, ytop, xbottom, ybottom: undistorted normalised coordinates of both ends.
    robot_from_camera : (3, 3) array_like
        Rotation camera -> robot.

    Returns
    -------
    (..., 3) float64
        Robot frame. That of a vertical straight ahead points left.
    """
    xy = np.asarray(ends, dtype=np.float64)
    one = np.ones_like(xy[..., :1])
    rotation = np.asarray(robot_from_camera, dtype=np.float64)
    top = np.concatenate([xy[..., :2], one], axis=-1) @ rotation.T
    bottom = np.concatenate([xy[..., 2:], one], axis=-1) @ rotation.T
    normal = np.cross(top, bottom)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def inclinations(normal: ArrayLike) -> FloatArray:
    """(...) beta of (..., 3) unit normals (rad), before any compensation."""
    return np.asarray(np.arcsin(np.clip(np.asarray(normal, dtype=np.float64)[..., 2], -1.0, 1.0)))


def level_bearings(normal: ArrayLike, pitch_rad: float, roll_rad: float) -> FloatArray:
    """Bearings of the horizontal directions in planes, after turning them level.

    Parameters
    ----------
    normal : (..., 3) array_like
        Unit normals as `plane_normals` gives them.
    pitch_rad, roll_rad : float
        The tilt (see `detect.verticals.tilt`).

    Returns
    -------
    (...) float64
        alpha (rad), 0 forward, positive to the left.
    """
    turned = np.asarray(normal, dtype=np.float64) @ level_rotation(pitch_rad, roll_rad).T
    # Of the plane's two level directions (n_y, -n_x) is the one ahead of the camera.
    return np.asarray(np.arctan2(turned[..., 1], turned[..., 0]))


def compensated_bearings(
    normal: ArrayLike, tilt: TiltEstimate | None, *, published: bool = False
) -> FloatArray:
    """Bearings of lines, compensated for the tilt of their frame.

    Parameters
    ----------
    normal : (..., 3) array_like
        Unit normals as `plane_normals` gives them.
    tilt : TiltEstimate or None
        None compensates nothing.
    published : bool
        Turn the other way, as the data set's own rows are.

    Returns
    -------
    (...) float64
        alpha (rad).
    """
    if tilt is None:
        return level_bearings(normal, 0.0, 0.0)
    sign = -1.0 if published else 1.0
    return level_bearings(normal, sign * tilt.pitch_rad, sign * tilt.roll_rad)


def join_bearings(
    alpha_rad: ArrayLike, sigma_rad: ArrayLike, weight: ArrayLike
) -> tuple[float, float]:
    """Mean and standard deviation of a mixture of Gaussians of bearings.

    Parameters
    ----------
    alpha_rad, sigma_rad : (N,) array_like
        Means and standard deviations of the components (rad); all means within half a turn.
    weight : (N,) array_like
        Their weights, not negative, of any sum.

    Returns
    -------
    alpha_rad, sigma_rad : float
        Of the mixture (rad).
    """
    from detect.verticals.bearing_kernels import join_mixture

    return join_mixture(
        np.asarray(alpha_rad, dtype=np.float64),
        np.asarray(sigma_rad, dtype=np.float64),
        np.asarray(weight, dtype=np.float64),
    )


def close_groups(alpha_rad: ArrayLike, distance_rad: ArrayLike) -> NDArray[np.int64]:
    """Number the groups of bearings whose neighbours are close.

    Parameters
    ----------
    alpha_rad : (N,) array_like
        Bearings (rad).
    distance_rad : (N,) array_like
        Two neighbours belong together if they are closer than the smaller of their two distances.

    Returns
    -------
    (N,) int64
        The group of each, counted from 0 at the largest bearing (leftmost in the image).
    """
    from detect.verticals.bearing_kernels import chain_neighbours

    return np.asarray(
        chain_neighbours(
            np.asarray(alpha_rad, dtype=np.float64), np.asarray(distance_rad, dtype=np.float64)
        )
    )
