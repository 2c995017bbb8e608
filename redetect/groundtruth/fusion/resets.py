"""Steps of odometry that no robot can make: poses that begin anew, and the ends of stalls.

If its driver is restarted, odometry continues at another pose: that step is no movement. If it
stalls, it repeats a pose for some time and then catches up: without the repeated poses there is a
pause (`redetect.groundtruth.fusion.inputs`), in which the path is unknown.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.fusion.inputs import usual_rate
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.plane import between, compose, log_motion

# A step is impossible if it exceeds this movement (m, rad) plus that at several times the usual
# rates, or at these (m/s, rad/s) if it is mostly at rest.
_LEAST, _TIMES, _LEAST_RATES = 0.2, 5.0, (0.3, 0.5)
_FEWEST = 10


class ContinuousOdometry(NamedTuple):
    """Odometry without the steps that no robot can make."""

    poses: PlanarPoses
    resets_s: tuple[tuple[float, float], ...]  # Times before and after poses that begin anew


def continuous_odometry(odometry: PlanarPoses) -> ContinuousOdometry:
    """Odometry with distinct times, continued after resets, and without the poses of stalls."""
    times_s, poses = odometry.times_s, odometry.poses.copy()
    if len(odometry) < _FEWEST:
        return ContinuousOdometry(odometry, ())
    passed = np.diff(times_s)
    arcs = log_motion(between(poses[:-1], poses[1:]))
    moved = np.column_stack([np.hypot(arcs[:, 0], arcs[:, 1]), np.abs(arcs[:, 2])])
    rates = np.maximum([usual_rate(times_s, own) for own in moved.T], _LEAST_RATES)

    def exceeds(movement: FloatArray, over_s: FloatArray) -> BoolArray:
        most = _LEAST + _TIMES * np.asarray(over_s)[..., None] * rates
        return np.asarray(np.any(movement > most, axis=-1))

    impossible = exceeds(moved, np.maximum(passed, np.median(passed)))
    repeated = ~np.any(moved > 0.0, axis=1)
    kept, resets = np.ones(len(odometry), dtype=np.bool_), []
    for step in np.flatnonzero(impossible):
        begin = step  # of the repeated poses
        while begin > 0 and repeated[begin - 1]:
            begin -= 1
        catches_up = not exceeds(moved[step], times_s[step + 1] - times_s[begin])
        at_origin = not np.any(odometry.poses[step + 1])  # where a driver begins
        if begin < step and catches_up and not at_origin:
            kept[begin + 1 : step + 1] = False
        else:
            poses[step + 1 :] = compose(poses[step], between(poses[step + 1], poses[step + 1 :]))
            resets.append((float(times_s[step]), float(times_s[step + 1])))
    return ContinuousOdometry(PlanarPoses(times_s, poses).only(kept), tuple(resets))
