"""The Victoria Park data set as a run: a car between trees that its laser scanner sees.

J. E. Guivant, E. M. Nebot, "Optimization of the simultaneous localization and map-building
algorithm for real-time implementation", IEEE Transactions on Robotics and Automation 17(3), 2001.
The robot frame is that of the scanner, X forward and Y left.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from redetect.slam.errors import SlamError
from redetect.slam.formats.axes import to_dataset
from redetect.slam.formats.range_bearing import RangeBearing
from redetect.slam.models.motion import chain_steps, relative_pose

FloatArray = NDArray[np.float64]

#: Dead reckoning (time in ms, speed, steering), and beside it scans (TLsr in ms, LASER in cm).
DRIVE, SCANS = "aa3_dr.mat", "aa3_lsr2.mat"
# The car: distance of the axles, of the encoder from the middle, and the scanner's place (m).
_AXLES_M, _ENCODER_M, _AHEAD_M, _LEFT_M = 2.83, 0.76, 3.78, 0.5
_BEAMS = 361
_FARTHEST_M = 75.0
# Neighbouring beams on one trunk differ by less; what is behind a trunk is farther by more.
_SAME_M, _BEHIND_M = 0.5, 1.5
_LEAST_DIAMETER_M, _MOST_DIAMETER_M = 0.05, 1.0


def read_drive(drive: Path) -> RangeBearing:
    """What the car logged, with the trees found in its scans."""
    time, speed, steering = _arrays(drive, ("time", "speed", "steering"))
    scanned, laser = _arrays(drive.with_name(SCANS), ("TLsr", "LASER"))
    time, speed, steering, scanned = (a.ravel() for a in (time, speed, steering, scanned))
    if len({len(time), len(speed), len(steering)}) != 1 or laser.shape != (len(scanned), _BEAMS):
        raise SlamError(f"{drive}: expected rows of equal number, and scans of {_BEAMS} beams")
    usable = scanned >= time[0]
    times, scans = scanned[usable] / 1000.0, laser[usable] / 100.0
    found = [trees_of(scan) for scan in scans]
    trees = np.concatenate([np.zeros((0, 2)), *found])
    return RangeBearing(
        times=times,
        steps=to_dataset(_steps(time / 1000.0, speed, steering, times), "robotics"),
        frame=np.repeat(np.arange(len(found)), [len(some) for some in found]),
        range_m=trees[:, 0],
        bearing_rad=trees[:, 1],
        ids=np.full(len(trees), -1),
    )


def trees_of(scan: FloatArray) -> FloatArray:
    """Trunks in a scan: runs of beams of nearly one range with nothing near beside them.

    Takes `scan` (361,); returns (n, 2).
    """
    edges = np.flatnonzero(np.abs(np.diff(scan)) > _SAME_M) + 1
    starts, ends = np.concatenate([[0], edges]), np.concatenate([edges, [len(scan)]])
    before = np.concatenate(
        [[0.0], scan[starts[1:] - 1]]
    )  # what the scan's border hides is unknown
    after = np.concatenate([scan[ends[:-1]], [0.0]])
    found = []
    for first, last, right, left in zip(starts, ends, before, after):
        reach = float(np.mean(scan[first:last]))
        diameter = reach * np.radians(0.5 * (last - first))
        alone = min(right, left) > reach + _BEHIND_M
        if alone and reach < _FARTHEST_M and _LEAST_DIAMETER_M < diameter < _MOST_DIAMETER_M:
            found.append((reach + 0.5 * diameter, np.radians(0.25 * (first + last - 1) - 90.0)))
    return np.array(found, dtype=np.float64).reshape(-1, 2)


def _steps(
    time: FloatArray, speed: FloatArray, steering: FloatArray, times: FloatArray
) -> FloatArray:
    """Movements of the scanner between times, from the speed of a rear wheel and the steering."""
    knots = np.union1d(time, times)
    knots = knots[knots >= time[0]]
    held = np.clip(np.searchsorted(time, knots[:-1], side="right") - 1, 0, None)
    duration = np.diff(knots)
    slope = np.tan(steering[held])
    way = speed[held] / (1.0 - slope * _ENCODER_M / _AXLES_M) * duration
    turn = way / _AXLES_M * slope
    along = np.stack([way - turn * _LEFT_M, turn * _AHEAD_M, turn], axis=1)
    poses = chain_steps(along)[np.searchsorted(knots, times)]
    return relative_pose(np.concatenate([np.zeros((1, 3)), poses[:-1]]), poses)


def _arrays(path: Path, names: tuple[str, ...]) -> list[FloatArray]:
    try:
        content = loadmat(path)
        return [np.asarray(content[name], dtype=np.float64) for name in names]
    except (OSError, ValueError, KeyError, NotImplementedError, MatReadError) as error:
        raise SlamError(
            f"{path}: cannot be read ({error}): expected a MATLAB file with {', '.join(names)}"
        ) from None
