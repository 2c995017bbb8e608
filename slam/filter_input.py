"""What the commands of both filters read: the run, the camera, the reference path."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from landmarks.map_file import Path2D, read_path
from slam.errors import SlamError
from slam.filter_frames import NO_CAMERA
from slam.options import RunFlags
from slam.recording import Recording, read_recording
from slam.run_camera import camera_of_run

FloatArray = NDArray[np.float64]


def read_run(
    run: Path, *, circles: bool, lines: bool, stem: str | None, camera: Path | None
) -> tuple[Recording, FloatArray]:
    """Rows of a run, and where its camera is.

    Parameters
    ----------
    run : Path
        Run folder or landmark file.
    circles, lines : bool
        What to use; discs where neither is asked for.
    stem : str or None
        Name of the landmark files.
    camera : Path or None
        Calibration; by default the one in the folder.

    Returns
    -------
    recording : Recording
    camera_xy : (2,) float64
        The camera's centre in the robot frame (m); zero where there are no lines, which alone need
        it.

    Raises
    ------
    SlamError
        If there is nothing to use, or lines without a calibration.
    camera.CameraError
        If the calibration is malformed.
    """
    recording = read_recording(run, circles=circles or not lines, lines=lines, stem=stem)
    if not len(recording.lines):
        return recording, NO_CAMERA
    mounting = camera_of_run(run, camera).robot_from_camera
    return recording, np.array([mounting[0][3], mounting[1][3]])


def read_run_of(flags: RunFlags) -> tuple[Recording, FloatArray]:
    """`read_run` of the run that a command names."""
    return read_run(
        flags.run,
        circles=flags.circles,
        lines=flags.lines,
        stem=flags.stem,
        camera=flags.camera,
    )


def read_reference(path: Path, poses: Path2D) -> Path2D:
    """A path to compare with, which must be of the same run.

    Raises
    ------
    SlamError
        If it has not as many poses.
    """
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
