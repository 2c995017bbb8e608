"""Disc positions corrected for the tilt that the verticals of the same frame show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.circles import CircleDetections
from detect.tilt import level_rotation
from landmarks import FrameTilt

FloatArray = NDArray[np.float64]

_STEP_M = 1e-4
_STEP_RAD = 1e-6


def levelled(found: CircleDetections, camera: Camera, tilt: FrameTilt) -> CircleDetections:
    """The same discs, their positions and covariances corrected for the tilt of their frame.

    Discs that the levelled camera would see above the horizon are left out.
    """
    tilt_covariance = np.array([[tilt.cpp, tilt.cpr], [tilt.cpr, tilt.crr]])
    floor_xy = level_positions(camera, found.floor_xy, tilt.pitch, tilt.roll)
    covariance = level_covariances(
        camera, found.floor_xy, found.covariance, tilt.pitch, tilt.roll, tilt_covariance
    )
    down = np.all(np.isfinite(floor_xy), axis=-1) & np.all(np.isfinite(covariance), axis=(-1, -2))
    return CircleDetections(
        pixels=found.pixels[down],
        floor_xy=floor_xy[down],
        covariance=covariance[down],
        quality=found.quality[down],
        evidence=found.evidence[down],
    )


def level_positions(
    camera: Camera, floor_xy: FloatArray, pitch_rad: float, roll_rad: float
) -> FloatArray:
    """Where on the floor discs are, of which the tilted robot's camera saw them at `floor_xy`.

    The robot tilts where it stands: about the origin of its frame, on the floor.

    Parameters
    ----------
    camera : Camera
        The camera as calibrated on the level robot.
    floor_xy : (N, 2) float64
        Positions computed without knowledge of the tilt, metres.
    pitch_rad, roll_rad : float
        The tilt (see `detect.tilt`).

    Returns
    -------
    (N, 2) float64
        In the level robot frame, metres; NaN where the levelled ray does not meet the floor.
    """
    rotation = level_rotation(pitch_rad, roll_rad)
    ray = np.column_stack([floor_xy, np.zeros(len(floor_xy))]) - camera.centre
    ray = ray @ rotation.T
    centre = rotation @ camera.centre
    down = np.where(ray[:, 2] < 0.0, ray[:, 2], np.nan)
    return np.asarray(centre[:2] - centre[2] / down[:, None] * ray[:, :2])


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
        Square metres.
    """

    def moved(dx: float, dy: float, dp: float, dr: float) -> FloatArray:
        at = floor_xy + np.array([dx, dy])
        return level_positions(camera, at, pitch_rad + dp, roll_rad + dr)

    m, a = _STEP_M, _STEP_RAD
    by_position = np.stack(
        [
            (moved(m, 0, 0, 0) - moved(-m, 0, 0, 0)) / (2 * m),
            (moved(0, m, 0, 0) - moved(0, -m, 0, 0)) / (2 * m),
        ],
        axis=-1,
    )
    by_tilt = np.stack(
        [
            (moved(0, 0, a, 0) - moved(0, 0, -a, 0)) / (2 * a),
            (moved(0, 0, 0, a) - moved(0, 0, 0, -a)) / (2 * a),
        ],
        axis=-1,
    )
    own = by_position @ covariance @ by_position.swapaxes(-1, -2)
    return np.asarray(own + by_tilt @ tilt_covariance @ by_tilt.swapaxes(-1, -2))
