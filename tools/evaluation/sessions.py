"""Lasers, clocks and fusion against the exact truth of simulated sessions."""

from __future__ import annotations

import json
import math
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.stats import chi2

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.fusion.clock import ClockSegment, read_clock
from redetect.groundtruth.lasers.acquisition import load_session
from redetect.groundtruth.lasers.scanners import Scanner, read_scanners
from redetect.groundtruth.lasers.tracking import (
    LaserTrack,
    SetStatus,
    combined_poses,
    track_by_lasers,
    track_without_suspects,
)
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    matched_streams,
    read_planar_poses,
)
from redetect.groundtruth.validation.scoring import score_poses
from redetect.landmarks import squared_mahalanobis
from redetect.plane import pose_differences
from tools.evaluation.figures import Figures, Study, StudyError, run_program
from tools.evaluation.tables import Table
from tools.simulator.laser.session_files import write_session
from tools.simulator.laser.settings import Faults, LaserSettings

_LASER_COLUMNS = {
    "sets": ".0f", "found": ".4f", "mm": ".2f", "max_mm": ".1f", "deg": "7.4f", "abs_deg": ".3f",
    "max_deg": ".2f", "nees": "6.3f", "lost_s": ".2f", "disturbed": ".3f", "scanner_mm": ".2f",
    "scanner_deg": ".3f", "scanner_nees": ".2f", "set_ms": ".3f", "speed": ".0f",
}  # fmt: skip


@dataclass(frozen=True)
class _Sessions(Study):
    """Simulated sessions."""

    seeds: int = 20  # Number of sessions, each with a seed of its own.
    first: int = 1  # The first of the seeds, which follow each other.

    def table_of(
        self, columns: Mapping[str, str], measure: Callable[[Path, int], dict[str, float]]
    ) -> tuple[Table, FloatArray]:
        """Measure a session in a folder of its own for each seed: table, and rows (N, columns)."""
        table, rows = Table({"seed": "<5", **columns}), []
        for seed in range(self.first, self.first + self.seeds):
            try:
                with tempfile.TemporaryDirectory() as folder:
                    row = measure(Path(folder), seed)
            except (GroundTruthError, StudyError) as error:
                print(f"{seed:4d} left out: {error}")
                continue
            rows.append([row[key] for key in columns])
            table.row(str(seed), *rows[-1])
        if not rows:
            raise StudyError("no session is left: expected at least one")
        return table, np.array(rows)


@dataclass(frozen=True)
class LaserSessions(_Sessions):
    """Simulate sessions, align scanners, track the robot, and print errors against the truth."""

    fault: Literal["none", "crossing", "moved", "rectangle"] = "none"
    """`crossing`: somebody passes right beside the robot; `moved`: a scanner is knocked by 50 mm
    after the empty area was scanned; `rectangle`: the outline does not show the front."""
    visits: int = 2  # Visits to the covered room.
    visit_s: float = 60.0  # About how long each of them lasts.
    average: int = 6  # Sets of scans per pose.

    def measure(self) -> Figures:
        table, rows = self.table_of(_LASER_COLUMNS, self._measured)
        table.row("mean", *np.mean(rows, axis=0))
        if len(rows) > 1:
            table.row("std", *np.std(rows, axis=0, ddof=1))
        return table.figures

    def _measured(self, session: Path, seed: int) -> dict[str, float]:
        """Errors of one session."""
        faults = Faults(crossing=self.fault == "crossing")
        if self.fault == "moved":
            faults = Faults(moved_scanner="fixed2", by=(0.04, -0.03, 0.01))
        settings = LaserSettings(
            visits=self.visits, visit_s=self.visit_s, between_s=45.0, references=3 * self.visits,
            onboard_hz=5.0, faults=faults,
        )  # fmt: skip
        if self.fault == "rectangle":
            settings = replace(settings, front_cut_m=0.0)
        write_session(settings, session, seed=seed)
        exact, aligned = session / "scanners.truth.json", session / "aligned.json"
        run_program("groundtruth", "lasers", session, "-o", aligned)
        scanners, robot, tables, sets, _ = load_session(session, aligned)
        rows = slice(0, 50)
        first = replace(
            sets, times_s=sets.times_s[rows], rows=sets.rows[rows], ages_s=sets.ages_s[rows]
        )
        track_by_lasers(first, tables, robot)  # compiles
        began = time.process_time()
        track, left_out = track_without_suspects(sets, tables, robot, scanners)
        elapsed = time.process_time() - began
        if left_out:
            print(f"     left out: {', '.join(left_out)}")
        disturbed = np.sum((track.beams[:, 3] + track.beams[:, 5]) >= 3)
        return {
            "sets": float(len(sets)),
            **errors_in_room(session, track, self.average),
            **scanner_errors(read_scanners(aligned), read_scanners(exact)),
            "disturbed": float(disturbed / len(sets)),
            "set_ms": 1e3 * elapsed / len(sets),
            "speed": float(sets.times_s[-1] - sets.times_s[0]) / elapsed,
        }


