"""Pictures of paths: association, filters, lasers, clocks and fusion."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from redetect.landmarks import read_frames

_INK, _OWN, _OTHER = "#444444", "#1f4e9c", "#e67e22"


def draw_association(figure: Any, run: Path) -> None:
    """Rows of a run where odometry and where the map puts them, coloured by what was found."""
    rows = _table(run / "slam" / "path.csv")
    path = np.array([[float(row[c]) for c in ("x_m", "y_m", "theta_rad")] for row in rows])
    summed = [np.zeros(3)]
    frames: list[Any] = []
    for frame in read_frames(run / "found.circles"):
        step = frame.step
        x, y, theta = summed[-1]
        c, s = np.cos(theta), np.sin(theta)
        summed.append(
            np.array(
                [x + c * step.dx - s * step.dy, y + s * step.dx + c * step.dy, theta + step.dphi]
            )
        )
        frames.append(frame.circles)
    panels = figure.subplots(1, 2)
    titles = ("rows where odometry puts them", "rows where the map's path puts them")
    for axes, poses, title in zip(panels, (np.array(summed), path), titles, strict=True):
        axes.plot(*poses[:, :2].T, color="#bbbbbb", lw=0.7)
        for pose, circles in zip(poses[1:], frames, strict=True):
            c, s = np.cos(pose[2]), np.sin(pose[2])
            for row in circles:
                x = pose[0] + c * row.px - s * row.py
                y = pose[1] + s * row.px + c * row.py
                axes.plot(x, y, ".", markersize=2.5, color=_colour(row.ids[0]))
        axes.set_title(title, fontsize=10)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=8)
        axes.set_xlabel("X / m")


def _colour(number: int) -> Any:
    import matplotlib as mpl

    # Neighbouring numbers in colours far from each other.
    return mpl.colormaps["hsv"]((number * 0.381966) % 1.0)


def draw_filter(figure: Any, run: Path) -> None:
    """Errors of EKF-SLAM's poses, as they were at the time, within three standard deviations."""
    truth = json.loads((run / "truth.json").read_text())
    x, y, heading = truth["start"]
    poses = np.array([truth["start"], *(frame["pose"] for frame in truth["frames"])])
    c, s = np.cos(heading), np.sin(heading)
    moved = poses - (x, y, heading)
    exact = np.column_stack(
        [c * moved[:, 0] + s * moved[:, 1], c * moved[:, 1] - s * moved[:, 0], moved[:, 2]]
    )
    rows = _table(run / "ekf" / "path.csv")
    panels = figure.subplots(1, 3)
    for axes, number, name, variance, unit in zip(
        panels,
        range(3),
        ("x_m", "y_m", "theta_rad"),
        ("cxx", "cyy", "cthetatheta"),
        ("x / m", "y / m", "heading / rad"),
        strict=True,
    ):
        error = np.array([float(row[name]) for row in rows]) - exact[:, number]
        if number == 2:
            error = (error + np.pi) % (2.0 * np.pi) - np.pi
        bound = 3.0 * np.sqrt([float(row[variance]) for row in rows])
        steps = np.arange(len(error))
        axes.fill_between(steps, -bound, bound, color="#d5e4f2")
        axes.plot(steps, error, color=_OWN, lw=0.9)
        within = 100.0 * np.mean(np.abs(error[1:]) <= bound[1:])
        axes.set_title(f"error of {unit}, within 3 sigma: {within:.1f} %", fontsize=10)
        axes.set_xlabel("step")


def _table(file: Path) -> list[dict[str, str]]:
    with file.open() as opened:
        return list(csv.DictReader(line for line in opened if not line.startswith("#")))


