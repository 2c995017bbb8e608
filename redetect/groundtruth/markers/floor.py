"""Constraint of the floor on the pose of a robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.geometry.transforms import roll_pitch

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Floor:
    """z, roll and pitch of a robot on the floor, with standard deviations."""

    z_m: float
    sigma_z_m: float
    sigma_tilt_rad: float


def floor_residuals(pose: FloatArray, floor: Floor) -> tuple[FloatArray, FloatArray]:
    """Deviation of a pose from the floor's z, roll, pitch: (3,) normalised, and (3, 6) Jacobian.

    The Jacobian is that of the normalised z, roll and pitch by the pose's right perturbation.
    """
    sigmas = np.array([floor.sigma_z_m, floor.sigma_tilt_rad, floor.sigma_tilt_rad])
    roll, pitch = roll_pitch(pose)
    missing = np.array([floor.z_m - pose[2, 3], -roll, -pitch])
    up = pose[2, :3]  # the world's vertical in the robot's axes; it turns by up x w
    jacobian = np.zeros((3, 6))
    jacobian[0, :3] = up
    by_rotation = np.array([[0, -up[2], up[1]], [up[2], 0, -up[0]], [-up[1], up[0], 0]])
    across = up[1] ** 2 + up[2] ** 2
    jacobian[1, 3:] = (up[2] * by_rotation[1] - up[1] * by_rotation[2]) / across
    jacobian[2, 3:] = -by_rotation[0] / np.sqrt(across)
    return missing / sigmas, jacobian / sigmas[:, None]
