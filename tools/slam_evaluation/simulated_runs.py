"""Small runs whose errors are exactly those that their covariances say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from redetect.landmarks.map_file import LandmarkMap, Landmarks, no_landmarks
from redetect.slam.models.measurement import bearing_of_vertical, disc_in_robot
from redetect.slam.models.motion import chain_steps
from redetect.slam.recording import CircleRows, LineRows, Recording

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CAMERA_XY = np.array([0.018, -0.081])


@dataclass(frozen=True)
class Scenario:
    """A robot drives rounds of a circle among landmarks, with noise white and Gaussian.

    Attributes
    ----------
    steps : int
        Of the drive.
    steps_per_round : int
        So often it comes by again.
    step_m : float
        Length of a step (m).
    turn_sigma_rad : float
        Standard deviation of each step's heading (rad).
    step_sigma_m : float
        Standard deviation of each step's dx and dy (m).
    discs, lines : int
        Landmarks along the way.
    disc_sigma_m : float
        Standard deviation of a disc across the line of sight (m); along it, it grows with the
        square of the distance.
    bearing_sigma_rad : float
        Standard deviation of a line's bearing (rad).
    overconfidence : float
        The covariances that the run states are this factor smaller than the true ones, in sigma.
    """

    steps: int = 300
    steps_per_round: int = 120
    step_m: float = 0.22
    turn_sigma_rad: float = 0.01
    step_sigma_m: float = 0.01
    discs: int = 60
    lines: int = 0
    disc_sigma_m: float = 0.04
    bearing_sigma_rad: float = 0.002
    overconfidence: float = 1.0


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """A run with its truth.

    Attributes
    ----------
    recording : Recording
    poses : (N + 1, 3) float64
        True poses, the start at 0.
    discs_xy, lines_xy : (n, 2) float64
        True places; landmark i has identifier i.
    """

    recording: Recording
    poses: FloatArray
    discs_xy: FloatArray
    lines_xy: FloatArray


def simulate(scenario: Scenario, seed: int) -> SimulatedRun:
    """Drive a run.

    Parameters
    ----------
    scenario : Scenario
    seed : int
        Everything random follows from it.

    Returns
    -------
    SimulatedRun
    """
    rng = np.random.default_rng(seed)
    turn = 2.0 * np.pi / scenario.steps_per_round
    true_steps = np.tile([0.0, -scenario.step_m, turn], (scenario.steps, 1))
    poses = chain_steps(true_steps)
    radius = scenario.step_m / turn
    centre = np.array([radius, 0.0])
    # Forward is -Y and a turn is counter-clockwise, so the circle's centre lies on the +X side.
    discs = _ring(rng, scenario.discs, centre, max(radius - 2.5, 0.3), radius + 2.5)
    lines = _ring(rng, scenario.lines, centre, radius + 2.0, radius + 6.0)
    sigma = np.array([scenario.step_sigma_m, scenario.step_sigma_m, scenario.turn_sigma_rad])
    noisy_steps = true_steps + sigma * rng.normal(size=true_steps.shape)
    stated = scenario.overconfidence**-2
    recording = Recording(
        prefixes=tuple(f"simulated.{k:04d}" for k in range(scenario.steps)),
        steps=noisy_steps,
        step_covariance=np.tile(stated * np.diag(sigma**2), (scenario.steps, 1, 1)),
        circles=_circle_rows(rng, scenario, poses, discs),
        lines=_line_rows(rng, scenario, poses, lines),
    )
    return SimulatedRun(recording, poses, discs, lines)


def true_map(run: SimulatedRun, sigma_m: float = 0.0, seed: int = 0) -> LandmarkMap:
    """The map of a run, with errors of a standard deviation that it states.

    Parameters
    ----------
    run : SimulatedRun
    sigma_m : float
        Of each landmark along x and y (m).
    seed : int
        Of the errors.

    Returns
    -------
    LandmarkMap
    """
    rng = np.random.default_rng(seed)

    def noisy(xy: FloatArray) -> Landmarks:
        count = len(xy)
        if not count:
            return no_landmarks()
        return Landmarks(
            ids=np.arange(count),
            xy=xy + sigma_m * rng.normal(size=xy.shape),
            covariance=np.tile(sigma_m**2 * np.eye(2), (count, 1, 1)),
            rows=np.ones(count, dtype=np.int64),
        )

    return LandmarkMap(discs=noisy(run.discs_xy), lines=noisy(run.lines_xy))


def _ring(
    rng: np.random.Generator, count: int, centre: FloatArray, inner: float, outer: float
) -> FloatArray:
    """Places spread evenly over a ring."""
    away = np.sqrt(rng.uniform(inner**2, outer**2, count))
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    return np.asarray(centre + np.stack([away * np.cos(angle), away * np.sin(angle)], axis=-1))


def _circle_rows(
    rng: np.random.Generator, scenario: Scenario, poses: FloatArray, discs: FloatArray
) -> CircleRows:
    seen = disc_in_robot(poses[1:, None], discs)
    away = np.hypot(seen[..., 0], seen[..., 1])
    ahead = np.abs(np.arctan2(seen[..., 0], -seen[..., 1])) < np.radians(50.0)
    frame, number = np.nonzero(ahead & (away > 0.8) & (away < 4.0))
    xy, distance = seen[frame, number], away[frame, number]
    sight = xy / distance[:, None]
    along = scenario.disc_sigma_m * (1.0 + 0.1 * distance**2)
    across = np.stack([-sight[:, 1], sight[:, 0]], axis=-1)
    root = np.stack([along[:, None] * sight, scenario.disc_sigma_m * across], axis=-1)
    noise = np.einsum("nij,nj->ni", root, rng.normal(size=xy.shape))
    covariance = root @ root.transpose(0, 2, 1)
    return CircleRows(
        frame=frame.astype(np.int64),
        xy=xy + noise,
        covariance=covariance * scenario.overconfidence**-2,
        ids=number.astype(np.int64),
    )


def _line_rows(
    rng: np.random.Generator, scenario: Scenario, poses: FloatArray, lines: FloatArray
) -> LineRows:
    bearing = bearing_of_vertical(poses[1:, None], lines, CAMERA_XY).reshape(len(poses) - 1, -1)
    away = np.linalg.norm(disc_in_robot(poses[1:, None], lines), axis=-1).reshape(bearing.shape)
    frame, number = np.nonzero((np.abs(bearing) < np.radians(50.0)) & (away < 8.0))
    noise = scenario.bearing_sigma_rad * rng.normal(size=len(frame))
    return LineRows(
        frame=frame.astype(np.int64),
        bearing_rad=bearing[frame, number] + noise,
        sigma_rad=np.full(len(frame), scenario.bearing_sigma_rad / scenario.overconfidence),
        ids=tuple((int(i),) for i in number),
    )
