"""Laser scanners in a plane and the robot that they see; ``scanners.json`` and ``robot.json``.

A scanner has its x axis along its middle beam where its beams lie symmetrically, as SICK's do;
beams are counted counter-clockwise. Its pose is that of the scanner in the world for a fixed one,
in the robot's frame for one on board.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import covariance_of, numbers, read_json, write_json
from redetect.storage.messages import excerpt

MOST_READINGS = 4096
MOST_SCANNERS = 256

_MILLIMETRE = 1e-3


@dataclass(frozen=True, eq=False)
class Scanner:
    """A laser scanner.

    Raises
    ------
    GroundTruthError
        If a shape or value is impossible.
    """

    name: str  # Its scans are in ``<name>.scans.npz``
    # (3,): x, y (m), theta (rad) of the scanner in the world or, on board, in the robot's frame
    pose: FloatArray
    # (3, 3): of the pose, (x, y, theta) in the same frame; zeros where it is known exactly.
    covariance: FloatArray
    # `first_angle_rad`, `angle_step_rad`: Beam i points to first_angle + i step in the scanner's
    # frame; the step is above 0.
    first_angle_rad: float
    angle_step_rad: float
    readings: int  # Beams per scan
    max_range_m: float  # A reading as long as this or longer is none
    sigma_m: float  # Standard deviation of a reading (m)

    def __post_init__(self) -> None:
        place = f"scanner {excerpt(self.name)}"
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", self.name):
            raise GroundTruthError(f"{place}: expected a name of letters, digits, '-', '_', '.'")
        if self.pose.shape != (3,) or self.covariance.shape != (3, 3):
            raise GroundTruthError(f"{place}: expected a pose of 3 numbers and a 3x3 covariance")
        if not (np.isfinite(self.pose).all() and np.isfinite(self.covariance).all()):
            raise GroundTruthError(f"{place}: its pose has a number that is not finite")
        if not 1 <= self.readings <= MOST_READINGS:
            raise GroundTruthError(
                f"{place}: {self.readings} readings: expected 1 to {MOST_READINGS}"
            )
        turn = (self.readings - 1) * self.angle_step_rad
        if not (self.angle_step_rad > 0.0 and turn <= 2.0 * np.pi + 1e-6):
            raise GroundTruthError(
                f"{place}: {self.readings} readings {self.angle_step_rad!r} rad apart: expected "
                "one turn or less, counter-clockwise"
            )
        if not np.isfinite(self.first_angle_rad):
            raise GroundTruthError(f"{place}: first_angle_rad is not finite")
        if not 0.0 < self.max_range_m < float("inf") or not 0.0 <= self.sigma_m < float("inf"):
            raise GroundTruthError(
                f"{place}: expected max_range_m above 0 and sigma_m of 0 or more"
            )

    @property
    def angles_rad(self) -> FloatArray:
        """(readings,) directions of the beams in the scanner's frame."""
        return np.asarray(self.first_angle_rad + self.angle_step_rad * np.arange(self.readings))

    def has_return(self, ranges_mm: ArrayLike) -> BoolArray:
        """Which of (..., readings) readings in millimetres hit something within range."""
        ranges = np.asarray(ranges_mm)
        return np.asarray((ranges > 0) & (ranges < self.max_range_m / _MILLIMETRE))

    def points(self, ranges_mm: ArrayLike) -> FloatArray:
        """Points (..., readings, 2) in the scanner's frame (m) of readings (..., readings) in
        millimetres.

        NaN where nothing was hit.
        """
        ranges = np.where(self.has_return(ranges_mm), np.asarray(ranges_mm) * _MILLIMETRE, np.nan)
        angles = self.angles_rad
        return np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=-1)


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot as laser tracking needs it."""

    # (K, 2): corners of the closed polygon that the scanners see, in the robot's frame (m)
    outline: FloatArray
    # `largest_speed_m_s`, `largest_turn_rad_s`: It moves no faster
    largest_speed_m_s: float
    largest_turn_rad_s: float
    scanners: tuple[Scanner, ...] = ()  # Those on board, with their poses in the robot's frame

    def __post_init__(self) -> None:
        if self.outline.ndim != 2 or self.outline.shape[1:] != (2,) or len(self.outline) < 3:
            raise GroundTruthError(
                f"outline of shape {self.outline.shape}: expected three or more corners (x, y)"
            )
        if not np.isfinite(self.outline).all():
            raise GroundTruthError("outline with a number that is not finite")
        for limit in (self.largest_speed_m_s, self.largest_turn_rad_s):
            if not 0.0 < limit < float("inf"):
                raise GroundTruthError(f"largest speed or turn {limit!r}: expected above 0")


def read_scanners(path: str | os.PathLike[str]) -> tuple[Scanner, ...]:
    """Read a ``scanners.json``: the scanners, in the file's order.

    Raises
    ------
    GroundTruthError
        If the file cannot be read, or an entry is missing, impossible or of a name given twice.
    """
    return _scanners(path, read_json(path))


def write_scanners(
    path: str | os.PathLike[str],
    scanners: Sequence[Scanner],
    extra: Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a ``scanners.json`` with covariances, and other entries, whole or not at all."""
    content = {"version": 1, "scanners": [scanner_entry(s) for s in scanners], **(extra or {})}
    write_json(path, content, overwrite=overwrite)


