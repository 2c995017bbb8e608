"""Lasers against the truth: simulated sessions, and scans of a real log."""

from __future__ import annotations

import gzip
import io
import json
import math
import tempfile
import time
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tyro.conf import Positional, arg

from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.lasers.scanners import Scanner, read_scanners
from redetect.groundtruth.lasers.sets import load_session
from redetect.groundtruth.lasers.tracking import (
    OK,
    REACQUIRED,
    UNDETERMINED,
    LaserTrack,
    combined_poses,
    track_robot,
    track_without_suspects,
)
from redetect.groundtruth.trajectories.streams import read_planar_poses
from redetect.landmarks import wrap_angle
from redetect.plane import between
from tools.arrays import BoolArray, FloatArray
from tools.evaluation.scan_matching import match_scans
from tools.evaluation.tables import Table

_COLUMNS = {
    "sets": ".0f", "found": ".4f", "mm": ".2f", "max_mm": ".1f", "deg": "7.4f", "abs_deg": ".3f",
    "max_deg": ".2f", "nees": "6.3f", "lost_s": ".2f", "disturbed": ".3f", "scanner_mm": ".2f",
    "scanner_deg": ".3f", "scanner_nees": ".2f", "set_ms": ".3f", "speed": ".0f",
}  # fmt: skip


@dataclass(frozen=True)
class LaserSessions:
    """Simulate sessions, align scanners, track the robot, and print errors against the truth."""

    seeds: int = 20  # Seeds first, first + 1, ...
    first: int = 1
    folder: Path | None = None  # Where sessions are kept; by default they are thrown away.
    scanners: Literal["aligned", "true"] = "aligned"
    """`aligned`: by `groundtruth lasers` from poses measured by hand; `true`: the exact ones."""
    fault: Literal["none", "crossing", "moved", "rectangle"] = "none"
    """`crossing`: somebody passes right beside the robot; `moved`: a scanner is knocked by 50 mm
    after the empty area was scanned; `rectangle`: the outline does not show the front."""
    visits: int = 2
    visit_s: float = 60.0
    average: int = 6  # Sets of scans per pose.

    def __call__(self) -> int:
        table = Table({"seed": "<5", **_COLUMNS})
        rows = []
        with ExitStack() as stack:
            folder = self.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
            for seed in range(self.first, self.first + self.seeds):
                try:
                    session = _session(self, seed, folder)
                except GroundTruthError as error:
                    print(f"{seed:4d} not simulated: {error}")
                    continue
                row = one_session(session, self)
                rows.append([row[key] for key in _COLUMNS])
                table.row(str(seed), *rows[-1])
        table.row("mean", *np.mean(rows, axis=0))
        if len(rows) > 1:
            table.row("std", *np.std(rows, axis=0, ddof=1))
        return 0


def one_session(session: Path, options: LaserSessions) -> dict[str, float]:
    """Errors of one session."""
    calibration, scanner_errors = _calibration(session, options)
    scanners, robot, tables, sets = load_session(session, calibration)
    track_robot(_first(sets), tables, robot)  # compiles
    began = time.process_time()
    track, left_out = track_without_suspects(sets, tables, robot, scanners)
    elapsed = time.process_time() - began
    if left_out:
        print(f"     left out: {', '.join(left_out)}")
    disturbed = np.sum((track.beams[:, 3] + track.beams[:, 5]) >= 3)
    span_s = float(sets.times_s[-1] - sets.times_s[0])
    return {
        "sets": float(len(sets)),
        **errors_in_room(session, track, options.average),
        **scanner_errors,
        "disturbed": float(disturbed / len(sets)),
        "set_ms": 1e3 * elapsed / len(sets),
        "speed": span_s / elapsed,
    }


def errors_in_room(session: Path, track: LaserTrack, sets_per_pose: int) -> dict[str, float]:
    """Errors of the poses while the robot is in the room, and how many sets have one."""
    truth = read_planar_poses(session / "truth.csv")
    visits = json.loads((session / "truth.json").read_text())["visits"]

    def inside(times_s: FloatArray) -> BoolArray:
        found = np.zeros(len(times_s), dtype=np.bool_)
        for begin, end in visits:
            found |= (times_s >= begin) & (times_s <= end)
        return found

    poses = combined_poses(track, sets_per_pose)
    chosen = inside(poses.times_s)
    wanted = inside(track.times_s)
    with_pose = wanted & np.isin(track.status, (OK, REACQUIRED, UNDETERMINED))
    if not chosen.any() or poses.covariances is None:
        return dict.fromkeys(
            ("found", "mm", "max_mm", "deg", "abs_deg", "max_deg", "nees", "lost_s"), math.nan
        )
    t = poses.times_s[chosen]
    heading = np.unwrap(truth.poses[:, 2])
    columns = (truth.poses[:, 0], truth.poses[:, 1], heading)
    error = poses.poses[chosen] - np.column_stack([np.interp(t, truth.times_s, v) for v in columns])
    error[:, 2] = wrap_angle(error[:, 2])
    shift, turn = 1e3 * np.hypot(error[:, 0], error[:, 1]), np.degrees(error[:, 2])
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(poses.covariances[chosen]), error)
    return {
        "found": float(with_pose.sum() / wanted.sum()),
        "mm": float(shift.mean()),
        "max_mm": float(shift.max()),
        "deg": float(turn.mean()),
        "abs_deg": float(np.abs(turn).mean()),
        "max_deg": float(np.abs(turn).max()),
        "nees": float(squared.mean() / 3.0),
        "lost_s": float((wanted & ~with_pose).sum() / 75.0),
    }


