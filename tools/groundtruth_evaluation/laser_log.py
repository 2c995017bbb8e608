"""Consecutive scans of a real laser log matched without odometry, against a graph's poses.

    python -m tools.groundtruth_evaluation.laser_log FOLDER

FOLDER holds ``<log>.scans.csv.gz`` (vertex, time, readings in metres from -90 degrees on, one per
degree unless ``<log>.meta.json`` says otherwise) and ``<log>.poses.csv`` (vertex, x, y, theta).
"""

from __future__ import annotations

import gzip
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray
from tyro.conf import Positional, arg

from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.geometry.plane import between
from redetect.groundtruth.lasers.icp_scans import ScanMatchSettings, match_scans
from redetect.landmarks import wrap_angle

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class LaserLog:
    """Match the consecutive scans of a log from zero motion and print the errors.

    Parameters
    ----------
    folder : Path
        With the log's scans and poses.
    log : str
        Its name; by default that of the only ``*.scans.csv.gz``.
    every : int
        Only every so many-th pair.
    heading_step_deg : float
        Distance of the headings that the matching begins from; 360: only no motion at all.
    shortest_m : float
        Shorter readings are taken for none.
    worst : int
        So many of the worst pairs are listed.
    """

    folder: Positional[Path]
    log: str = ""
    every: int = 1
    heading_step_deg: float = ScanMatchSettings().heading_step_deg
    shortest_m: float = 0.05
    worst: Annotated[int, arg(aliases=["-n"])] = 0


def read_log(folder: Path, name: str, shortest_m: float) -> tuple[list[FloatArray], FloatArray]:
    """Points of the scans and their reference poses.

    Returns
    -------
    points : list of (n, 2) float64
        In the scanner's frame, in the order of the beams (m).
    poses : (N, 3) float64
        x, y (m), theta (rad) in the world.
    """
    if not name:
        names = sorted(p.name.removesuffix(".scans.csv.gz") for p in folder.glob("*.scans.csv.gz"))
        if len(names) != 1:
            raise GroundTruthError(f"{folder}: {len(names)} logs: expected one, or --log")
        name = names[0]
    meta = {"start_angle_rad": -np.pi / 2, "angle_step_rad": np.pi / 180, "max_range_m": 50.0}
    described = folder / f"{name}.meta.json"
    if described.is_file():
        meta |= json.loads(described.read_text())
    with gzip.open(folder / f"{name}.scans.csv.gz", "rt") as stream:
        rows = np.loadtxt(stream, delimiter=",")
    poses = np.loadtxt(folder / f"{name}.poses.csv", delimiter=",")
    if len(rows) != len(poses) or not np.array_equal(rows[:, 0], poses[:, 0]):
        raise GroundTruthError(f"{folder}: scans and poses of {name} are of different vertices")
    ranges = rows[:, 2:]
    angles = meta["start_angle_rad"] + meta["angle_step_rad"] * np.arange(ranges.shape[1])
    beams = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    hit = (ranges > shortest_m) & (ranges < meta["max_range_m"])
    return [r[h, None] * beams[h] for r, h in zip(ranges, hit)], poses[:, 1:4]


def perform(options: LaserLog) -> int:
    """Match, and print the table."""
    points, poses = read_log(options.folder, options.log, options.shortest_m)
    settings = ScanMatchSettings(heading_step_deg=options.heading_step_deg)
    pairs = np.arange(0, len(points) - 1, options.every)
    match_scans(points[1], points[0], settings)  # compiles
    found = np.full((len(pairs), 3), np.nan)
    share = np.zeros((len(pairs), 2))
    ambiguous = np.zeros(len(pairs), dtype=np.bool_)
    covariances = np.tile(np.eye(3), (len(pairs), 1, 1))
    began = time.perf_counter()
    for row, i in enumerate(pairs):
        try:
            match = match_scans(points[i + 1], points[i], settings)
        except GeometryError:
            continue
        ambiguous[row], covariances[row] = match.ambiguous, match.covariance
        found[row], share[row] = match.pose, (match.explained, match.rival)
    elapsed = time.perf_counter() - began
    truth = between(poses[:-1], poses[1:])[pairs]
    shift_m = np.hypot(*(found[:, :2] - truth[:, :2]).T)
    turn_deg = np.degrees(np.abs(wrap_angle(found[:, 2] - truth[:, 2])))
    shift_m, turn_deg = (np.where(np.isnan(e), np.inf, e) for e in (shift_m, turn_deg))
    gross = (shift_m > 0.15) | (turn_deg > 3.0)
    print(f"pairs {len(pairs)}, {1e3 * elapsed / len(pairs):.1f} ms each")
    print(f"gross failures (> 0.15 m or > 3 deg): {100 * gross.mean():.2f} % ({gross.sum()})")
    print(
        f"gross failures that are not flagged: {100 * np.mean(gross & ~ambiguous):.2f} % "
        f"({np.sum(gross & ~ambiguous)}); flagged: {np.sum(gross & ambiguous)} of them, "
        f"{np.sum(~gross & ambiguous)} of {np.sum(~gross)} others"
    )
    if np.any(gross & ~np.isnan(found[:, 0])):
        rows = gross & np.isfinite(covariances).all(axis=(1, 2)) & ~np.isnan(found[:, 0])
        error = found[rows] - truth[rows]
        error[:, 2] = wrap_angle(error[:, 2])
        normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariances[rows]), error)
        print(f"gross failures: median squared error, normalised, {np.median(normalised) / 3:.1f}")
    for percent in (50, 90, 95):
        print(
            f"{percent:3d} %: {np.percentile(shift_m, percent):.4f} m "
            f"{np.percentile(turn_deg, percent):.3f} deg"
        )
    for row in np.argsort(-np.maximum(shift_m / 0.15, turn_deg / 3.0))[: options.worst]:
        print(
            f"pair {pairs[row]}: found {found[row].round(3)} reference {truth[row].round(3)} "
            f"explained {share[row, 0]:.2f} rival {share[row, 1]:.2f}"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(perform(tyro.cli(LaserLog)))
