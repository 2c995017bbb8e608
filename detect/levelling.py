"""Disc positions corrected for the tilt of the robot.

The robot tilts about the origin of its frame on the floor, by pitch and roll. Its camera, at c,
believes the floor where it would be on a level robot: a disc seen at p lies on the ray
c + s (p - c). Turned level by R, that ray meets the floor at

    q = R (c + s (p - c)),    s = -(R c)_z / (R (p - c))_z    (`detect.seen.level_seen`).

The covariance of q is J diag(C_p, C_tilt) J^T, J = dq / d(p, pitch, roll).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.circles import CircleDetections
from detect.seen import level_seen
from redetect.landmarks import FrameTilt

FloatArray = NDArray[np.float64]

#: Over which length (m) and angle (rad) levelled positions are differenced, either way.
_STEP = 1e-6


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
    """Positions (N, 2) on the floor (m) and their covariances, corrected for a tilt.

    Positions are those that the calibrated camera sees on a level robot. The covariances returned
    are their own, carried along, and that due to the tilt's. Where the levelled ray does not meet
    the floor, numbers are NaN and the mask is false.
    """
    steps = _STEP * np.vstack([np.zeros(4), np.eye(4), -np.eye(4)])
    tilts = steps[:, 2:] + (tilt.pitch, tilt.roll)
    level_xy, *ends = level_seen(camera, floor_xy + steps[:, None, :2], tilts)
    jacobian = np.stack([ends[k] - ends[k + 4] for k in range(4)], axis=-1) / (2.0 * _STEP)
    of_all = np.zeros((len(floor_xy), 4, 4))
    of_all[:, :2, :2] = covariance
    of_all[:, 2:, 2:] = [[tilt.cpp, tilt.cpr], [tilt.cpr, tilt.crr]]
    level_covariance = jacobian @ of_all @ jacobian.swapaxes(1, 2)
    down = np.isfinite(level_xy).all(axis=1) & np.isfinite(level_covariance).all(axis=(1, 2))
    return level_xy, level_covariance, np.asarray(down)
