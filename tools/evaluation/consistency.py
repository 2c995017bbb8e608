"""Whether the filters' covariances are right: normalised errors squared over simulated runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from redetect.landmarks import squared_mahalanobis, wrap_angle
from redetect.landmarks.map_file import LandmarkMap, Landmarks, no_landmarks
from redetect.slam.filters.ekf_slam import EkfSlam, JacobiansAt, run_ekf
from redetect.slam.filters.frames import FilterRun, run_filter
from redetect.slam.filters.localizer import Localizer, MapErrors
from redetect.slam.models import bearing_of_vertical, chain_steps, disc_in_robot
from redetect.slam.recording import CircleRows, LineRows, Recording
from tools.arrays import FloatArray
from tools.evaluation.tables import Table

CAMERA_XY = np.array([0.018, -0.081])


@dataclass(frozen=True)
class Scenario:
    """A robot drives rounds of a circle among landmarks, with noise white and Gaussian."""

    steps: int = 300  # Of the drive.
    steps_per_round: int = 120  # So often it comes by again.
    step_m: float = 0.22  # Length of a step (m).
    turn_sigma_rad: float = 0.01  # Standard deviation of each step's heading (rad).
    step_sigma_m: float = 0.01  # Standard deviation of each step's dx and dy (m).
    discs: int = 60  # Landmarks along the way.
    lines: int = 0
    disc_sigma_m: float = 0.04
    """Standard deviation of a disc across the line of sight (m); along it, it grows with the square
    of the distance."""
    bearing_sigma_rad: float = 0.002  # Standard deviation of a line's bearing (rad).
    overconfidence: float = 1.0
    """The covariances that the run states are this factor smaller than the true ones, in sigma."""


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """A run with its truth."""

    recording: Recording
    poses: FloatArray  # (N + 1, 3) True poses, the start at 0.
    discs_xy: FloatArray  # (n, 2) True places; landmark i has identifier i.
    lines_xy: FloatArray  # (n, 2)


def simulate(scenario: Scenario, seed: int) -> SimulatedRun:
    """Drive a run."""
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
    """The map of a run, with errors of a standard deviation that it states."""
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


POSE_NUMBERS = 3
_MAP_SIGMA_M = 0.05


@dataclass(frozen=True, eq=False)
class Consistency:
    """What a filter's normalised errors come to."""

    mean: FloatArray
    """(N,) Normalised estimation error squared of the pose after each step, mean of all runs."""
    band: tuple[float, float]  # Where 95 % of these means lie if the covariances are right.
    heading_error_rad: float  # Largest error of heading in any run.

    @property
    def inside(self) -> float:
        """Share of the steps at which the mean lies in the band."""
        return float(np.mean((self.mean >= self.band[0]) & (self.mean <= self.band[1])))

    @property
    def overall(self) -> float:
        """Mean of all steps and runs; expected is 3."""
        return float(np.mean(self.mean))


def band(runs: int) -> tuple[float, float]:
    """Where 95 % of the means of `runs` normalised errors squared of poses lie."""
    low, high = chi2.interval(0.95, POSE_NUMBERS * runs)
    return float(low) / runs, float(high) / runs


def normalised_errors(run: FilterRun, truth: FloatArray) -> tuple[FloatArray, float]:
    """Normalised estimation error squared of each pose but the start's, and the largest turn.
    `truth` (N + 1, 3); returns `squared` (N,).
    """
    assert run.path.covariance is not None
    error = run.path.poses[1:] - truth[1:]
    error[:, 2] = wrap_angle(error[:, 2])
    squared = squared_mahalanobis(error, run.path.covariance[1:])
    return squared, float(np.max(np.abs(error[:, 2])))


def assess(
    scenario: Scenario, estimate: Callable[[SimulatedRun, int], FilterRun], runs: int, seed: int
) -> Consistency:
    """Normalised errors of a filter over simulated runs."""
    errors, heading = [], 0.0
    for k in range(seed, seed + runs):
        simulated = simulate(scenario, k)
        squared, largest = normalised_errors(estimate(simulated, k), simulated.poses)
        errors.append(squared)
        heading = max(heading, largest)
    return Consistency(np.mean(errors, axis=0), band(runs), heading)


def localized(sigma_m: float, map_errors: MapErrors) -> Callable[[SimulatedRun, int], FilterRun]:
    """Localisation in the true map, or in one with errors of a standard deviation."""
    return lambda run, seed: run_filter(
        run.recording,
        Localizer(
            true_map(run, sigma_m, seed + 1_000_000), camera_xy=CAMERA_XY, map_errors=map_errors
        ),
    )


def mapped(jacobians: JacobiansAt) -> Callable[[SimulatedRun, int], FilterRun]:
    """EKF-SLAM."""
    return lambda run, _: run_ekf(run.recording, EkfSlam(camera_xy=CAMERA_XY, jacobians=jacobians))


@dataclass(frozen=True)
class ConsistencyStudy:
    """Normalised estimation error squared (NEES) of localizer and EKF-SLAM."""

    runs: int = 50  # Simulated runs for each line of the table.
    steps: int = 240  # Steps of each.
    seed: int = 1  # Of the first run; the others follow.
    turn_sigma_deg: tuple[float, ...] = (0.1, 1.0, 3.0)
    """Heading noise of a step, one part of the table each (degrees)."""

    def __call__(self) -> int:
        low, high = band(self.runs)
        print(
            f"NEES of the pose, mean of {self.runs} runs of {self.steps} steps; expected "
            f"{POSE_NUMBERS}, 95 % band {low:.2f} to {high:.2f}"
        )
        table = Table(
            {"heading noise / deg": ".1f", "landmarks": "<12", "filter": "<34", "NEES": "7.2f",
             "last": "7.2f", "in band": "8.1%", "heading error / deg": ".1f"}
        )  # fmt: skip
        filters = [
            ("localizer, exact map", localized(0.0, "considered")),
            ("localizer, map of 5 cm, considered", localized(_MAP_SIGMA_M, "considered")),
            ("localizer, map of 5 cm, white", localized(_MAP_SIGMA_M, "white")),
            ("localizer, map of 5 cm, ignored", localized(_MAP_SIGMA_M, "ignored")),
            ("EKF-SLAM, Jacobians at latest", mapped("latest")),
            ("EKF-SLAM, Jacobians at first", mapped("first")),
        ]
        for degrees in self.turn_sigma_deg:
            for landmarks, lines in (("discs", 0), ("discs, lines", 25)):
                sigma = float(np.radians(degrees))
                scenario = Scenario(steps=self.steps, turn_sigma_rad=sigma, lines=lines)
                for name, estimate in filters:
                    found = assess(scenario, estimate, self.runs, self.seed)
                    table.row(
                        degrees, landmarks, name, found.overall, found.mean[-1], found.inside,
                        np.degrees(found.heading_error_rad),
                    )  # fmt: skip
        return 0
