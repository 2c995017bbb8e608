"""A run: its odometry and landmark rows as arrays, checked for estimators, and its calibration."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from camera import Camera, camera_in, read_camera
from redetect import landmarks
from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.landmarks.files import read_head
from redetect.landmarks.records import numbers_of_step
from redetect.slam.errors import SlamError
from redetect.slam.models import OdometryNoise, common_tilt_jacobian
from redetect.slam.options import RunFlags
from redetect.storage import IMAGE_SUFFIXES

UNKNOWN_ID = -1

#: Origin of bearings where there are none: the robot's.
NO_CAMERA = np.zeros(2)

#: The noise of odometry without covariances.
ASSUMED = OdometryNoise()

#: Steps with larger standard deviations give no information on the robot's motion: they are lost.
MOST_STEP_SIGMA_M = 100.0
MOST_STEP_SIGMA_RAD = float(np.pi)
#: Standard deviations of the step from one run to another.
LOST_SIGMA_M, LOST_SIGMA_RAD = 1000.0, 10.0

# Share of the variance of discs' tilts that is assumed to be common to all frames.
_COMMON_SHARE = 0.5
# Indices of the covariance's numbers in a STEP row.
_STEP_COVARIANCE = np.array([[3, 4, 6], [4, 5, 7], [6, 7, 8]])


@dataclass(frozen=True, eq=False)
class CircleRows:
    """All disc rows of a run."""

    frame: IntArray  # (n,): of each row, ascending from 0: it was seen after step `frame`
    xy: FloatArray  # (n, 2): centres in the robot frame (m)
    covariance: FloatArray  # (n, 2, 2): of `xy` (m^2), positive definite
    ids: IntArray  # (n,): the first known one of each row; below 0 if there is none

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def identified(self) -> BoolArray:
        """(n,) mask of rows with an identifier."""
        return np.asarray(self.ids >= 0)

    def only(self, chosen: BoolArray | Sequence[int] | slice) -> CircleRows:
        """The chosen rows."""
        return CircleRows(*(each[chosen] for each in vars(self).values()))


@dataclass(frozen=True, eq=False)
class LineRows:
    """All rows of vertical lines of a run."""

    frame: IntArray  # (n,): of each row, ascending from 0
    bearing_rad: FloatArray  # (n,): 0 forward, positive to the left
    sigma_rad: FloatArray  # (n,): its standard deviation, above 0
    ids: tuple[tuple[int, ...], ...]  # all lines of each row (joined ones); empty if unknown

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def identified(self) -> BoolArray:
        """(n,) mask of rows with identifiers."""
        return np.array([len(ids) > 0 for ids in self.ids], dtype=np.bool_)

    def only(self, chosen: BoolArray | Sequence[int] | slice) -> LineRows:
        """The chosen rows."""
        return LineRows(
            self.frame[chosen],
            self.bearing_rad[chosen],
            self.sigma_rad[chosen],
            tuple(self.ids[k] for k in np.arange(len(self))[chosen]),
        )

    @classmethod
    def of(cls, rows: Iterable[tuple[int, float, float, tuple[int, ...]]] = ()) -> LineRows:
        """Rows of frame, bearing, its standard deviation and identifiers."""
        table = list(rows)
        return cls(
            np.array([row[0] for row in table], dtype=np.int64),
            np.array([row[1] for row in table], dtype=np.float64),
            np.array([row[2] for row in table], dtype=np.float64),
            tuple(row[3] for row in table),
        )


@dataclass(frozen=True, eq=False)
class Recording:
    """A run: N steps of odometry and the measurements after each."""

    prefixes: tuple[str, ...]  # the frames' names
    steps: FloatArray  # (N, 3): dx, dy (m), dphi (rad) in the robot frame before each step
    step_covariance: FloatArray  # (N, 3, 3): positive definite
    circles: CircleRows
    lines: LineRows  # none if they were not requested
    unstated_steps: int = 0  # number of steps with an assumed covariance
    tilted: bool = False  # whether covariances of discs include that of an unknown tilt
    levelled_by: tuple[float, float] = (0.0, 0.0)  # mean pitch and roll of frames with discs (rad)

    def __len__(self) -> int:
        return len(self.steps)

    @property
    def lost(self) -> IntArray:
        """Steps whose odometry gives no information on the robot's motion."""
        position = np.linalg.eigvalsh(self.step_covariance[:, :2, :2])[:, -1]
        turn = self.step_covariance[:, 2, 2]
        return np.flatnonzero((position > MOST_STEP_SIGMA_M**2) | (turn > MOST_STEP_SIGMA_RAD**2))

    @property
    def common_tilt_variance(self) -> float:
        """Variance of pitch, and of roll, that all frames may have in common (rad^2).

        Covariances of rows do not state how much of their tilt is common to all frames, such as the
        lean of the camera, but they have to contain it: half of the largest possible variance is
        assumed, and none if the covariances contain no tilt.
        """
        if not self.tilted or not len(self.circles):
            return 0.0
        effect = np.sum(common_tilt_jacobian(self.circles.xy) ** 2, axis=(1, 2))
        stated = np.trace(self.circles.covariance, axis1=1, axis2=2)
        largest = float(np.max(effect / stated))
        return _COMMON_SHARE / largest if largest > 0.0 else 0.0

    def part(self, first: int, last: int | None = None) -> Recording:
        """The frames from one on, up to another or the end."""
        end = len(self) if last is None else last
        discs = self.circles.only((self.circles.frame >= first) & (self.circles.frame < end))
        lines = self.lines.only((self.lines.frame >= first) & (self.lines.frame < end))
        return Recording(
            self.prefixes[first:end],
            self.steps[first:end],
            self.step_covariance[first:end],
            replace(discs, frame=discs.frame - first),
            replace(lines, frame=lines.frame - first),
            tilted=self.tilted,
        )


