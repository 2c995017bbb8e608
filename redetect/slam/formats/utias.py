"""UTIAS (MRCLAM), robots that see barcodes of landmarks and each other: runs, paths and maps.

Robots log velocities, and range and bearing. Their axes are X forward, Y left.

References
----------
K. Leung, Y. Halpern, T. Barfoot, H. Liu, "The UTIAS multi-robot cooperative localization and
mapping dataset", International Journal of Robotics Research 30(8), 2011.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from redetect.array_types import FloatArray, IntArray
from redetect.bounds import LARGEST_NUMBER
from redetect.landmarks import wrap_angle
from redetect.landmarks.axes import to_dataset
from redetect.landmarks.map_file import LandmarkMap, MapLandmarks, Path2D, no_landmarks
from redetect.plane import apply, between, invert
from redetect.slam.errors import SlamError
from redetect.slam.formats import ranges
from redetect.slam.formats.motion_log import (
    RAW_SIGMA_M,
    RAW_SIGMA_RAD,
    MotionLog,
    demand_common_times,
    demand_order,
    names_of,
    run_of,
)
from redetect.slam.recording import CircleRows, Recording
from redetect.storage.bounded import rows_of_numbers

#: Suffixes of the names of a robot's odometry and of the files beside it.
ODOMETRY, MEASUREMENTS, TRUTH = "_Odometry.dat", "_Measurement.dat", "_Groundtruth.dat"
LANDMARKS, BARCODES = "Landmark_Groundtruth.dat", "Barcodes.dat"
_ROBOTS = 5
_LARGEST_ID = 2**31 - 1
#: Most that the clock of a robot's log may go back, seconds.
_SET_BACK_S = 1.0
#: Largest bearing that a camera sees, radians.
_WIDEST_RAD = 1.2
#: Usual errors of these ranges, metres and as a share; of bearings.
_USUAL_SIGMA_M, _USUAL_SHARE, _USUAL_SIGMA_RAD = 0.03, 0.02, 0.02
#: Zeros between commands that last less than this are ignored, seconds.
_SHORT_STOP_S = 0.1
#: How a robot follows its commands: lags that are tried, and the longest time between two sightings
#: of landmarks that show it, seconds.
_LAGS_S, _NEXT_SIGHTING_S = np.arange(-0.5, 1.05, 0.1), 1.0
_NEAR_S = 0.02  #: A lag this near an end may be beyond it.
#: Step of the derivatives of residuals with respect to a response.
_STEP = 1e-3
#: Standard deviation of the lag: a robot of data set 6 starts after 0.32 s, stops after 0.17 s.
_LATE_S = 0.08


def _seen_by_robot(odometry: Path, *, calibrated: bool) -> ranges.Sightings:
    """The measurements beside a robot's odometry; sightings of other robots are ignored.

    Calibrated ones have ranges instead of depths, still too long.
    """
    measurements, listed = _beside(odometry, MEASUREMENTS), odometry.with_name(BARCODES)
    seen = _table(measurements, "time barcode range bearing")
    barcodes = _table(listed, "subject barcode")
    numbers = (_whole(listed, "barcode", barcodes[:, 1]), _whole(listed, "subject", barcodes[:, 0]))
    subject = dict(zip(*(each.tolist() for each in numbers)))
    shown = _whole(measurements, "barcode", seen[:, 1]).tolist()
    ids = np.array([subject.get(barcode, 0) for barcode in shown], dtype=np.int64)
    seen, ids = seen[ids > _ROBOTS], ids[ids > _ROBOTS]
    for k in np.flatnonzero(seen[:, 2] <= 0.0)[:1]:
        raise SlamError(
            f"{measurements}: range {seen[k, 2]:g} at {seen[k, 0]:.3f}: expected above 0"
        )
    if len(subject) < len(barcodes):
        raise SlamError(f"{listed}: expected a subject for each barcode")
    order = np.argsort(seen[:, 0], kind="stable")
    times, frame = np.unique(seen[order, 0], return_inverse=True)
    range_m, bearing_rad = seen[order, 2], seen[order, 3]
    if calibrated:
        for k in np.flatnonzero(np.abs(bearing_rad) > _WIDEST_RAD)[:1]:
            raise SlamError(
                f"{measurements}: bearing {bearing_rad[k]:g} at {seen[order[k], 0]:.3f}: expected "
                f"within +-{_WIDEST_RAD:g}, as seen by a camera; --no-calibrated takes ranges and "
                "odometry as they are"
            )
        range_m = range_m / np.cos(bearing_rad)
    return ranges.Sightings(times, frame, range_m, bearing_rad, ids[order])


class Response(NamedTuple):
    """How a robot follows its commands; the usual response in logs of the data set."""

    lag_s: float = 0.25  # how much later it moves
    speed: float = 1.0  # its speed over the commanded one
    turn: float = 1.0  # its turn rate over the commanded one
    #: What the logs call range is the depth along the camera's axis, over the true one: in logs of
    #: three robots, of data sets 6 and 7, compared with the true poses, 1.02, 1.03 and 1.05.
    depth: float = 1.033

    def sentence(self) -> str:
        """Description of the response."""
        return (
            f"the robot is taken to move {self.lag_s:.2f} s after its commands, {self.speed:.3f} "
            f"times as fast, and to turn {self.turn:.3f} times; depths are taken to be "
            f"too long by a factor of {self.depth:.3f}"
        )

    def doubt(self) -> str | None:
        """What may be wrong if the response is at the end of what was searched."""
        if not _LAGS_S[0] + _NEAR_S < self.lag_s < _LAGS_S[-1] - _NEAR_S:
            return "the clocks of odometry and measurements differ by more than was searched"
        return None


#: How much responses vary.
_RESPONSE_SIGMA = Response(0.25, 0.1, 0.1, 0.02)


def read_run(
    odometry: Path,
    sigma_m: float | None = None,
    sigma_rad: float | None = None,
    *,
    calibrated: bool = True,
) -> tuple[Recording, Response | None, ranges.Noise | None]:
    """A robot's log, with landmarks as discs; `SlamError` if a file cannot be used.

    Calibrated, steps are as the robot follows its commands (`response_of`), not as commanded, and
    ranges are computed from the depths that the log has; otherwise there is no `Response`.

    Takes standard deviations of independent ranges (m) and bearings (rad). By default, those of
    calibrated ones are learned, and so are covariances of steps (`redetect.slam.formats.ranges`);
    if only that of bearings is given, ranges have the usual errors. Otherwise most steps have no
    covariance, and there is no `Noise`.
    """
    velocity = _log(odometry, "time v omega")
    seen = _seen_by_robot(odometry, calibrated=calibrated)
    demand_common_times(odometry, velocity[:, 0], _beside(odometry, MEASUREMENTS), seen.times)
    usual_m = np.hypot(_USUAL_SIGMA_M, _USUAL_SHARE * seen.range_m) if calibrated else RAW_SIGMA_M
    usual_rad = _USUAL_SIGMA_RAD if calibrated else RAW_SIGMA_RAD
    sigma = np.empty((len(seen.ids), 2))
    sigma[:, 0] = usual_m if sigma_m is None else sigma_m
    sigma[:, 1] = usual_rad if sigma_rad is None else sigma_rad
    response, noise, log = None, None, _robot_log(velocity)
    if calibrated:
        velocity = _without_short_stops(velocity)
        places = np.full((len(seen.ids), 2), np.nan)
        if (file := odometry.with_name(LANDMARKS)).exists():
            true = read_landmarks(file).discs
            places = ranges.places_of(seen.ids, true.ids, true.xy)
        response = response_of(velocity, seen, sigma, places)
        seen = seen._replace(range_m=seen.range_m / response.depth)
        log = _robot_log(velocity, response)
    steps, spread = log.steps(np.append(min(velocity[0, 0], seen.times[0]), seen.times))
    rows = ranges.discs_of_ranges(seen.range_m, seen.bearing_rad, *sigma.T)
    run = run_of(seen.times, steps, spread, CircleRows(seen.frame, *rows, seen.ids))
    if calibrated and sigma_m is None and sigma_rad is None:
        run, noise = ranges.estimate_noise(run, seen, sigma)
    elif calibrated and sigma_m is None:
        run = ranges.with_noise(run, seen, sigma)
    return run, response, noise


def response_of(
    velocity: FloatArray, seen: ranges.Sightings, sigma: FloatArray, places: FloatArray
) -> Response:
    """How a robot follows its commands and measures depths, as the landmarks show it.

    From one sighting of a landmark to the next, range and bearing change as the robot moves; two
    landmarks seen in succession have a known distance. The most likely response predicts both
    best; where they show little, it is the usual one.

    Takes time (s), speed (m/s) and turn rate (rad/s) of each command (k, 3), n sightings with
    ranges that are too long by a factor, their standard deviations (n, 2) (m, rad), and the true
    positions of the landmarks (n, 2) (m), NaN for unknown ones.
    """
    time, every = seen.times[seen.frame], np.arange(len(seen.ids))
    before, after = _in_succession(np.lexsort((seen.frame, seen.ids)), time)
    one = (seen.ids[before] == seen.ids[after]) & (time[before] < time[after])
    before, after = before[one], after[one]
    first, second = _in_succession(every, time)
    apart_m = np.hypot(*(places[second] - places[first]).T)
    two = apart_m > 0.0
    first, second, apart_m = first[two], second[two], apart_m[two]
    spread = np.sum(sigma**2 * np.stack([np.ones(len(time)), seen.range_m**2], axis=1), axis=1)
    spread_of_pair = np.sqrt(spread[first] + spread[second])
    direction = np.stack([np.cos(seen.bearing_rad), np.sin(seen.bearing_rad)], axis=1)

    def residuals(numbers: ArrayLike) -> FloatArray:
        response = Response(*np.asarray(numbers).tolist())
        poses = _robot_log(velocity, response).poses(seen.times)[seen.frame]
        range_m = seen.range_m / response.depth
        place = range_m[:, None] * direction

        def later(start: IntArray, end: IntArray) -> FloatArray:
            """Places in the robot frame of another sighting."""
            return apply(invert(between(poses[start], poses[end])), place[start])

        x, y = later(before, after).T
        offset = later(first, second) - place[second]
        # Lengths are compared in the units of the log, whose errors are known.
        changes = np.concatenate([
            wrap_angle(np.arctan2(y, x) - seen.bearing_rad[after]) / sigma[after, 1],
            (np.hypot(x, y) - range_m[after]) * response.depth / sigma[after, 0],
            (np.hypot(*offset.T) - apart_m) * response.depth / spread_of_pair,
        ])  # fmt: skip
        robust = np.copysign(np.sqrt(np.arctan(changes**2)), changes)
        return np.concatenate([robust, np.subtract(response, Response()) / _RESPONSE_SIGMA])

    def jacobian(numbers: FloatArray) -> FloatArray:
        # Not by `least_squares`, whose steps are relative to the numbers: the lag may be 0.
        steps = _STEP * np.eye(len(numbers))
        changes = [residuals(numbers + step) - residuals(numbers - step) for step in steps]
        return np.stack(changes, axis=1) / (2.0 * _STEP)

    starts = [Response(lag_s) for lag_s in _LAGS_S.tolist()]
    begin = min(starts, key=lambda response: float(np.sum(residuals(response) ** 2)))
    bounds = (_LAGS_S[0] - 1e-9, 0.5, 0.5, 0.5), (_LAGS_S[-1] + 1e-9, 2.0, 2.0, 2.0)
    return Response(*least_squares(residuals, begin, jacobian, bounds).x.tolist())


def _in_succession(order: IntArray, time: FloatArray) -> tuple[IntArray, IntArray]:
    """Pairs of sightings, neighbours in some order, with little time in between."""
    apart_s = np.diff(time[order])
    near = (apart_s >= 0.0) & (apart_s < _NEXT_SIGHTING_S)
    return order[:-1][near], order[1:][near]


def read_truth(odometry: Path) -> tuple[Path2D, int]:
    """True poses at a robot's start and its frames; how many lie outside: these are the nearest."""
    times = _seen_by_robot(odometry, calibrated=False).times
    logged = _log(odometry, "time v omega")
    truth = _log(_beside(odometry, TRUTH), "time x y theta")
    demand_common_times(odometry, logged[:, 0], _beside(odometry, MEASUREMENTS), times)
    demand_common_times(odometry, times, _beside(odometry, TRUTH), truth[:, 0])
    at = np.concatenate([[min(logged[0, 0], times[0])], times])
    repeated = int(np.count_nonzero((at < truth[0, 0]) | (at > truth[-1, 0])))
    columns = (truth[:, 1], truth[:, 2], np.unwrap(truth[:, 3]))
    poses = np.stack([np.interp(at, truth[:, 0], column) for column in columns], axis=1)
    return Path2D(("start", *names_of(times)), to_dataset(poses)), repeated


