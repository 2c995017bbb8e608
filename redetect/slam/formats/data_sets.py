"""Data sets of robots that measure ranges and bearings of landmarks, as runs, paths and maps.

UTIAS (MRCLAM): robots log velocities, and range and bearing to barcodes of landmarks and of each
other. Victoria Park: a car between trees that its laser scanner sees; the robot frame is that of
the scanner. Axes of both are X forward, Y left.

References
----------
K. Leung, Y. Halpern, T. Barfoot, H. Liu, "The UTIAS multi-robot cooperative localization and
mapping dataset", International Journal of Robotics Research 30(8), 2011.
J. E. Guivant, E. M. Nebot, "Optimization of the simultaneous localization and map-building
algorithm for real-time implementation", IEEE Transactions on Robotics and Automation 17(3), 2001.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from redetect.array_types import FloatArray, IntArray
from redetect.bounds import LARGEST_NUMBER
from redetect.landmarks.axes import covariance_from_dataset, to_dataset
from redetect.landmarks.map_file import LandmarkMap, Landmarks, Path2D, no_landmarks
from redetect.plane import between, chain_steps
from redetect.slam.errors import SlamError
from redetect.slam.recording import ASSUMED, UNKNOWN_ID, CircleRows, LineRows, Recording
from redetect.storage.bounded import rows_of_numbers

#: Suffixes of the names of a robot's odometry and of the files beside it.
ODOMETRY, MEASUREMENTS, TRUTH = "_Odometry.dat", "_Measurement.dat", "_Groundtruth.dat"
LANDMARKS, BARCODES = "Landmark_Groundtruth.dat", "Barcodes.dat"
_ROBOTS = 5
#: Most that the clock of a robot's log may go back, seconds.
_SET_BACK_S = 1.0
# A log has a gap if nothing is logged for this many of its usual intervals, and this time.
_GAP_INTERVALS, _LEAST_GAP_S = 10.0, 0.25

#: Dead reckoning (time in ms, speed, steering), and beside it scans (TLsr in ms, LASER in cm).
DRIVE, SCANS = "aa3_dr.mat", "aa3_lsr2.mat"
# The car: wheelbase, distance of the encoder from the middle, and the scanner's position (m).
_AXLES_M, _ENCODER_M, _AHEAD_M, _LEFT_M = 2.83, 0.76, 3.78, 0.5
_BEAMS = 361
_FARTHEST_M = 75.0
# Largest range difference of neighbouring beams on a trunk, and least one to the background.
_SAME_M, _BEHIND_M = 0.5, 1.5
_LEAST_DIAMETER_M, _MOST_DIAMETER_M = 0.05, 1.0


def _names(times: FloatArray) -> tuple[str, ...]:
    """Names of frames: their times (s)."""
    return tuple(f"{time:.3f}" for time in times)


def discs_of_ranges(
    range_m: ArrayLike, bearing_rad: ArrayLike, sigma_m: float, sigma_rad: float
) -> tuple[FloatArray, FloatArray]:
    """Landmarks measured by range and bearing, as positions in the robot frame.

    Takes `range_m, bearing_rad` (n,); returns `xy` (n, 2), `covariance` (n, 2, 2).
    """
    distance = np.asarray(range_m, dtype=np.float64)
    sin, cos = np.sin(bearing_rad), np.cos(bearing_rad)
    direction = np.stack([sin, -cos], axis=-1)
    across = sigma_rad * distance[..., None] * np.stack([cos, sin], axis=-1)
    root = np.stack([sigma_m * direction, across], axis=-1)
    return distance[..., None] * direction, root @ np.swapaxes(root, -1, -2)


def _steps_between(
    logged: FloatArray,
    times: FloatArray,
    along: Callable[[IntArray, FloatArray], FloatArray],
    ends: tuple[float, float],
) -> tuple[FloatArray, FloatArray]:
    """Movements (N, 3) to each time, from the first of `ends` on; log rows hold until the next.

    `along` gives the movements for rows of the log (k,) held for some seconds (k,). Movements in
    gaps of the log have a covariance (N, 3, 3), from how much those per second vary; others zero.
    """
    knots = np.union1d(np.append(logged, ends[1]), times)
    knots = knots[knots >= ends[0]]
    held = np.clip(np.searchsorted(logged, knots[:-1], side="right") - 1, 0, None)
    poses = chain_steps(along(held, np.diff(knots)))[np.searchsorted(knots, times)]
    steps = between(np.concatenate([np.zeros((1, 3)), poses[:-1]]), poses)
    usual = np.median(np.diff(logged)) if len(logged) > 1 else math.inf
    silent = knots[1:] - logged[held] > max(_GAP_INTERVALS * usual, _LEAST_GAP_S)
    of_step = np.searchsorted(times, knots[1:])
    silence_s = np.bincount(of_step, np.diff(knots) * silent, len(times) + 1)[: len(times)]
    spread = np.var(along(np.arange(len(logged)), np.ones(len(logged))), axis=0)
    covariance = silence_s[:, None, None] ** 2 * np.diag(spread) + ASSUMED.covariance(steps)
    return steps, covariance * (silence_s > 0.0)[:, None, None]


class _Sightings(NamedTuple):
    """Landmarks that a robot saw."""

    times: FloatArray  # (N,): of the frames (s), ascending
    frame: IntArray  # (n,): the frame of each measurement, ascending
    range_m: FloatArray  # (n,): from the origin of the robot frame
    bearing_rad: FloatArray  # (n,): 0 forward, positive to the left
    ids: IntArray  # (n,): the landmark


def _seen_by_robot(odometry: Path) -> _Sightings:
    """The measurements beside a robot's odometry; sightings of other robots are ignored."""
    seen = _table(_beside(odometry, MEASUREMENTS), "time barcode range bearing")
    barcodes = _table(odometry.with_name(BARCODES), "subject barcode")
    subject = {int(barcode): int(number) for number, barcode in barcodes}
    ids = np.array([subject.get(int(barcode), 0) for barcode in seen[:, 1]], dtype=np.int64)
    seen, ids = seen[ids > _ROBOTS], ids[ids > _ROBOTS]
    for k in np.flatnonzero(seen[:, 2] <= 0.0)[:1]:
        raise SlamError(f"{odometry}: range {seen[k, 2]:g} at {seen[k, 0]:.3f}: expected above 0")
    if len(subject) < len(barcodes):
        raise SlamError(f"{odometry}: expected a subject for each barcode")
    order = np.argsort(seen[:, 0], kind="stable")
    times, frame = np.unique(seen[order, 0], return_inverse=True)
    return _Sightings(times, frame, seen[order, 2], seen[order, 3], ids[order])


