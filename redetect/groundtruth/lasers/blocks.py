"""Poses of single sets of scans combined, a few neighbouring ones each, with their motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.tracking import OK, REACQUIRED, UNDETERMINED, LaserTrack
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.landmarks import wrap_angle

FloatArray = NDArray[np.float64]

#: Sets farther apart than this are not of one block (s).
LARGEST_GAP_S = 0.05


def combined_poses(track: LaserTrack, sets_per_pose: int = 1) -> PlanarPoses:
    """Poses of a track, each from `sets_per_pose` consecutive sets.

    The sets' poses are moved to their mean time with the robot's motion and averaged. Every set
    is in one pose only, so that the readings' errors in different poses are independent; those of
    the scanners' poses are common to all and are not averaged away.

    Parameters
    ----------
    track : LaserTrack
    sets_per_pose : int
        1: every set by itself. A block is shorter at the end of a visit, and where sets have no
        determined pose.

    Returns
    -------
    PlanarPoses
        Sets with an undetermined direction come as poses of their own, with the covariance that
        says so; those whose front is unknown do not come at all.

    Raises
    ------
    GroundTruthError
        If `sets_per_pose` is not positive.
    """
    if sets_per_pose < 1:
        raise GroundTruthError(f"sets per pose is {sets_per_pose}: expected 1 or more")
    determined = np.isin(track.status, (OK, REACQUIRED))
    rows = np.flatnonzero(determined | (track.status == UNDETERMINED))
    if not len(rows):
        return PlanarPoses(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    times = track.times_s[rows]
    # A new block where the visit changes, after a gap, and round an undetermined set.
    parted = np.ones(len(rows), dtype=np.bool_)
    parted[1:] = (
        (track.segment[rows[1:]] != track.segment[rows[:-1]])
        | (np.diff(times) > LARGEST_GAP_S)
        | ~determined[rows[1:]]
        | ~determined[rows[:-1]]
    )
    first = np.flatnonzero(parted)
    run = np.cumsum(parted) - 1
    within = (np.arange(len(rows)) - first[run]) // sets_per_pose
    begins = parted | np.concatenate([[True], np.diff(within) != 0])
    block = np.cumsum(begins) - 1
    count = int(block[-1]) + 1

    size = np.bincount(block, minlength=count).astype(np.float64)
    origin = times[0]
    middle = np.bincount(block, times - origin, minlength=count) / size
    lead = track.poses[rows[np.flatnonzero(begins)]]
    moved = track.poses[rows] + track.motion[rows] * (middle[block] - (times - origin))[:, None]
    apart = moved - lead[block]
    apart[:, 2] = wrap_angle(apart[:, 2])
    # All weigh the same: information computed at a wrong pose would favour the wrong poses, and
    # with equal weights at the mean time an error of the motion drops out.
    noise, shared = np.zeros((count, 3, 3)), np.zeros((count, 3, 3))
    mean = np.zeros((count, 3))
    np.add.at(mean, block, apart / size[block][:, None])
    np.add.at(noise, block, track.noise[rows] / (size**2)[block][:, None, None])
    np.add.at(shared, block, (track.covariances - track.noise)[rows] / size[block][:, None, None])
    poses = lead + mean
    poses[:, 2] = wrap_angle(poses[:, 2])
    covariances = noise + shared
    covariances = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    return PlanarPoses(middle + origin, poses, covariances)
