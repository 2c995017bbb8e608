"""Least-squares maps of runs whose truth is known: chi-squared, distance from the truth, time."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tyro.conf import Positional

from redetect.array_types import BoolArray, FloatArray
from redetect.landmarks import squared_mahalanobis
from redetect.plane import between
from redetect.slam.mapping.graph import Estimate, Graph, first_sight, graph_of_recording
from redetect.slam.mapping.graph_terms import Weighting, cost
from redetect.slam.mapping.run_map import MappedRun, map_run
from redetect.slam.mapping.solve import solve
from redetect.slam.mapping.solve_gtsam import estimate_of_values, gtsam_problem, load_gtsam
from redetect.slam.models import disc_in_robot
from redetect.slam.recording import Recording, read_recording
from tools.benchmark.timing import measure_in_turn
from tools.evaluation.figures import Figures, Study, demand_some
from tools.evaluation.tables import Table
from tools.simulator.driving import step_covariance


class Truth(NamedTuple):
    """True poses and places of discs, in the frame of the start."""

    poses: FloatArray  # (N + 1, 3)
    discs: dict[int, FloatArray]  # (2,) by number
    wrong_odometry: BoolArray  # (N,) Steps whose odometry errs beyond its covariance.


def read_truth(run: Path) -> Truth:
    """Read a simulated run's ``truth.json``."""
    truth = json.loads((run / "truth.json").read_text(encoding="utf-8"))
    start = np.array(truth["start"])
    world = np.array([truth["start"], *(frame["pose"] for frame in truth["frames"])])
    poses = between(start, world)
    poses[:, 2] = np.unwrap(poses[:, 2])
    return Truth(
        poses=poses,
        discs={d["id"]: disc_in_robot(start, d["xy"]) for d in truth["discs"]},
        wrong_odometry=np.array([frame["wrong_odometry"] for frame in truth["frames"]]),
    )


def path_distance(poses: FloatArray, truth: Truth) -> float:
    """Root mean square distance of positions from the truth (m)."""
    return float(np.sqrt(np.mean(np.sum((poses - truth.poses)[:, :2] ** 2, axis=1))))


def disc_errors(mapped: MappedRun, truth: Truth) -> tuple[float, float]:
    """Root mean square distance of discs from the truth (m), and their mean NEES per number."""
    off = mapped.estimate.disc_xy - [truth.discs[int(i)] for i in mapped.graph.disc_ids]
    nees = np.mean(squared_mahalanobis(off, mapped.covariance.discs))
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))), float(nees) / 2.0


def with_right_odometry(recording: Recording, truth: Truth, seed: int) -> Recording:
    """A run whose wrong steps are measured again, with errors that agree with the covariances."""
    rng = np.random.default_rng(seed)
    true = between(truth.poses[:-1], truth.poses[1:])
    root = np.linalg.cholesky(step_covariance(true))
    fresh = true + np.einsum("nij,nj->ni", root, rng.standard_normal(true.shape))
    wrong = truth.wrong_odometry
    steps, covariance = recording.steps.copy(), recording.step_covariance.copy()
    steps[wrong] = fresh[wrong]
    covariance[wrong] = step_covariance(steps[wrong])
    return replace(recording, steps=steps, step_covariance=covariance)


@dataclass(frozen=True)
class MapStudy(Study):
    """Map simulated runs (python -m tools.simulator rows) and compare them with their truth.

    Each is mapped twice: as simulated (with wrong odometry outdoors), and with odometry
    whose covariances are right everywhere.
    """

    runs: Positional[tuple[Path, ...]]  # Run folders.
    seed: int = 1  # Of the odometry that replaces the wrong one.

    def measure(self) -> Figures:
        demand_some(self.runs, "runs")
        table = Table(
            {"run": "<8", "variant": "<20", "p": "5d", "n": "4d", "m": "6d", "chi-sq.": "9.1f",
             "expected": "d", "factor": "6.3f", "path before / m": ".2f", "after / m": ".2f",
             "discs / m": ".2f", "NEES/2": ".2f", "s": "6.2f"}, keys=2
        )  # fmt: skip
        for run in self.runs:
            recording, truth = read_recording(run), read_truth(run)
            right = with_right_odometry(recording, truth, self.seed)
            for name, variant in (("as simulated", recording), ("right covariances", right)):
                begin = time.perf_counter()
                mapped = map_run(variant, name=str(run))
                seconds = time.perf_counter() - begin
                t = mapped.table
                table.row(
                    run.name, name, t.poses, t.landmarks, t.measurements, t.chi_squared,
                    t.expected, t.factor, path_distance(mapped.start.poses, truth),
                    path_distance(mapped.estimate.poses, truth), *disc_errors(mapped, truth),
                    seconds,
                )  # fmt: skip
        return table.figures


def _plain_gtsam(kind: str, graph: Graph, start: Estimate) -> tuple[float, int]:
    """One of GTSAM's optimizers with its own default parameters: cost and number of steps."""
    gtsam = load_gtsam()
    factors, values = gtsam_problem(graph, start)
    parameters: Any = getattr(gtsam, f"{kind}Params")()
    optimizer = getattr(gtsam, f"{kind}Optimizer")(factors, values, parameters)
    found = estimate_of_values(graph, optimizer.optimize(), start)
    return cost(graph, found, Weighting()), int(optimizer.iterations())


@dataclass(frozen=True)
class MapSpeed(Study):
    """Compare the time of a run's least squares with plain GTSAM on the same factors."""

    run: Positional[Path]  # Run folder or .circles file.
    repeats: int = 3  # Number of rounds, each with every solver, in one process.

    def measure(self) -> Figures:
        graph = graph_of_recording(read_recording(self.run))
        start = first_sight(graph)

        def separable() -> tuple[float, int]:
            solution = solve(graph, start, Weighting())
            return solution.costs[-1], len(solution.costs) - 1

        own = "separable (slam map)"
        solvers: dict[str, Callable[[], tuple[float, int]]] = {own: separable}
        for kind in ("LevenbergMarquardt", "Dogleg", "GaussNewton"):
            solvers[f"GTSAM {kind}"] = partial(_plain_gtsam, kind, graph, start)
        reached: dict[str, tuple[float, int]] = {}

        def timed(name: str, _: int) -> None:
            reached[name] = solvers[name]()

        functions = {name: partial(timed, name) for name in solvers}
        seconds = measure_in_turn(
            functions, 1, self.repeats, np.inf, time.perf_counter, warm_up=False
        )
        table = Table(
            {"solver": "<26", "steps": "d", "chi-squared": ".2f", "least s": ".2f",
             "median s": ".2f", "ratio": ".2f"}
        )  # fmt: skip
        for name, times in seconds.items():
            chi_squared, steps = reached[name]
            ratio = seconds[own].min() / times.min()
            table.row(name, steps, chi_squared, times.min(), np.median(times), ratio)
        print("ratio: time of slam map's solver by that of the row's, least of each")
        return table.figures
