"""Least-squares maps of runs whose truth is known: chi-squared, distance from the truth, time."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from camera import Camera
from redetect.landmarks import squared_mahalanobis
from redetect.plane import between
from redetect.slam.commands.files import camera_of_run
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import Estimate, Graph, first_sight, graph_of_recording
from redetect.slam.mapping.graph_terms import RowErrors, Weighting, cost, errors
from redetect.slam.mapping.run_map import MappedRun, map_run
from redetect.slam.mapping.solve import solve
from redetect.slam.mapping.solve_gtsam import estimate_of_values, gtsam_problem, load_gtsam
from redetect.slam.models import disc_in_robot
from redetect.slam.mounting import rotation_exp, rows_through_mounting
from redetect.slam.recording import UNKNOWN_ID, CircleRows, Recording, read_recording
from tools.arrays import BoolArray, FloatArray, IntArray
from tools.evaluation.tables import Table
from tools.simulator.driving import step_covariance


@dataclass(frozen=True, eq=False)
class Truth:
    """Where everything really is, in the frame of the start."""

    poses: FloatArray  # (N + 1, 3)
    discs: dict[int, FloatArray]  # (2,) by number
    edges: dict[int, FloatArray]  # (2,) by number
    wrong_odometry: BoolArray  # (N,) Steps whose odometry errs beyond its covariance.


@dataclass(frozen=True)
class Distance:
    """Distances from the truth."""

    path_rms_m: float  # Of positions along the path.
    discs_rms_m: float
    discs_nees: float  # Mean normalised error squared of a disc; 2 where the covariances are right.


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
        edges={e["id"]: disc_in_robot(start, e["xy"]) for e in truth["edges"]},
        wrong_odometry=np.array([frame["wrong_odometry"] for frame in truth["frames"]]),
    )


def path_distance(poses: FloatArray, truth: Truth) -> float:
    """Root mean square distance of positions from the truth (m)."""
    return float(np.sqrt(np.mean(np.sum((poses - truth.poses)[:, :2] ** 2, axis=1))))


def distance(mapped: MappedRun, truth: Truth) -> Distance:
    """Compare a map with the truth."""
    rms = path_distance(mapped.estimate.poses, truth)
    true = np.array([truth.discs[int(i)] for i in mapped.graph.disc_ids])
    off = mapped.estimate.disc_xy - true
    discs_rms = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    nees = float(np.mean(squared_mahalanobis(off, mapped.covariance.discs)))
    return Distance(rms, discs_rms, nees)


def drawn(covariance: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(n, d) errors drawn from covariances (n, d, d)."""
    root = np.linalg.cholesky(covariance)
    return np.asarray(np.einsum("nij,nj->ni", root, rng.standard_normal(root.shape[:2])))


def with_right_odometry(recording: Recording, truth: Truth, seed: int) -> Recording:
    """A run whose wrong steps are measured anew, with errors as their covariances say."""
    rng = np.random.default_rng(seed)
    true = between(truth.poses[:-1], truth.poses[1:])
    fresh = true + drawn(step_covariance(true), rng)
    wrong = truth.wrong_odometry
    steps, covariance = recording.steps.copy(), recording.step_covariance.copy()
    steps[wrong] = fresh[wrong]
    covariance[wrong] = step_covariance(steps[wrong])
    return replace(recording, steps=steps, step_covariance=covariance)


def overconfident(recording: Recording, factor: float) -> Recording:
    """A run whose covariances are too small by a factor."""
    circles = replace(recording.circles, covariance=recording.circles.covariance / factor)
    return replace(recording, circles=circles, step_covariance=recording.step_covariance / factor)


@dataclass(frozen=True)
class MapStudy:
    """Map simulated runs (python -m tools.simulator rows) and compare with their truth.

    Each is mapped three times: as simulated (odometry wrong on the outside stretch); with odometry
    whose covariances are right everywhere; and so with all covariances overconfident.
    """

    runs: Positional[tuple[Path, ...]]  # Run folders.
    overconfidence: float = 2.0  # Factor by which the last variant's variances are too small.
    seed: int = 1  # Of the odometry that takes the place of the wrong one.

    def __call__(self) -> int:
        table = Table(
            {"run": "<8", "variant": "<20", "p": "5d", "n": "4d", "m": "6d", "chi-sq.": "9.1f",
             "expected": "d", "factor": "6.3f", "path before / m": ".2f", "after / m": ".2f",
             "discs / m": ".2f", "NEES/2": ".2f", "s": "6.2f"}
        )  # fmt: skip
        for run in self.runs:
            recording, truth = read_recording(run), read_truth(run)
            right = with_right_odometry(recording, truth, self.seed)
            variants = {
                "as simulated": recording,
                "right covariances": right,
                f"overconfident by {self.overconfidence:g}": overconfident(
                    right, self.overconfidence
                ),
            }
            for name, variant in variants.items():
                begin = time.perf_counter()
                mapped = map_run(variant, name=str(run))
                seconds = time.perf_counter() - begin
                before = path_distance(mapped.start.poses, truth)
                t, d = mapped.table, distance(mapped, truth)
                table.row(
                    run.name, name, t.poses, t.landmarks, t.measurements, t.chi_squared,
                    t.expected, t.factor, before, d.path_rms_m, d.discs_rms_m, d.discs_nees / 2,
                    seconds,
                )  # fmt: skip
        return 0


