"""Streams of poses against the truth."""

from __future__ import annotations

from redetect.groundtruth.trajectories.streams import (
    Interpolated,
    PlanarPoses,
    matched_streams,
    moved_poses,
    planar_alignment,
)
from redetect.groundtruth.validation.scoring import PoseScore, score_poses


def compare_streams(
    poses: PlanarPoses,
    truth: PlanarPoses,
    *,
    largest_gap_s: float = 0.5,
    interpolate: Interpolated = "truth",
    align: bool = False,
) -> PoseScore:
    """The score of a stream against another of other times, as of `groundtruth score`."""
    mine, theirs, unmatched = matched_streams(
        poses, truth, largest_gap_s=largest_gap_s, interpolate=interpolate
    )
    if align:
        mine = moved_poses(mine, planar_alignment(mine, theirs))
    return score_poses(mine, theirs, unmatched)
