"""A run's odometry and landmark rows as arrays, checked for values that estimators cannot use."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.landmarks import Frame, is_positive_definite, read_frames
from redetect.slam.errors import SlamError
from redetect.slam.models import OdometryNoise

UNKNOWN_ID = -1

#: The noise of odometry that states none.
ASSUMED = OdometryNoise()

#: Suffixes of images.
PICTURES = {".bmp", ".gif", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff"}
_STEP_COLUMNS = (
    *("dx", "dy", "dphi"),
    *("cxx", "cxy", "cxphi"),
    *("cxy", "cyy", "cyphi"),
    *("cxphi", "cyphi", "cphiphi"),
)


@dataclass(frozen=True, eq=False)
class CircleRows:
    """All disc rows of a run.

    Attributes
    ----------
    frame : (n,) int64
        The frame of each row, ascending from 0: it was seen after step `frame`.
    xy : (n, 2) float64
        Centres in the robot frame (m).
    covariance : (n, 2, 2) float64
        Of `xy` (m^2), positive definite.
    ids : (n,) int64
        Identifiers; -1 where unknown, as are all below 0. Of a row with several the first that is
        known counts.
    """

    frame: IntArray
    xy: FloatArray
    covariance: FloatArray
    ids: IntArray

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def identified(self) -> BoolArray:
        """(n,) which rows say what disc they show."""
        return np.asarray(self.ids != UNKNOWN_ID)

    def only(self, chosen: BoolArray) -> CircleRows:
        """The chosen rows."""
        return CircleRows(
            self.frame[chosen], self.xy[chosen], self.covariance[chosen], self.ids[chosen]
        )


@dataclass(frozen=True, eq=False)
class LineRows:
    """All rows of vertical lines of a run.

    Attributes
    ----------
    frame : (n,) int64
        The frame of each row, ascending from 0.
    bearing_rad : (n,) float64
        alpha of each row, 0 forward and positive to the left.
    sigma_rad : (n,) float64
        Its standard deviation, above 0.
    ids : tuple of n tuples of int
        All lines that a row shows (joined rows have several); empty where unknown.
    """

    frame: IntArray
    bearing_rad: FloatArray
    sigma_rad: FloatArray
    ids: tuple[tuple[int, ...], ...]

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def identified(self) -> BoolArray:
        """(n,) which rows say what lines they show."""
        return np.array([len(ids) > 0 for ids in self.ids], dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class Recording:
    """A run: N steps of odometry and the measurements after each.

    Attributes
    ----------
    prefixes : tuple of N str
        The frames' names.
    steps : (N, 3) float64
        dx, dy (m), dphi (rad) in the robot frame before each step.
    step_covariance : (N, 3, 3) float64
        Of `steps`, positive definite.
    circles : CircleRows
    lines : LineRows
        Without rows if they were not requested.
    unstated_steps : int
        Steps whose covariance their source does not state: it is an assumed one.
    """

    prefixes: tuple[str, ...]
    steps: FloatArray
    step_covariance: FloatArray
    circles: CircleRows
    lines: LineRows
    unstated_steps: int = 0

    def __len__(self) -> int:
        return len(self.steps)


def landmark_file(run: Path, suffix: str, stem: str | None = None) -> Path:
    """The landmark file of a run folder."""
    candidates = [run / f"{name}{suffix}" for name in ([stem] if stem else ["map", "detected"])]
    for path in candidates:
        if path.is_file():
            return path
    expected = " or ".join(path.name for path in candidates)
    command = "circles" if suffix == ".circles" else "lines"
    raise SlamError(
        f"{run}: no landmarks: expected {expected} in it: `detect {command}` writes "
        f"detected{suffix}, --stem says how another file is called"
    )


def demand_landmarks(path: Path) -> Path:
    """A file that is named as a run, refused where it can't be one."""
    if not path.exists():
        raise SlamError(
            f"{path}: no such landmark file or folder: expected a run folder, or a .circles or "
            ".lines file"
        )
    if path.suffix.lower() in PICTURES:
        raise SlamError(
            f"{path}: is a picture: expected a run folder, or a .circles or .lines file: `detect "
            "circles` and `detect lines` find the landmarks in pictures"
        )
    if path.suffix.lower() == ".cam":
        raise SlamError(
            f"{path}: is a calibration: expected a run folder, or a .circles or .lines file; "
            "calibrations are named by --camera"
        )
    return path