#: The robot's frame is uncertain by this much beyond a row's covariance when a disc is looked for.
_SWAY_M = 0.10
_GATE = 13.8  # chi-squared of two numbers, 99.9 %


def true_ids(circles: CircleRows, truth: Truth) -> IntArray:
    """(n,) the true disc that each row shows, -1 for none; each disc once in a frame."""
    numbers = np.array(list(truth.discs), dtype=np.int64)
    places = np.array(list(truth.discs.values()))
    found = np.full(len(circles), UNKNOWN_ID, dtype=np.int64)
    for frame in np.unique(circles.frame):
        rows = np.flatnonzero(circles.frame == frame)
        true = disc_in_robot(truth.poses[frame + 1], places)
        spread = circles.covariance[rows] + _SWAY_M**2 * np.eye(2)
        off = circles.xy[rows, None] - true
        squared = squared_mahalanobis(off, np.broadcast_to(spread[:, None], (*off.shape, 2)))
        for row, disc in zip(*np.unravel_index(np.argsort(squared, axis=None), squared.shape)):
            if squared[row, disc] > _GATE:
                break
            if found[rows[row]] == UNKNOWN_ID and numbers[disc] not in found[rows]:
                found[rows[row]] = numbers[disc]
    return found


def with_true_places(recording: Recording, ids: IntArray, truth: Truth, seed: int) -> Recording:
    """The same rows where they should be, with errors as their covariances say."""
    circles = recording.circles
    known = np.flatnonzero(ids != UNKNOWN_ID)
    rng = np.random.default_rng(seed)
    places = np.array([truth.discs[int(i)] for i in ids[known]])
    xy = circles.xy.copy()
    xy[known] = disc_in_robot(truth.poses[circles.frame[known] + 1], places)
    xy[known] += drawn(circles.covariance[known], rng)
    return replace(recording, circles=replace(circles, xy=xy, ids=ids))


def shown(used: IntArray, ids: IntArray, numbers: IntArray) -> IntArray:
    """(M,) the true disc that most rows of each landmark show, -1 where they show none."""
    majority = []
    for number in numbers:
        values, counts = np.unique(ids[used == number], return_counts=True)
        majority.append(values[np.argmax(counts)])
    return np.array(majority, dtype=np.int64)


def errors_of(mapped: MappedRun, discs: IntArray, truth: Truth) -> FloatArray:
    """Root mean square errors of true discs seen more than once, and of the path (m)."""
    often = (mapped.graph.disc_row_counts > 1) & (discs != UNKNOWN_ID)
    true = np.array([truth.discs[int(i)] for i in discs[often]])
    off = np.sum((mapped.estimate.disc_xy[often] - true) ** 2, axis=1)
    path = path_distance(mapped.estimate.poses, truth)
    return np.array([np.sqrt(np.mean(off)), path])


@dataclass(frozen=True)
class MapRedetected:
    """Compare maps from detected discs with maps from true ones with the same noise.

    Each detected row gets the identifier of the true disc next to it, within its gate; rows of no
    disc have none. The same rows at their true places, with errors drawn from their own
    covariances, show what a detector could reach whose covariances are right. With `--own-ids` a
    disc of the map is compared with the true one that most of its rows show.
    """

    run: Positional[Path]  # Simulated run folder (with truth.json).
    detected: Positional[tuple[Path, ...]]  # The .circles files that detectors wrote of it.
    own_ids: bool = False  # Take the files' identifiers.
    seeds: int = 20  # Maps from true discs.

    def __call__(self) -> int:
        truth = read_truth(self.run)
        table = Table(
            {"rows": "<24", "used": "5d", "discs": "5d", "false": "5d", "factor": "6.2f",
             "discs off / m": ".4f", "path off / m": ".4f", "true discs / m": ".4f",
             "path / m": ".4f", "ratios": "6.2f", "": "4.2f"}
        )  # fmt: skip
        for path in self.detected:
            recording = read_recording(path)
            ids = true_ids(recording.circles, truth)
            if not np.any(ids != UNKNOWN_ID):
                raise SlamError(f"{path}: no row is near a true disc: expected a file of this run")
            used = recording.circles.ids if self.own_ids else ids
            mapped = map_run(
                replace(recording, circles=replace(recording.circles, ids=used)), name=str(path)
            )
            discs = shown(used, ids, mapped.graph.disc_ids)
            off = errors_of(mapped, discs, truth)
            ideal = []
            for seed in range(self.seeds):
                true = map_run(with_true_places(recording, ids, truth, seed))
                ideal.append(errors_of(true, true.graph.disc_ids, truth) ** 2)
            best = np.sqrt(np.mean(ideal, axis=0))
            table.row(
                path.name, mapped.table.measurements, mapped.table.landmarks,
                int(np.sum(discs == UNKNOWN_ID)), mapped.table.factor, *off, *best, *(off / best),
            )  # fmt: skip
        return 0


