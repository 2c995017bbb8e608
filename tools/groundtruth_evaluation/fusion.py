"""Simulated sessions through all of it: lasers, laser, sync and fuse, each against the exact truth.

    python -m tools.groundtruth_evaluation.fusion --seeds 20

The commands are run as a user would, on sessions that `tools.simulator laser-session` makes.
"""

from __future__ import annotations

import io
import json
import tempfile
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Optional

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.stats import chi2

from redetect.groundtruth.cli import main as groundtruth
from redetect.groundtruth.clocks.clock import ClockSegment, read_clock
from redetect.groundtruth.trajectories.streams import PlanarPoses, read_planar_poses
from redetect.groundtruth.validation.scoring import compare_streams
from tools.simulator.laser.session_files import write_session
from tools.simulator.laser.settings import Faults, LaserSettings

FloatArray = NDArray[np.float64]
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


@dataclass(frozen=True)
class FusionStudy:
    """Simulate sessions, run the commands, and print errors against the truth.

    Parameters
    ----------
    seeds : int
        Seeds first, first + 1, ...
    first : int
    folder : Path
        Where sessions are kept; by default they are thrown away.
    fault : str
        What goes wrong: the robot's `clock` is set by 0.3 s, the `camera` or the `laser` is lost
        for a while, a `scanner` is knocked after the empty area was scanned, somebody is `crossing`
        right beside the robot.
    visits : int
    """

    seeds: int = 20
    first: int = 1
    folder: Optional[Path] = None  # noqa: UP045
    fault: Fault = "none"
    visits: int = 3


def perform(study: FusionStudy) -> int:
    """Go through the seeds and print a line for each, then the means."""
    print(
        "seed  clock ms  ppm  told    laser mm  NEES    fused: seen mm  NEES   bridged mm  NEES"
        "   rejected restarts"
    )
    rows = []
    with ExitStack() as stack:
        folder = study.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for seed in range(study.first, study.first + study.seeds):
            row = one_session(folder / f"{study.fault}{study.visits}-{seed}", seed, study)
            rows.append(row)
            print(
                f"{seed:4d} {row['clock_ms']:9.2f} {row['clock_ppm']:5.1f} {row['told']:4.0f}  "
                f"{row['laser_mm']:9.2f} {row['laser_nees']:6.2f} {row['seen_mm']:12.2f} "
                f"{row['seen_nees']:7.2f} {row['bridged_mm']:11.1f} {row['bridged_nees']:6.2f} "
                f"{row['rejected']:9.0f} {row['restarts']:6.0f}",
                flush=True,
            )
    mean = {key: float(np.nanmean([row[key] for row in rows])) for key in rows[0]}
    worst = {key: float(np.nanmax([row[key] for row in rows])) for key in rows[0]}
    instants = [row["instant_nees"] for row in rows]
    band = chi2.ppf([0.025, 0.975], 3 * len(rows)) / (3 * len(rows))
    print(
        f"of {len(rows)}: clock {mean['clock_ms']:.2f} ms (worst {worst['clock_ms']:.2f}), "
        f"{mean['clock_ppm']:.1f} ppm (worst {worst['clock_ppm']:.1f}); laser "
        f"{mean['laser_mm']:.2f} mm, {mean['laser_deg']:.3f} deg, NEES {mean['laser_nees']:.2f}; "
        f"fused where the laser sees {mean['seen_mm']:.2f} mm (rms {mean['seen_rms_mm']:.2f}, "
        f"laser's {mean['laser_rms_mm']:.2f}, camera's {mean['camera_rms_mm']:.1f}), "
        f"{mean['seen_deg']:.3f} deg, NEES {mean['seen_nees']:.2f}; bridged "
        f"{mean['bridged_mm']:.1f} mm, NEES {mean['bridged_nees']:.2f}; "
        f"NEES at one instant per session {np.mean(instants):.2f} "
        f"(95 % band {band[0]:.2f} to {band[1]:.2f})"
    )
    return 0


