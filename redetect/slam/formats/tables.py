"""A run as comma-separated tables for GTSAM, MRPT and the like.

``odometry.csv`` has each step with two covariances: in the axes before the step, as the data set's
rows and MRPT's Gaussian poses have it, and in the axes at its end (``end_``), as GTSAM's
BetweenFactorPose2 and g2o's EDGE_SE2 measure their errors. ``discs.csv`` and ``bearings.csv`` have
the measurements. Numbers are in full precision; comments begin with ``#``.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import BoolArray
from redetect.slam.formats.g2o import end_covariance
from redetect.slam.formats.text import Axes, covariance_from_dataset, from_dataset, write_text
from redetect.slam.recording import UNKNOWN_ID, CircleRows, LineRows, Recording

_TRIANGLE_3 = ("cxx_m2", "cxy_m2", "cxphi_m_rad", "cyy_m2", "cyphi_m_rad", "cphiphi_rad2")
ODOMETRY_COLUMNS = (
    *("step", "prefix", "dx_m", "dy_m", "dphi_rad"),
    *_TRIANGLE_3,
    *(f"end_{name}" for name in _TRIANGLE_3),
)
DISC_COLUMNS = ("step", "prefix", "id", "x_m", "y_m", "cxx_m2", "cxy_m2", "cyy_m2")
BEARING_COLUMNS = (
    *("step", "prefix", "ids", "bearing_rad", "sigma_rad"),
    *("camera_x_m", "camera_y_m"),
)


def write_odometry(
    path: Path,
    recording: Recording,
    axes: Axes,
    comments: Sequence[str] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Write a run's steps: columns as `ODOMETRY_COLUMNS`, steps counted from 1."""
    steps = from_dataset(recording.steps, axes)
    before = covariance_from_dataset(recording.step_covariance, axes)
    triangle = np.triu_indices(3)
    numbers = np.concatenate(
        [steps, before[:, *triangle], end_covariance(steps, before)[:, *triangle]], axis=1
    )
    rows = [
        (k + 1, prefix, *row)
        for k, (prefix, row) in enumerate(zip(recording.prefixes, numbers.tolist()))
    ]
    _write(path, ODOMETRY_COLUMNS, rows, comments, overwrite)


def write_discs(
    path: Path,
    recording: Recording,
    axes: Axes,
    comments: Sequence[str] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Write the measurements of discs that have an identifier: columns as `DISC_COLUMNS`.

    Parameters, errors: as `write_odometry`.
    """
    some = recording.circles
    triangle = np.triu_indices(2)
    covariance = covariance_from_dataset(some.covariance, axes)[:, *triangle]
    numbers = np.concatenate([from_dataset(some.xy, axes), covariance], axis=1).tolist()
    rows = [
        (some.frame[k] + 1, recording.prefixes[some.frame[k]], some.ids[k], *numbers[k])
        for k in np.flatnonzero(identified_discs(some))
    ]
    _write(path, DISC_COLUMNS, rows, comments, overwrite)


def write_bearings(
    path: Path,
    recording: Recording,
    camera_xy: ArrayLike,
    axes: Axes,
    comments: Sequence[str] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Write the bearings of verticals that have identifiers: columns as `BEARING_COLUMNS`."""
    some = recording.lines
    camera = from_dataset(camera_xy, axes).tolist()
    rows = [
        (
            *(
                some.frame[k] + 1,
                recording.prefixes[some.frame[k]],
                ";".join(map(str, some.ids[k])),
            ),
            *(float(some.bearing_rad[k]), float(some.sigma_rad[k]), *camera),
        )
        for k in np.flatnonzero(identified_lines(some))
    ]
    _write(path, BEARING_COLUMNS, rows, comments, overwrite)


def identified_discs(some: CircleRows) -> BoolArray:
    """Which rows say what disc they show."""
    return np.asarray(some.ids != UNKNOWN_ID)


def identified_lines(some: LineRows) -> BoolArray:
    """Which rows say what lines they show."""
    return np.array([len(ids) > 0 for ids in some.ids], dtype=np.bool_)


def _write(
    path: Path,
    columns: Sequence[str],
    rows: Sequence[Sequence[object]],
    comments: Sequence[str],
    overwrite: bool,
) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    # csv writes the shortest digits that give a float back.
    writer.writerows(rows)
    head = [f"# {comment}" for comment in comments]
    write_text(path, [*head, *text.getvalue().splitlines()], overwrite=overwrite)