def miswritten(
    recording: Recording, truth: Truth, camera: Camera, change: FloatArray, seed: int
) -> Recording:
    """A run whose rows come from a camera that is mounted otherwise than calibrated."""
    circles = recording.circles
    known = np.flatnonzero(circles.ids >= 0)
    places = np.array([truth.discs[int(i)] for i in circles.ids[known]])
    seen = disc_in_robot(truth.poses[circles.frame[known] + 1], places)
    # The way back: through the camera as mounted, read by the camera as calibrated.
    turn, _ = rotation_exp(-change[:3])
    mounted = camera.centre + np.array([0.0, 0.0, change[3]])
    rays = np.column_stack([seen, np.zeros(len(seen))]) - mounted
    nominal = np.column_stack([camera.rotation, camera.centre])
    written, _ = rows_through_mounting(camera, rays @ turn.T, nominal)
    errors = drawn(circles.covariance[known], np.random.default_rng(seed))
    rows = replace(
        circles, frame=circles.frame[known], xy=written + errors,
        covariance=circles.covariance[known], ids=circles.ids[known],
    )  # fmt: skip
    return replace(recording, circles=rows)


@dataclass(frozen=True)
class MapCalibration:
    """Compare the mounting that `slam map --calibrate` finds with the true one.

    Rows of simulated runs (python -m tools.simulator rows) are written as a camera mounted
    otherwise than its calibration says would write them.
    """

    runs: Positional[tuple[Path, ...]]  # Run folders.
    rotation_rad: tuple[float, float, float] = (-0.0366, 0.0099, 0.0024)
    """How the camera is turned against its calibration: about robot x, y, z."""
    height_m: float = -0.0111  # How much higher it is.
    seed: int = 1  # Of all errors.

    def __call__(self) -> int:
        change = np.array([*self.rotation_rad, self.height_m])
        print("rotation x, y, z (rad) and height (m); off: in standard deviations")
        table = Table(
            {"run": "<8", "rows": "<10", "found": "<32", "sigma": "<32", "off": "<24",
             "factor": ".3f", "path / m": ".2f"}
        )  # fmt: skip
        table.row("true", "", _row(change), "", "", np.nan, np.nan)
        for run in self.runs:
            truth, camera = read_truth(run), camera_of_run(run)
            right = with_right_odometry(read_recording(run), truth, self.seed)
            written = miswritten(right, truth, camera, change, self.seed)
            ways: tuple[RowErrors, ...] = ("corrected", "recorded")
            for way in ways:
                mapped = map_run(written, camera, Weighting(calibrate=True, row_errors=way))
                assert mapped.mounting is not None
                found = mapped.mounting.change
                sigma = np.sqrt(np.diag(mapped.mounting.covariance))
                path = path_distance(mapped.estimate.poses, truth)
                off = " ".join(f"{x:5.1f}" for x in (found - change) / sigma)
                factor = mapped.table.factor
                table.row(run.name, way, _row(found), _row(sigma), off, factor, path)
        return 0


def _row(values: FloatArray) -> str:
    return " ".join(f"{value:7.4f}" for value in values)


#: What the published covariance of a row has whatever the row's place (m).
PUBLISHED_FLOOR_M = 0.04


def variants(recording: Recording) -> Iterator[tuple[str, Recording, Weighting]]:
    """Models by name."""
    recorded = Weighting(calibrate=True, row_errors="recorded")
    yield "as shipped", recording, Weighting()
    yield "mounting (rows corrected)", recording, Weighting(calibrate=True)
    yield "mounting (rows as recorded)", recording, recorded
    for degrees in (0.25, 0.5, 1.0):
        tilted = replace(recorded, tilt_sigma_rad=float(np.radians(degrees)))
        yield f"  and tilt of {degrees:g} deg", recording, tilted
    tilted = replace(recorded, tilt_sigma_rad=float(np.radians(0.5)))
    for floor in (0.02, 0.03, 0.05, 0.06):
        yield f"  tilt 0.5 deg, floor {floor:g} m", with_floor(recording, floor), tilted
    for factor in (0.25, 0.5):
        weighed = replace(recording, step_covariance=recording.step_covariance * factor)
        yield f"  tilt 0.5 deg, odometry x{factor:g}", weighed, tilted