def one_session(session: Path, seed: int, study: FusionStudy) -> dict[str, float]:
    """Run the commands on one session and measure their results."""
    if not (session / "truth.json").exists():
        settings = replace(LaserSettings(), visits=study.visits, faults=_FAULTS[study.fault])
        write_session(settings, session, seed=seed)
    at = {name: str(session / f"{name}.csv") for name in ("odometry", "laser", "camera", "fused")}
    clock = str(session / "clock.json")
    _run("lasers", str(session))
    _run("laser", str(session))
    _run("sync", at["odometry"], at["laser"], "-o", clock)
    streams = ["--laser", at["laser"], "--camera", at["camera"]]
    _run("fuse", at["odometry"], *streams, "--clock", clock, "-o", at["fused"])

    truth = read_planar_poses(session / "truth.csv")
    laser, camera, fused = (
        read_planar_poses(session / f"{name}.csv") for name in ("laser", "camera", "fused")
    )
    seen = _seen_by(laser, fused.times_s)
    alone = compare_streams(laser, truth)
    inside = compare_streams(_some(fused, seen), truth)
    bridged = compare_streams(_some(fused, ~seen), truth)
    instant = _some(fused, np.arange(len(fused)) == np.flatnonzero(seen)[np.sum(seen) // 3])
    account = json.loads((session / "fused.json").read_text())
    return {
        **_clock_errors(session, list(read_clock(clock).segments)),
        "laser_mm": 1e3 * alone.position_mean_m,
        "laser_rms_mm": 1e3 * alone.position_rmse_m,
        "laser_deg": float(np.degrees(alone.angle_sigma_rad)),
        "laser_nees": alone.normalised_error,
        "camera_rms_mm": 1e3 * compare_streams(camera, truth).position_rmse_m,
        "seen_mm": 1e3 * inside.position_mean_m,
        "seen_rms_mm": 1e3 * inside.position_rmse_m,
        "seen_deg": float(np.degrees(inside.angle_sigma_rad)),
        "seen_nees": inside.normalised_error,
        "bridged_mm": 1e3 * bridged.position_mean_m,
        "bridged_nees": bridged.normalised_error,
        "instant_nees": compare_streams(instant, truth).normalised_error,
        "rejected": float(len(account["rejected"])),
        "restarts": float(len(account["restarts_s"])),
    }


def _run(*arguments: str) -> None:
    """Run a command of `groundtruth`, and fail if it does."""
    out = io.StringIO()
    with redirect_stdout(out):
        code = groundtruth([*arguments, "--force"])
    if code != 0:
        raise RuntimeError(f"groundtruth {' '.join(arguments)} ended with {code}: {out.getvalue()}")


def _seen_by(laser: PlanarPoses, times_s: FloatArray) -> NDArray[np.bool_]:
    """Which times lie between poses of the laser that follow each other closely."""
    after = np.clip(np.searchsorted(laser.times_s, times_s), 1, len(laser) - 1)
    close = laser.times_s[after] - laser.times_s[after - 1] < _CONTINUOUS_S
    inside = (times_s >= laser.times_s[0]) & (times_s <= laser.times_s[-1])
    return np.asarray(close & inside)


def _some(poses: PlanarPoses, which: NDArray[np.bool_]) -> PlanarPoses:
    assert poses.covariances is not None
    return PlanarPoses(poses.times_s[which], poses.poses[which], poses.covariances[which])


def _clock_errors(session: Path, segments: list[ClockSegment]) -> dict[str, float]:
    """Largest errors of offset (ms) and rate (ppm) over the segments that are told."""
    pieces = json.loads((session / "truth.json").read_text())["clock"]["pieces"]
    told = [segment for segment in segments if segment.status != "no turns"]
    offsets, rates = [], []
    for segment in told:
        begun = [p for p in pieces if p["from_s"] is None or p["from_s"] <= segment.reference_s]
        piece = begun[-1]
        exact = piece["offset_s"] + piece["drift"] * (segment.reference_s - piece["reference_s"])
        offsets.append(1e3 * abs(segment.offset_s - exact))
        rates.append(1e6 * abs(segment.rate - 1.0 - piece["drift"]))
    return {
        "clock_ms": max(offsets, default=np.nan),
        "clock_ppm": max(rates, default=np.nan),
        "told": float(len(told)),
    }


if __name__ == "__main__":
    raise SystemExit(perform(tyro.cli(FusionStudy, description=FusionStudy.__doc__)))