def draw_laser(figure: Any, session: Path, time_s: float) -> None:
    """One set of scans: background, what is new, and the outline fitted to it."""
    scanners = json.loads((session / "aligned.json").read_text())["scanners"]
    outline = np.array(json.loads((session / "robot.json").read_text())["outline"])
    poses = _rows(session / "laser.csv")
    pose = poses[np.argmin(np.abs(poses[:, 0] - poses[0, 0] - time_s))]
    panels = figure.subplots(1, 2)
    walls = np.loadtxt(session / "building.csv", delimiter=",", skiprows=1)
    for axes in panels:
        axes.plot(walls[:, ::2].T, walls[:, 1::2].T, color="#999999", lw=1)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=8)
    for scanner in scanners:
        x, y, theta = scanner["pose"]
        angles = theta + scanner["first_angle_rad"]
        angles = angles + scanner["angle_step_rad"] * np.arange(scanner["readings"])
        scans = np.load(session / f"{scanner['name']}.scans.npz")
        now = scans["ranges_mm"][np.argmin(np.abs(scans["times_s"] - pose[0]))] / 1000.0
        seen = np.load(session / "empty" / f"{scanner['name']}.scans.npz")["ranges_mm"] / 1000.0
        nearest = np.min(np.where(seen > 0.0, seen, np.inf), axis=0)
        new = (now > 0.0) & (now < nearest - 0.05)
        places = np.array([x, y])[:, None] + now * np.array([np.cos(angles), np.sin(angles)])
        for axes in panels:
            axes.plot(*places[:, (now > 0) & ~new], ".", color="#88aadd", markersize=2)
            axes.plot(*places[:, new], ".", color=_OTHER, markersize=5)
            axes.plot(x, y, "^", color=_INK, markersize=6)
    c, s = np.cos(pose[3]), np.sin(pose[3])
    fitted = outline @ np.array([[c, s], [-s, c]]) + pose[1:3]
    for axes in panels:
        axes.plot(*np.vstack([fitted, fitted[:1]]).T, color=_OWN, lw=1.4)
    panels[0].set_title("a set of four scans: background (blue), new (orange)", fontsize=10)
    panels[1].set_title("the outline fitted to what is new", fontsize=10)
    panels[0].set_xlim(walls[:, ::2].min() - 0.5, 12.0)
    panels[0].set_ylim(-1.0, 9.0)
    panels[1].set_xlim(pose[1] - 0.8, pose[1] + 0.8)
    panels[1].set_ylim(pose[2] - 0.8, pose[2] + 0.8)


def draw_clock(figure: Any, session: Path) -> None:
    """Rates of turn by both clocks, and the fused path with what it is sure of."""
    odometry, laser = _rows(session / "odometry.csv"), _rows(session / "laser.csv")
    segment = json.loads((session / "clock.json").read_text())["segments"][0]
    panels = figure.subplots(1, 3, width_ratios=(1, 1, 1.2))
    begin, end = segment["from_s"], segment["to_s"]
    shown = laser[(laser[:, 0] >= begin) & (laser[:, 0] <= end)]
    unaligned = odometry[:, 0]
    aligned = (unaligned - segment["offset_s"] - segment["reference_s"]) / segment[
        "rate"
    ] + segment["reference_s"]
    for axes, times, title in (
        (panels[0], unaligned, "turning, by each stream's own clock"),
        (panels[1], aligned, f"by one clock: {segment['offset_s'] * 1000:.0f} ms taken off"),
    ):
        time, rate = _turning(np.column_stack([times, odometry[:, 3]]))
        axes.plot(time - begin, np.degrees(rate), color=_INK, lw=0.8, label="odometry")
        time, rate = _turning(shown[:, [0, 3]])
        axes.plot(time - begin, np.degrees(rate), ".-", color=_OTHER, lw=1, label="laser")
        axes.set_xlim(0, 4)
        axes.set_xlabel("s")
        axes.set_ylabel("°/s")
        axes.set_title(title, fontsize=10)
    panels[0].legend(fontsize=8)
    fused = np.loadtxt(session / "fused.csv", delimiter=",")
    axes = panels[2]
    sigma = np.sqrt(fused[:, 4] + fused[:, 8])
    dots = axes.scatter(fused[:, 1], fused[:, 2], c=np.log10(1000 * sigma), s=2, cmap="viridis")
    axes.plot(*laser[:, 1:3].T, ".", color=_OTHER, markersize=2)
    figure.colorbar(dots, ax=axes, label="log10 of sigma / mm")
    axes.set_aspect("equal")
    axes.set_title("fused path; poses of the laser in orange", fontsize=10)


def _rows(file: Path) -> Any:
    return np.loadtxt(file, delimiter=",", usecols=range(4))


def _turning(poses: Any) -> tuple[Any, Any]:
    """Times and rates of turn over a fifth of a second, of rows t, theta."""
    grid = np.arange(poses[0, 0], poses[-1, 0], 0.05)
    heading = np.interp(grid, poses[:, 0], np.unwrap(poses[:, 1]))
    return grid[2:-2], (heading[4:] - heading[:-4]) / 0.2
