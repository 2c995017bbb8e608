"""A small run whose truth is known: a robot drives round twice among discs and verticals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from redetect.array_types import FloatArray
from redetect.plane import between, chain_steps
from redetect.slam.models import bearing_of_vertical, disc_in_robot
from redetect.slam.recording import LineRows, Recording
from tests.slam.ekf_rows import circle_rows

CAMERA_XY = np.array([0.018, -0.081])


@dataclass(frozen=True, eq=False)
class SmallRun:
    """What was seen, and the truth in the frame of the start."""

    recording: Recording
    poses: FloatArray
    disc_xy: FloatArray
    line_xy: FloatArray


def small_run(
    seed: int,
    noise: float = 1.0,
    steps: int = 60,
    discs: int = 14,
    turn_sigma_rad: float = 0.006,
    weave_rad: float = 0.0,
) -> SmallRun:
    """Two laps; `noise` is a factor on the errors' standard deviations, not on the covariances.

    Turns differ by up to `weave_rad`: on a circle the camera's place cannot be told from its
    heading.
    """
    rng = np.random.default_rng(seed)
    true_steps = np.tile([0.01, -0.4, 4 * np.pi / steps], (steps, 1))
    true_steps[:, 2] += weave_rad * np.sin(2.0 * np.pi * np.arange(steps) / 9.0)
    poses = chain_steps(true_steps)
    assert np.allclose(between(poses[:-1], poses[1:]), true_steps)
    centre = poses[:, :2].mean(axis=0)
    radius = np.linalg.norm(poses[0, :2] - centre)
    around = np.linspace(0.0, 2 * np.pi, discs, endpoint=False)
    out = np.stack([np.cos(around), np.sin(around)], axis=1)
    disc_xy = centre + out * (radius + rng.uniform(-0.4, 0.4, (discs, 1)))
    line_xy = centre + out[::2] * (radius + 2.5)

    sigma = np.array([0.01, 0.012, turn_sigma_rad])
    shape = np.diag(sigma) @ np.array([[1, 0.2, 0.3], [0.2, 1, -0.1], [0.3, -0.1, 1]])
    step_covariance = shape @ np.diag(sigma)
    measured = true_steps + noise * rng.multivariate_normal(np.zeros(3), step_covariance, steps)

    disc_rows, line_rows = [], []
    for k in range(steps):
        seen = disc_in_robot(poses[k + 1], disc_xy)
        ahead = (seen[:, 1] < -0.9) & (np.abs(seen[:, 0]) < -seen[:, 1])
        for i in np.flatnonzero(ahead & (np.linalg.norm(seen, axis=1) < 3.5)):
            spread = 0.0016 * np.eye(2) + 0.0004 * np.outer(seen[i], seen[i]) / 4
            error = noise * rng.multivariate_normal(np.zeros(2), spread)
            disc_rows.append((k, seen[i] + error, spread, int(i) + 1))
        bearing = bearing_of_vertical(poses[k + 1], line_xy, CAMERA_XY)
        for j in np.flatnonzero(np.abs(bearing) < 1.2):
            off = noise * 0.004 * rng.standard_normal()
            line_rows.append((k, bearing[j] + off, 0.004, (int(j) + 1,)))
    recording = Recording(
        prefixes=tuple(f"s.{k:04d}" for k in range(steps)),
        steps=measured,
        step_covariance=np.tile(step_covariance, (steps, 1, 1)),
        circles=circle_rows(disc_rows),
        lines=LineRows.of(line_rows),
    )
    return SmallRun(recording, poses, disc_xy, line_xy)
