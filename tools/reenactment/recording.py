"""A run's landmark file as arrays, and the places to begin a fit from."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from redetect.landmarks import Frame, circle_arrays, is_positive_definite
from tools.reenactment.model import chain_odometry

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class RecordingError(ValueError):
    """A recording, path or map from which no world can be made."""


@dataclass(frozen=True, eq=False)
class Recording:
    """What a run's landmark file says, as arrays; rows without an ID are left out.

    Parameters
    ----------
    prefixes : (N,) array of str
        Names of the frames' images.
    steps : (N, 3) float array
        Odometry: dx, dy, dphi in the robot frame before the step.
    step_covariance : (N, 3, 3) float array
        Their covariances.
    disc_ids : (M,) int array
        The discs' IDs, ascending; one ID can stand for several discs.
    frame, disc : (n,) int arrays
        For each row its frame and its disc (an index into `disc_ids`, not an ID).
    row_xy : (n, 2) float array
        The rows' positions in the robot frame, metres.
    row_covariance : (n, 2, 2) float array
        Their covariances.
    pixels : (n, 2) float array
        Where in the image the rows came from.
    """

    prefixes: NDArray[np.str_]
    steps: FloatArray
    step_covariance: FloatArray
    disc_ids: IntArray
    frame: IntArray
    disc: IntArray
    row_xy: FloatArray
    row_covariance: FloatArray
    pixels: FloatArray


def recording_of_frames(camera: Camera, frames: Iterable[Frame]) -> Recording:
    """Gather the frames of a landmark file.

    Parameters
    ----------
    camera : Camera
        As calibrated: the one that put the rows on the floor.
    frames : iterable of Frame
        E.g. from `redetect.landmarks.read_frames`.

    Raises
    ------
    RecordingError
        If no row has an ID, a covariance cannot be inverted, or a row lies where the camera sees no
        floor; the frame is named.
    """
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


def _demand(good: NDArray[np.bool_], prefixes: NDArray[np.str_], problem: str) -> None:
    if not good.all():
        raise RecordingError(f"STEP {prefixes[np.argmin(good)]}: {problem}")


def read_path(path: str | os.PathLike[str], frames: int) -> FloatArray:
    """Read a path: rows x, y (m), theta (rad); the start (0, 0, 0), then the pose after each step.

    Returns
    -------
    (frames, 3) float array
        Without the start.

    Raises
    ------
    RecordingError
        If the file isn't one; the file is named.
    """
    poses = _read_table(path, 3)
    if len(poses) != frames + 1:
        raise RecordingError(
            f"{path}: {len(poses)} poses: expected {frames + 1}, the start and one for each STEP"
        )
    if np.any(poses[0] != 0.0):
        raise RecordingError(f"{path}: starts at {poses[0]}: expected 0, 0, 0")
    return poses[1:]


def read_map(path: str | os.PathLike[str], disc_ids: IntArray) -> FloatArray:
    """Read a map: rows ID, x, y (m).

    Returns
    -------
    (M, 2) float array
        Places of the discs asked for, in their order.

    Raises
    ------
    RecordingError
        If the file isn't one, or lacks a disc; the file is named.
    """
    table = _read_table(path, 3)
    place = {int(disc_id): (x, y) for disc_id, x, y in table}
    missing = [int(disc_id) for disc_id in disc_ids if int(disc_id) not in place]
    if missing:
        raise RecordingError(f"{path}: no disc with ID {missing[0]}, which the landmark file names")
    return np.array([place[int(disc_id)] for disc_id in disc_ids])


def _read_table(path: str | os.PathLike[str], columns: int) -> FloatArray:
    try:
        with Path(path).open(encoding="utf-8") as stream:
            table = np.array(
                [
                    [float(word) for word in line.split(",")]
                    for line in stream
                    if line.strip() and not line.startswith("#")
                ]
            )
    except ValueError as error:
        raise RecordingError(
            f"{path}: {error}: expected {columns} numbers a row, separated by commas"
        ) from None
    if table.ndim != 2 or table.shape[1] != columns or not np.all(np.isfinite(table)):
        raise RecordingError(f"{path}: expected {columns} numbers a row, separated by commas")
    return table


def start_from_odometry(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """The path that odometry alone gives, and the discs where they were seen from it on average.

    Returns
    -------
    poses : (N, 3) float array
        x, y, theta in the map.
    disc_xy : (M, 2) float array
        Metres, in the map.
    """
    poses = chain_odometry(recording.steps)
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
