"""Simulated sessions: scanners aligned, the robot tracked, both against the exact truth.

    python -m tools.groundtruth_evaluation.laser_session --seeds 20

Sessions that stand in the folder already are not simulated again. Errors count where the robot is
in the covered room.
"""

from __future__ import annotations

import io
import json
import math
import tempfile
import time
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Optional

import numpy as np
import tyro
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.blocks import combined_poses
from redetect.groundtruth.lasers.scanners import Scanner, read_scanners
from redetect.groundtruth.lasers.session import load_session
from redetect.groundtruth.lasers.suspects import track_robot, track_without_suspects
from redetect.groundtruth.lasers.tracking import OK, REACQUIRED, UNDETERMINED, LaserTrack
from redetect.groundtruth.trajectories.streams import read_planar_poses
from redetect.landmarks import wrap_angle

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class LaserSessions:
    """Simulate sessions, align the scanners, track the robot, and print errors against the truth.

    Parameters
    ----------
    seeds : int
        Seeds first, first + 1, ...
    first : int
    folder : Path
        Where sessions are kept; by default they are thrown away.
    scanners : str
        `aligned`: by `groundtruth lasers` from poses measured by hand; `true`: the exact ones.
    fault : str
        `crossing`: somebody passes right beside the robot; `moved`: a scanner is knocked by 50 mm
        after the empty area was scanned; `rectangle`: the outline does not show the front.
    visits : int
    visit_s : float
    average : int
        Sets of scans per pose.
    """

    seeds: int = 20
    first: int = 1
    folder: Optional[Path] = None  # noqa: UP045
    scanners: Literal["aligned", "true"] = "aligned"
    fault: Literal["none", "crossing", "moved", "rectangle"] = "none"
    visits: int = 2
    visit_s: float = 60.0
    average: int = 6


def perform(options: LaserSessions) -> int:
    """Go through the seeds and print a line for each, then the means."""
    rows = []
    print(
        "seed   sets found  mean mm  max mm  mean deg  mean |deg|  max deg   NEES  lost s"
        "  scanners mm / deg / NEES  ms per set  x real time"
    )
    with ExitStack() as stack:
        folder = options.folder
        if folder is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for seed in range(options.first, options.first + options.seeds):
            try:
                session = _session(options, seed, folder)
            except GroundTruthError as error:
                print(f"{seed:4d} not simulated: {error}")
                continue
            row = one_session(session, options)
            rows.append(row)
            print(
                f"{seed:4d} {row['sets']:6.0f} {100 * row['found']:5.1f} {row['mm']:8.2f} "
                f"{row['max_mm']:7.1f} {row['deg']:9.4f} {row['abs_deg']:11.3f} "
                f"{row['max_deg']:8.2f} {row['nees']:6.3f} {row['lost_s']:7.2f}  "
                f"{row['scanner_mm']:6.2f} {row['scanner_deg']:6.3f} {row['scanner_nees']:6.2f} "
                f"{row['set_ms']:11.3f} {row['speed']:8.0f}",
                flush=True,
            )
    mean = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
    spread = np.std([row["nees"] for row in rows], ddof=1) if len(rows) > 1 else 0.0
    print(
        f"mean of {len(rows)}: {mean['mm']:.2f} mm, {mean['deg']:.4f} deg, "
        f"|.| {mean['abs_deg']:.3f} deg, NEES {mean['nees']:.3f} (sessions scatter by "
        f"{spread:.3f}), found {100 * mean['found']:.2f} %, scanners {mean['scanner_mm']:.2f} mm "
        f"{mean['scanner_deg']:.3f} deg NEES {mean['scanner_nees']:.2f}, "
        f"{mean['set_ms']:.3f} ms per set, {100 * mean['disturbed']:.1f} % disturbed"
    )
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

    def inside(times_s: FloatArray) -> NDArray[np.bool_]:
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


if __name__ == "__main__":
    raise SystemExit(perform(tyro.cli(LaserSessions)))
