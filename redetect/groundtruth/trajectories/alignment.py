"""Whole paths moved rigidly in the plane: onto another path, with their covariances."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.trajectories.streams import PlanarPoses

FloatArray = NDArray[np.float64]


def planar_alignment(poses: PlanarPoses, truth: PlanarPoses) -> FloatArray:
    """(3,) rigid motion x, y (m), theta (rad) that takes poses' positions onto the truth's best.

    Both have the same times. Least squares in the plane (Horn 1987), without scale, cannot mirror,
    as alignments in space can.

    Raises
    ------
    GroundTruthError
        If there are fewer than two poses.
    """
    if len(poses) < 2:
        raise GroundTruthError(f"{len(poses)} poses: expected 2 or more to align them")
    a, b = poses.poses[:, :2], truth.poses[:, :2]
    from_a, from_b = a - a.mean(axis=0), b - b.mean(axis=0)
    across = np.sum(from_a[:, 0] * from_b[:, 1] - from_a[:, 1] * from_b[:, 0])
    angle = float(np.arctan2(across, np.sum(from_a * from_b)))
    return np.array([*(b.mean(axis=0) - _rotation(angle) @ a.mean(axis=0)), angle])


def align_poses(poses: PlanarPoses, truth: PlanarPoses) -> PlanarPoses:
    """Poses moved rigidly in the plane, without scale, so that their positions fit the truth best.

    Both have the same times (see `planar_alignment`).
    """
    return moved_poses(poses, planar_alignment(poses, truth))


def moved_poses(poses: PlanarPoses, motion: FloatArray) -> PlanarPoses:
    """Poses, and their covariances, after a rigid motion (x, y, theta) of the world."""
    turn = np.eye(3)
    turn[:2, :2] = _rotation(float(motion[2]))
    moved = poses.poses @ turn.T + motion
    covariances = None
    if poses.covariances is not None:
        covariances = turn @ poses.covariances @ turn.T
    return PlanarPoses(poses.times_s, moved, covariances)


def _rotation(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])