def read_robot(odometry: Path, sigma_m: float, sigma_rad: float) -> Recording:
    """A robot's log, with landmarks as discs; steps have no covariance.

    Takes the standard deviations of ranges and bearings.
    """
    velocity, seen = _log(odometry, "time v omega"), _seen_by_robot(odometry)
    _demand_together(odometry, velocity[:, 0], _beside(odometry, MEASUREMENTS), seen.times)
    steps = _velocity_steps(velocity, seen.times)
    rows = discs_of_ranges(seen.range_m, seen.bearing_rad, sigma_m, sigma_rad)
    return _run(seen.times, *steps, CircleRows(seen.frame, *rows, seen.ids))


def _run(
    times: FloatArray, steps: FloatArray, covariance: FloatArray, rows: CircleRows
) -> Recording:
    """A run of movements (N, 3), X forward, before frames at some times (N,)."""
    spread = covariance_from_dataset(covariance, back=True)
    return Recording(_names(times), to_dataset(steps), spread, rows, LineRows.of())


def read_truth(odometry: Path) -> tuple[Path2D, int]:
    """True poses at a robot's start and its frames; how many lie outside: these are the nearest."""
    times, logged = _seen_by_robot(odometry).times, _log(odometry, "time v omega")
    truth = _log(_beside(odometry, TRUTH), "time x y theta")
    _demand_together(odometry, logged[:, 0], _beside(odometry, MEASUREMENTS), times)
    _demand_together(odometry, times, _beside(odometry, TRUTH), truth[:, 0])
    at = np.concatenate([[min(logged[0, 0], times[0])], times])
    repeated = int(np.count_nonzero((at < truth[0, 0]) | (at > truth[-1, 0])))
    columns = (truth[:, 1], truth[:, 2], np.unwrap(truth[:, 3]))
    poses = np.stack([np.interp(at, truth[:, 0], column) for column in columns], axis=1)
    return Path2D(("start", *_names(times)), to_dataset(poses)), repeated


