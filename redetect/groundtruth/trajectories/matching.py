"""Poses at other times, two streams at common times, and paths moved rigidly onto others."""

from __future__ import annotations

import numpy as np

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.landmarks import wrap_angle


def interpolate_poses(
    poses: PlanarPoses, times_s: FloatArray, largest_gap_s: float = np.inf
) -> tuple[PlanarPoses, BoolArray]:
    """Poses at other times, linearly between neighbours, headings the short way round.

    Times (N,) ascend. Between neighbours farther apart than the largest gap there is no pose, but
    at their own times. Returns the poses at those times that have one, covariances interpolated
    like them, and which times those are (N,).
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

    Parameters
    ----------
    largest_gap_s : float
        Nothing is interpolated across longer gaps.
    interpolate : str
        `truth` at the poses' times, or `poses` at the truth's times (RAWSEEDS' definition).

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
    kept = still.only(known)
    mine, theirs = (kept, at_times) if interpolate == "truth" else (at_times, kept)
    if len(mine) == 0:
        raise GroundTruthError(
            f"no pose has the truth beside it: poses from {poses.times_s[0]:.3f} to "
            f"{poses.times_s[-1]:.3f} s, truth from {truth.times_s[0]:.3f} to "
            f"{truth.times_s[-1]:.3f} s, gaps of at most {largest_gap_s:g} s interpolated"
        )
    return mine, theirs, int((~known).sum())


def planar_alignment(poses: PlanarPoses, truth: PlanarPoses) -> FloatArray:
    """(3,) rigid motion x, y (m), theta (rad) that takes poses' positions onto the truth's best.

    Both have the same times. Least squares in the plane (Horn 1987), without scale, cannot mirror,
    as alignments in space can.
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


def pose_differences(poses: FloatArray, truth: FloatArray) -> FloatArray:
    """(N, 3) poses minus the truth's, headings the short way round."""
    difference = poses - truth
    difference[:, 2] = wrap_angle(difference[:, 2])
    return difference


def squared_lengths(differences: FloatArray, covariances: FloatArray) -> FloatArray:
    """(N,) squared Mahalanobis lengths of differences (N, d)."""
    weighted = np.linalg.solve(covariances, differences[..., None])[..., 0]
    return np.asarray(np.sum(differences * weighted, axis=1))