def read_landmarks(path: Path) -> LandmarkMap:
    """`Landmark_Groundtruth.dat` (subject, x, y and their standard deviations) as a map."""
    table = _table(path, "subject x y x_sigma y_sigma")
    table = table[np.argsort(table[:, 0])]
    ids = _whole(path, "subject", table[:, 0])
    if not len(ids) or not np.all(np.diff(ids) > 0) or np.any(table[:, 3:] < 0.0):
        raise SlamError(f"{path}: expected landmarks, each once, and sigmas of 0 or more")
    covariance = np.zeros((len(table), 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = table[:, 4] ** 2, table[:, 3] ** 2
    count = np.zeros(len(table), dtype=np.int64)
    discs = MapLandmarks(ids, to_dataset(table[:, 1:3]), covariance, count)
    return LandmarkMap(discs, no_landmarks())


def _without_short_stops(velocity: FloatArray) -> FloatArray:
    """Commands (k, 3) without the zeros of 10 to 30 ms that the log has at full seconds."""
    still = ~np.any(velocity[:, 1:] != 0.0, axis=1)
    bounds = np.flatnonzero(np.diff(still, prepend=~still[:1], append=~still[-1:]))
    first, end = bounds[:-1], bounds[1:]
    lasts_s = velocity[np.minimum(end, len(still) - 1), 0] - velocity[first, 0]
    dropped = still[first] & (first > 0) & (end < len(still)) & (lasts_s < _SHORT_STOP_S)
    return np.asarray(velocity[~np.repeat(dropped, end - first)])


def _robot_log(velocity: FloatArray, response: Response | None = None) -> MotionLog:
    """The log of commands (k, 3), as the robot follows them; arcs are approximated by chords."""
    lag_s, speed_share, turn_share, _ = response or (0.0, 1.0, 1.0, 1.0)
    time, speed, turn_rate = (velocity * [1.0, speed_share, turn_share]).T

    def along(held: IntArray, duration: FloatArray) -> FloatArray:
        turn = turn_rate[held] * duration
        chord = speed[held] * duration * np.sinc(turn / (2.0 * np.pi))
        return np.stack([chord * np.cos(turn / 2.0), chord * np.sin(turn / 2.0), turn], axis=1)

    return MotionLog(time + lag_s, along, 0.0 if response is None else _LATE_S)


def _beside(odometry: Path, ending: str) -> Path:
    return odometry.with_name(odometry.name.removesuffix(ODOMETRY) + ending)


def _log(path: Path, names: str) -> FloatArray:
    """The numbers of a file, by time. A clock that a network sets may go back by some of it."""
    table = _table(path, names)
    demand_order(path, table[:, 0], _SET_BACK_S)
    return table[np.argsort(table[:, 0], kind="stable")]


def _table(path: Path, names: str) -> FloatArray:
    """The numbers of a file."""
    rows = [row for _, row in rows_of_numbers(path, "file of the data set", names, SlamError)]
    if np.any(np.abs(np.array(rows)) > LARGEST_NUMBER):
        raise SlamError(f"{path}: expected numbers within +-{LARGEST_NUMBER:g}")
    return np.array(rows, dtype=np.float64).reshape(-1, len(names.split()))


def _whole(path: Path, name: str, numbers: FloatArray) -> IntArray:
    """A column of identifiers (n,)."""
    for number in numbers[(numbers % 1.0 != 0.0) | (numbers < 0.0) | (numbers > _LARGEST_ID)][:1]:
        raise SlamError(f"{path}: {name} {number:g}: expected a whole number, 0 to {_LARGEST_ID}")
    return numbers.astype(np.int64)