def with_floor(recording: Recording, floor_m: float) -> Recording:
    """A run whose rows' covariances have another constant part."""
    change = (floor_m**2 - PUBLISHED_FLOOR_M**2) * np.eye(2)
    circles = replace(recording.circles, covariance=recording.circles.covariance + change)
    return replace(recording, circles=circles)


def log_determinants(recording: Recording) -> float:
    """Sum of the covariances' log determinants."""
    known = recording.circles.ids >= 0
    total = np.sum(np.linalg.slogdet(recording.circles.covariance[known])[1])
    total += np.sum(np.linalg.slogdet(recording.step_covariance)[1])
    return float(total)


@dataclass(frozen=True)
class MapModelling:
    """Try what takes chi-squared off a real run: mounting, tilt, other covariances.

    Where covariances differ chi-squared alone says nothing: -2 log likelihood is printed as well,
    against that of the first line.
    """

    run: Positional[Path]  # Run folder or .circles file with the published covariances.
    camera: Path | None = None  # Its calibration.

    def __call__(self) -> int:
        recording = read_recording(self.run)
        camera = camera_of_run(self.run, self.camera)
        table = Table(
            {"model": "<28", "chi-sq.": "9.1f", "expected": "d", "factor": "6.2f",
             "odometry": ".0f", "rows": "7.0f", "tilt": "6.0f", "rows > 4 s": "d",
             "-2 log L": ".0f"}
        )  # fmt: skip
        first: float | None = None
        for name, run, weighting in variants(recording):
            mapped = map_run(run, camera, weighting)
            t = mapped.table
            fit = t.chi_squared + log_determinants(run)
            first = fit if first is None else first
            off = errors(mapped.graph, mapped.estimate, weighting).discs
            far = int(np.sum(np.sum(off**2, axis=1) > 4.0**2))
            table.row(
                name, t.chi_squared, t.expected, t.factor, t.odometry, t.discs, t.tilt, far,
                fit - first,
            )  # fmt: skip
        return 0


def _plain_gtsam(kind: str, graph: Graph, start: Estimate) -> tuple[float, int]:
    """One of GTSAM's optimizers with its own default parameters: cost and number of steps."""
    gtsam = load_gtsam()
    factors, values = gtsam_problem(graph, start, Weighting())
    parameters: Any = getattr(gtsam, f"{kind}Params")()
    optimizer = getattr(gtsam, f"{kind}Optimizer")(factors, values, parameters)
    found = estimate_of_values(graph, optimizer.optimize(), start)
    return cost(graph, found, Weighting()), int(optimizer.iterations())


@dataclass(frozen=True)
class MapSpeed:
    """Time the least squares of a run beside plain GTSAM on the same factors, in one process."""

    run: Positional[Path]  # Run folder or .circles file.
    repeats: int = 3  # Rounds, in each of which every solver has its turn.

    def __call__(self) -> int:
        graph = graph_of_recording(read_recording(self.run))
        start = first_sight(graph)

        def separable() -> tuple[float, int]:
            solution = solve(graph, start, Weighting())
            return solution.cost, len(solution.costs) - 1

        own = "separable (slam map)"
        solvers: dict[str, Callable[[], tuple[float, int]]] = {own: separable}
        for kind in ("LevenbergMarquardt", "Dogleg", "GaussNewton"):
            solvers[f"GTSAM {kind}"] = partial(_plain_gtsam, kind, graph, start)
        seconds: dict[str, list[float]] = {name: [] for name in solvers}
        reached = {}
        for _ in range(self.repeats):
            for name, solver in solvers.items():
                begin = time.perf_counter()
                reached[name] = solver()
                seconds[name].append(time.perf_counter() - begin)
        table = Table(
            {"solver": "<26", "steps": "d", "chi-squared": ".2f", "least s": ".2f",
             "median s": ".2f", "ratio": ".2f"}
        )  # fmt: skip
        for name, times in seconds.items():
            chi_squared, steps = reached[name]
            ratio = min(seconds[own]) / min(times)
            table.row(name, steps, chi_squared, min(times), float(np.median(times)), ratio)
        print("ratio: time of slam map's solver by that of the row's, least of each")
        return 0
