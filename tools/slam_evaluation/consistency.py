"""Are the filters' covariances right? Normalised estimation error squared over simulated runs.

``python -m tools.slam_evaluation.consistency`` prints the table of docs/slam/filters.md.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import tyro
from numpy.typing import NDArray

from redetect.landmarks import wrap_angle
from redetect.slam.filters.ekf_slam import EkfSlam, JacobiansAt, run_ekf
from redetect.slam.filters.frames import FilterRun
from redetect.slam.filters.localizer import Localizer, MapErrors, run_localizer
from tools.slam_evaluation.simulated_runs import (
    CAMERA_XY,
    Scenario,
    SimulatedRun,
    simulate,
    true_map,
)

FloatArray = NDArray[np.float64]

POSE_NUMBERS = 3
_MAP_SIGMA_M = 0.05


@dataclass(frozen=True)
class Settings:
    """Normalised estimation error squared of localizer and EKF-SLAM.

    Parameters
    ----------
    runs : int
        Simulated runs for each line of the table.
    steps : int
        Steps of each.
    seed : int
        Of the first run; the others follow.
    turn_sigma_deg : floats
        Heading noise of a step, one part of the table each (degrees).
    """

    runs: int = 50
    steps: int = 240
    seed: int = 1
    turn_sigma_deg: tuple[float, ...] = (0.1, 1.0, 3.0)


@dataclass(frozen=True, eq=False)
class Consistency:
    """What a filter's normalised errors come to.

    Attributes
    ----------
    mean : (N,) float64
        Normalised estimation error squared of the pose after each step, mean of all runs.
    band : (float, float)
        Where 95 % of these means lie if the covariances are right.
    heading_error_rad : float
        Largest error of heading in any run.
    """

    mean: FloatArray
    band: tuple[float, float]
    heading_error_rad: float

    @property
    def inside(self) -> float:
        """Share of the steps at which the mean lies in the band."""
        return float(np.mean((self.mean >= self.band[0]) & (self.mean <= self.band[1])))

    @property
    def overall(self) -> float:
        """Mean of all steps and runs; expected is 3."""
        return float(np.mean(self.mean))


def band(runs: int, numbers: int = POSE_NUMBERS, probability: float = 0.95) -> tuple[float, float]:
    """Where the mean of `runs` normalised errors squared of `numbers` numbers lies.

    Parameters
    ----------
    runs, numbers : int
    probability : float
        Of lying inside; half of the rest lies on each side.

    Returns
    -------
    lower, upper : float
        Quantiles of chi squared with runs * numbers degrees of freedom, over runs.
    """
    from scipy.special import chdtri

    outside = 0.5 * (1.0 - probability)
    freedom = runs * numbers
    return (
        float(chdtri(freedom, 1.0 - outside)) / runs,
        float(chdtri(freedom, outside)) / runs,
    )


def normalised_errors(run: FilterRun, truth: FloatArray) -> tuple[FloatArray, float]:
    """Normalised estimation error squared of each pose but the start's, and the largest turn.

    Parameters
    ----------
    run : FilterRun
        With covariances.
    truth : (N + 1, 3) float64
        True poses.

    Returns
    -------
    squared : (N,) float64
    heading_rad : float
        Largest error of heading.
    """
    assert run.path.covariance is not None
    error = run.path.poses[1:] - truth[1:]
    error[:, 2] = wrap_angle(error[:, 2])
    solved = np.linalg.solve(run.path.covariance[1:], error[..., None])[..., 0]
    return np.sum(error * solved, axis=1), float(np.max(np.abs(error[:, 2])))


def assess(
    scenario: Scenario, estimate: Callable[[SimulatedRun, int], FilterRun], runs: int, seed: int
) -> Consistency:
    """Normalised errors of a filter over simulated runs.

    Parameters
    ----------
    scenario : Scenario
    estimate : callable
        Takes a run and its seed to what the filter makes of it.
    runs : int
        How many.
    seed : int
        Of the first.

    Returns
    -------
    Consistency
    """
    errors, heading = [], 0.0
    for k in range(seed, seed + runs):
        simulated = simulate(scenario, k)
        squared, largest = normalised_errors(estimate(simulated, k), simulated.poses)
        errors.append(squared)
        heading = max(heading, largest)
    return Consistency(np.mean(errors, axis=0), band(runs), heading)


def localized(sigma_m: float, map_errors: MapErrors) -> Callable[[SimulatedRun, int], FilterRun]:
    """Localisation in the true map, or in one with errors of a standard deviation."""

    def estimate(run: SimulatedRun, seed: int) -> FilterRun:
        some_map = true_map(run, sigma_m, seed + 1_000_000)
        localizer = Localizer(some_map, camera_xy=CAMERA_XY, map_errors=map_errors)
        return run_localizer(run.recording, localizer)

    return estimate


def mapped(jacobians: JacobiansAt) -> Callable[[SimulatedRun, int], FilterRun]:
    """EKF-SLAM."""

    def estimate(run: SimulatedRun, seed: int) -> FilterRun:
        ekf = EkfSlam(camera_xy=CAMERA_XY, jacobians=jacobians)
        return run_ekf(run.recording, ekf)

    return estimate


def report(settings: Settings) -> Iterator[str]:
    """The table, line by line."""
    low, high = band(settings.runs)
    yield (
        f"NEES of the pose, mean of {settings.runs} runs of {settings.steps} steps; expected "
        f"{POSE_NUMBERS}, 95 % band {low:.2f} to {high:.2f}"
    )
    yield (
        f"{'heading noise':>13}  {'landmarks':<12}  {'filter':<34} {'NEES':>7} {'last':>7} "
        f"{'in band':>8}  {'heading error':>13}"
    )
    filters = [
        ("localizer, exact map", localized(0.0, "considered")),
        ("localizer, map of 5 cm, considered", localized(_MAP_SIGMA_M, "considered")),
        ("localizer, map of 5 cm, white", localized(_MAP_SIGMA_M, "white")),
        ("localizer, map of 5 cm, ignored", localized(_MAP_SIGMA_M, "ignored")),
        ("EKF-SLAM, Jacobians at latest", mapped("latest")),
        ("EKF-SLAM, Jacobians at first", mapped("first")),
    ]
    kinds = [("discs", {"lines": 0}), ("discs, lines", {"lines": 25})]
    for degrees in settings.turn_sigma_deg:
        for landmarks, change in kinds:
            scenario = replace(
                Scenario(steps=settings.steps, turn_sigma_rad=float(np.radians(degrees))), **change
            )
            for name, estimate in filters:
                found = assess(scenario, estimate, settings.runs, settings.seed)
                yield (
                    f"{degrees:9.1f} deg  {landmarks:<12}  {name:<34} {found.overall:7.2f} "
                    f"{found.mean[-1]:7.2f} {found.inside:8.1%}  "
                    f"{np.degrees(found.heading_error_rad):9.1f} deg"
                )


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    settings = tyro.cli(Settings, prog="consistency", args=arguments)
    for line in report(settings):
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
