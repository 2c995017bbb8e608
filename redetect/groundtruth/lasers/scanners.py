"""Planar laser scanners, the robot that they see, their scans over time, and the files.

If a scanner's beams are symmetric, as SICK's are, its x axis is along its middle beam; beams are
counted counter-clockwise. Poses of fixed scanners are in the world, those of scanners on board in
the robot's frame. The files are described in docs/groundtruth/sessions.md.
"""

from __future__ import annotations

import io
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, BinaryIO, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from redetect.array_types import FloatArray
from redetect.bounds import ABOVE_0, FINITE, NOT_0, NotNegative, Positive, demand_fields, whole
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import JsonObject, PathLike, parse_numbers, read_rows, write_json
from redetect.groundtruth.lasers.outline import outline_faces
from redetect.messages import excerpt, one_line
from redetect.storage.bounded import read_content, read_plain_array

MOST_READINGS = 4096

_MILLIMETRE = 1e-3
_LARGEST_FILE_BYTES = 1 << 30
# Far above what 16 bits hold; longer ranges are read as this, and are no readings then.
_FARTHEST_M = 1e3
# Noise is measured on beams with this number of readings at least. Stated noise is believed unless
# readings scatter by this factor more than it, or than what rounding to millimetres explains.
_FEWEST_FOR_NOISE = 20
_BELIEVED_NOISE = 1.5
_ENDINGS = (".scans.npz", ".scans.csv", ".scans.csv.gz")


@dataclass(frozen=True, eq=False)
class Scanner:
    """A laser scanner; raises `GroundTruthError` if a shape or value is impossible."""

    name: str  # Its scans are in ``<name>.scans.npz``
    pose: FloatArray  # (3,): x, y (m), theta (rad) in the world or, on board, the robot's frame
    covariance: FloatArray  # (3, 3): of the pose; zeros if it is known exactly
    first_angle_rad: Annotated[float, FINITE]  # Beam i points to first + i step in its frame
    angle_step_rad: Annotated[float, NOT_0]  # Negative where it is mounted upside down
    readings: Annotated[int, whole(1, MOST_READINGS)]  # Beams per scan
    max_range_m: Positive  # Readings of at least this length are no returns
    sigma_m: NotNegative  # Standard deviation of a reading (m)
    sweep_s: NotNegative = 0.0  # From a scan's first beam to its last (s)

    def __post_init__(self) -> None:
        place = f"scanner {excerpt(self.name)}"
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", self.name):
            raise GroundTruthError(f"{place}: expected a name of letters, digits, '-', '_', '.'")
        demand_fields(self, GroundTruthError)
        if (self.readings - 1) * abs(self.angle_step_rad) > 2.0 * np.pi + 1e-6:
            raise GroundTruthError(
                f"{place}: {self.readings} readings {self.angle_step_rad!r} rad apart: expected "
                "one turn or less"
            )

    @property
    def angles_rad(self) -> FloatArray:
        """(readings,) directions of the beams in the scanner's frame."""
        return np.asarray(self.first_angle_rad + self.angle_step_rad * np.arange(self.readings))

    @property
    def beam_times_s(self) -> FloatArray:
        """(readings,) times of the beams after the middle of the scan."""
        share = np.arange(self.readings) / max(self.readings - 1, 1) - 0.5
        return np.asarray(self.sweep_s * share)

    def metres(self, ranges_mm: ArrayLike) -> FloatArray:
        """Readings (...) in millimetres in metres; NaN if they hit nothing within range."""
        ranges = np.asarray(ranges_mm)
        hit = (ranges > 0) & (ranges < self.max_range_m / _MILLIMETRE)
        return np.where(hit, ranges * _MILLIMETRE, np.nan)

    def points(self, ranges_mm: ArrayLike) -> FloatArray:
        """Points (..., readings, 2) (m) in its frame of readings in mm; NaN if nothing was hit."""
        ranges, angles = self.metres(ranges_mm), self.angles_rad
        return np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=-1)


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot to be tracked by laser scanners."""

    outline: FloatArray  # (K, 2): corners of the polygon that scanners see, in its frame (m)
    largest_speed_m_s: float  # Upper bound of its speed
    largest_turn_rad_s: float
    scanners: tuple[Scanner, ...] = ()  # Those on board, with their poses in the robot's frame


def with_measured_noise(
    scanners: Sequence[Scanner], empties: Sequence[Scans], path: PathLike
) -> tuple[tuple[Scanner, ...], list[str]]:
    """The scanners of a file; those whose readings of the empty area scatter far more than stated
    get that noise: of a usual beam, which neither jumps along an edge nor is crossed.

    Also returns what to say about these.
    """
    found, texts = [], []
    for scanner, empty in zip(scanners, empties):
        metres = scanner.metres(empty.ranges_mm)
        beams = np.isfinite(metres).sum(axis=0) >= max(_FEWEST_FOR_NOISE, 0.5 * len(metres))
        scatter = np.nanstd(metres[:, beams], axis=0)
        measured = float(np.median(scatter)) if np.any(beams) else 0.0
        if measured > _BELIEVED_NOISE * max(scanner.sigma_m, _MILLIMETRE):
            texts.append(
                f"scanner {scanner.name}: readings of the empty area scatter by "
                f"{1e3 * measured:.1f} mm, not by {1e3 * scanner.sigma_m:.1f} mm as in {path}: the "
                "larger value is used"
            )
            scanner = replace(scanner, sigma_m=measured)
        found.append(scanner)
    return tuple(found), texts


def read_scanners(path: PathLike) -> tuple[Scanner, ...]:
    """Read a ``scanners.json``: the scanners, in the file's order.

    Raises `GroundTruthError` if the file cannot be read, an entry is missing or impossible, or two
    scanners have the same name.
    """
    return scanners_in(JsonObject.read(path))


def write_scanners(
    path: PathLike,
    scanners: Sequence[Scanner],
    extra: Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a ``scanners.json`` with covariances, and other entries, whole or not at all."""
    content = {"version": 1, "scanners": [scanner_entry(s) for s in scanners], **(extra or {})}
    write_json(path, content, overwrite=overwrite)


