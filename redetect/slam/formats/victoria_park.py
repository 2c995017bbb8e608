"""Victoria Park: a car between trees that its laser scanner sees, as a run.

The robot frame is that of the scanner, X forward, Y left.

References
----------
J. E. Guivant, E. M. Nebot, "Optimization of the simultaneous localization and map-building
algorithm for real-time implementation", IEEE Transactions on Robotics and Automation 17(3), 2001.
"""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.bounds import LARGEST_NUMBER
from redetect.slam.errors import SlamError
from redetect.slam.formats import ranges
from redetect.slam.formats.motion_log import (
    RAW_SIGMA_M,
    RAW_SIGMA_RAD,
    MotionLog,
    demand_common_times,
    demand_order,
    run_of,
)
from redetect.slam.recording import UNKNOWN_ID, CircleRows, Recording
from redetect.storage.bounded import read_content

#: Dead reckoning (time in ms, speed, steering), and beside it scans (TLsr in ms, LASER in cm).
DRIVE, SCANS = "aa3_dr.mat", "aa3_lsr2.mat"
_LARGEST_BYTES = 1 << 28
# Reads arrays of such a file, in a process of its own, which a damaged file may crash.
_READER = """
import io, sys, numpy, scipy.io
found = scipy.io.loadmat(io.BytesIO(sys.stdin.buffer.read()), variable_names=sys.argv[1:])
content = io.BytesIO()
numpy.savez(content, **{name: found[name] for name in sys.argv[1:]})
sys.stdout.buffer.write(content.getvalue())
"""
# The car: wheelbase, distance of the encoder from the middle, and the scanner's position (m).
_AXLES_M, _ENCODER_M, _AHEAD_M, _LEFT_M = 2.83, 0.76, 3.78, 0.5
_MOST_STEERING_RAD = 1.2
_BEAMS = 361
_RANGES_CM = 1 << 13
_FARTHEST_M = 75.0
# Largest range difference of neighbouring beams on a trunk, and least one to the background.
_SAME_M, _BEHIND_M = 0.5, 1.5
_LEAST_DIAMETER_M, _MOST_DIAMETER_M = 0.05, 1.0


def read_run(
    drive: Path, sigma_m: float | None = None, sigma_rad: float | None = None
) -> Recording:
    """The car's log, with the trees found in its scans as discs; see `utias.read_run`."""
    time, speed, steering = _arrays(drive, ("time", "speed", "steering"))
    scanned, laser = _arrays(drive.with_name(SCANS), ("TLsr", "LASER"))
    time, speed, steering, scanned = (a.ravel() for a in (time, speed, steering, scanned))
    if len({len(time), len(speed), len(steering)}) != 1 or laser.shape != (len(scanned), _BEAMS):
        raise SlamError(f"{drive}: expected rows of equal number, and scans of {_BEAMS} beams")
    if np.any(np.abs(steering) > _MOST_STEERING_RAD):
        raise SlamError(f"{drive}: steering: expected angles within +-{_MOST_STEERING_RAD:g} rad")
    demand_order(drive, time)
    demand_order(drive.with_name(SCANS), scanned)
    demand_common_times(drive, time, drive.with_name(SCANS), scanned)
    usable = scanned >= time[0]
    # The upper bits of a range are the intensity.
    times, scans = scanned[usable] / 1000.0, (laser[usable] % _RANGES_CM) / 100.0
    found = [trees_of(scan) for scan in scans]
    trees = np.concatenate([np.zeros((0, 2)), *found])
    frame = np.repeat(np.arange(len(found)), [len(some) for some in found])
    of_ranges = RAW_SIGMA_M if sigma_m is None else sigma_m
    of_bearings = RAW_SIGMA_RAD if sigma_rad is None else sigma_rad
    rows = ranges.discs_of_ranges(trees[:, 0], trees[:, 1], of_ranges, of_bearings)
    log = _car_log(time / 1000.0, speed, steering)
    steps = log.steps(np.append(log.times[0], times))
    return run_of(times, *steps, CircleRows(frame, *rows, np.full(len(trees), UNKNOWN_ID)))


def trees_of(scan: FloatArray) -> FloatArray:
    """Ranges and bearings (n, 2) of trunks in a scan (361,): runs of beams of nearly equal range
    with a distant background.
    """
    edges = np.flatnonzero(np.abs(np.diff(scan)) > _SAME_M) + 1
    starts, ends = np.concatenate([[0], edges]), np.concatenate([edges, [len(scan)]])
    # Trunks at the scan's border are skipped, since their width is unknown.
    before = np.concatenate([[0.0], scan[starts[1:] - 1]])
    after = np.concatenate([scan[ends[:-1]], [0.0]])
    found = []
    for first, last, right, left in zip(starts, ends, before, after):
        reach = float(np.mean(scan[first:last]))
        diameter = reach * np.radians(0.5 * (last - first))
        alone = min(right, left) > reach + _BEHIND_M
        if alone and reach < _FARTHEST_M and _LEAST_DIAMETER_M < diameter < _MOST_DIAMETER_M:
            bearing_rad = np.radians(0.25 * (first + last - 1) - 90.0)
            found.append((reach + 0.125 * np.pi * diameter, bearing_rad))
    return np.array(found, dtype=np.float64).reshape(-1, 2)


def _car_log(time: FloatArray, speed: FloatArray, steering: FloatArray) -> MotionLog:
    """The scanner's log, from times (s), the speed of a rear wheel and the steering."""

    def along(held: IntArray, duration: FloatArray) -> FloatArray:
        slope = np.tan(steering[held])
        distance = speed[held] / (1.0 - slope * _ENCODER_M / _AXLES_M) * duration
        turn = distance / _AXLES_M * slope
        return np.stack([distance - turn * _LEFT_M, turn * _AHEAD_M, turn], axis=1)

    return MotionLog(time, along)


def _arrays(path: Path, names: tuple[str, ...]) -> list[FloatArray]:
    content = read_content(path, _LARGEST_BYTES, "MATLAB file", SlamError)
    reader = subprocess.run(
        [sys.executable, "-c", _READER, *names], input=content, capture_output=True, check=False
    )
    try:
        found = np.load(io.BytesIO(reader.stdout))
        arrays = [np.asarray(np.real_if_close(found[name]), np.float64) for name in names]
    except Exception as error:  # damage can raise almost any
        why = reader.stderr.decode(errors="replace").strip().rpartition("\n")[2] or error
        raise SlamError(
            f"{path}: cannot be read ({why}): expected a MATLAB file with {', '.join(names)}"
        ) from None
    for name, values in zip(names, arrays):
        if not np.all(np.abs(values) <= LARGEST_NUMBER):
            raise SlamError(f"{path}: {name}: expected numbers within +-{LARGEST_NUMBER:g}")
    return arrays