def read_robot(path: str | os.PathLike[str]) -> Robot:
    """Read a ``robot.json``.

    Raises
    ------
    GroundTruthError
        If the file cannot be read, or an entry is missing or impossible.
    """
    content = read_json(path)
    limits = []
    for key in ("largest_speed_m_s", "largest_turn_rad_s"):
        limits.append(float(numbers(f"{path}: {key}", content.get(key))))
    outline = numbers(f"{path}: outline", content.get("outline"), None, 2).reshape(-1, 2)
    scanners = _scanners(path, content) if "scanners" in content else ()
    try:
        return Robot(outline, limits[0], limits[1], scanners)
    except GroundTruthError as error:
        raise GroundTruthError(f"{path}: {error}") from None


def scanner_entry(scanner: Scanner) -> dict[str, Any]:
    """A scanner as files have it."""
    return {
        "name": scanner.name,
        "pose": scanner.pose.tolist(),
        "covariance": scanner.covariance.tolist(),
        "first_angle_rad": scanner.first_angle_rad,
        "angle_step_rad": scanner.angle_step_rad,
        "readings": scanner.readings,
        "max_range_m": scanner.max_range_m,
        "sigma_m": scanner.sigma_m,
    }


def _scanners(path: str | os.PathLike[str], content: dict[str, Any]) -> tuple[Scanner, ...]:
    if content.get("version") != 1:
        raise GroundTruthError(f"{path}: version is {excerpt(content.get('version'))}: expected 1")
    entries = content.get("scanners")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise GroundTruthError(f"{path}: scanners: expected a list of objects")
    if len(entries) > MOST_SCANNERS:
        raise GroundTruthError(f"{path}: {len(entries)} scanners: expected at most {MOST_SCANNERS}")
    scanners = tuple(_scanner(f"{path}: scanners[{i}]", e) for i, e in enumerate(entries))
    names = [scanner.name for scanner in scanners]
    for name in names:
        if names.count(name) > 1:
            raise GroundTruthError(f"{path}: scanner {excerpt(name)} is listed more than once")
    return scanners


def _scanner(place: str, entry: dict[str, Any]) -> Scanner:
    name, readings = entry.get("name"), entry.get("readings")
    if not isinstance(name, str):
        raise GroundTruthError(f"{place}: name is {excerpt(name)}: expected a text")
    if not isinstance(readings, int) or isinstance(readings, bool):
        raise GroundTruthError(f"{place}: readings is {excerpt(readings)}: expected a whole number")
    pose = numbers(f"{place}: pose", entry.get("pose"), 3)
    first, step, most, sigma = (
        float(numbers(f"{place}: {key}", entry.get(key)))
        for key in ("first_angle_rad", "angle_step_rad", "max_range_m", "sigma_m")
    )
    try:
        covariance = _pose_covariance(place, entry)
        return Scanner(name, pose, covariance, first, step, readings, most, sigma)
    except GroundTruthError as error:
        raise GroundTruthError(f"{place}: {error}") from None


def _pose_covariance(place: str, entry: dict[str, Any]) -> FloatArray:
    """The covariance of an entry, from `covariance` or `pose_sigma`; zeros without both."""
    if "covariance" in entry and "pose_sigma" in entry:
        raise GroundTruthError(f"{place}: has covariance and pose_sigma: expected one of them")
    if "pose_sigma" in entry:
        sigma = numbers(f"{place}: pose_sigma", entry["pose_sigma"], 3)
        if np.any(sigma < 0.0):
            raise GroundTruthError(f"{place}: pose_sigma: expected 0 or more")
        return np.diag(sigma**2)
    if "covariance" not in entry:
        return np.zeros((3, 3))
    return covariance_of(f"{place}: covariance", entry["covariance"], 3)
