"""Lasers against the truth of simulated sessions."""

from __future__ import annotations

import io
import json
import math
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from redetect.groundtruth.cli import main as groundtruth
from redetect.groundtruth.errors import GroundTruthError
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
from redetect.groundtruth.trajectories.streams import (
    matched_streams,
    pose_differences,
    read_planar_poses,
)
from redetect.groundtruth.validation.scoring import score_poses
from redetect.landmarks import squared_mahalanobis
from tools.arrays import BoolArray, FloatArray
from tools.evaluation.tables import Table
from tools.simulator.laser.session_files import write_session
from tools.simulator.laser.settings import Faults, LaserSettings

_COLUMNS = {
    "sets": ".0f", "found": ".4f", "mm": ".2f", "max_mm": ".1f", "deg": "7.4f", "abs_deg": ".3f",
    "max_deg": ".2f", "nees": "6.3f", "lost_s": ".2f", "disturbed": ".3f", "scanner_mm": ".2f",
    "scanner_deg": ".3f", "scanner_nees": ".2f", "set_ms": ".3f", "speed": ".0f",
}  # fmt: skip


def run_groundtruth(*arguments: object) -> None:
    """Run a command of `groundtruth` quietly, and fail if it does."""
    out = io.StringIO()
    words = [*map(str, arguments), "--force"]
    with redirect_stdout(out):
        code = groundtruth(words)
    if code != 0:
        raise GroundTruthError(f"groundtruth {' '.join(words)} ended with {code}: {out.getvalue()}")


def table_of_sessions(
    columns: Mapping[str, str], seeds: range, measure: Callable[[Path, int], dict[str, float]]
) -> tuple[Table, FloatArray]:
    """Measure a session, in a folder of its own, for each seed, and print a row of it.

    Returns the rows (N, columns), too.
    """
    table, rows = Table({"seed": "<5", **columns}), []
    for seed in seeds:
        try:
            with tempfile.TemporaryDirectory() as folder:
                row = measure(Path(folder), seed)
        except GroundTruthError as error:
            print(f"{seed:4d} left out: {error}")
            continue
        rows.append([row[key] for key in columns])
        table.row(str(seed), *rows[-1])
    return table, np.array(rows)


@dataclass(frozen=True)
class LaserSessions:
    """Simulate sessions, align scanners, track the robot, and print errors against the truth."""

    seeds: int = 20  # Seeds first, first + 1, ...
    first: int = 1
    scanners: Literal["aligned", "true"] = "aligned"
    """`aligned`: by `groundtruth lasers` from poses measured by hand; `true`: the exact ones."""
    fault: Literal["none", "crossing", "moved", "rectangle"] = "none"
    """`crossing`: somebody passes right beside the robot; `moved`: a scanner is knocked by 50 mm
    after the empty area was scanned; `rectangle`: the outline does not show the front."""
    visits: int = 2
    visit_s: float = 60.0
    average: int = 6  # Sets of scans per pose.

    def __call__(self) -> int:
        seeds = range(self.first, self.first + self.seeds)
        table, rows = table_of_sessions(_COLUMNS, seeds, self._measured)
        table.row("mean", *np.mean(rows, axis=0))
        if len(rows) > 1:
            table.row("std", *np.std(rows, axis=0, ddof=1))
        return 0

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
        if self.scanners == "aligned":
            run_groundtruth("lasers", session, "-o", aligned)
        calibration = exact if self.scanners == "true" else aligned
        scanners, robot, tables, sets = load_session(session, calibration)
        rows = slice(0, 50)
        first = replace(
            sets, times_s=sets.times_s[rows], rows=sets.rows[rows], ages_s=sets.ages_s[rows]
        )
        track_robot(first, tables, robot)  # compiles
        began = time.process_time()
        track, left_out = track_without_suspects(sets, tables, robot, scanners)
        elapsed = time.process_time() - began
        if left_out:
            print(f"     left out: {', '.join(left_out)}")
        disturbed = np.sum((track.beams[:, 3] + track.beams[:, 5]) >= 3)
        return {
            "sets": float(len(sets)),
            **errors_in_room(session, track, self.average),
            **scanner_errors(read_scanners(calibration), read_scanners(exact)),
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
    with_pose = wanted & np.isin(track.status, (OK, REACQUIRED, UNDETERMINED))
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
