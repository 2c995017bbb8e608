"""The fusion against the exact truth of simulated sessions."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.stats import chi2

from redetect.groundtruth.clocks.clock import ClockSegment, read_clock
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    matched_streams,
    read_planar_poses,
)
from redetect.groundtruth.validation.scoring import score_poses
from tools.arrays import BoolArray, FloatArray
from tools.evaluation.lasers import run_groundtruth, table_of_sessions
from tools.simulator.laser.session_files import write_session
from tools.simulator.laser.settings import Faults, LaserSettings

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


_COLUMNS = {
    "clock_ms": ".2f", "clock_ppm": ".1f", "segments": ".0f", "laser_mm": ".2f",
    "laser_rms_mm": ".2f", "laser_deg": ".3f", "laser_nees": ".2f", "camera_rms_mm": ".1f",
    "seen_mm": ".2f", "seen_rms_mm": ".2f", "seen_deg": ".3f", "seen_nees": ".2f",
    "bridged_mm": ".1f", "bridged_nees": ".2f", "instant_nees": ".2f", "rejected": ".0f",
    "restarts": ".0f",
}  # fmt: skip


@dataclass(frozen=True)
class FusionStudy:
    """Simulate sessions, run lasers, laser, sync and fuse, and compare each with the exact truth.

    Segments of the clock, the lasers' poses, fused poses where the laser sees the robot, bridged
    ones, and the NEES at one instant of each session.
    """

    seeds: int = 20  # Seeds first, first + 1, ...
    first: int = 1
    fault: Fault = "none"
    """What goes wrong: the robot's `clock` is set by 0.3 s, the `camera` or the `laser` is lost for
    a while, a `scanner` is knocked after the empty area was scanned, somebody is `crossing` right
    beside the robot."""
    visits: int = 3

    def __call__(self) -> int:
        settings = LaserSettings(visits=self.visits, faults=_FAULTS[self.fault])

        def measured(session: Path, seed: int) -> dict[str, float]:
            write_session(settings, session, seed=seed)
            return errors_of_session(session)

        seeds = range(self.first, self.first + self.seeds)
        table, rows = table_of_sessions(_COLUMNS, seeds, measured)
        table.row("mean", *np.nanmean(rows, axis=0))
        table.row("worst", *np.nanmax(rows, axis=0))
        band = chi2.ppf([0.025, 0.975], 3 * len(rows)) / (3 * len(rows))
        print(f"95 % band of the mean NEES at one instant: {band[0]:.2f} to {band[1]:.2f}")
        return 0


def errors_of_session(session: Path) -> dict[str, float]:
    """Run the commands on one session and measure their results."""
    at = {name: session / f"{name}.csv" for name in ("odometry", "laser", "camera", "fused")}
    clock = session / "clock.json"
    run_groundtruth("lasers", session)
    run_groundtruth("laser", session)
    run_groundtruth("sync", at["odometry"], at["laser"], "-o", clock)
    streams = ["--laser", at["laser"], "--camera", at["camera"]]
    run_groundtruth("fuse", at["odometry"], *streams, "--clock", clock, "-o", at["fused"])

    truth = read_planar_poses(session / "truth.csv")
    laser, camera, fused = (read_planar_poses(at[name]) for name in ("laser", "camera", "fused"))
    seen = _seen_by(laser, fused.times_s)
    alone = score_poses(*matched_streams(laser, truth))
    inside = score_poses(*matched_streams(fused.only(seen), truth))
    bridged = score_poses(*matched_streams(fused.only(~seen), truth))
    instant = fused.only(np.arange(len(fused)) == np.flatnonzero(seen)[np.sum(seen) // 3])
    account = json.loads((session / "fused.json").read_text())
    return {
        **_clock_errors(session, list(read_clock(clock).segments)),
        "laser_mm": 1e3 * alone.position_mean_m,
        "laser_rms_mm": 1e3 * alone.position_rmse_m,
        "laser_deg": float(np.degrees(alone.angle_sigma_rad)),
        "laser_nees": alone.normalised_error,
        "camera_rms_mm": 1e3 * score_poses(*matched_streams(camera, truth)).position_rmse_m,
        "seen_mm": 1e3 * inside.position_mean_m,
        "seen_rms_mm": 1e3 * inside.position_rmse_m,
        "seen_deg": float(np.degrees(inside.angle_sigma_rad)),
        "seen_nees": inside.normalised_error,
        "bridged_mm": 1e3 * bridged.position_mean_m,
        "bridged_nees": bridged.normalised_error,
        "instant_nees": score_poses(*matched_streams(instant, truth)).normalised_error,
        "rejected": float(len(account["rejected"])),
        "restarts": float(len(account["restarts_s"])),
    }


def _seen_by(laser: PlanarPoses, times_s: FloatArray) -> BoolArray:
    """Which times lie between poses of the laser that follow each other closely."""
    after = np.clip(np.searchsorted(laser.times_s, times_s), 1, len(laser) - 1)
    close = laser.times_s[after] - laser.times_s[after - 1] < _CONTINUOUS_S
    inside = (times_s >= laser.times_s[0]) & (times_s <= laser.times_s[-1])
    return np.asarray(close & inside)


def _clock_errors(session: Path, segments: list[ClockSegment]) -> dict[str, float]:
    """Largest errors of offset (ms) and rate (ppm) over the segments with turns."""
    pieces = json.loads((session / "truth.json").read_text())["clock"]["pieces"]
    turning = [segment for segment in segments if segment.status != "no turns"]
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