def first_poses(runs: Sequence[Recording]) -> IntArray:
    """(k + 1,) index in the path of `joined` runs at which each begins, and the number of poses."""
    return np.cumsum([0, *(len(run) + 1 for run in runs)])


def joined(runs: Sequence[Recording]) -> Recording:
    """Runs as one: a lost step leads from the end of each to the start of the next.

    The frame after that step has no rows; it is called `start`.
    """
    if len(runs) == 1:
        return runs[0]
    starts = first_poses(runs)
    lost = np.diag([LOST_SIGMA_M**2, LOST_SIGMA_M**2, LOST_SIGMA_RAD**2])[None]
    circles = [replace(run.circles, frame=run.circles.frame + k) for run, k in zip(runs, starts)]
    lines = [replace(run.lines, frame=run.lines.frame + k) for run, k in zip(runs, starts)]
    # The first run's start is not a step.
    return Recording(
        tuple(name for run in runs for name in ("start", *run.prefixes))[1:],
        np.concatenate([part for run in runs for part in (np.zeros((1, 3)), run.steps)])[1:],
        np.concatenate([part for run in runs for part in (lost, run.step_covariance)])[1:],
        CircleRows(*map(np.concatenate, zip(*(vars(some).values() for some in circles)))),
        LineRows.of(row for some in lines for row in zip(*vars(some).values())),
        sum(run.unstated_steps for run in runs),
        any(run.tilted for run in runs),
        _mean_tilt([run.levelled_by for run in runs for _ in range(len(run))]),
    )


def _mean_tilt(tilts: Sequence[tuple[float, float]]) -> tuple[float, float]:
    pitch, roll = np.mean(tilts or [(0.0, 0.0)], axis=0).tolist()
    return pitch, roll


def landmark_files(
    run: Path, *, circles: bool = True, lines: bool = False, stem: str | None = None
) -> list[Path]:
    """The landmark files of a run folder, of the requested kinds; for a file, itself.

    Their name is `stem`, by default map, or else detected.
    """
    if not run.is_dir():
        _demand_landmarks(run)
        if lines and run.suffix == ".circles":
            raise SlamError(f"{run}: has discs, not lines: expected its .lines file, or the folder")
        return [run]
    kinds = ["circles"] * circles + ["lines"] * lines
    if not kinds:
        raise SlamError(f"{run}: neither circles nor lines: expected at least one to be used")
    files = []
    for kind in kinds:
        candidates = [run / f"{name}.{kind}" for name in ([stem] if stem else ["map", "detected"])]
        found = next((path for path in candidates if path.is_file()), None)
        if found is None:
            expected = " or ".join(path.name for path in candidates)
            raise SlamError(
                f"{run}: no landmarks: expected {expected} in it: `detect {kind}` writes "
                f"detected.{kind}, --stem names another file"
            )
        files.append(found)
    return files


def _demand_landmarks(path: Path) -> None:
    """Raise `SlamError` for a path that cannot be a run."""
    expected = "expected a run folder, or a .circles or .lines file"
    if not path.exists():
        raise SlamError(f"{path}: no such landmark file or folder: {expected}")
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise SlamError(
            f"{path}: is a picture: {expected}: `detect circles` and `detect lines` find the "
            "landmarks in pictures"
        )
    if path.suffix.lower() == ".cam":
        raise SlamError(f"{path}: is a calibration: {expected}; calibrations are named by --camera")


def camera_of_run(run: Path, camera: Path | Camera | None = None) -> Camera:
    """Read the calibration that belongs to a run, a folder or a file in one.

    By default it is ``<run>.cam`` in the folder, or the only ``.cam`` there. Raises `SlamError` if
    there is none, `camera.CameraError` if it is ambiguous.
    """
    if camera is not None:
        return camera if isinstance(camera, Camera) else read_camera(camera)
    folder = run if run.is_dir() else run.parent
    found = camera_in(folder)
    if found is None:
        raise SlamError(
            f"{folder}: no calibration: expected a .cam file in it, or one by --camera; `camera "
            "calibrate` makes one, `camera convert` converts one of another program"
        )
    return found


