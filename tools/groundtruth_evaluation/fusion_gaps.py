"""How honest the fused covariances are in gaps that odometry alone bridges, and beside them.

    python -m tools.groundtruth_evaluation.fusion_gaps

Robots that drive straight or round bends, with odometry that errs in three ways, none of them taken
from the estimator: as the simulated sessions' does, with sideways slip besides, and wheel by wheel
(every wheel errs by itself, so that ways and turns err together in bends). Poses are measured
before and after a gap. NEES is the squared normalised error per number: 1 if covariances are right.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.stats import chi2

from redetect.groundtruth.fusion.fuse import Fusion, fuse
from redetect.groundtruth.fusion.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.landmarks import wrap_angle
from tools.simulator.laser.route import Route
from tools.simulator.laser.settings import DrivingLimits, WheelErrors
from tools.simulator.laser.wheels import measured_path

FloatArray = NDArray[np.float64]
Odometry = Callable[[FloatArray, np.random.Generator], FloatArray]

_ODOMETRY_HZ = 50.0
_TRACK_M = 0.4
_WHEEL_SIGMA_M = 0.0015
_WHEEL_SCALES = (1.006, 1.009)


@dataclass(frozen=True)
class GapStudy:
    """Fuse made-up drives with gaps, and print how far errors and covariances agree.

    Parameters
    ----------
    seeds : int
        Drives of each kind.
    gaps_s : tuple of float
        How long nothing is measured.
    seen_s : float
        How long poses are measured before and after.
    rate_hz : float
        Of the measured poses.
    sigma_m, sigma_deg : float
        Of the measured poses.
    learn_noise : bool
        Let the fusion find how much odometry errs.
    """

    seeds: int = 60
    gaps_s: tuple[float, ...] = (2.0, 10.0, 30.0, 120.0)
    seen_s: float = 40.0
    rate_hz: float = 25.0
    sigma_m: float = 0.001
    sigma_deg: float = 0.2
    learn_noise: bool = True


def perform(study: GapStudy) -> int:
    """Print a line for each way of erring, path and gap."""
    low, high = chi2.ppf([0.025, 0.975], 3 * study.seeds) / (3 * study.seeds)
    print(
        f"NEES per number of {study.seeds} drives; 95 % band of one instant each "
        f"{low:.2f} to {high:.2f}"
    )
    print("odometry   path      gap s   middle mm   NEES middle   along across turn   near its end"
          "   whole gap   outside")  # fmt: skip
    everything = []
    for name, odometry in _ODOMETRIES.items():
        for path in ("straight", "curved"):
            for gap_s in study.gaps_s:
                rows = [
                    one_drive(study, odometry, path, gap_s, seed) for seed in range(study.seeds)
                ]
                mean = np.mean(rows, axis=0)
                everything.append(mean)
                print(
                    f"{name:10s} {path:8s} {gap_s:6.0f} {mean[0]:11.1f} {mean[1]:13.2f}"
                    f" {mean[2]:7.2f} {mean[3]:6.2f} {mean[4]:4.2f} {mean[5]:14.2f}"
                    f" {mean[6]:11.2f} {mean[7]:9.2f}",
                    flush=True,
                )
    total = np.mean(everything, axis=0)
    print(
        f"all: middle {total[1]:.3f} (along {total[2]:.3f}, across {total[3]:.3f}, turn "
        f"{total[4]:.3f}), near the end {total[5]:.3f}, whole gap {total[6]:.3f}, "
        f"outside {total[7]:.3f}"
    )
    return 0


def one_drive(
    study: GapStudy, odometry: Odometry, path: str, gap_s: float, seed: int
) -> list[float]:
    """Error in the middle (mm); NEES there, by direction, near the end, in the gap, outside."""
    rng = np.random.default_rng([seed, int(10 * gap_s), path == "curved"])
    route = _route(rng, path, 2.0 * study.seen_s + gap_s)
    times = np.arange(0.0, 2.0 * study.seen_s + gap_s, 1.0 / _ODOMETRY_HZ)
    own = odometry(route.poses(times), rng)
    begin, end = study.seen_s, study.seen_s + gap_s
    seen = np.arange(0.003, times[-1], 1.0 / study.rate_hz)
    seen = seen[(seen < begin) | (seen > end)]
    sigmas = np.array([study.sigma_m, study.sigma_m, np.radians(study.sigma_deg)])
    measured = route.poses(seen) + rng.normal(size=(len(seen), 3)) * sigmas
    measured[:, 2] = wrap_angle(measured[:, 2])
    covariances = np.broadcast_to(np.diag(sigmas**2), (len(seen), 3, 3)).copy()
    fusion = fuse(
        PlanarPoses(times, own),
        {"laser": PlanarPoses(seen, measured, covariances)},
        FuseSettings(learn_noise=study.learn_noise),
    )
    return _figures(fusion, route, begin, end)


def _figures(fusion: Fusion, route: Route, begin: float, end: float) -> list[float]:
    found = fusion.poses
    assert found.covariances is not None
    exact = route.poses(found.times_s)
    error = found.poses - exact
    error[:, 2] = wrap_angle(error[:, 2])
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariances), error) / 3.0
    inside = (found.times_s > begin) & (found.times_s < end)
    middle = int(np.argmin(np.abs(found.times_s - 0.5 * (begin + end))))
    late = int(np.argmin(np.abs(found.times_s - (0.1 * begin + 0.9 * end))))
    c, s = np.cos(exact[middle, 2]), np.sin(exact[middle, 2])
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    by_direction = (turn @ error[middle]) ** 2 / np.diagonal(
        turn @ found.covariances[middle] @ turn.T
    )
    return [
        1e3 * float(np.hypot(error[middle, 0], error[middle, 1])),
        float(squared[middle]),
        *(float(value) for value in by_direction),
        float(squared[late]),
        float(np.mean(squared[inside])),
        float(np.mean(squared[~inside])),
    ]


def _route(rng: np.random.Generator, path: str, seconds: float) -> Route:
    """A way of at least so many seconds, with two stops on it."""
    limits = DrivingLimits()
    length = 1.1 * limits.speed_m_s * seconds
    if path == "straight":
        direction = rng.uniform(-np.pi, np.pi)
        ways = np.linspace(0.0, length, 9)
        waypoints = ways[:, None] * np.array([np.cos(direction), np.sin(direction)])
    else:
        # Bends to both sides, of some 1 to 3 m radius, about a heading that wanders.
        legs = int(length / 2.0)
        bearings = np.cumsum(rng.normal(0.0, 0.8, legs))
        steps = 2.0 * np.column_stack([np.cos(bearings), np.sin(bearings)])
        waypoints = np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return Route(waypoints, [], limits, -1.0)


def _as_simulated(poses: FloatArray, rng: np.random.Generator) -> FloatArray:
    return measured_path(poses, WheelErrors(), rng)


def _slipping(poses: FloatArray, rng: np.random.Generator) -> FloatArray:
    return measured_path(poses, WheelErrors(sigma_side_m=0.006), rng)


def _wheel_by_wheel(poses: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Two wheels that roll by shares too far and each slips by itself; summed up along arcs."""
    turn = np.diff(poses[:, 2])
    step = np.diff(poses[:, :2], axis=0)
    middle = poses[:-1, 2] + 0.5 * turn
    way = np.cos(middle) * step[:, 0] + np.sin(middle) * step[:, 1]
    wheels = []
    for side, scale in zip((-1.0, 1.0), _WHEEL_SCALES):
        rolled = way + side * 0.5 * _TRACK_M * turn
        slip = _WHEEL_SIGMA_M * np.sqrt(np.abs(rolled)) * rng.standard_normal(len(rolled))
        wheels.append(scale * rolled + slip)
    told, way = (wheels[1] - wheels[0]) / _TRACK_M, 0.5 * (wheels[0] + wheels[1])
    theta = np.concatenate([[0.0], np.cumsum(told)])
    heading = 0.5 * (theta[1:] + theta[:-1])
    steps = way[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    xy = np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.column_stack([xy, theta])


_ODOMETRIES: dict[str, Odometry] = {
    "simulated": _as_simulated,
    "slipping": _slipping,
    "wheels": _wheel_by_wheel,
}


if __name__ == "__main__":
    raise SystemExit(perform(tyro.cli(GapStudy, description=GapStudy.__doc__)))