def _session(options: LaserSessions, seed: int, folder: Path) -> Path:
    from tools.simulator.laser.session_files import write_session
    from tools.simulator.laser.settings import LaserSettings

    session = folder / f"{options.fault}{seed}"
    if (session / "truth.json").is_file():
        return session
    settings = LaserSettings(
        visits=options.visits, visit_s=options.visit_s, between_s=45.0,
        references=3 * options.visits, onboard_hz=5.0,
    )  # fmt: skip
    faults = settings.faults
    if options.fault == "crossing":
        faults = replace(faults, crossing=True)
    if options.fault == "moved":
        faults = replace(faults, moved_scanner="fixed2", by=(0.04, -0.03, 0.01))
    cut = 0.0 if options.fault == "rectangle" else settings.front_cut_m
    settings = replace(settings, faults=faults, front_cut_m=cut)
    session.mkdir(parents=True, exist_ok=True)
    write_session(settings, session, seed=seed, overwrite=True)
    return session


def _calibration(session: Path, options: LaserSessions) -> tuple[Path, dict[str, float]]:
    """The scanners' file to track with, and its errors."""
    exact = session / "scanners.truth.json"
    if options.scanners == "true":
        return exact, {"scanner_mm": 0.0, "scanner_deg": 0.0, "scanner_nees": 0.0}
    from redetect.groundtruth.commands.lasers import perform as align
    from redetect.groundtruth.commands.options import Lasers

    output = session / "aligned.json"
    with redirect_stdout(io.StringIO()):
        align(Lasers(session, output=output, force=True))
    return output, scanner_errors(read_scanners(output), read_scanners(exact))


def scanner_errors(found: tuple[Scanner, ...], exact: tuple[Scanner, ...]) -> dict[str, float]:
    """Mean errors of the scanners' poses, and the mean normalised error squared."""
    error = np.array([f.pose - e.pose for f, e in zip(found, exact)])
    error[:, 2] = wrap_angle(error[:, 2])
    nees = [float(e @ np.linalg.solve(f.covariance, e)) / 3.0 for e, f in zip(error, found)]
    return {
        "scanner_mm": float(1e3 * np.hypot(error[:, 0], error[:, 1]).mean()),
        "scanner_deg": float(np.degrees(np.abs(error[:, 2])).mean()),
        "scanner_nees": float(np.mean(nees)),
    }


def _first(sets: Any) -> Any:
    """A few sets."""
    rows = slice(0, 50)
    return replace(sets, times_s=sets.times_s[rows], rows=sets.rows[rows], ages_s=sets.ages_s[rows])


def read_log(folder: Path, name: str, shortest_m: float) -> tuple[list[FloatArray], FloatArray]:
    """Points of the scans and their reference poses. Returns `poses` (N, 3)."""
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


@dataclass(frozen=True)
class LaserLog:
    """Match the consecutive scans of a log from zero motion and print the errors."""

    folder: Positional[Path]  # With the log's scans and poses.
    log: str = ""  # Its name; by default that of the only ``*.scans.csv.gz``.
    every: int = 1  # Only every so many-th pair.
    heading_step_deg: float = 10.0
    """Distance of the headings that the matching begins from; 360: only no motion at all."""
    shortest_m: float = 0.05  # Shorter readings are taken for none.
    worst: Annotated[int, arg(aliases=["-n"])] = 0  # So many of the worst pairs are listed.

    def __call__(self) -> int:
        points, poses = read_log(self.folder, self.log, self.shortest_m)
        pairs = np.arange(0, len(points) - 1, self.every)
        found = np.full((len(pairs), 3), np.nan)
        share = np.zeros((len(pairs), 2))
        ambiguous = np.zeros(len(pairs), dtype=np.bool_)
        covariances = np.tile(np.eye(3), (len(pairs), 1, 1))
        began = time.perf_counter()
        for row, i in enumerate(pairs):
            try:
                match = match_scans(
                    points[i + 1], points[i], heading_step_deg=self.heading_step_deg
                )
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
            print(
                f"gross failures: median squared error, normalised, {np.median(normalised) / 3:.1f}"
            )
        for percent in (50, 90, 95):
            print(
                f"{percent:3d} %: {np.percentile(shift_m, percent):.4f} m "
                f"{np.percentile(turn_deg, percent):.3f} deg"
            )
        for row in np.argsort(-np.maximum(shift_m / 0.15, turn_deg / 3.0))[: self.worst]:
            print(
                f"pair {pairs[row]}: found {found[row].round(3)} reference {truth[row].round(3)} "
                f"explained {share[row, 0]:.2f} rival {share[row, 1]:.2f}"
            )
        return 0