def camera_xy_of(recording: Recording, run: Path, camera: Path | None = None) -> FloatArray:
    """(2,) the camera's centre in the robot frame (m); zero if no line needs it."""
    if not len(recording.lines):
        return NO_CAMERA
    return np.array(camera_of_run(run, camera).centre[:2])


def read_recording(
    run: str | os.PathLike[str],
    *,
    circles: bool = True,
    lines: bool = False,
    stem: str | None = None,
    noise: OdometryNoise = ASSUMED,
) -> Recording:
    """Read a run's rows.

    Of a folder, `circles` and `lines` of the files named `stem` (`landmark_files`); all rows of a
    single ``.circles`` or ``.lines`` file. `noise` is that of steps without a covariance. Raises
    `redetect.landmarks.LandmarkFileError` if a file is malformed; `SlamError`, with file, step and
    row, if there is no file or step, two files are not of the same run, or a covariance is not
    positive definite.
    """
    files = landmark_files(Path(run), circles=circles, lines=lines, stem=stem)
    frames = list(landmarks.read_frames(files[0]))
    for other in files[1:]:
        frames = _merged(frames, list(landmarks.read_frames(other)), files[0], other)
    found = recording_of_frames(frames, " and ".join(map(os.fspath, files)), noise)
    if not files[0].is_file():  # a pipe cannot be read twice
        return found
    return replace(found, tilted=read_head(files[0]).covers_tilt)


def read_runs(flags: RunFlags) -> list[Recording]:
    """Read the rows of the runs that flags name."""
    return [read_recording(run, noise=flags.odometry_noise, **flags.rows) for run in flags.runs]


def recording_of_frames(
    frames: Sequence[landmarks.Frame], name: str, noise: OdometryNoise = ASSUMED
) -> Recording:
    """Gather frames to arrays."""
    if not frames:
        raise SlamError(f"{name}: no STEP row: expected a run")
    steps = [frame.step for frame in frames]
    numbers = np.array([numbers_of_step(step) for step in steps])
    covariance = numbers[:, _STEP_COVARIANCE]
    if not np.any(numbers):
        raise SlamError(
            f"{name}: no odometry: all {len(steps)} steps and their covariances are 0; expected "
            "the robot's movements: `detect` includes them, from the source given by --odometry"
        )
    unstated = ~np.any(covariance, axis=(1, 2))
    covariance[unstated] = noise.covariance(numbers[unstated, :3])
    for bad in np.flatnonzero(~landmarks.is_positive_definite(covariance)):
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
        levelled_by=_mean_tilt([f.levelled_by or (0.0, 0.0) for f in frames if f.circles]),
    )


def frames_of_discs(recording: Recording) -> list[landmarks.Frame]:
    """Steps and rows of discs, of quality 1, as frames: the inverse of `recording_of_frames`."""
    circles, spread = recording.circles, recording.step_covariance.reshape(-1, 9)
    starts = np.searchsorted(circles.frame, np.arange(len(recording) + 1))
    numbers = np.column_stack([recording.steps, spread[:, [0, 1, 4, 2, 5, 8]]])
    frames = []
    for k, (prefix, row) in enumerate(zip(recording.prefixes, numbers.tolist())):
        own = circles.only(slice(starts[k], starts[k + 1]))
        seen = landmarks.circle_landmarks(own.xy, np.ones(len(own)), own.covariance, own.ids)
        frames.append(landmarks.Frame(landmarks.Step(prefix, *row), seen))
    return frames


def _circle_rows(frames: Sequence[landmarks.Frame], name: str) -> CircleRows:
    seen = [(k, row) for k, frame in enumerate(frames) for row in frame.circles]
    rows = landmarks.circle_arrays([row for _, row in seen])
    for bad in np.flatnonzero(~landmarks.is_positive_definite(rows.covariance)):
        k, row = seen[bad]
        raise SlamError(
            f"{name}: step {k + 1} ({frames[k].step.prefix}): the disc at ({row.px:g}, {row.py:g}) "
            "has a covariance that is not positive definite"
        )
    frame = np.array([k for k, _ in seen], dtype=np.int64)
    return CircleRows(frame, rows.xy, rows.covariance, rows.ids)


def _line_rows(frames: Sequence[landmarks.Frame], name: str) -> LineRows:
    seen = [(k, row) for k, frame in enumerate(frames) for row in frame.lines]
    for k, row in seen:
        if not row.sigma > 0.0:
            raise SlamError(
                f"{name}: step {k + 1} ({frames[k].step.prefix}): the line at bearing "
                f"{row.alpha:g} has sigma {row.sigma:g}: expected above 0"
            )
    return LineRows.of(
        (k, row.alpha, row.sigma, tuple(i for i in row.ids if i >= 0)) for k, row in seen
    )


def _merged(
    first: list[landmarks.Frame], second: list[landmarks.Frame], one: Path, other: Path
) -> list[landmarks.Frame]:
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
        merged.append(landmarks.Frame(a.step, a.landmarks + b.landmarks))
    return merged
