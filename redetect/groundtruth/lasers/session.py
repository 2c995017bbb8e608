"""A session's scanners, robot and scans on disk, as the tracking needs them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.json_file import read_json
from redetect.groundtruth.lasers.background import learn_background
from redetect.groundtruth.lasers.scanners import Robot, Scanner, read_robot, read_scanners
from redetect.groundtruth.lasers.scans import find_scans, read_scans
from redetect.groundtruth.lasers.sets import ScannerTables, ScanSets, scanner_tables, sets_of_scans

FloatArray = NDArray[np.float64]


def load_session(
    folder: Path, calibration: Path
) -> tuple[tuple[Scanner, ...], Robot, ScannerTables, ScanSets]:
    """Read fixed scanners, robot, scans, and learn the background.

    Raises
    ------
    GroundTruthError
        If a file is missing or does not fit the others.
    """
    scanners = read_scanners(calibration)
    robot = read_robot(folder / "robot.json")
    backgrounds = []
    for scanner in scanners:
        path = find_scans(folder / "empty", scanner.name)
        backgrounds.append(
            learn_background(read_scans(path, scanner.readings).ranges_mm, scanner.max_range_m)
        )
    tables = scanner_tables(scanners, backgrounds, joint_covariance(calibration, scanners))
    scans = [read_scans(find_scans(folder, s.name), s.readings) for s in scanners]
    return scanners, robot, tables, sets_of_scans(scans)


def joint_covariance(path: Path, scanners: tuple[Scanner, ...]) -> FloatArray | None:
    """The scanners' joint covariance that `groundtruth lasers` writes, if the file has one."""
    entry = read_json(path).get("joint_covariance")
    if entry is None:
        return None
    names = [scanner.name for scanner in scanners]
    size = 3 * len(names)
    if not isinstance(entry, dict) or entry.get("scanners") != names:
        raise GroundTruthError(f"{path}: joint_covariance: expected scanners {names} in this order")
    try:
        matrix = np.array(entry.get("matrix"), dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise GroundTruthError(f"{path}: joint_covariance: expected {size} x {size} finite numbers")
    return matrix
