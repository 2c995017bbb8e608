"""Fusion of odometry with ground truths: Kalman filter forward, smoothing backward (RAWSEEDS D2.1).

Odometry is the control, poses from laser and markers are the measurements. The nodes are the
odometry's times and the measurements' own, between which odometry is interpolated linearly; so no
measurement is interpolated, which would make two of one and count the same noise twice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from groundtruth.errors import GroundTruthError
from groundtruth.scoring import interpolate_poses, wrapped
from groundtruth.smoother_kernels import filter_forward, smooth_backward
from groundtruth.streams import RAWSEEDS_ROUNDING, PlanarPoses

FloatArray = NDArray[np.float64]

# A robot that stands still may yet be moved a little; without it, standing would make covariances
# that cannot be inverted.
_CREEP_M2_PER_S = (1e-4) ** 2
_CREEP_RAD2_PER_S = (1e-4) ** 2
_RESTART_AFTER = 40
_RESTART_COVARIANCE = np.diag([25.0, 25.0, math.pi**2])


@dataclass(frozen=True)
class FuseSettings:
    """How odometry errs, and how far a measurement may be off.

    Parameters
    ----------
    distance_sigma : float
        Standard deviation of odometry's distance after a metre (m); it grows with the root.
    turn_sigma : float
        Standard deviation of its heading after turning a radian (rad).
    turn_per_metre_sigma : float
        The same after a metre driven (rad).
    gate_probability : float
        Share of right poses that pass the gate.
    covariance_scale : dict of str to float
        Factors on the measurements' covariances, by the stream's name; others count as 1.

    Raises
    ------
    GroundTruthError
        If a number is not finite, negative, or no probability.
    """

    distance_sigma: float = 0.02
    turn_sigma: float = 0.02
    turn_per_metre_sigma: float = 0.01
    gate_probability: float = 0.9999
    covariance_scale: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        for name in ("distance_sigma", "turn_sigma", "turn_per_metre_sigma"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise GroundTruthError(f"{name} is {value}: expected 0 or more")
        if not 0.0 < self.gate_probability < 1.0:
            raise GroundTruthError(
                f"gate_probability is {self.gate_probability}: expected between 0 and 1"
            )
        for name, value in (self.covariance_scale or {}).items():
            if not (math.isfinite(value) and value > 0.0):
                raise GroundTruthError(f"covariance scale of {name} is {value}: expected above 0")


@dataclass(frozen=True)
class Rejected:
    """A measurement that the gate kept out.

    Attributes
    ----------
    stream : str
        Whose it was.
    time_s : float
    squared_innovation : float
        Squared normalised distance from what was expected.
    """

    stream: str
    time_s: float
    squared_innovation: float


@dataclass(frozen=True, eq=False)
class Fusion:
    """The robot's path out of all streams.

    Attributes
    ----------
    poses : PlanarPoses
        At the odometry's times from the first measurement to the last, with covariances; headings
        within +-pi.
    rejected : tuple of Rejected
        In order of time.
    restarts_s : tuple of float
        When the filter began anew, since nothing of what was measured fitted any more.
    used : dict of str to int
        Measurements that went in, by stream.
    repaired : dict of str to int
        Covariances that were not positive definite as written, by stream; they were raised by their
        file's rounding.
    """

    poses: PlanarPoses
    rejected: tuple[Rejected, ...]
    restarts_s: tuple[float, ...]
    used: dict[str, int]
    repaired: dict[str, int]


def fuse(
    odometry: PlanarPoses,
    streams: Mapping[str, PlanarPoses],
    settings: FuseSettings | None = None,
) -> Fusion:
    """Fuse odometry with poses measured by other means.

    Parameters
    ----------
    odometry : PlanarPoses
        The robot's own poses, on the measurements' clock; only movements between them count.
    streams : mapping of str to PlanarPoses
        Measured poses with covariances, by name.
    settings : FuseSettings, optional

    Returns
    -------
    Fusion

    Raises
    ------
    GroundTruthError
        If there is no measurement within the odometry's time, a stream has no covariances, or one
        of them cannot be repaired.
    """
    chosen = settings or FuseSettings()
    names, times, measured, covariances, repaired = _gather(odometry, streams, chosen)
    first, last = float(times[0]), float(times[-1])
    inside = odometry.times_s[(odometry.times_s >= first) & (odometry.times_s <= last)]
    node_times = np.union1d(inside, times)
    path, _ = interpolate_poses(odometry, node_times)
    controls, variances = _controls(node_times, path.poses, chosen)
    nodes = np.searchsorted(node_times, times).astype(np.int64)

    count = len(node_times)
    predicted, filtered, smoothed = (np.empty((count, 3)) for _ in range(3))
    spreads = [np.empty((count, 3, 3)) for _ in range(3)]
    transitions = np.empty((count, 3, 3))
    squared = np.empty(len(times))
    accepted = np.empty(len(times), dtype=np.bool_)
    restarted = np.empty(count, dtype=np.bool_)
    filter_forward(
        controls,
        variances,
        measured[0].copy(),
        _RESTART_COVARIANCE,
        nodes,
        measured,
        covariances,
        float(chi2.ppf(chosen.gate_probability, 3)),
        _RESTART_AFTER,
        _RESTART_COVARIANCE,
        predicted,
        spreads[0],
        filtered,
        spreads[1],
        transitions,
        squared,
        accepted,
        restarted,
    )
    smooth_backward(
        predicted, spreads[0], filtered, spreads[1], transitions, restarted, smoothed, spreads[2]
    )
    at = np.searchsorted(node_times, inside)
    poses = smoothed[at]
    poses[:, 2] = wrapped(poses[:, 2])
    return Fusion(
        poses=PlanarPoses(
            inside, poses, 0.5 * (spreads[2][at] + np.swapaxes(spreads[2][at], 1, 2))
        ),
        rejected=tuple(
            Rejected(names[i], float(times[i]), float(squared[i]))
            for i in np.flatnonzero(~accepted)
        ),
        restarts_s=tuple(float(time) for time in node_times[restarted]),
        used={
            name: int(np.count_nonzero(accepted & (np.array(names) == name))) for name in streams
        },
        repaired=repaired,
    )


def _gather(
    odometry: PlanarPoses, streams: Mapping[str, PlanarPoses], settings: FuseSettings
) -> tuple[list[str], FloatArray, FloatArray, FloatArray, dict[str, int]]:
    """All measurements within the odometry's time, in order, with covariances that can be used."""
    names: list[str] = []
    times, poses, covariances = [], [], []
    repaired = {}
    for name, stream in streams.items():
        if stream.covariances is None:
            raise GroundTruthError(f"{name}: no covariances: expected t, x, y, theta and 9 more")
        inside = (stream.times_s >= odometry.times_s[0]) & (stream.times_s <= odometry.times_s[-1])
        usable, repaired[name] = _usable(name, stream.covariances[inside])
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
    )


