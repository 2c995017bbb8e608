"""Files of poses and times: RAWSEEDS' comma-separated streams, TUM trajectories, ``.times``.

A RAWSEEDS stream has a row per pose: time (s), x, y (m), heading theta (rad), and for ground truth
the 3x3 covariance of (x, y, theta) row by row. It has no comments and no header.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.errors import GroundTruthError, StreamError
from redetect.groundtruth.files import read_text
from redetect.groundtruth.trajectories.transforms import quaternion_xyzw
from redetect.storage import write_whole
from redetect.storage.messages import excerpt

#: Half of the last digit of the covariances in RAWSEEDS' own files.
RAWSEEDS_ROUNDING = 5e-7

_POSE_COLUMNS = 4
_COVARIANCE_COLUMNS = 13
_LARGEST_FILE_BYTES = 1 << 28
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


@dataclass(frozen=True, eq=False)
class PlanarPoses:
    """Poses of a robot on the floor over time.

    Raises
    ------
    GroundTruthError
        If shapes disagree, a number is not finite or times descend.
    """

    times_s: FloatArray  # (N,): seconds, not descending
    # (N, 3): x, y (m) and theta (rad). Headings may lie past +-pi, as in the real streams.
    poses: FloatArray
    # (N, 3, 3): covariances of (x, y, theta); may be singular where a file's rounding made them so.
    covariances: FloatArray | None = None

    def __post_init__(self) -> None:
        count = len(self.times_s)
        if self.times_s.shape != (count,) or self.poses.shape != (count, 3):
            raise GroundTruthError(
                f"poses of shapes {self.times_s.shape} and {self.poses.shape}: "
                "expected (N,) times and (N, 3) poses"
            )
        if self.covariances is not None and self.covariances.shape != (count, 3, 3):
            raise GroundTruthError(
                f"covariances of shape {self.covariances.shape}: expected ({count}, 3, 3)"
            )
        for name, values in (
            ("times", self.times_s),
            ("poses", self.poses),
            ("covariances", self.covariances),
        ):
            if values is not None and not np.all(np.isfinite(values)):
                raise GroundTruthError(f"{name} with a number that is not finite")
        descending = np.flatnonzero(np.diff(self.times_s) < 0.0)
        if descending.size:
            i = int(descending[0])
            raise GroundTruthError(
                f"pose {i + 2} of {count} is from {self.times_s[i + 1]:.6f} s, before pose {i + 1} "
                f"from {self.times_s[i]:.6f} s: expected times in order"
            )

    def __len__(self) -> int:
        return len(self.times_s)

    def only(self, chosen: NDArray[Any] | slice) -> PlanarPoses:
        """The chosen poses, by a mask, indices or a slice."""
        covariances = None if self.covariances is None else self.covariances[chosen]
        return PlanarPoses(self.times_s[chosen], self.poses[chosen], covariances)


def last_of_each_time(poses: PlanarPoses) -> PlanarPoses:
    """Keep only the last of all poses with the same time.

    Where stamps are coarser than samples, as with buffers that are read from time to time, several
    poses have the same time. The robot moved between them, but at no computable speed.
    """
    last = np.append(np.diff(poses.times_s) > 0.0, True)[: len(poses)]
    return poses if np.all(last) else poses.only(last)


def is_positive_definite(covariances: FloatArray, rounding: float = 0.0) -> BoolArray:
    """Which of (..., d, d) covariances can be inverted in earnest.

    `covariances` (..., d, d). `rounding`: by how much each entry may be off; an eigenvalue must be
    larger than that.
    """
    symmetric = 0.5 * (covariances + np.swapaxes(covariances, -1, -2))
    scale = np.sqrt(np.clip(np.diagonal(symmetric, axis1=-2, axis2=-1), 0.0, None))
    positive = np.all(scale > 0.0, axis=-1)
    safe = np.where(positive[..., None], scale, 1.0)
    correlation = symmetric / safe[..., :, None] / safe[..., None, :]
    smallest = np.linalg.eigvalsh(correlation)[..., 0]
    absolute = np.linalg.eigvalsh(symmetric)[..., 0]
    return np.asarray(positive & (smallest > 1e-9) & (absolute > rounding))


def read_planar_poses(path: str | os.PathLike[str]) -> PlanarPoses:
    """Read a RAWSEEDS stream, with or without covariances.

    Parameters
    ----------
    path : path
        Rows of 4 or 13 numbers between commas or blanks, all rows alike; blank lines and `#`
        comments, which the real files do not have, are skipped.

    Raises
    ------
    StreamError
        If the file cannot be read or a row is malformed; the message names file and line.
    """
    rows: list[list[float]] = []
    columns: int | None = None
    for line, words in _rows(path):
        if columns is None:
            columns = len(words)
        if len(words) not in (_POSE_COLUMNS, _COVARIANCE_COLUMNS) or len(words) != columns:
            expected = "4 or 13" if not rows else str(columns)
            raise StreamError(
                path,
                line,
                f"{len(words)} numbers: expected {expected}: t, x, y, theta and 9 of covariance",
            )
        rows.append(_numbers(path, line, words))
        if len(rows) > 1 and rows[-1][0] < rows[-2][0]:
            raise StreamError(
                path, line, f"time {rows[-1][0]:.6f} s is before the row above: expected in order"
            )
    if columns is None:
        raise StreamError(path, None, "no poses in it")
    table = np.array(rows)
    covariances = table[:, 4:].reshape(-1, 3, 3) if columns == _COVARIANCE_COLUMNS else None
    return PlanarPoses(table[:, 0].copy(), table[:, 1:4].copy(), covariances)


def format_planar_poses(poses: PlanarPoses, covariance_decimals: int = 12) -> str:
    """Format poses as a RAWSEEDS stream.

    `covariance_decimals`: the real files have 6, with which variances below (0.7 mm)^2 vanish and
    matrices become singular; so there are more here unless asked for.
    """
    lines = []
    for i in range(len(poses)):
        words = [f"{poses.times_s[i]:.6f}", *(f"{value:.6f}" for value in poses.poses[i])]
        if poses.covariances is not None:
            words += [f"{value:.{covariance_decimals}f}" for value in poses.covariances[i].ravel()]
        lines.append(",".join(words) + "\n")
    return "".join(lines)


def write_planar_poses(
    path: str | os.PathLike[str],
    poses: PlanarPoses,
    *,
    covariance_decimals: int = 12,
    overwrite: bool = False,
) -> None:
    """Write poses as a RAWSEEDS stream, whole or not at all (see `format_planar_poses`)."""
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write(format_planar_poses(poses, covariance_decimals).encode())


def format_tum(times_s: FloatArray, world_from_robot: FloatArray) -> str:
    """Format (N,) times and (N, 4, 4) poses as a TUM trajectory: t x y z qx qy qz qw."""
    quaternions = quaternion_xyzw(world_from_robot) if len(times_s) else np.zeros((0, 4))
    return "".join(
        " ".join([f"{t:.6f}", *(f"{v:.6f}" for v in pose[:3, 3]), *(f"{v:.9f}" for v in q)]) + "\n"
        for t, pose, q in zip(times_s, world_from_robot, quaternions)
    )


def read_times(path: str | os.PathLike[str]) -> dict[str, float]:
    """Read a ``.times`` file: rows ``prefix seconds``, with `#` comments.

    Returns
    -------
    dict of str to float
        Seconds by image prefix.

    Raises
    ------
    StreamError
        If the file cannot be read, a row is malformed or a prefix is listed twice.
    """
    times: dict[str, float] = {}
    for line, words in _rows(path):
        if len(words) != 2:
            raise StreamError(path, line, f"{len(words)} words: expected a prefix and seconds")
        prefix = words[0]
        if prefix in times:
            raise StreamError(path, line, f"prefix {excerpt(prefix)} is listed a second time")
        times[prefix] = _numbers(path, line, words[1:])[0]
    return times


def read_rows_of_numbers(
    path: str | os.PathLike[str], columns: int, expected: str, *, head: str = ""
) -> FloatArray:
    """Read rows of numbers between commas or blanks; blank lines and `#` comments are skipped.

    Parameters
    ----------
    columns : int
        Numbers in every row.
    expected : str
        What they are, for messages.
    head : str
        Names between commas that may be on the first line.

    Returns
    -------
    (N, columns) float64

    Raises
    ------
    StreamError
        If the file cannot be read, is empty or a row is malformed; it names file and line.
    """
    rows: list[list[float]] = []
    for line, words in _rows(path):
        if not rows and words == head.split(","):
            continue
        if len(words) != columns:
            raise StreamError(path, line, f"{len(words)} numbers: expected {columns}: {expected}")
        rows.append(_numbers(path, line, words))
    if not rows:
        raise StreamError(path, None, f"no rows in it: expected {expected}")
    return np.array(rows)


def _rows(path: str | os.PathLike[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield line numbers and words, without comments and blank lines."""
    text = read_text(path, _LARGEST_FILE_BYTES, "rows of numbers")
    for number, line in enumerate(text.split("\n"), 1):
        content = line.partition("#")[0].strip()
        if content:
            yield number, re.split(r"\s*,\s*|\s+", content)


def _numbers(path: str | os.PathLike[str], line: int, words: list[str]) -> list[float]:
    numbers = []
    for word in words:
        value = float(word) if _NUMBER.fullmatch(word) else float("nan")
        if not np.isfinite(value):
            raise StreamError(path, line, f"{excerpt(word)}: expected a finite number")
        numbers.append(value)
    return numbers
