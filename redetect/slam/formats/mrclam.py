"""Robots of the UTIAS data set (MRCLAM) as runs, paths and maps.

K. Leung, Y. Halpern, T. Barfoot, H. Liu, "The UTIAS multi-robot cooperative localization and
mapping dataset", International Journal of Robotics Research 30(8), 2011. Robots log velocities, and
range and bearing to barcodes of landmarks and of each other; axes are X forward, Y left.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from redetect.landmarks.map_file import LandmarkMap, Landmarks, Path2D, no_landmarks
from redetect.slam.errors import SlamError
from redetect.slam.formats.axes import to_dataset
from redetect.slam.formats.range_bearing import RangeBearing
from redetect.slam.formats.text import finite, text_rows
from redetect.slam.models.motion import chain_steps, relative_pose

FloatArray = NDArray[np.float64]

#: How the names of a robot's odometry and of the files beside it end.
ODOMETRY, MEASUREMENTS, TRUTH = "_Odometry.dat", "_Measurement.dat", "_Groundtruth.dat"
LANDMARKS, BARCODES = "Landmark_Groundtruth.dat", "Barcodes.dat"
_ROBOTS = 5


def read_robot(odometry: Path) -> RangeBearing:
    """What a robot logged; other robots that it saw are left out."""
    velocity = _table(odometry, ("time", "v", "omega"))
    seen = _table(_beside(odometry, MEASUREMENTS), ("time", "barcode", "range", "bearing"))
    barcodes = _table(odometry.with_name(BARCODES), ("subject", "barcode"))
    subject = {int(barcode): int(number) for number, barcode in barcodes}
    ids = np.array([subject.get(int(barcode), 0) for barcode in seen[:, 1]], dtype=np.int64)
    seen, ids = seen[ids > _ROBOTS], ids[ids > _ROBOTS]
    order = np.argsort(seen[:, 0], kind="stable")
    times, frame = np.unique(seen[order, 0], return_inverse=True)
    if len(times) == 0 or len(velocity) == 0:
        raise SlamError(f"{odometry}: no odometry, or no landmark seen: expected both")
    return RangeBearing(
        times=times,
        steps=to_dataset(_steps(velocity, times), "robotics"),
        frame=frame,
        range_m=seen[order, 2],
        bearing_rad=seen[order, 3],
        ids=ids[order],
    )


def read_truth(odometry: Path) -> Path2D:
    """True poses of a robot at the times of its frames, and first that at the start."""
    run = read_robot(odometry)
    truth = _table(_beside(odometry, TRUTH), ("time", "x", "y", "theta"))
    if len(truth) == 0:
        raise SlamError(f"{odometry}: no true pose beside it: expected some")
    begin = _table(odometry, ("time", "v", "omega"))[0, 0]
    at = np.concatenate([[min(begin, run.times[0])], run.times])
    columns = (truth[:, 1], truth[:, 2], np.unwrap(truth[:, 3]))
    poses = np.stack([np.interp(at, truth[:, 0], column) for column in columns], axis=1)
    return Path2D(("start", *run.prefixes), to_dataset(poses, "robotics"))


def read_landmarks(path: Path) -> LandmarkMap:
    """`Landmark_Groundtruth.dat` (subject, x, y and their standard deviations) as a map."""
    table = _table(path, ("subject", "x", "y", "x sigma", "y sigma"))
    table = table[np.argsort(table[:, 0])]
    covariance = np.zeros((len(table), 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = table[:, 4] ** 2, table[:, 3] ** 2
    count = np.zeros(len(table), dtype=np.int64)
    xy = to_dataset(table[:, 1:3], "robotics")
    return LandmarkMap(
        Landmarks(table[:, 0].astype(np.int64), xy, covariance, count), no_landmarks()
    )


def _steps(velocity: FloatArray, times: FloatArray) -> FloatArray:
    """Movements from the odometry's begin to each time; a velocity holds till the next."""
    ends = np.concatenate([velocity[1:, 0], [max(times[-1], velocity[-1, 0]) + 1.0]])
    knots = np.union1d(np.concatenate([velocity[:, 0], ends[-1:]]), times)
    knots = knots[knots >= min(velocity[0, 0], times[0])]
    held = np.clip(np.searchsorted(velocity[:, 0], knots[:-1], side="right") - 1, 0, None)
    duration = np.diff(knots)
    turn = velocity[held, 2] * duration
    # Along an arc, by its chord.
    chord = velocity[held, 1] * duration * np.sinc(turn / (2.0 * np.pi))
    along = np.stack([chord * np.cos(turn / 2.0), chord * np.sin(turn / 2.0), turn], axis=1)
    poses = chain_steps(along)[np.searchsorted(knots, times)]
    return relative_pose(np.concatenate([np.zeros((1, 3)), poses[:-1]]), poses)


def _beside(odometry: Path, ending: str) -> Path:
    return odometry.with_name(odometry.name.removesuffix(ODOMETRY) + ending)


def _table(path: Path, names: tuple[str, ...]) -> FloatArray:
    """The numbers of a file, sorted by the first column as they come."""
    rows = []
    for line, text in text_rows(path):
        if text.startswith("#"):
            continue
        words = text.split()
        if len(words) != len(names):
            raise SlamError(f"{path}:{line}: {len(words)} numbers: expected {', '.join(names)}")
        rows.append([finite(path, line, name, word) for name, word in zip(names, words)])
    return np.array(rows, dtype=np.float64).reshape(-1, len(names))
