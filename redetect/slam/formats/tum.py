"""Paths as TUM trajectories: a row ``t x y z qx qy qz qw`` for each pose; X forward, Y left.

Comments begin with ``#``. A path on the floor has z, qx and qy 0. For a run without times, t is the
number of the step, 0 for the start.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

import numpy as np

from redetect.landmarks import wrap_angle
from redetect.landmarks.axes import from_dataset, to_dataset
from redetect.landmarks.map_file import Path2D
from redetect.slam.errors import SlamError
from redetect.storage import write_text
from redetect.storage.bounded import rows_of_numbers

_COLUMNS = "t x y z qx qy qz qw"
# Tolerance of poses on the floor (m; quaternion).
_FLAT = 1e-6
_UNIT = 1e-3


def write_tum(
    path: str | os.PathLike[str],
    poses: Path2D,
    *,
    times: Mapping[str, float] | None = None,
    comments: Sequence[str] = (),
    overwrite: bool = False,
) -> None:
    """Write a path as a TUM trajectory."""
    rows = [f"# {comment}" for comment in (*comments, _COLUMNS)]
    numbers = (from_dataset(poses.poses) + 0.0).tolist()
    for number, (name, (x, y, theta)) in enumerate(zip(poses.prefixes, numbers)):
        half, t = 0.5 * theta, str(number)
        if times is not None:
            if name not in times:
                continue
            t = f"{times[name]:.6f}"
        rows.append(f"{t} {x!r} {y!r} 0 0 0 {np.sin(half).item()!r} {np.cos(half).item()!r}")
    write_text(path, rows, overwrite=overwrite)


def read_tum(path: str | os.PathLike[str]) -> Path2D:
    """Read a TUM trajectory of a path on the floor; the result is in the data set's axes.

    Angles are in [-pi, pi). The first pose is called ``start``, the others by their time. Raises
    `SlamError` with file and line if it is not on the floor, or its times do not ascend.
    """
    prefixes: list[str] = []
    numbers: list[list[float]] = []
    for place, row in rows_of_numbers(path, "TUM trajectory", _COLUMNS, SlamError):
        time, _, _, z, *quaternion = row
        if numbers and time <= numbers[-1][0]:
            raise SlamError(f"{place}: t is {time}: expected more than the row before")
        if abs(float(np.linalg.norm(quaternion)) - 1.0) > _UNIT:
            raise SlamError(f"{place}: qx qy qz qw are no unit quaternion")
        if max(map(abs, (z, *quaternion[:2]))) > _FLAT:
            raise SlamError(f"{place}: expected a pose on the floor: z, qx and qy 0")
        prefixes.append(f"{time:.15g}" if numbers else "start")
        numbers.append(row)
    if not numbers:
        raise SlamError(f"{path}: no poses: expected rows of {_COLUMNS}")
    table = np.array(numbers, dtype=np.float64)
    theta = wrap_angle(2.0 * np.arctan2(table[:, 6], table[:, 7]))
    poses = to_dataset(np.column_stack([table[:, 1:3], theta])) + 0.0  # no -0.0
    return Path2D(tuple(prefixes), poses)
