"""A box-shaped robot that carries six markers on boards round it.

Robot frame: origin on the floor below its middle, x forward, y left, z up; metres.
"""

from __future__ import annotations

import numpy as np

from detect.markers.dictionaries import marker_dictionary
from redetect.groundtruth.geometry.transforms import planar_transform
from redetect.groundtruth.markers.calibration import Rig
from tools.simulator.markers.clutter import blotches
from tools.simulator.markers.prints import marker_surface
from tools.simulator.markers.surface import (
    FloatArray,
    Surface,
    Texture,
    box_sides,
    plain,
    pose_of,
)

#: Identifiers of the markers on the robot.
ROBOT_IDS = (31, 64, 107, 200, 333, 498)

# Where each board has its middle (m), and where it looks: azimuth from x, elevation, turn (deg).
_BOARDS = (
    ((0.43, 0.0, 0.42), (0.0, 25.0, 0.0)),
    ((0.0, 0.32, 0.42), (90.0, 22.0, 0.0)),
    ((-0.43, 0.0, 0.42), (180.0, 25.0, 0.0)),
    ((0.0, -0.32, 0.42), (-90.0, 22.0, 0.0)),
    ((0.18, 0.02, 0.68), (12.0, 58.0, 20.0)),
    ((-0.18, -0.02, 0.68), (168.0, 58.0, -15.0)),
)
_BODY_M = (0.72, 0.5, 0.45)
_GROUND_M = 0.1
_QUIET_CELLS = 2
_ANGLE_SIGMA_DEG = 2.0
_PLACE_SIGMA_M = 0.004
#: Half of the robot's extent on the floor, its boards included.
FOOTPRINT_M = (0.5, 0.4)


def robot_rig(rng: np.random.Generator, dictionary: str = "rawseeds", width_m: float = 0.2) -> Rig:
    """Six markers on a robot, their boards mounted by hand: a few millimetres and degrees off.

    Parameters
    ----------
    rng : numpy Generator
        Source of chance.
    dictionary : str
        The set that they are from.
    width_m : float
        Width of the black squares.

    Returns
    -------
    Rig
        Exactly known: its covariance is zero.
    """
    known = marker_dictionary(dictionary)
    ids = ROBOT_IDS if ROBOT_IDS[-1] < len(known) else tuple(range(len(_BOARDS)))
    poses = []
    for place, angles in _BOARDS:
        azimuth, elevation, turn = np.radians(
            np.array(angles) + rng.normal(0.0, _ANGLE_SIGMA_DEG, 3)
        )
        middle = np.array(place) + rng.normal(0.0, _PLACE_SIGMA_M, 3)
        poses.append(facing_pose(middle, azimuth, elevation, turn))
    count = len(poses)
    return Rig(
        dictionary, ids, np.full(count, width_m), np.stack(poses), np.zeros((6 * count, 6 * count))
    )


def facing_pose(
    middle: FloatArray, azimuth_rad: float, elevation_rad: float, turn_rad: float = 0.0
) -> FloatArray:
    """parent_from_surface of an upright surface whose normal has an azimuth and an elevation.

    Parameters
    ----------
    middle : (3,) float64
        Its origin in the parent frame, z up.
    azimuth_rad, elevation_rad : float
        Of its normal: about z from x, and above the horizon.
    turn_rad : float
        By which it is turned about its normal, counter-clockwise as one looks at it.
    """
    ca, sa = np.cos(azimuth_rad), np.sin(azimuth_rad)
    ce, se = np.cos(elevation_rad), np.sin(elevation_rad)
    right, up = np.array([-sa, ca, 0.0]), np.array([-se * ca, -se * sa, ce])
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return pose_of(c * right + s * up, c * up - s * right, middle)


def robot_surfaces(rig: Rig, rng: np.random.Generator) -> list[Surface]:
    """All that is seen of the robot, in its own frame: first its boards in the rig's order.

    Parameters
    ----------
    rig : Rig
        Its markers.
    rng : numpy Generator
        Source of its paint.
    """
    known = marker_dictionary(rig.dictionary)
    boards = [
        marker_surface(known, marker, float(width), pose, quiet_cells=_QUIET_CELLS, back=0.3)
        for marker, width, pose in zip(rig.ids, rig.widths_m, rig.robot_from_marker)
    ]
    lifted = planar_transform(0.0, 0.0, 0.0)
    lifted[2, 3] = _GROUND_M
    paint = {side: _panel(rng) for side in ("front", "rear", "left", "right")}
    body = box_sides(_BODY_M, {**paint, "top": plain(0.3)}, lifted)
    wheels = [
        surface
        for x in (-0.22, 0.22)
        for surface in box_sides(
            (0.16, _BODY_M[1] - 0.04, _GROUND_M),
            {side: plain(0.06) for side in ("front", "rear", "left", "right")},
            planar_transform(x, 0.0, 0.0),
        )
    ]
    return [*boards, *body, *wheels]


def _panel(rng: np.random.Generator) -> Texture:
    """A painted side with vents and a label."""
    values = 0.34 + 0.05 * (blotches(rng, (90, 144)) - np.float32(0.5))
    for row in range(52, 82, 6):
        values[row : row + 3, 20:90] = 0.08
    values[20:34, 100:132] = 0.7
    values[24:30, 104:122] = 0.2
    values[:4], values[-4:] = 0.15, 0.15
    return Texture(np.asarray(values, dtype=np.float32), smooth=True)