def read_recording(
    run: str | os.PathLike[str],
    *,
    circles: bool = True,
    lines: bool = False,
    stem: str | None = None,
    noise: OdometryNoise = ASSUMED,
) -> Recording:
    """Read a run's rows.

    Parameters
    ----------
    run : path
        A run folder, or a single ``.circles`` or ``.lines`` file.
    circles, lines : bool
        Which landmarks to read from a folder. A file's own rows are all read.
    stem : str, optional
        Name of the files in the folder without suffix; see `landmark_file`.
    noise : OdometryNoise
        Of the steps that state no covariance.

    Returns
    -------
    Recording

    Raises
    ------
    redetect.landmarks.LandmarkFileError
        If a file is malformed.
    SlamError
        If there is no file, no step, two files are not of the same run, or a covariance is not
        positive definite; the message names file, step and row.
    """
    path = Path(run)
    if not path.is_dir():
        return recording_of_frames(
            list(read_frames(demand_landmarks(path))), os.fspath(path), noise
        )
    if not circles and not lines:
        raise SlamError(f"{path}: neither circles nor lines: expected at least one to be used")
    kinds = (".circles", circles), (".lines", lines)
    files = [landmark_file(path, suffix, stem) for suffix, wanted in kinds if wanted]
    frames = list(read_frames(files[0]))
    for other in files[1:]:
        frames = _merged(frames, list(read_frames(other)), files[0], other)
    return recording_of_frames(frames, " and ".join(map(os.fspath, files)), noise)


def recording_of_frames(
    frames: Sequence[Frame], name: str, noise: OdometryNoise = ASSUMED
) -> Recording:
    """Gather frames to arrays."""
    if not frames:
        raise SlamError(f"{name}: no STEP row: expected a run")
    steps = [frame.step for frame in frames]
    numbers = np.array([[getattr(step, name) for name in _STEP_COLUMNS] for step in steps])
    covariance = numbers[:, 3:].reshape(-1, 3, 3)
    if not np.any(numbers):
        raise SlamError(
            f"{name}: no odometry: all {len(steps)} steps and their covariances are 0; expected "
            "the robot's movements: `detect` takes them along, --odometry says where from"
        )
    unstated = ~np.any(covariance, axis=(1, 2))
    covariance[unstated] = noise.covariance(numbers[unstated, :3])
    for bad in np.flatnonzero(~is_positive_definite(covariance)):
        raise SlamError(
            f"{name}: step {bad + 1} ({steps[bad].prefix}): its covariance is not positive "
            "definite: expected a covariance of dx, dy and dphi of full rank"
        )
    return Recording(
        prefixes=tuple(step.prefix for step in steps),
        steps=numbers[:, :3].copy(),
        step_covariance=covariance,
        circles=_circle_rows(frames, name),
        lines=_line_rows(frames, name),
        unstated_steps=int(np.count_nonzero(unstated)),
    )


def _circle_rows(frames: Sequence[Frame], name: str) -> CircleRows:
    rows = [(k, row) for k, frame in enumerate(frames) for row in frame.circles]
    numbers = np.array(
        [(r.px, r.py, r.cxx, r.cxy, r.cxy, r.cyy) for _, r in rows], dtype=np.float64
    ).reshape(-1, 6)
    covariance = numbers[:, 2:].reshape(-1, 2, 2)
    for bad in np.flatnonzero(~is_positive_definite(covariance)):
        k, row = rows[bad]
        raise SlamError(
            f"{name}: step {k + 1} ({frames[k].step.prefix}): the disc at ({row.px:g}, {row.py:g}) "
            "has a covariance that is not positive definite"
        )
    return CircleRows(
        frame=np.array([k for k, _ in rows], dtype=np.int64),
        xy=numbers[:, :2].copy(),
        covariance=covariance,
        ids=np.array(
            [next((i for i in r.ids if i >= 0), UNKNOWN_ID) for _, r in rows], dtype=np.int64
        ),
    )


def _line_rows(frames: Sequence[Frame], name: str) -> LineRows:
    rows = [(k, row) for k, frame in enumerate(frames) for row in frame.lines]
    for k, row in rows:
        if not row.sigma > 0.0:
            raise SlamError(
                f"{name}: step {k + 1} ({frames[k].step.prefix}): the line at bearing "
                f"{row.alpha:g} has sigma {row.sigma:g}: expected above 0"
            )
    return LineRows(
        frame=np.array([k for k, _ in rows], dtype=np.int64),
        bearing_rad=np.array([r.alpha for _, r in rows], dtype=np.float64),
        sigma_rad=np.array([r.sigma for _, r in rows], dtype=np.float64),
        ids=tuple(tuple(i for i in r.ids if i >= 0) for _, r in rows),
    )


def _merged(first: list[Frame], second: list[Frame], one: Path, other: Path) -> list[Frame]:
    """Frames with the landmarks of both files, whose steps must be the same."""
    if len(first) != len(second):
        raise SlamError(f"{other}: {len(second)} steps: expected {len(first)}, as in {one}")
    merged = []
    for k, (a, b) in enumerate(zip(first, second)):
        if a.step != b.step:
            raise SlamError(
                f"{other}: step {k + 1} ({b.step.prefix}) is not that of {one} "
                f"({a.step.prefix}): expected files of one run"
            )
        merged.append(Frame(a.step, a.landmarks + b.landmarks))
    return merged
