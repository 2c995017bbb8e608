"""Time of a map against plain GTSAM on the same factors, side by side in one process."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from redetect.slam.mapping.graph import Estimate, Graph, first_sight, graph_of_recording
from redetect.slam.mapping.graph_terms import Weighting, cost
from redetect.slam.mapping.solve import solve
from redetect.slam.mapping.solve_gtsam import estimate_of_values, gtsam_problem, load_gtsam
from redetect.slam.recording import read_recording

#: A run that GTSAM takes from odometry: what it is, and how many of its steps lead how far.
Outcome = tuple[float, int]


@dataclass(frozen=True)
class Settings:
    """Time the least squares of a run."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder or .circles file."""
    repeats: int = 3
    """Rounds, in each of which every solver has its turn."""
    most_steps: int = 100
    """GTSAM's default."""


def plain_gtsam(kind: str, most_steps: int) -> Callable[[Graph, Estimate], Outcome]:
    """One of GTSAM's optimizers with its own default parameters, from odometry and first sight."""
    gtsam = load_gtsam()

    def run(graph: Graph, start: Estimate) -> Outcome:
        factors, values = gtsam_problem(graph, start, Weighting())
        parameters: Any = getattr(gtsam, f"{kind}Params")()
        parameters.setMaxIterations(most_steps)
        optimizer = getattr(gtsam, f"{kind}Optimizer")(factors, values, parameters)
        found = estimate_of_values(graph, optimizer.optimize(), start)
        return cost(graph, found, Weighting()), int(optimizer.iterations())

    return run


def separable(graph: Graph, start: Estimate) -> Outcome:
    """The project's own."""
    solution = solve(graph, start, Weighting())
    return solution.cost, len(solution.costs) - 1


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    settings = tyro.cli(Settings, prog="map-speed", args=arguments)
    graph = graph_of_recording(read_recording(settings.run))
    start = first_sight(graph)
    solvers: dict[str, Callable[[Graph, Estimate], Outcome]] = {"separable (slam map)": separable}
    for kind in ("LevenbergMarquardt", "Dogleg", "GaussNewton"):
        solvers[f"GTSAM {kind}"] = plain_gtsam(kind, settings.most_steps)
    seconds: dict[str, list[float]] = {name: [] for name in solvers}
    reached: dict[str, Outcome] = {}
    for _ in range(settings.repeats):
        for name, run in solvers.items():
            begin = time.perf_counter()
            reached[name] = run(graph, start)
            seconds[name].append(time.perf_counter() - begin)
    own = min(seconds["separable (slam map)"])
    print(
        f"{'solver':<28}{'steps':>6}{'chi-squared':>14}{'least s':>9}{'median s':>10}{'ratio':>7}"
    )
    for name, times in seconds.items():
        chi_squared, steps = reached[name]
        print(
            f"{name:<28}{steps:>6}{chi_squared:>14.2f}{min(times):>9.2f}"
            f"{float(np.median(times)):>10.2f}{own / min(times):>7.2f}"
        )
    print("ratio: time of slam map's solver by that of the row's, least of each")
    return 0