def errors_in_room(session: Path, track: LaserTrack, sets_per_pose: int) -> dict[str, float]:
    """Errors of the poses while the robot is in the room, and how many sets have one."""
    visits = np.array(json.loads((session / "truth.json").read_text())["visits"])

    def inside(times_s: FloatArray) -> BoolArray:
        after, before = times_s >= visits[:, :1], times_s <= visits[:, 1:]
        return np.asarray((after & before).any(axis=0))

    poses = combined_poses(track, sets_per_pose)
    poses = poses.only(inside(poses.times_s))
    wanted = inside(track.times_s)
    undetermined = track.status == SetStatus.UNDETERMINED_DIRECTION
    with_pose = wanted & (track.is_determined | undetermined)
    score = score_poses(*matched_streams(poses, read_planar_poses(session / "truth.csv")))
    return {
        "found": float(with_pose.sum() / wanted.sum()),
        "mm": 1e3 * score.position_mean_m,
        "max_mm": 1e3 * score.position_max_m,
        "deg": math.degrees(score.angle_mean_rad),
        "abs_deg": math.degrees(score.angle_abs_mean_rad),
        "max_deg": math.degrees(score.angle_max_rad),
        "nees": score.normalised_error,
        "lost_s": float((wanted & ~with_pose).sum() / 75.0),
    }


def scanner_errors(found: tuple[Scanner, ...], exact: tuple[Scanner, ...]) -> dict[str, float]:
    """Mean errors of the scanners' poses, and the mean normalised error squared."""
    error = pose_differences(*(np.array([s.pose for s in of]) for of in (found, exact)))
    covariances = np.array([scanner.covariance for scanner in found])
    known = covariances.any()
    nees = squared_mahalanobis(error, covariances).mean() / 3.0 if known else 0.0
    return {
        "scanner_mm": float(1e3 * np.hypot(error[:, 0], error[:, 1]).mean()),
        "scanner_deg": float(np.degrees(np.abs(error[:, 2])).mean()),
        "scanner_nees": float(nees),
    }


Fault = Literal["none", "clock", "camera", "laser", "scanner", "crossing"]

_CONTINUOUS_S = 0.5
_FAULTS: dict[Fault, Faults] = {
    "none": Faults(),
    "clock": Faults(clock_jump_s=0.3),
    "camera": Faults(lost_camera_s=20.0),
    "laser": Faults(lost_laser_s=10.0),
    "scanner": Faults(moved_scanner="fixed0", by=(0.05, 0.0, 0.0)),
    "crossing": Faults(crossing=True),
}


_FUSION_COLUMNS = {
    "clock_ms": ".2f", "clock_ppm": ".1f", "segments": ".0f", "laser_mm": ".2f",
    "laser_rms_mm": ".2f", "laser_deg": ".3f", "laser_nees": ".2f", "camera_rms_mm": ".1f",
    "seen_mm": ".2f", "seen_rms_mm": ".2f", "seen_deg": ".3f", "seen_nees": ".2f",
    "bridged_mm": ".1f", "bridged_nees": ".2f", "instant_nees": ".2f", "rejected": ".0f",
    "restarts": ".0f",
}  # fmt: skip


