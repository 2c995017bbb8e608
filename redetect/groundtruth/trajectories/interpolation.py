"""Poses at other times, and two streams at common times."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.landmarks import wrap_angle

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def interpolate_poses(
    poses: PlanarPoses, times_s: FloatArray, largest_gap_s: float = np.inf
) -> tuple[PlanarPoses, BoolArray]:
    """Poses at other times, linearly between neighbours, headings the short way round.

    Parameters
    ----------
    poses : PlanarPoses
    times_s : (N,) array
        Ascending.
    largest_gap_s : float
        Between neighbours farther apart than this there is no pose, but at their own times.

    Returns
    -------
    PlanarPoses
        At those of the times that have one; covariances interpolated like the poses.
    (N,) bool array
        Which times those are.
    """
    if len(poses) == 0:
        raise GroundTruthError("no poses to interpolate between")
    after = np.clip(np.searchsorted(poses.times_s, times_s, side="left"), 0, len(poses) - 1)
    before = np.where(poses.times_s[after] == times_s, after, np.maximum(after - 1, 0))
    inside = (times_s >= poses.times_s[0]) & (times_s <= poses.times_s[-1])
    gap = poses.times_s[after] - poses.times_s[before]
    known = inside & (gap <= largest_gap_s)
    before, after, gap = before[known], after[known], gap[known]
    part = np.where(gap > 0.0, (times_s[known] - poses.times_s[before]) / np.where(gap, gap, 1), 0)
    change = poses.poses[after] - poses.poses[before]
    change[:, 2] = wrap_angle(change[:, 2])
    between = poses.poses[before] + part[:, None] * change
    covariances = None
    if poses.covariances is not None:
        a, b = poses.covariances[before], poses.covariances[after]
        covariances = a + part[:, None, None] * (b - a)
    return PlanarPoses(times_s[known], between, covariances), known


def matched_streams(
    poses: PlanarPoses,
    truth: PlanarPoses,
    *,
    largest_gap_s: float = 0.5,
    interpolate: str = "truth",
) -> tuple[PlanarPoses, PlanarPoses, int]:
    """Both streams at common times, and how many times had to be left out.

    See `compare_streams` for the parameters.

    Raises
    ------
    GroundTruthError
        If no pose has a truth at its time.
    """
    if len(poses) == 0 or len(truth) == 0:
        raise GroundTruthError(
            f"{len(poses)} poses and {len(truth)} of the truth: expected at least one of each"
        )
    still, moving = (poses, truth) if interpolate == "truth" else (truth, poses)
    at_times, known = interpolate_poses(moving, still.times_s, largest_gap_s)
    kept = PlanarPoses(
        still.times_s[known],
        still.poses[known],
        None if still.covariances is None else still.covariances[known],
    )
    mine, theirs = (kept, at_times) if interpolate == "truth" else (at_times, kept)
    if len(mine) == 0:
        raise GroundTruthError(
            f"no pose has the truth beside it: poses from {poses.times_s[0]:.3f} to "
            f"{poses.times_s[-1]:.3f} s, truth from {truth.times_s[0]:.3f} to "
            f"{truth.times_s[-1]:.3f} s, gaps of at most {largest_gap_s:g} s interpolated"
        )
    return mine, theirs, int((~known).sum())
