"""How well a fusion predicts ground truth that it was not given: one segment after the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.fusion.fuse import FuseSettings, fuse
from redetect.groundtruth.trajectories.alignment import moved_poses, planar_alignment
from redetect.groundtruth.trajectories.interpolation import interpolate_poses
from redetect.groundtruth.trajectories.streams import PlanarPoses, last_of_each_time
from redetect.landmarks import wrap_angle

FloatArray = NDArray[np.float64]

# A longer pause in the ground truth begins another segment; fused poses and odometry are not
# interpolated over a longer one.
_SEGMENT_GAP_S = 5.0
_LARGEST_GAP_S = 2.0


@dataclass(frozen=True)
class LeftOut:
    """A segment of the ground truth, predicted without it.

    Attributes
    ----------
    from_s, to_s : float
        The segment.
    poses : int
        Of the ground truth in it that have a prediction.
    position_rms_m, heading_rms_rad : float
        Root of the mean squared error of the fused path.
    normalised_error : float
        Mean squared normalised error per number, 1 if covariances are right.
    aligned_position_rms_m, aligned_heading_rms_rad : float
        The same of odometry after the rigid motion that fits it to the other segments best.
    """

    from_s: float
    to_s: float
    poses: int
    position_rms_m: float
    heading_rms_rad: float
    normalised_error: float
    aligned_position_rms_m: float
    aligned_heading_rms_rad: float


def leave_out(
    odometry: PlanarPoses,
    streams: Mapping[str, PlanarPoses],
    settings: FuseSettings | None = None,
) -> tuple[LeftOut, ...]:
    """Leave each segment of the ground truth between two others out, and predict it.

    Parameters
    ----------
    odometry, streams, settings
        As of `redetect.groundtruth.fusion.fuse.fuse`. Segments are those of the first stream; the
        others are left out at the same times.

    Returns
    -------
    tuple of LeftOut
        In order of time. The first segment and the last are not among them, since a fused path goes
        from the first measured pose to the last.

    Raises
    ------
    GroundTruthError
        If there are fewer than three segments within the odometry's time.
    """
    truth = next(iter(streams.values()))
    own = last_of_each_time(odometry)
    inside = (truth.times_s >= own.times_s[0]) & (truth.times_s <= own.times_s[-1])
    truth = _some(truth, inside)
    cuts = np.flatnonzero(np.diff(truth.times_s) > _SEGMENT_GAP_S) + 1
    parts = [times for times in np.split(truth.times_s, cuts) if len(times)]
    if len(parts) < 3:
        raise GroundTruthError(
            f"{len(parts)} segments of ground truth within the odometry's time: expected 3 or "
            "more, to leave one out between two others"
        )
    return tuple(
        _left_out(own, streams, truth, float(times[0]), float(times[-1]), settings)
        for times in parts[1:-1]
    )


def _left_out(
    odometry: PlanarPoses,
    streams: Mapping[str, PlanarPoses],
    truth: PlanarPoses,
    from_s: float,
    to_s: float,
    settings: FuseSettings | None,
) -> LeftOut:
    fusion = fuse(
        odometry,
        {name: _some(one, ~_during(one, from_s, to_s)) for name, one in streams.items()},
        settings,
    )
    here = _during(truth, from_s, to_s)
    segment, others = _some(truth, here), _some(truth, ~here)
    predicted, known = interpolate_poses(fusion.poses, segment.times_s, _LARGEST_GAP_S)
    error = _difference(predicted, _some(segment, known))
    assert predicted.covariances is not None
    assert segment.covariances is not None
    covariances = predicted.covariances + segment.covariances[known]
    weighted = np.linalg.solve(covariances, error[:, :, None])[:, :, 0]
    beside, aligned = interpolate_poses(odometry, others.times_s, _LARGEST_GAP_S)
    moved = moved_poses(odometry, planar_alignment(beside, _some(others, aligned)))
    rigid, known = interpolate_poses(moved, segment.times_s, _LARGEST_GAP_S)
    return LeftOut(
        from_s,
        to_s,
        len(predicted),
        *_rms(error),
        float(np.mean(np.sum(error * weighted, axis=1)) / 3.0),
        *_rms(_difference(rigid, _some(segment, known))),
    )


def _some(poses: PlanarPoses, which: NDArray[np.bool_]) -> PlanarPoses:
    covariances = None if poses.covariances is None else poses.covariances[which]
    return PlanarPoses(poses.times_s[which], poses.poses[which], covariances)


def _during(poses: PlanarPoses, from_s: float, to_s: float) -> NDArray[np.bool_]:
    return np.asarray((poses.times_s >= from_s) & (poses.times_s <= to_s))


def _difference(poses: PlanarPoses, truth: PlanarPoses) -> FloatArray:
    difference = poses.poses - truth.poses
    difference[:, 2] = wrap_angle(difference[:, 2])
    return difference


def _rms(difference: FloatArray) -> tuple[float, float]:
    """Of the position (m) and of the heading (rad)."""
    if len(difference) == 0:
        return np.nan, np.nan
    squared = np.mean(np.square(difference), axis=0)
    return float(np.sqrt(squared[0] + squared[1])), float(np.sqrt(squared[2]))
