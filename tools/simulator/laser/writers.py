"""Writers of a laser session's files (docs/groundtruth/sessions.md); `groundtruth` reads them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.files import write_json
from redetect.groundtruth.lasers.building import HEAD
from redetect.groundtruth.lasers.scanners import Robot, Scans, scanner_entry
from redetect.groundtruth.validation.reference_poses import DISTANCES_HEAD, Distance, Survey
from redetect.storage import write_whole
from tools.simulator.files import write_lines


def write_scans(path: Path, scans: Scans, *, overwrite: bool = False) -> None:
    """Write scans as a ``.npz``; the same scans give the same bytes."""
    with write_whole(path, overwrite=overwrite) as stream:
        np.savez_compressed(stream, times_s=scans.times_s, ranges_mm=scans.ranges_mm)


def write_robot(
    path: Path, robot: Robot, extra: Mapping[str, Any] | None = None, *, overwrite: bool = False
) -> None:
    """Write a ``robot.json``, and other entries."""
    content = {
        "version": 1,
        "outline": robot.outline.tolist(),
        "largest_speed_m_s": robot.largest_speed_m_s,
        "largest_turn_rad_s": robot.largest_turn_rad_s,
        "scanners": [scanner_entry(scanner) for scanner in robot.scanners],
        **(extra or {}),
    }
    write_json(path, content, overwrite=overwrite)


def write_building(path: Path, walls: FloatArray, *, overwrite: bool = False) -> None:
    """Write walls (S, 4) as a ``building.csv``, in micrometres."""
    rows = (",".join(f"{x:.6f}" for x in wall) for wall in walls)
    write_lines(path, [HEAD, *rows], overwrite=overwrite)


def write_drawing(path: Path, walls: FloatArray, *, overwrite: bool = False) -> None:
    """Write walls (S, 4) as lines on the layer WALLS of a drawing in metres (DXF R12)."""
    head = "0\nSECTION\n2\nHEADER\n9\n$ACADVER\n1\nAC1009\n9\n$INSUNITS\n70\n6\n0\nENDSEC"
    rows = (
        f"0\nLINE\n8\nWALLS\n10\n{x1:.6f}\n20\n{y1:.6f}\n30\n0.0\n"
        f"11\n{x2:.6f}\n21\n{y2:.6f}\n31\n0.0"
        for x1, y1, x2, y2 in walls
    )
    entities = ["0\nSECTION\n2\nENTITIES", *rows, "0\nENDSEC\n0\nEOF"]
    write_lines(path, [head, *entities], overwrite=overwrite)


def write_survey(
    path: Path, survey: Survey, extra: Mapping[str, Any] | None = None, *, overwrite: bool = False
) -> None:
    """Write a ``fiducials.json``, and other entries."""
    content = {
        "version": 1,
        "fiducials": {name: point.tolist() for name, point in survey.fiducials.items()},
        "robot_points": {name: point.tolist() for name, point in survey.robot_points.items()},
        "sigma_m": survey.sigma_m,
        **(extra or {}),
    }
    write_json(path, content, overwrite=overwrite)


def write_distances(path: Path, distances: list[Distance], *, overwrite: bool = False) -> None:
    """Write a ``distances.csv``, in tenths of a millimetre."""
    rows = [f"{d.pose},{d.time_s:.6f},{d.point},{d.fiducial},{d.distance_m:.4f}" for d in distances]
    write_lines(path, [DISTANCES_HEAD, *rows], overwrite=overwrite)
