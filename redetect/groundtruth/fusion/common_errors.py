"""Errors that all poses of a stream have in common, such as those of the scanners' poses.

They do not average out. So streams are fused without them, and they are added to the result: the
fused path has the same error in the world as the stream that determines it.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.files import JsonObject
from redetect.groundtruth.trajectories.streams import PlanarPoses

#: Its name in the file beside a stream.
COMMON = "common_covariance"
# A common covariance below this share of the poses' own is left in them.
_NEGLIGIBLE = 0.05
# Least share of a pose's variance that is left without the common part, which is a mean.
_LEAST_OWN = 0.02


def read_common_covariance(stream: str | os.PathLike[str]) -> FloatArray:
    """(3, 3) covariance that is common to a stream's poses, from the .json that
    `groundtruth laser` wrote beside it; zeros if there is none.
    """
    path = Path(stream).with_suffix(".json")
    if path.is_file():
        content = JsonObject.read(path)
        if COMMON in content:
            return content.covariance(COMMON, 3)
    return np.zeros((3, 3))


def without_common(poses: PlanarPoses, common: FloatArray) -> tuple[PlanarPoses, FloatArray]:
    """Poses without the common part (3, 3) of their covariances, and that part.

    The part is zeros, and the poses are unchanged, if it is negligible.
    """
    if poses.covariances is None or not len(poses):
        return poses, np.zeros((3, 3))
    usual = np.median(np.diagonal(poses.covariances, axis1=1, axis2=2), axis=0)
    if np.all(np.diag(common) <= _NEGLIGIBLE * usual):
        return poses, np.zeros((3, 3))
    # In units of each pose's deviations, no direction may lose all of its variance.
    scale = np.sqrt(np.diagonal(poses.covariances, axis1=1, axis2=2))
    units = scale[:, :, None] * scale[:, None, :]
    values, vectors = np.linalg.eigh((poses.covariances - common) / units)
    own = (vectors * np.maximum(values, _LEAST_OWN)[:, None]) @ np.swapaxes(vectors, 1, 2)
    return PlanarPoses(poses.times_s, poses.poses, own * units), common


def with_common(poses: PlanarPoses, common: FloatArray) -> PlanarPoses:
    """Poses with a common part (3, 3) added to their covariances."""
    assert poses.covariances is not None
    return PlanarPoses(poses.times_s, poses.poses, poses.covariances + common)
