"""Maps from detected discs against maps from true ones with the same noise, end to end.

Each detected row gets the identifier of the true disc next to it, within its gate; rows of no disc
have none. The same rows at their true places, with errors drawn from their own covariances, say
what a detector could reach whose covariances are right. Or the file's own identifiers are taken
(`slam associate`), and a disc of the map is held against the true one that most of its rows show.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray

from redetect.landmarks import squared_mahalanobis
from redetect.slam.errors import SlamError
from redetect.slam.mapping.run_map import MappedRun, map_run
from redetect.slam.models.measurement import disc_in_robot
from redetect.slam.recording import UNKNOWN_ID, CircleRows, Recording, read_recording
from tools.slam_evaluation.map_truth import Truth, path_distance, read_truth

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: The robot's frame is uncertain by this much beyond a row's covariance when a disc is looked for.
_SWAY_M = 0.10
_GATE = 13.8  # chi-squared of two numbers, 99.9 %


@dataclass(frozen=True)
class Settings:
    """Compare maps from detected and from true discs."""

    run: Annotated[Path, tyro.conf.Positional]
    """Simulated run folder (with truth.json)."""
    detected: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """The .circles files that detectors wrote of it."""
    own_ids: bool = False
    """Take the files' identifiers."""
    seeds: int = 20
    """Maps from true discs."""


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
    root = np.linalg.cholesky(circles.covariance[known])
    xy = circles.xy.copy()
    xy[known] = disc_in_robot(truth.poses[circles.frame[known] + 1], places)
    xy[known] += np.einsum("nij,nj->ni", root, rng.standard_normal((len(known), 2)))
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
    path, _ = path_distance(mapped.estimate.poses, truth)
    return np.array([np.sqrt(np.mean(off)), path])


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    settings = tyro.cli(Settings, prog="map-redetected", args=arguments)
    truth = read_truth(settings.run)
    print(
        f"{'rows':<26}{'used':>6}{'discs':>7}{'false':>7}{'factor':>8}"
        f"{'discs off':>11}{'path off':>11}{'true discs':>12}{'path':>9}{'ratios':>13}"
    )
    for path in settings.detected:
        recording = read_recording(path)
        ids = true_ids(recording.circles, truth)
        if not np.any(ids != UNKNOWN_ID):
            raise SlamError(f"{path}: no row is near a true disc: expected a file of this run")
        used = ids
        if settings.own_ids:
            used = recording.circles.ids
        mapped = map_run(
            replace(recording, circles=replace(recording.circles, ids=used)), name=str(path)
        )
        discs = shown(used, ids, mapped.graph.disc_ids)
        off = errors_of(mapped, discs, truth)
        ideal = []
        for seed in range(settings.seeds):
            true = map_run(with_true_places(recording, ids, truth, seed))
            ideal.append(errors_of(true, true.graph.disc_ids, truth) ** 2)
        best = np.sqrt(np.mean(ideal, axis=0))
        print(
            f"{path.name:<26}{mapped.table.measurements:>6}{mapped.table.landmarks:>7}"
            f"{int(np.sum(discs == UNKNOWN_ID)):>7}"
            f"{mapped.table.factor:>8.2f}{off[0]:>9.4f} m{off[1]:>9.4f} m{best[0]:>10.4f} m"
            f"{best[1]:>7.4f} m{off[0] / best[0]:>7.2f}{off[1] / best[1]:>6.2f}"
        )
    return 0
