"""Disc positions corrected for the tilt that the verticals of the same frame show."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.circles import CircleDetections
from detect.discs.levelling import level_discs
from landmarks import FrameTilt

FloatArray = NDArray[np.float64]


def levelled(found: CircleDetections, camera: Camera, tilt: FrameTilt) -> CircleDetections:
    """The same discs, their positions and covariances corrected for the tilt of their frame.

    Discs that the levelled camera would see above the horizon are left out.
    """
    floor_xy, covariance, down = level_discs(
        np.ascontiguousarray(found.floor_xy),
        np.ascontiguousarray(found.covariance),
        _centre_of(camera),
        (tilt.pitch, tilt.roll, tilt.cpp, tilt.cpr, tilt.crr),
    )
    by = (tilt.pitch, tilt.roll)
    if down.all():
        return CircleDetections(
            found.pixels, floor_xy, covariance, found.quality, found.evidence, by
        )
    return CircleDetections(
        pixels=found.pixels[down],
        floor_xy=floor_xy[down],
        covariance=covariance[down],
        quality=found.quality[down],
        evidence=found.evidence[down],
        levelled_by=by,
    )


def level_positions(
    camera: Camera, floor_xy: FloatArray, pitch_rad: float, roll_rad: float
) -> FloatArray:
    """Where on the floor discs are, of which the tilted robot's camera saw them at `floor_xy`.

    The robot tilts about the origin of its frame, on the floor.

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
    unknown = np.zeros((len(floor_xy), 2, 2))
    return level_discs(
        np.ascontiguousarray(floor_xy, dtype=np.float64), unknown, _centre_of(camera),
        (pitch_rad, roll_rad, 0.0, 0.0, 0.0),
    )[0]  # fmt: skip


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
    (cpp, cpr), (_, crr) = np.asarray(tilt_covariance, np.float64).tolist()
    return level_discs(
        np.ascontiguousarray(floor_xy, dtype=np.float64),
        np.ascontiguousarray(covariance, dtype=np.float64),
        _centre_of(camera),
        (pitch_rad, roll_rad, cpp, cpr, crr),
    )[1]


@lru_cache(maxsize=4)
def _centre_of(camera: Camera) -> FloatArray:
    """In memory of its own: a camera that came from another process has arrays of another kind."""
    return np.array(camera.centre)
