"""Surveyed fiducial points, points on the robot, and distances measured between them.

``fiducials.json`` holds both kinds of points; ``distances.csv`` has the head
``pose,t,point,fiducial,distance_m`` and a row per distance, measured while the robot stood still.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError, StreamError
from redetect.groundtruth.files import is_number, read_json, read_text
from redetect.storage.messages import excerpt

DISTANCES_HEAD = "pose,t,point,fiducial,distance_m"
_NAME = re.compile(r"[^\s,#\"]{1,64}")
_LARGEST_FILE_BYTES = 1 << 26
_FARTHEST_M = 1e6


@dataclass(frozen=True, eq=False)
class Survey:
    """Points between which distances are measured."""

    fiducials: dict[str, FloatArray]  # Surveyed points in the world (m)
    robot_points: dict[str, FloatArray]  # Points on the robot, in its frame (m)
    sigma_m: float  # Standard deviation of a distance (m)


@dataclass(frozen=True)
class Distance:
    """A distance from a point on the robot to a fiducial."""

    pose: int  # Number of the reference pose
    time_s: float  # When, on the ground truth's clock
    # `point`, `fiducial`: The two ends
    point: str
    fiducial: str
    distance_m: float


def read_survey(path: str | os.PathLike[str]) -> Survey:
    """Read a ``fiducials.json``.

    Raises
    ------
    GroundTruthError
        If the file cannot be read, or an entry is missing or impossible.
    """
    content = read_json(path)
    if content.get("version") != 1:
        raise GroundTruthError(f"{path}: version is {excerpt(content.get('version'))}: expected 1")
    sigma = content.get("sigma_m")
    if not is_number(sigma) or not 0.0 < sigma < _FARTHEST_M:
        raise GroundTruthError(f"{path}: sigma_m is {excerpt(sigma)}: expected metres above 0")
    points = [_points(path, content, key) for key in ("fiducials", "robot_points")]
    return Survey(points[0], points[1], float(sigma))


def read_distances(path: str | os.PathLike[str], survey: Survey) -> list[Distance]:
    """Read a ``distances.csv``.

    Parameters
    ----------
    survey : Survey
        The file may contain only its points.

    Returns
    -------
    list of Distance
        In the file's order.

    Raises
    ------
    StreamError
        If the file cannot be read, a row is malformed or names a point that is not known.
    """
    text = read_text(path, _LARGEST_FILE_BYTES, "rows")
    rows: list[Distance] = []
    for number, line in enumerate(text.split("\n"), 1):
        content = line.partition("#")[0].strip()
        if not content or (not rows and content == DISTANCES_HEAD):
            continue
        rows.append(_distance(path, number, [word.strip() for word in content.split(",")], survey))
    return rows


def _points(
    path: str | os.PathLike[str], content: dict[str, Any], key: str
) -> dict[str, FloatArray]:
    entries = content.get(key)
    if not isinstance(entries, dict) or len(entries) < 2:
        raise GroundTruthError(f"{path}: {key}: expected two or more points by name")
    points = {}
    for name, value in entries.items():
        good = isinstance(value, list) and len(value) == 2 and all(map(is_number, value))
        if not good or not all(abs(x) < _FARTHEST_M for x in value):
            raise GroundTruthError(
                f"{path}: {key}: {excerpt(name)} is {excerpt(value)}: expected [x, y]"
            )
        if not _NAME.fullmatch(name):
            raise GroundTruthError(
                f"{path}: {key}: {excerpt(name)}: expected a name without blanks"
            )
        points[name] = np.array(value, dtype=np.float64)
    return points


def _distance(
    path: str | os.PathLike[str], number: int, words: list[str], survey: Survey
) -> Distance:
    if len(words) != 5:
        raise StreamError(path, number, f"{len(words)} words: expected {DISTANCES_HEAD}")
    try:
        pose, time, distance = int(words[0]), float(words[1]), float(words[4])
    except ValueError:
        raise StreamError(path, number, f"expected numbers in {DISTANCES_HEAD}") from None
    if pose < 0 or not np.isfinite(time) or not 0.0 <= distance < _FARTHEST_M:
        raise StreamError(path, number, "expected a pose and a distance of 0 or more, finite")
    for name, known in ((words[2], survey.robot_points), (words[3], survey.fiducials)):
        if name not in known:
            raise StreamError(path, number, f"{excerpt(name)}: expected one of {', '.join(known)}")
    return Distance(pose, time, words[2], words[3], distance)
