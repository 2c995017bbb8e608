"""A run's landmark file as arrays, and the places to begin a fit from."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from redetect.landmarks import Frame, circle_arrays, is_positive_definite
from redetect.slam.models import chain_steps
from tools.arrays import BoolArray, FloatArray, IntArray


class RecordingError(ValueError):
    """A recording, path or map from which no world can be made."""


@dataclass(frozen=True, eq=False)
class Recording:
    """What a run's landmark file says, as arrays; rows without an ID are left out."""

    prefixes: NDArray[np.str_]  # (N,) Names of the frames' images.
    steps: FloatArray  # (N, 3) Odometry: dx, dy, dphi in the robot frame before the step.
    step_covariance: FloatArray  # (N, 3, 3) Their covariances.
    disc_ids: IntArray  # (M,) The discs' IDs, ascending; one ID can stand for several discs.
    frame: IntArray
    """(n,) For each row its frame and its disc (an index into `disc_ids`, not an ID)."""
    disc: IntArray  # (n,)
    row_xy: FloatArray  # (n, 2) The rows' positions in the robot frame, metres.
    row_covariance: FloatArray  # (n, 2, 2) Their covariances.
    pixels: FloatArray  # (n, 2) Where in the image the rows came from.


def recording_of_frames(camera: Camera, frames: Iterable[Frame]) -> Recording:
    """Gather the frames of a landmark file."""
    frames = list(frames)
    circles = [circle_arrays(frame.circles) for frame in frames]
    ids = np.concatenate([np.zeros(0, dtype=np.int64), *(c.ids for c in circles)])
    known = ids >= 0
    if not known.any():
        raise RecordingError(
            f"no disc with an ID in {len(frames)} frames: expected LANDMARK_C rows"
        )
    prefixes = np.array([frame.step.prefix for frame in frames])
    frame_index = np.repeat(np.arange(len(frames)), [len(c.ids) for c in circles])[known]
    disc_ids, disc = np.unique(ids[known], return_inverse=True)
    row_xy = np.concatenate([c.xy for c in circles])[known]
    row_covariance = np.concatenate([c.covariance for c in circles])[known]
    pixels = camera.project_floor(row_xy)

    numbers = np.array(
        [
            (s.dx, s.dy, s.dphi, s.cxx, s.cxy, s.cxphi, s.cyy, s.cyphi, s.cphiphi)
            for s in (frame.step for frame in frames)
        ]
    )
    step_covariance = numbers[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(-1, 3, 3)

    _demand(is_positive_definite(step_covariance), prefixes, "odometry covariance is singular")
    row_prefixes = prefixes[frame_index]
    _demand(is_positive_definite(row_covariance), row_prefixes, "a disc's covariance is singular")
    seen = np.all(np.isfinite(pixels), axis=1)
    _demand(seen, row_prefixes, "a disc lies where the camera sees no floor: is it this camera?")
    return Recording(
        prefixes=prefixes,
        steps=numbers[:, :3],
        step_covariance=step_covariance,
        disc_ids=disc_ids,
        frame=frame_index.astype(np.int64),
        disc=disc.astype(np.int64),
        row_xy=row_xy,
        row_covariance=row_covariance,
        pixels=pixels,
    )


def _demand(good: BoolArray, prefixes: NDArray[np.str_], problem: str) -> None:
    if not good.all():
        raise RecordingError(f"STEP {prefixes[np.argmin(good)]}: {problem}")


def read_path(path: str | os.PathLike[str], frames: int) -> FloatArray:
    """Read a path: rows x, y (m), theta (rad); the start (0, 0, 0), then the pose after each step.
    Returns (frames, 3).
    """
    poses = _read_table(path)
    if len(poses) != frames + 1:
        raise RecordingError(
            f"{path}: {len(poses)} poses: expected {frames + 1}, the start and one for each STEP"
        )
    if np.any(poses[0] != 0.0):
        raise RecordingError(f"{path}: starts at {poses[0]}: expected 0, 0, 0")
    return poses[1:]


def read_map(path: str | os.PathLike[str], disc_ids: IntArray) -> FloatArray:
    """Read a map: rows ID, x, y (m). Returns (M, 2)."""
    table = _read_table(path)
    place = {int(disc_id): (x, y) for disc_id, x, y in table}
    missing = [int(disc_id) for disc_id in disc_ids if int(disc_id) not in place]
    if missing:
        raise RecordingError(f"{path}: no disc with ID {missing[0]}, which the landmark file names")
    return np.array([place[int(disc_id)] for disc_id in disc_ids])


def _read_table(path: str | os.PathLike[str]) -> FloatArray:
    expected = "expected 3 numbers a row, separated by commas"
    try:
        with warnings.catch_warnings(action="ignore"):
            table = np.loadtxt(path, delimiter=",", ndmin=2)
    except ValueError as error:
        raise RecordingError(f"{path}: {error}: {expected}") from None
    if table.shape[1] != 3 or len(table) == 0 or not np.all(np.isfinite(table)):
        raise RecordingError(f"{path}: {expected}")
    return table


def start_from_odometry(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """The path that odometry alone gives, and the discs where they were seen from it on average.
    Returns `poses` (N, 3), `disc_xy` (M, 2).
    """
    poses = chain_steps(recording.steps)[1:]
    x, y, theta = poses[recording.frame].T
    cos, sin = np.cos(theta), np.sin(theta)
    left, back = recording.row_xy.T
    count = np.bincount(recording.disc)
    disc_xy = np.stack(
        [
            np.bincount(recording.disc, x + cos * left - sin * back) / count,
            np.bincount(recording.disc, y + sin * left + cos * back) / count,
        ],
        axis=1,
    )
    return poses, disc_xy