def read_robot(path: PathLike) -> Robot:
    """Read a ``robot.json``; raises `GroundTruthError` if the file or an entry is not valid."""
    content = JsonObject.read(path)
    outline = content.numbers("outline", None, 2)
    if len(outline) < 3:
        raise content.wrong("outline", "three or more corners (x, y)")
    try:
        outline_faces(outline)
    except GroundTruthError as error:
        raise GroundTruthError(f"{content.place}: {error}") from None
    return Robot(
        outline,
        content.number("largest_speed_m_s", ABOVE_0),
        content.number("largest_turn_rad_s", ABOVE_0),
        scanners_in(content) if content.values.get("scanners") else (),
    )


def scanner_entry(scanner: Scanner) -> dict[str, Any]:
    """A scanner as an entry of a file."""
    values = {field.name: getattr(scanner, field.name) for field in fields(scanner)}
    if not scanner.sweep_s:
        del values["sweep_s"]
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}


def scanners_in(content: JsonObject) -> tuple[Scanner, ...]:
    """The scanners of a file's object (see `read_scanners`)."""
    content.demand_version()
    scanners = tuple(_scanner(entry) for entry in content.rows("scanners"))
    names = [scanner.name for scanner in scanners]
    if twice := [name for name in names if names.count(name) > 1]:
        raise GroundTruthError(
            f"{content.place}: scanner {excerpt(twice[0])} is listed more than once"
        )
    return scanners


def _scanner(entry: JsonObject) -> Scanner:
    keys = ("first_angle_rad", "angle_step_rad", "max_range_m", "sigma_m")
    first, step, most, sigma = (entry.number(key) for key in keys)
    name, readings = entry.text("name"), entry.whole("readings")
    pose, covariance = entry.numbers("pose", 3), entry.uncertainty(3, "pose_sigma")
    sweep = entry.number("sweep_s") if "sweep_s" in entry else 0.0
    try:
        return Scanner(name, pose, covariance, first, step, readings, most, sigma, sweep)
    except GroundTruthError as error:
        raise GroundTruthError(f"{entry.place}: {error}") from None


@dataclass(frozen=True, eq=False)
class Scans:
    """Scans of one scanner over time.

    Raises `GroundTruthError` if shapes or types disagree or a time is not finite.
    """

    times_s: FloatArray  # (N,): of scans' middle beams, as measured; some real logs step back
    ranges_mm: NDArray[np.uint16]  # (N, readings): in millimetres, 0 if nothing was returned

    def __post_init__(self) -> None:
        count = len(self.times_s)
        if len(self.ranges_mm) != count or not 1 <= self.ranges_mm.shape[1] <= MOST_READINGS:
            raise GroundTruthError(
                f"ranges_mm of shape {self.ranges_mm.shape}: expected {count} scans of 1 to "
                f"{MOST_READINGS} readings"
            )
        if not np.isfinite(self.times_s).all():
            raise GroundTruthError("times_s with a number that is not finite")

    def __len__(self) -> int:
        return len(self.times_s)


def find_scans(folder: PathLike, name: str) -> Path:
    """The file with a scanner's scans in a folder: ``.scans.npz``, ``.csv`` or ``.csv.gz``.

    Raises `GroundTruthError` if there is none, or more than one.
    """
    found = [path for end in _ENDINGS if (path := Path(folder) / (name + end)).is_file()]
    if len(found) != 1:
        what = "no scans" if not found else f"scans in {len(found)} files"
        raise GroundTruthError(
            f"{Path(folder)}: {what} of scanner {excerpt(name)}: expected one file "
            f"{name}{_ENDINGS[0]}, {_ENDINGS[1]} or {_ENDINGS[2]}"
        )
    return found[0]


