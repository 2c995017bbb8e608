"""Drives whose odometry errs as settings say, and poses measured of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses, interpolate_poses
from redetect.landmarks import wrap_angle
from redetect.plane import chain_steps

FloatArray = NDArray[np.float64]
LASER_COVARIANCE = np.array([[4e-4, 1e-4, 0.0], [1e-4, 9e-4, 2e-5], [0.0, 2e-5, 1e-4]])


def drive(
    rng: np.random.Generator, seconds: float, settings: FuseSettings, rate_hz: float = 50.0
) -> tuple[PlanarPoses, PlanarPoses]:
    """True path, and odometry whose errors are exactly as the settings say."""
    times = np.arange(0.0, seconds, 1.0 / rate_hz)
    speed = 0.5 + 0.3 * np.sin(0.3 * times + rng.uniform(0, 6))
    turning = 0.5 * np.sin(0.2 * times + rng.uniform(0, 6))
    step = np.column_stack([speed, 0 * times, turning]) / rate_hz
    # The truth differs from what odometry says by the noise of its movements.
    distance = np.abs(step[:, 0])
    sigma = np.column_stack(
        [
            settings.distance_sigma * np.sqrt(distance),
            settings.lateral_sigma * np.sqrt(distance),
            np.sqrt(
                settings.turn_sigma**2 * np.abs(step[:, 2])
                + settings.turn_per_metre_sigma**2 * distance
            ),
        ]
    )
    true_step = step + rng.normal(size=step.shape) * sigma
    return (
        PlanarPoses(times, chain(true_step[1:], rng.normal(size=3))),
        PlanarPoses(times, chain(step[1:], (7.0, -3.0, 2.0))),
    )


def chain(steps: FloatArray, start: ArrayLike = (0.0, 0.0, 0.0)) -> FloatArray:
    """(N + 1, 3) poses along N steps, their headings wrapped."""
    poses = chain_steps(steps, start)
    poses[:, 2] = wrap_angle(poses[:, 2])
    return poses


def measure(
    rng: np.random.Generator, truth: PlanarPoses, times: FloatArray, covariance: FloatArray
) -> PlanarPoses:
    exact, _ = interpolate_poses(truth, times)
    noise = rng.multivariate_normal(np.zeros(3), covariance, len(exact))
    return PlanarPoses(
        exact.times_s, exact.poses + noise, np.broadcast_to(covariance, (len(exact), 3, 3)).copy()
    )


def errors_m(poses: PlanarPoses, truth: PlanarPoses) -> FloatArray:
    """Distances of positions from the truth."""
    exact, _ = interpolate_poses(truth, poses.times_s)
    return np.asarray(np.linalg.norm((poses.poses - exact.poses)[:, :2], axis=1))


def normalised_error(poses: PlanarPoses, truth: PlanarPoses) -> FloatArray:
    exact, _ = interpolate_poses(truth, poses.times_s)
    error = poses.poses - exact.poses
    error[:, 2] = wrap_angle(error[:, 2])
    assert poses.covariances is not None
    return np.asarray(np.einsum("ni,nij,nj->n", error, np.linalg.inv(poses.covariances), error))
