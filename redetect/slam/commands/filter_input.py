"""Input of the filters' commands: the run, the camera, the reference path."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from redetect.landmarks.map_file import Path2D, read_path
from redetect.slam.commands.run_camera import camera_of_run
from redetect.slam.commands.run_rows import recording_of
from redetect.slam.errors import SlamError
from redetect.slam.filters.frames import NO_CAMERA
from redetect.slam.options import RunFlags
from redetect.slam.recording import Recording

FloatArray = NDArray[np.float64]


def read_run_of(flags: RunFlags) -> tuple[Recording, FloatArray]:
    """Rows of the run that a command names, and where its camera is.

    Returns `recording`, `camera_xy` (2,).
    """
    recording = recording_of(flags)
    return recording, camera_xy_of(recording, flags.run, flags.camera)


def camera_xy_of(recording: Recording, run: Path, camera: Path | None = None) -> FloatArray:
    """(2,) the camera's centre in the robot frame (m); zero where no line needs it."""
    if not len(recording.lines):
        return NO_CAMERA
    mounting = camera_of_run(run, camera).robot_from_camera
    return np.array([mounting[0][3], mounting[1][3]])


def read_reference(path: Path, poses: Path2D) -> Path2D:
    """A path to compare with, which must be of the same run."""
    reference = read_path(path)
    if len(reference.poses) != len(poses.poses):
        raise SlamError(
            f"{path}: {len(reference.poses)} poses: expected {len(poses.poses)}, the start and one "
            "after each step of the run"
        )
    return reference


def default_output(run: Path, name: str) -> Path:
    """Folder for a command's results: `slam/<name>` beside the run's landmarks."""
    return (run if run.is_dir() else run.parent) / "slam" / name