@dataclass(frozen=True)
class FusionStudy(_Sessions):
    """Simulate sessions, run lasers, laser, sync and fuse, and compare each with the exact truth.

    Segments of the clock, the lasers' poses, fused poses where the laser sees the robot, bridged
    ones, and the NEES at one instant of each session.
    """

    fault: Fault = "none"
    """What goes wrong: the robot's `clock` is set by 0.3 s, the `camera` or the `laser` is lost for
    a while, a `scanner` is knocked after the empty area was scanned, somebody is `crossing` right
    beside the robot."""
    visits: int = 3  # Visits to the covered room.

    def measure(self) -> Figures:
        settings = LaserSettings(visits=self.visits, faults=_FAULTS[self.fault])

        def measured(session: Path, seed: int) -> dict[str, float]:
            write_session(settings, session, seed=seed)
            return errors_of_session(session)

        table, rows = self.table_of(_FUSION_COLUMNS, measured)
        table.row("mean", *np.nanmean(rows, axis=0))
        table.row("worst", *np.nanmax(rows, axis=0))
        band = chi2.ppf([0.025, 0.975], 3 * len(rows)) / (3 * len(rows))
        print(f"95 % band of the mean NEES at one instant: {band[0]:.2f} to {band[1]:.2f}")
        return {**table.figures, "band": band}


def errors_of_session(session: Path) -> dict[str, float]:
    """Run the commands on one session and measure their results."""
    at = {name: session / f"{name}.csv" for name in ("odometry", "laser", "camera", "fused")}
    clock = session / "clock.json"
    streams = ["--laser", at["laser"], "--camera", at["camera"]]
    for words in (
        ("lasers", session),
        ("laser", session),
        ("sync", at["odometry"], at["laser"], "-o", clock),
        ("fuse", at["odometry"], *streams, "--clock", clock, "-o", at["fused"]),
    ):
        run_program("groundtruth", *words)
    truth = read_planar_poses(session / "truth.csv")
    laser, camera, fused = (read_planar_poses(at[name]) for name in ("laser", "camera", "fused"))
    seen = _seen_by(laser, fused.times_s)
    instant = np.arange(len(fused)) == np.flatnonzero(seen)[np.sum(seen) // 3]
    parts = (fused.only(which) for which in (seen, ~seen, instant))
    names = ("laser", "camera", "seen", "bridged", "instant")
    account = json.loads((session / "fused.json").read_text())
    errors = {
        **_clock_errors(session, list(read_clock(clock).segments)),
        "rejected": float(len(account["rejected"])),
        "restarts": float(len(account["restarts_s"])),
    }
    for name, poses in zip(names, (laser, camera, *parts), strict=True):
        score = score_poses(*matched_streams(poses, truth))
        errors[f"{name}_mm"] = 1e3 * score.position_mean_m
        errors[f"{name}_rms_mm"] = 1e3 * score.position_rmse_m
        errors[f"{name}_deg"] = math.degrees(score.angle_sigma_rad)
        errors[f"{name}_nees"] = score.normalised_error
    return errors


def _seen_by(laser: PlanarPoses, times_s: FloatArray) -> BoolArray:
    """Which times lie between poses of the laser that follow each other closely."""
    after = np.clip(np.searchsorted(laser.times_s, times_s), 1, len(laser) - 1)
    close = laser.times_s[after] - laser.times_s[after - 1] < _CONTINUOUS_S
    inside = (times_s >= laser.times_s[0]) & (times_s <= laser.times_s[-1])
    return np.asarray(close & inside)


def _clock_errors(session: Path, segments: list[ClockSegment]) -> dict[str, float]:
    """Largest errors of offset (ms) and rate (ppm) over the segments with turns."""
    pieces = json.loads((session / "truth.json").read_text())["clock"]["pieces"]
    turning = [segment for segment in segments if segment.is_determined]
    offsets, rates = [], []
    for segment in turning:
        begun = [p for p in pieces if p["from_s"] is None or p["from_s"] <= segment.reference_s]
        piece = begun[-1]
        exact = piece["offset_s"] + piece["drift"] * (segment.reference_s - piece["reference_s"])
        offsets.append(1e3 * abs(segment.offset_s - exact))
        rates.append(1e6 * abs(segment.rate - 1.0 - piece["drift"]))
    return {
        "clock_ms": max(offsets, default=np.nan),
        "clock_ppm": max(rates, default=np.nan),
        "segments": float(len(turning)),
    }