def read_landmarks(path: Path) -> LandmarkMap:
    """`Landmark_Groundtruth.dat` (subject, x, y and their standard deviations) as a map."""
    table = _table(path, "subject x y x_sigma y_sigma")
    table = table[np.argsort(table[:, 0])]
    if not len(table) or np.any(table[:, 0] % 1.0) or not np.all(np.diff(table[:, 0]) > 0.0):
        raise SlamError(f"{path}: expected landmarks, each once, with whole numbers as subjects")
    covariance = np.zeros((len(table), 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = table[:, 4] ** 2, table[:, 3] ** 2
    count = np.zeros(len(table), dtype=np.int64)
    xy = to_dataset(table[:, 1:3])
    discs = Landmarks(table[:, 0].astype(np.int64), xy, covariance, count)
    return LandmarkMap(discs, no_landmarks())


def _velocity_steps(velocity: FloatArray, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Movements from the start of the odometry to each time, arcs approximated by their chords."""
    ends = min(velocity[0, 0], times[0]), max(times[-1], velocity[-1, 0]) + 1.0

    def along(held: IntArray, duration: FloatArray) -> FloatArray:
        turn = velocity[held, 2] * duration
        chord = velocity[held, 1] * duration * np.sinc(turn / (2.0 * np.pi))
        return np.stack([chord * np.cos(turn / 2.0), chord * np.sin(turn / 2.0), turn], axis=1)

    return _steps_between(velocity[:, 0], times, along, ends)


def _beside(odometry: Path, ending: str) -> Path:
    return odometry.with_name(odometry.name.removesuffix(ODOMETRY) + ending)


def _demand_order(path: Path, times: FloatArray, slack: float = 0.0) -> None:
    """Raise `SlamError` if times go back by more than some slack."""
    for k in np.flatnonzero(np.diff(times) < -slack)[:1]:
        raise SlamError(f"{path}: {times[k + 1]:.3f} is after {times[k]:.3f}: expected order")


def _demand_together(one: Path, first: FloatArray, other: Path, second: FloatArray) -> None:
    """Raise `SlamError` unless the times in two files, in order, overlap."""
    parts = [f"{t[0]:.3f} to {t[-1]:.3f}" if len(t) else "none" for t in (first, second)]
    if "none" in parts or max(first[0], second[0]) > min(first[-1], second[-1]):
        raise SlamError(f"{one}: times {parts[0]}, {other.name}: {parts[1]}: expected common ones")


def _log(path: Path, names: str) -> FloatArray:
    """The numbers of a file, by time. A clock that a network sets may go back by some of it."""
    table = _table(path, names)
    _demand_order(path, table[:, 0], _SET_BACK_S)
    return table[np.argsort(table[:, 0], kind="stable")]


def _table(path: Path, names: str) -> FloatArray:
    """The numbers of a file."""
    rows = [row for _, row in rows_of_numbers(path, "file of the data set", names, SlamError)]
    if np.any(np.abs(np.array(rows)) > LARGEST_NUMBER):
        raise SlamError(f"{path}: expected numbers within +-{LARGEST_NUMBER:g}")
    return np.array(rows, dtype=np.float64).reshape(-1, len(names.split()))


def read_drive(drive: Path, sigma_m: float, sigma_rad: float) -> Recording:
    """The car's log, with the trees found in its scans as discs; see `read_robot`."""
    time, speed, steering = _arrays(drive, ("time", "speed", "steering"))
    scanned, laser = _arrays(drive.with_name(SCANS), ("TLsr", "LASER"))
    time, speed, steering, scanned = (a.ravel() for a in (time, speed, steering, scanned))
    if len({len(time), len(speed), len(steering)}) != 1 or laser.shape != (len(scanned), _BEAMS):
        raise SlamError(f"{drive}: expected rows of equal number, and scans of {_BEAMS} beams")
    _demand_order(drive, time)
    _demand_order(drive.with_name(SCANS), scanned)
    _demand_together(drive, time, drive.with_name(SCANS), scanned)
    usable = scanned >= time[0]
    times, scans = scanned[usable] / 1000.0, laser[usable] / 100.0
    found = [trees_of(scan) for scan in scans]
    trees = np.concatenate([np.zeros((0, 2)), *found])
    frame = np.repeat(np.arange(len(found)), [len(some) for some in found])
    rows = discs_of_ranges(trees[:, 0], trees[:, 1], sigma_m, sigma_rad)
    steps = _car_steps(time / 1000.0, speed, steering, times)
    return _run(times, *steps, CircleRows(frame, *rows, np.full(len(trees), UNKNOWN_ID)))


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


def _car_steps(
    time: FloatArray, speed: FloatArray, steering: FloatArray, times: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Movements of the scanner between times, from the speed of a rear wheel and the steering."""

    def along(held: IntArray, duration: FloatArray) -> FloatArray:
        slope = np.tan(steering[held])
        way = speed[held] / (1.0 - slope * _ENCODER_M / _AXLES_M) * duration
        turn = way / _AXLES_M * slope
        return np.stack([way - turn * _LEFT_M, turn * _AHEAD_M, turn], axis=1)

    return _steps_between(time, times, along, (time[0], max(time[-1], times[-1])))


def _arrays(path: Path, names: tuple[str, ...]) -> list[FloatArray]:
    try:
        content = loadmat(str(path))
        return [np.asarray(content[name], dtype=np.float64) for name in names]
    except (OSError, TypeError, ValueError, KeyError, NotImplementedError, MatReadError) as error:
        raise SlamError(
            f"{path}: cannot be read ({error}): expected a MATLAB file with {', '.join(names)}"
        ) from None
