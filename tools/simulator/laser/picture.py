"""A picture of a session: map, way, scanners, and what they measured at one time."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.json_file import read_json
from redetect.groundtruth.lasers.building import read_building
from redetect.groundtruth.lasers.scanners import Scanner, read_robot, read_scanners
from redetect.groundtruth.lasers.scans import find_scans, read_scans
from redetect.groundtruth.trajectories.streams import read_planar_poses
from redetect.groundtruth.validation.fiducials import read_survey
from redetect.storage import write_whole
from tools.simulator.laser.measuring import compose

FloatArray = NDArray[np.float64]

_COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:purple")


def draw_session(
    folder: Path, path: Path, *, at_s: float | None = None, overwrite: bool = False
) -> None:
    """Draw a session from its files.

    Parameters
    ----------
    folder : path
        The session.
    path : path
        The PNG to write.
    at_s : float, optional
        When the scans that are drawn were taken (ground truth's clock); by default in the middle
        of the poses from markers.
    overwrite : bool
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    truth, camera = (read_planar_poses(folder / f"{n}.csv") for n in ("truth", "camera"))
    at_s = float(camera.times_s[len(camera) // 2]) if at_s is None else at_s
    robot_pose = truth.poses[np.argmin(np.abs(truth.times_s - at_s))]
    robot = read_robot(folder / "robot.json")
    figure = Figure(figsize=(12.0, 10.0), layout="tight")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(aspect="equal")
    walls = read_building(folder / "building.csv").segments.reshape(-1, 2, 2)
    axes.add_collection(LineCollection(list(walls), colors="black", linewidths=1.2))
    axes.plot(*truth.poses[:, :2].T, color="0.6", linewidth=0.8, label="way")
    axes.plot(*camera.poses[:, :2].T, ".", color="tab:red", markersize=2, label="marker poses")
    stands = read_planar_poses(folder / "reference.csv") if _has_rows(folder) else None
    if stands is not None:
        axes.plot(*stands.poses[:, :2].T, "k+", markersize=9, label="reference poses")
    survey = read_survey(folder / "fiducials.json")
    axes.plot(*np.stack(list(survey.fiducials.values())).T, "k*", label="fiducials")
    scanners = read_scanners(folder / "scanners.truth.json")
    for scanner, colour in zip(scanners, _COLOURS):
        points = _points_at(folder, scanner, scanner.pose, at_s)
        axes.plot(*points.T, ".", color=colour, markersize=3, label=scanner.name)
        axes.plot(*_arrow(scanner.pose), color=colour, linewidth=2.5)
    for scanner, colour in zip(robot.scanners, ("0.3", "tab:cyan")):
        pose = compose(robot_pose[None], scanner.pose[None])[0]
        points = _points_at(folder, scanner, pose, _robot_time(folder, at_s))
        axes.plot(*points.T, "x", color=colour, markersize=3, label=f"{scanner.name} (on board)")
    outline = np.vstack([robot.outline, robot.outline[:1]])
    body = compose(
        np.tile(robot_pose, (len(outline), 1)), np.column_stack([outline, 0 * outline[:, :1]])
    )
    axes.plot(*body[:, :2].T, color="tab:red", linewidth=1.5)
    axes.autoscale_view()
    axes.set(xlabel="x / m", ylabel="y / m", title=f"t = {at_s:.2f} s")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100, metadata={"Software": None})
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write(buffer.getvalue())


def _robot_time(folder: Path, at_s: float) -> float:
    """What the robot's clock showed, by the truth."""
    time = at_s
    for piece in read_json(folder / "truth.json")["clock"]["pieces"]:
        if piece["from_s"] is None or at_s >= piece["from_s"]:
            time = at_s + piece["offset_s"] + piece["drift"] * (at_s - piece["reference_s"])
    return time


def _has_rows(folder: Path) -> bool:
    return (folder / "reference.csv").stat().st_size > 0


def _arrow(pose: FloatArray) -> FloatArray:
    """(2, 2) ends of a short line from a scanner along its middle beam."""
    tip = pose[:2] + 0.5 * np.array([np.cos(pose[2]), np.sin(pose[2])])
    return np.stack([pose[:2], tip]).T


def _points_at(folder: Path, scanner: Scanner, pose: FloatArray, at_s: float) -> FloatArray:
    """(M, 2) points in the world of the scan nearest in time."""
    scans = read_scans(find_scans(folder, scanner.name), scanner.readings)
    points = scanner.points(scans.ranges_mm[np.argmin(np.abs(scans.times_s - at_s))])
    points = points[np.isfinite(points[:, 0])]
    local = np.column_stack([points, np.zeros(len(points))])
    return compose(np.tile(pose, (len(points), 1)), local)[:, :2]
