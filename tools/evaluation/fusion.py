"""The fusion against the exact truth: whole sessions, gaps that odometry bridges, and time."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.stats import chi2

from redetect.groundtruth.clocks.clock import ClockSegment, read_clock
from redetect.groundtruth.fusion.fuse import Fusion, fuse
from redetect.groundtruth.fusion.inputs import FuseSettings
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    matched_streams,
    pose_differences,
    read_planar_poses,
)
from redetect.groundtruth.validation.scoring import score_poses
from redetect.landmarks import squared_mahalanobis, wrap_angle
from tools.arrays import BoolArray, FloatArray
from tools.evaluation.lasers import run_groundtruth, table_of_sessions
from tools.evaluation.tables import Table
from tools.simulator.laser.motion import Route, measured_path
from tools.simulator.laser.session_files import write_session
from tools.simulator.laser.settings import DrivingLimits, Faults, LaserSettings, WheelErrors

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


Odometry = Callable[[FloatArray, np.random.Generator], FloatArray]

_ODOMETRY_HZ = 50.0
#: How long poses are measured before and after a gap, how often, and their errors (m, m, rad).
_SEEN_S, _SEEN_HZ = 40.0, 25.0
_SEEN_SIGMAS = np.array([0.001, 0.001, np.radians(0.2)])
_TRACK_M = 0.4
_WHEEL_SIGMA_M = 0.0015
_WHEEL_SCALES = (1.006, 1.009)


@dataclass(frozen=True)
class GapStudy:
    """Fuse made-up drives with gaps that odometry bridges: how far errors and covariances agree.

    Robots drive straight or round bends, with odometry that errs in three ways, none of them taken
    from the estimator: as the simulated sessions' does, with sideways slip besides, and wheel by
    wheel. Printed is the NEES per number, 1 if covariances are right: in the gap's middle, by
    direction, near its end, in all of it, and outside.
    """

    seeds: int = 60  # Drives of each kind.
    gaps_s: tuple[float, ...] = (2.0, 10.0, 30.0, 120.0)  # How long nothing is measured.
    learn_noise: bool = True  # Let the fusion find how much odometry errs.

    def __call__(self) -> int:
        low, high = chi2.ppf([0.025, 0.975], 3 * self.seeds) / (3 * self.seeds)
        print(f"{self.seeds} drives; 95 % band of one instant each {low:.2f} to {high:.2f}")
        nees = ("middle", "along", "across", "turn", "near its end", "whole gap", "outside")
        table = Table(
            {"odometry": "<10", "path": "<8", "gap s": ".0f", "middle mm": ".1f",
             **dict.fromkeys(nees, "6.3f")}
        )  # fmt: skip
        means = []
        for name, odometry in _ODOMETRIES.items():
            for path in ("straight", "curved"):
                for gap_s in self.gaps_s:
                    settings = FuseSettings(learn_noise=self.learn_noise)
                    rows = [
                        one_drive(settings, odometry, path, gap_s, s) for s in range(self.seeds)
                    ]
                    means.append(np.mean(rows, axis=0))
                    table.row(name, path, gap_s, *means[-1])
        table.row("all", "", np.nan, *np.mean(means, axis=0))
        return 0


def one_drive(
    settings: FuseSettings, odometry: Odometry, path: str, gap_s: float, seed: int
) -> list[float]:
    """Error in the middle (mm); NEES there, by direction, near the end, in the gap, outside."""
    rng = np.random.default_rng([seed, int(10 * gap_s), path == "curved"])
    begin, end = _SEEN_S, _SEEN_S + gap_s
    route = _route(rng, path, end + _SEEN_S)
    times = np.arange(0.0, end + _SEEN_S, 1.0 / _ODOMETRY_HZ)
    own = odometry(route.poses(times), rng)
    seen = np.arange(0.003, times[-1], 1.0 / _SEEN_HZ)
    seen = seen[(seen < begin) | (seen > end)]
    measured = route.poses(seen) + rng.normal(size=(len(seen), 3)) * _SEEN_SIGMAS
    measured[:, 2] = wrap_angle(measured[:, 2])
    covariances = np.tile(np.diag(_SEEN_SIGMAS**2), (len(seen), 1, 1))
    laser = PlanarPoses(seen, measured, covariances)
    return _figures(fuse(PlanarPoses(times, own), {"laser": laser}, settings), route, begin, end)


def _figures(fusion: Fusion, route: Route, begin: float, end: float) -> list[float]:
    found = fusion.poses
    assert found.covariances is not None
    exact = route.poses(found.times_s)
    error = pose_differences(found.poses, exact)
    squared = squared_mahalanobis(error, found.covariances) / 3.0
    inside = (found.times_s > begin) & (found.times_s < end)
    middle = int(np.argmin(np.abs(found.times_s - 0.5 * (begin + end))))
    late = int(np.argmin(np.abs(found.times_s - (0.1 * begin + 0.9 * end))))
    c, s = np.cos(exact[middle, 2]), np.sin(exact[middle, 2])
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    by_direction = (turn @ error[middle]) ** 2 / np.diagonal(
        turn @ found.covariances[middle] @ turn.T
    )
    return [
        1e3 * float(np.hypot(error[middle, 0], error[middle, 1])),
        float(squared[middle]),
        *(float(value) for value in by_direction),
        float(squared[late]),
        float(np.mean(squared[inside])),
        float(np.mean(squared[~inside])),
    ]


def _route(rng: np.random.Generator, path: str, seconds: float) -> Route:
    """A way of at least so many seconds, with two stops on it."""
    limits = DrivingLimits()
    length = 1.1 * limits.speed_m_s * seconds
    if path == "straight":
        direction = rng.uniform(-np.pi, np.pi)
        ways = np.linspace(0.0, length, 9)
        waypoints = ways[:, None] * np.array([np.cos(direction), np.sin(direction)])
    else:
        # Bends to both sides, of some 1 to 3 m radius, about a heading that wanders.
        legs = int(length / 2.0)
        bearings = np.cumsum(rng.normal(0.0, 0.8, legs))
        steps = 2.0 * np.column_stack([np.cos(bearings), np.sin(bearings)])
        waypoints = np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return Route(waypoints, [], limits, -1.0)


def _wheel_by_wheel(poses: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Two wheels that roll by shares too far and each slips by itself; summed up along arcs."""
    turn = np.diff(poses[:, 2])
    step = np.diff(poses[:, :2], axis=0)
    middle = poses[:-1, 2] + 0.5 * turn
    way = np.cos(middle) * step[:, 0] + np.sin(middle) * step[:, 1]
    wheels = []
    for side, scale in zip((-1.0, 1.0), _WHEEL_SCALES):
        rolled = way + side * 0.5 * _TRACK_M * turn
        slip = _WHEEL_SIGMA_M * np.sqrt(np.abs(rolled)) * rng.standard_normal(len(rolled))
        wheels.append(scale * rolled + slip)
    turning, way = (wheels[1] - wheels[0]) / _TRACK_M, 0.5 * (wheels[0] + wheels[1])
    theta = np.concatenate([[0.0], np.cumsum(turning)])
    heading = 0.5 * (theta[1:] + theta[:-1])
    steps = way[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    xy = np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.column_stack([xy, theta])


_ODOMETRIES: dict[str, Odometry] = {
    "simulated": lambda poses, rng: measured_path(poses, WheelErrors(), rng),
    "slipping": lambda poses, rng: measured_path(poses, WheelErrors(sigma_side_m=0.006), rng),
    "wheels": _wheel_by_wheel,
}


@dataclass(frozen=True)
class FusionSpeed:
    """Fuse a made-up session and print the times."""

    hours: float = 1.0

    def __call__(self) -> int:
        rng = np.random.default_rng(1)
        times = np.arange(0.0, 3600.0 * self.hours, 1.0 / _ODOMETRY_HZ)
        heading = np.cumsum(0.3 * np.sin(0.2 * times)) / _ODOMETRY_HZ
        step = 0.5 / _ODOMETRY_HZ
        path = np.column_stack(
            [np.cumsum(np.cos(heading)) * step, np.cumsum(np.sin(heading)) * step, heading]
        )
        seen = np.arange(0.0, times[-1] - 1.0, 1.0 / 75.0)
        exact = np.column_stack([np.interp(seen, times, path[:, k]) for k in range(3)])
        noisy = exact + rng.normal(0.0, 0.01, exact.shape)
        laser = PlanarPoses(seen, noisy, np.tile(1e-4 * np.eye(3), (len(seen), 1, 1)))
        spent = []
        for _ in range(4):
            begun = time.process_time()
            fusion = fuse(PlanarPoses(times, path), {"laser": laser})
            spent.append(time.process_time() - begun)
        print(
            f"{self.hours:g} h: {len(times)} steps of odometry, {len(laser)} poses of the laser, "
            # The first compiles.
            f"{len(fusion.poses)} poses fused: {min(spent[1:]):.2f} s of the processor "
            f"(median {np.median(spent[1:]):.2f} s)"
        )
        return 0
