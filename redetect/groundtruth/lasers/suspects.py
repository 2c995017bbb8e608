"""Following the robot without the scanners whose readings do not fit the others'."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.lasers.acquisition import robot_body
from redetect.groundtruth.lasers.scanners import Robot, Scanner
from redetect.groundtruth.lasers.sets import ScannerTables, ScanSets
from redetect.groundtruth.lasers.settings import LaserSettings
from redetect.groundtruth.lasers.tracking import LaserTrack, Tracker

FloatArray = NDArray[np.float64]

_SUSPECT_SIGMA, _SUSPECT_M, _SUSPECT_RAD = 5.0, 0.005, 0.002


def track_robot(
    sets: ScanSets, tables: ScannerTables, robot: Robot, settings: LaserSettings | None = None
) -> LaserTrack:
    """Follow the robot through sets of scans (see `redetect.groundtruth.lasers.tracking`)."""
    settings = LaserSettings() if settings is None else settings
    body = robot_body(robot.outline, settings.symmetry_m)
    return Tracker(
        sets, tables, body, robot.largest_speed_m_s, robot.largest_turn_rad_s, settings
    ).run()


def track_without_suspects(
    sets: ScanSets,
    tables: ScannerTables,
    robot: Robot,
    scanners: tuple[Scanner, ...],
    settings: LaserSettings | None = None,
) -> tuple[LaserTrack, dict[str, FloatArray]]:
    """Follow the robot, leaving out scanners whose readings do not fit the others'.

    One at a time, the worst first, and only while three scanners or more are left to say so.

    Returns
    -------
    track : LaserTrack
    left_out : dict of str to (2, 3) float64
        By scanner, the shift that its readings suggest and its standard deviations.
    """
    left_out: dict[str, FloatArray] = {}
    track = track_robot(sets, tables, robot, settings)
    while len(scanners) - len(left_out) >= 3:
        excess = excess_shifts(track, scanners)
        worst = int(np.argmax(excess))
        if excess[worst] <= 1.0:
            break
        left_out[scanners[worst].name] = np.stack(
            [track.corrections[worst], track.correction_sigma[worst]]
        )
        rows = sets.rows.copy()
        rows[:, worst] = -1
        sets = replace(sets, rows=rows)
        track = track_robot(sets, tables, robot, settings)
    return track, left_out


def excess_shifts(track: LaserTrack, scanners: tuple[Scanner, ...]) -> FloatArray:
    """(scanners,) how far beyond what is allowed their shifts are; above 1 is suspect."""
    least = np.array([_SUSPECT_M, _SUSPECT_M, _SUSPECT_RAD])
    excess = np.zeros(len(scanners))
    for k, scanner in enumerate(scanners):
        shift, sigma = track.corrections[k], track.correction_sigma[k]
        if np.isfinite(shift).all():
            allowed = _SUSPECT_SIGMA * np.sqrt(sigma**2 + np.diag(scanner.covariance))
            excess[k] = float(np.max(np.abs(shift) / np.maximum(allowed, least)))
    return excess
