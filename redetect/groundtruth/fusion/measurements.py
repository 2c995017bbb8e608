"""Measured poses of all streams, in one order, with covariances that can be inverted."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.fusion.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import RAWSEEDS_ROUNDING, PlanarPoses

FloatArray = NDArray[np.float64]


def gather(
    odometry: PlanarPoses, streams: Mapping[str, PlanarPoses], settings: FuseSettings
) -> tuple[list[str], FloatArray, FloatArray, FloatArray, dict[str, int], dict[str, int]]:
    """All measurements within the odometry's time, in order, with covariances that can be used.

    Parameters
    ----------
    odometry : PlanarPoses
    streams : mapping of str to PlanarPoses
        Measured poses, by name.
    settings : FuseSettings

    Returns
    -------
    names : list of M str
        The stream of each measurement.
    times_s, poses, covariances : (M,), (M, 3), (M, 3, 3) arrays
    repaired : dict of str to int
        Covariances that had to be raised, by stream.
    repeated : dict of str to int
        Rows that are the row before once more, to the last digit, by stream: left out, since one
        measurement must not count twice.

    Raises
    ------
    GroundTruthError
        If there is no measurement within the odometry's time, a stream has no covariances, or one
        of them cannot be repaired.
    """
    names: list[str] = []
    times, poses, covariances = [], [], []
    repaired, repeated = {}, {}
    for name, stream in streams.items():
        if stream.covariances is None:
            raise GroundTruthError(f"{name}: no covariances: expected t, x, y, theta and 9 more")
        inside = (stream.times_s >= odometry.times_s[0]) & (stream.times_s <= odometry.times_s[-1])
        again = inside & _repeats(stream, stream.covariances)
        repeated[name] = int(np.count_nonzero(again))
        inside &= ~again
        usable, repaired[name] = _usable(name, stream.covariances, np.flatnonzero(inside))
        scale = (settings.covariance_scale or {}).get(name, 1.0)
        names += [name] * int(np.count_nonzero(inside))
        times.append(stream.times_s[inside])
        poses.append(stream.poses[inside])
        covariances.append(usable * scale)
    if not names:
        raise GroundTruthError(
            "no measured pose within the odometry's time "
            f"({odometry.times_s[0]:.3f} s to {odometry.times_s[-1]:.3f} s)"
        )
    all_times = np.concatenate(times)
    order = np.argsort(all_times, kind="stable")
    return (
        [names[i] for i in order],
        all_times[order],
        np.concatenate(poses)[order],
        np.concatenate(covariances)[order],
        repaired,
        repeated,
    )


def _repeats(stream: PlanarPoses, covariances: FloatArray) -> NDArray[np.bool_]:
    """(N,) which rows are those before them."""
    rows = np.column_stack([stream.times_s, stream.poses, covariances.reshape(len(stream), 9)])
    same = np.all(rows[1:] == rows[:-1], axis=1)
    return np.concatenate([np.zeros(min(len(rows), 1), dtype=np.bool_), same])


def _usable(name: str, covariances: FloatArray, rows: NDArray[np.int64]) -> tuple[FloatArray, int]:
    """Covariances of rows made symmetric, and raised where rounding made them singular."""
    symmetric = 0.5 * (covariances[rows] + np.swapaxes(covariances[rows], 1, 2))
    smallest = np.linalg.eigvalsh(symmetric)[:, 0]
    worst = float(smallest.min(initial=0.0))
    # Three entries of a row may each be off by the rounding.
    if worst < -3.0 * RAWSEEDS_ROUNDING:
        at = int(np.argmin(smallest))
        raise GroundTruthError(
            f"{name}: pose {rows[at] + 1} has a covariance with eigenvalue {worst:.3g}: expected "
            "none below what rounding to six decimals makes of 0"
        )
    weak = smallest <= RAWSEEDS_ROUNDING * 0.1
    symmetric[weak] += np.eye(3) * (
        RAWSEEDS_ROUNDING + np.maximum(0.0, -smallest[weak])[:, None, None]
    )
    return symmetric, int(np.count_nonzero(weak))
