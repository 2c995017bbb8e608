"""Drives whose odometry errs as settings say, and poses measured of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses, interpolate_poses
from redetect.landmarks import wrap_angle

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
    return (
        PlanarPoses(times, chain(step + rng.normal(size=step.shape) * sigma, rng.normal(size=3))),
        PlanarPoses(times, chain(step, np.array([7.0, -3.0, 2.0]))),
    )


def chain(steps: FloatArray, start: FloatArray) -> FloatArray:
    """(N, 3) poses from a start; each step but the first is in the frame of the pose before."""
    theta = start[2] + np.concatenate([[0.0], np.cumsum(steps[1:, 2])])
    moves = (steps[1:, 0] + 1j * steps[1:, 1]) * np.exp(1j * theta[:-1])
    xy = complex(start[0], start[1]) + np.concatenate([[0.0], np.cumsum(moves)])
    return np.column_stack([xy.real, xy.imag, wrap_angle(theta)])


def measure(
    rng: np.random.Generator, truth: PlanarPoses, times: FloatArray, covariance: FloatArray
) -> PlanarPoses:
    exact, _ = interpolate_poses(truth, times)
    noise = rng.multivariate_normal(np.zeros(3), covariance, len(exact))
    return PlanarPoses(
        exact.times_s, exact.poses + noise, np.broadcast_to(covariance, (len(exact), 3, 3)).copy()
    )


def normalised_error(poses: PlanarPoses, truth: PlanarPoses) -> FloatArray:
    exact, _ = interpolate_poses(truth, poses.times_s)
    error = poses.poses - exact.poses
    error[:, 2] = wrap_angle(error[:, 2])
    assert poses.covariances is not None
    return np.asarray(np.einsum("ni,nij,nj->n", error, np.linalg.inv(poses.covariances), error))