def _usable(name: str, covariances: FloatArray) -> tuple[FloatArray, int]:
    """Covariances made symmetric, and raised where a file's rounding made them singular."""
    symmetric = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    smallest = np.linalg.eigvalsh(symmetric)[:, 0]
    worst = float(smallest.min(initial=0.0))
    # Three entries of a row may each be off by the rounding.
    if worst < -3.0 * RAWSEEDS_ROUNDING:
        at = int(np.argmin(smallest))
        raise GroundTruthError(
            f"{name}: pose {at + 1} has a covariance with eigenvalue {worst:.3g}: expected none "
            "below what rounding to six decimals makes of 0"
        )
    weak = smallest <= RAWSEEDS_ROUNDING * 0.1
    symmetric[weak] += np.eye(3) * (
        RAWSEEDS_ROUNDING + np.maximum(0.0, -smallest[weak])[:, None, None]
    )
    return symmetric, int(np.count_nonzero(weak))


def _controls(
    times_s: FloatArray, path: FloatArray, settings: FuseSettings
) -> tuple[FloatArray, FloatArray]:
    """Movements between the nodes in the robot's frame, and their variances."""
    controls = np.zeros((len(times_s), 3))
    change = np.diff(path, axis=0)
    change[:, 2] = wrapped(change[:, 2])
    cos, sin = np.cos(path[:-1, 2]), np.sin(path[:-1, 2])
    controls[1:, 0] = cos * change[:, 0] + sin * change[:, 1]
    controls[1:, 1] = -sin * change[:, 0] + cos * change[:, 1]
    controls[1:, 2] = change[:, 2]
    distance = np.hypot(controls[:, 0], controls[:, 1])
    passed = np.concatenate([[0.0], np.diff(times_s)])
    variances = np.empty((len(times_s), 3))
    along = settings.distance_sigma**2 * distance + _CREEP_M2_PER_S * passed + 1e-14
    variances[:, 0] = variances[:, 1] = along
    variances[:, 2] = (
        settings.turn_sigma**2 * np.abs(controls[:, 2])
        + settings.turn_per_metre_sigma**2 * distance
        + _CREEP_RAD2_PER_S * passed
        + 1e-14
    )
    return controls, variances
