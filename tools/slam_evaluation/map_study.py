"""Least-squares maps of simulated runs: chi-squared, distance from the truth, time.

Each run is mapped three times: as simulated (odometry wrong on the outside stretch); with odometry
whose covariances are right everywhere; and so with all covariances overconfident by 2.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from redetect.slam.mapping.chi_squared import ChiSquared
from redetect.slam.mapping.run_map import MappedRun, map_run
from redetect.slam.models.motion import relative_pose
from redetect.slam.recording import Recording, read_recording
from tools.simulator.odometry import step_covariance
from tools.slam_evaluation.map_truth import Distance, Truth, distance, path_distance, read_truth


@dataclass(frozen=True)
class Settings:
    """Map simulated runs (python -m tools.simulator rows) and compare with their truth."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run folders."""
    overconfidence: float = 2.0
    """Factor that the file's variances are too small by, in the last variant."""
    seed: int = 1
    """Of the odometry that takes the place of the wrong one."""


@dataclass(frozen=True)
class Result:
    """One map."""

    run: str
    variant: str
    table: ChiSquared
    before_rms_m: float
    after: Distance
    seconds: float


def with_right_odometry(recording: Recording, truth: Truth, seed: int) -> Recording:
    """A run whose wrong steps are measured anew, with errors as their covariances say."""
    rng = np.random.default_rng(seed)
    true = relative_pose(truth.poses[:-1], truth.poses[1:])
    root = np.linalg.cholesky(step_covariance(true))
    fresh = true + np.einsum("nij,nj->ni", root, rng.standard_normal(true.shape))
    wrong = truth.wrong_odometry
    steps, covariance = recording.steps.copy(), recording.step_covariance.copy()
    steps[wrong] = fresh[wrong]
    covariance[wrong] = step_covariance(steps[wrong])
    return replace(recording, steps=steps, step_covariance=covariance)


def overconfident(recording: Recording, factor: float) -> Recording:
    """A run whose covariances are too small by a factor."""
    circles = replace(recording.circles, covariance=recording.circles.covariance / factor)
    return replace(recording, circles=circles, step_covariance=recording.step_covariance / factor)


def study(run: Path, settings: Settings) -> Iterator[Result]:
    """Map one run in all variants."""
    recording, truth = read_recording(run), read_truth(run)
    right = with_right_odometry(recording, truth, settings.seed)
    variants = {
        "as simulated": recording,
        "right covariances": right,
        f"overconfident by {settings.overconfidence:g}": overconfident(
            right, settings.overconfidence
        ),
    }
    for name, variant in variants.items():
        begin = time.perf_counter()
        mapped: MappedRun = map_run(variant, name=str(run))
        seconds = time.perf_counter() - begin
        before, _ = path_distance(mapped.start.poses, truth)
        yield Result(run.name, name, mapped.table, before, distance(mapped, truth), seconds)


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    settings = tyro.cli(Settings, prog="map", args=arguments)
    print(
        f"{'run':<8}{'variant':<22}{'p':>6}{'n':>5}{'m':>7}{'chi-sq.':>11}{'expected':>10}"
        f"{'factor':>8}{'path before':>13}{'after':>8}{'discs':>8}{'NEES/2':>8}{'s':>7}"
    )
    for run in settings.runs:
        for r in study(run, settings):
            t, d = r.table, r.after
            print(
                f"{r.run:<8}{r.variant:<22}{t.poses:>6}{t.landmarks:>5}{t.measurements:>7}"
                f"{t.chi_squared:>11.1f}{t.expected:>10}{t.factor:>8.3f}{r.before_rms_m:>11.2f} m"
                f"{d.path_rms_m:>6.2f} m{d.discs_rms_m:>6.2f} m{d.discs_nees / 2:>8.2f}"
                f"{r.seconds:>7.2f}",
                flush=True,
            )
    return 0
