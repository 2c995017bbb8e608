"""Disc positions corrected for the tilt of the robot.

The robot tilts about the origin of its frame on the floor, by pitch and roll. Its camera, at c,
believes the floor where it would be on a level robot: a disc seen at p lies on the ray
c + s (p - c). Turned level by R, that ray meets the floor at

    q = R (c + s (p - c)),    s = -(R c)_z / (R (p - c))_z .

The covariance of q is J diag(C_p, C_tilt) J^T, J = dq / d(p, pitch, roll).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.circles import CircleDetections
from detect.verticals.tilt import level_matrix
from landmarks import FrameTilt

FloatArray = NDArray[np.float64]

#: Over which angle the levelled positions are differenced, either way.
_STEP_RAD = 1e-6


def levelled(found: CircleDetections, camera: Camera, tilt: FrameTilt) -> CircleDetections:
    """The same discs, their positions and covariances corrected for the tilt of their frame.

    Discs that the levelled camera would see above the horizon are left out.
    """
    floor_xy, covariance, down = level_discs(camera, found.floor_xy, found.covariance, tilt)
    return replace(
        found,
        pixels=found.pixels[down],
        floor_xy=floor_xy[down],
        covariance=covariance[down],
        quality=found.quality[down],
        evidence=found.evidence[down],
        levelled_by=(tilt.pitch, tilt.roll),
    )


def level_discs(
    camera: Camera, floor_xy: FloatArray, covariance: FloatArray, tilt: FrameTilt
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """`level_positions` and `level_covariances`, and (N,) whether they are below the horizon."""
    of_tilt = np.array([[tilt.cpp, tilt.cpr], [tilt.cpr, tilt.crr]])
    level_xy = level_positions(camera, floor_xy, tilt.pitch, tilt.roll)
    covariance = level_covariances(camera, floor_xy, covariance, tilt.pitch, tilt.roll, of_tilt)
    down = np.asarray(np.isfinite(level_xy).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)))
    return level_xy, covariance, down


def level_positions(
    camera: Camera, floor_xy: FloatArray, pitch_rad: float, roll_rad: float
) -> FloatArray:
    """Where on the floor discs are, of which the tilted robot's camera saw them at `floor_xy`.

    Parameters
    ----------
    camera : Camera
        The camera as calibrated on the level robot.
    floor_xy : (N, 2) float64
        Positions computed without knowledge of the tilt, metres.
    pitch_rad, roll_rad : float
        The tilt (see `detect.verticals.tilt`).

    Returns
    -------
    (N, 2) float64
        In the level robot frame, metres; NaN where the levelled ray does not meet the floor.
    """
    rotation = level_matrix(pitch_rad, roll_rad)
    return np.asarray(_levelled(rotation[None], camera.centre, floor_xy)[0])


def level_covariances(
    camera: Camera,
    floor_xy: FloatArray,
    covariance: FloatArray,
    pitch_rad: float,
    roll_rad: float,
    tilt_covariance: FloatArray,
) -> FloatArray:
    """Covariances of levelled positions: their own, carried along, and the tilt's.

    Parameters
    ----------
    camera, floor_xy, pitch_rad, roll_rad
        As in `level_positions`.
    covariance : (N, 2, 2) float64
        Of `floor_xy`, square metres.
    tilt_covariance : (2, 2) float64
        Of pitch and roll, square radians.

    Returns
    -------
    (N, 2, 2) float64
        Square metres; NaN where the levelled ray does not meet the floor.
    """
    rotation, centre, h = level_matrix(pitch_rad, roll_rad), camera.centre, _STEP_RAD
    ray = np.column_stack([floor_xy, np.zeros(len(floor_xy))]) - centre
    across, down = ray @ rotation[:2].T, ray @ rotation[2]
    height = rotation[2] @ centre
    by_place = rotation[:2, :2] - across[:, :, None] / down[:, None, None] * rotation[2, :2]
    by_place *= -height / down[:, None, None]
    turned = np.stack([
        level_matrix(pitch_rad + pitch, roll_rad + roll)
        for pitch, roll in ((h, 0.0), (0.0, h), (-h, 0.0), (0.0, -h))
    ])  # fmt: skip
    ends = _levelled(turned, centre, floor_xy)
    by_tilt = np.moveaxis(ends[:2] - ends[2:], 0, -1) / (2.0 * h)
    carried = by_place @ covariance @ by_place.swapaxes(1, 2)
    of_tilt = by_tilt @ tilt_covariance @ by_tilt.swapaxes(1, 2)
    return np.where((down < 0.0)[:, None, None], carried + of_tilt, np.nan)


def _levelled(rotations: FloatArray, centre: FloatArray, floor_xy: FloatArray) -> FloatArray:
    """(M, N, 2) positions levelled by each of (M, 3, 3) rotations."""
    ray = np.column_stack([floor_xy, np.zeros(len(floor_xy))]) - centre
    turned = ray @ rotations.swapaxes(1, 2)
    origin = (rotations @ centre)[:, None]
    down = np.where(turned[..., 2:] < 0.0, turned[..., 2:], np.nan)
    return np.asarray((origin - origin[..., 2:] / down * turned)[..., :2])