def read_scans(path: PathLike, readings: int | None = None, *, ordered: bool = True) -> Scans:
    """Read scans.

    Parameters
    ----------
    path : path
        ``.npz``, or rows of numbers, ``.gz`` or not.
    readings : int, optional
        Readings per scan. In rows with one number more, the first is a running number and is
        ignored; without `readings` the first number of a row is the time.
    ordered : bool
        Whether times that step back are refused.

    Returns
    -------
    Scans
        Readings rounded to millimetres; those of 65.536 m and more, which these files cannot
        store, are treated as no returns.

    Raises
    ------
    GroundTruthError
        If the file cannot be read, holds pickled objects, arrays of other shapes or types than
        expected, times that step back, or more than a GiB.
    """
    packed = Path(path).suffix == ".npz"
    times, ranges = _read_npz(path) if packed else _read_rows(path, readings)
    try:
        scans = Scans(times, ranges)
    except GroundTruthError as error:
        raise GroundTruthError(f"{path}: {error}") from None
    if not len(scans):
        raise GroundTruthError(f"{path}: no scans in it")
    width = scans.ranges_mm.shape[1]
    if readings not in (None, width):
        raise GroundTruthError(f"{path}: {width} readings per scan: expected {readings}")
    back = np.flatnonzero(np.diff(scans.times_s) < 0.0)
    if ordered and back.size:
        i = int(back[0])
        raise GroundTruthError(
            f"{path}: scan {i + 2} of {len(scans)} is from {scans.times_s[i + 1]:.6f} s, the one "
            f"before it from {scans.times_s[i]:.6f} s: expected times in order"
        )
    return scans


def _read_npz(path: PathLike) -> tuple[FloatArray, NDArray[np.uint16]]:
    """Read the two arrays, checking the sizes stated in the file and without unpickling."""
    content = read_content(path, _LARGEST_FILE_BYTES, "file", GroundTruthError)
    place, arrays = f"{path}: unreadable .npz", []
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for name, kind, dimensions in (("times_s", np.float64, 1), ("ranges_mm", np.uint16, 2)):
                place = f"{path}: {name}"
                info = archive.getinfo(f"{name}.npy")
                if info.file_size > _LARGEST_FILE_BYTES:
                    raise ValueError(f"larger than {_LARGEST_FILE_BYTES} bytes")
                with archive.open(info) as stream:
                    file, dtype = cast(BinaryIO, stream), np.dtype(kind)
                    arrays.append(read_plain_array(file, dtype, dimensions, info.file_size))
    except KeyError:
        raise GroundTruthError(f"{place}: no such array: expected times_s and ranges_mm") from None
    # Errors of damaged archives: names that are not UTF-8, offsets beyond the file, ...
    except (
        zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, ValueError, OverflowError,
        struct.error, zlib.error,
    ) as error:  # fmt: skip
        raise GroundTruthError(f"{place}: {one_line(str(error), 200)}") from None
    times, ranges = arrays
    return times, ranges


def _read_rows(path: PathLike, readings: int | None) -> tuple[FloatArray, NDArray[np.uint16]]:
    rows: list[FloatArray] = []
    columns = None if readings is None else readings + 1
    for line, words in read_rows(path, _LARGEST_FILE_BYTES):
        if not rows and words[0].lower() in ("t", "t_s", "time"):
            continue
        # Some scanners have infinity or the largest float for beams without a return.
        lead = 1 if readings is None else len(words) - readings
        words[lead:] = ["0" if word.lower() == "inf" else word for word in words[lead:]]
        values = np.array(parse_numbers(path, line, words, below=np.inf))
        if readings is not None and len(values) == readings + 2:
            values = values[1:]
        columns = columns or len(values)
        if len(values) != columns or columns < 2:
            wanted = "a time and readings" if columns < 2 else f"{columns}: time and readings"
            raise GroundTruthError(f"{path}:{line}: {len(words)} numbers: expected {wanted}")
        if np.any(values[1:] < 0.0):
            raise GroundTruthError(f"{path}:{line}: a reading below 0: expected metres")
        rows.append(values)
    table = np.stack(rows) if rows else np.zeros((0, columns or 2))
    millimetres = np.rint(np.minimum(table[:, 1:], _FARTHEST_M) / _MILLIMETRE)
    ranges = np.where(millimetres < 65536.0, millimetres, 0.0).astype(np.uint16)
    return table[:, 0].copy(), ranges
