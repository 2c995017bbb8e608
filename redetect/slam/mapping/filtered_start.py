"""A start for least squares where odometry is too wrong: the poses of a filter along the run.

Odometry with a systematic error winds up: after a loop its heading may be half a turn off, and
least squares from there end in a wrong minimum, with the path wound once too often. The filter
corrects the pose in each frame, so that no error winds up while discs are in view.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray
from redetect.slam.filters.ekf_slam import EkfSlam
from redetect.slam.filters.frames import frames_of
from redetect.slam.models import move
from redetect.slam.recording import LineRows, Recording

# The state is limited to this many discs, those seen last: its update costs their number squared.
_MOST_DISCS = 300


def filtered_poses(recording: Recording, start: ArrayLike = (0.0, 0.0, 0.0)) -> FloatArray:
    """Poses by EKF-SLAM with the identifiers of discs, as estimated at the time.

    After a lost step the filter begins again.

    Parameters
    ----------
    recording : Recording
    start : (3,) array_like
        The first pose (m, m, rad).

    Returns
    -------
    (N + 1, 3) float64
        The start and the pose after each step; theta is not wrapped.

    Raises
    ------
    SlamError
        If an update is not possible, because covariances contradict each other.
    """
    lost = set(recording.lost.tolist())
    poses = np.empty((len(recording) + 1, 3))
    poses[0] = start
    ekf, seen = EkfSlam(poses[0]), dict[int, int]()
    for k, rows in enumerate(frames_of(recording)):
        if k in lost:
            ekf, seen = EkfSlam(move(poses[k], recording.steps[k])), {}
        else:
            ekf.predict(recording.steps[k], recording.step_covariance[k])
        ekf.measure(rows._replace(lines=LineRows.of()))
        seen.update(dict.fromkeys(rows.circles.ids[rows.circles.identified].tolist(), k))
        if len(seen) > _MOST_DISCS:
            kept = dict(sorted(seen.items(), key=lambda item: -item[1])[: _MOST_DISCS // 2])
            ekf.forget(seen.keys() - kept.keys(), set())
            seen = kept
        poses[k + 1] = ekf.state[:3]
    return poses
