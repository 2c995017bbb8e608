"""A run on disk: its camera, its frames, its odometry.

Either a run folder of the data set (``images/``, ``<run>.cam``, ``<run>.txt``, ``map.circles``),
or any folder of images with a ``.cam`` in it. A frame is a STEP row with its image; without
odometry, an image with a STEP row of zeros.

A run may be long. Only the names of its images are kept in memory, some 20 bytes each. The odometry
is read along with the frames, and once before, so that errors in it are reported before any work is
done.
"""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from camera import Camera, read_camera
from detect.errors import DetectError, FrameError
from detect.sources.gray import bounded_content, decode_gray, wrong_size
from detect.sources.image_files import RunFrames, bits_of_images, images_of_folder
from detect.sources.interface import Frames, RunFrame, only_calibration
from redetect.landmarks import read_steps


@dataclass(frozen=True)
class ImageRun:
    """A run whose files were found and read, with or without a calibration."""

    folder: Path  # of another source the folder that it is in
    frames: Frames
    odometry: Path | None  # where the STEP rows come from
    output_base: Path  # results are called this, with an ending of their own
    has_times: bool = False  # whether frames' times are known, and written beside the results

    @property
    def name(self) -> str:
        """The recording's own name, or else the folder's."""
        recording = self.output_base.name.removesuffix(".detected")
        return self.folder.resolve().name if recording == "detected" else recording

    @property
    def images_without_step(self) -> int:
        """How many images, so far, are not part of the run, as there are no steps of theirs."""
        return self.frames.left_out

    def output(self, kind: str) -> Path:
        """The file that a kind of result is written to."""
        return self.output_base.with_name(f"{self.output_base.name}.{kind}")

    def calibrated(self, camera: Camera) -> Run:
        """The run with a calibration."""
        return Run(**vars(self), camera=camera)


@dataclass(frozen=True)
class Run(ImageRun):
    """A run with a calibration."""

    camera: Camera = field(kw_only=True)


def open_run(folder: Path, camera_path: Path | None = None, *, bits: int | None = None) -> Run:
    """Read a run folder.

    Parameters
    ----------
    folder : path
        A run folder of the data set's layout, or a folder of images.
    camera_path : path, optional
        The calibration; by default the one ``.cam`` in the folder (``<run>.cam`` if there are
        several).
    bits : int, optional
        Significant bits of 16-bit images; by default what some of them need.

    Raises
    ------
    DetectError
        If there is no such folder, no image, no calibration, or more than one to choose from.
    camera.CameraError, redetect.landmarks.LandmarkFileError
        If the calibration or the odometry cannot be read.
    """
    run = open_images(folder, camera_path, bits=bits)
    if isinstance(run, Run):
        return run
    raise DetectError(
        f"{folder}: no calibration: expected a .cam file in it, or one named by --camera; "
        "`camera calibrate` makes one, `camera convert` brings one over from other programs"
    )


def open_images(
    folder: Path, camera_path: Path | None = None, *, bits: int | None = None
) -> ImageRun:
    """Read a run folder as `open_run` does; without a calibration it is no `Run`."""
    if not folder.is_dir():
        raise DetectError(f"{folder}: no such folder: expected a run folder or a folder of images")
    camera = camera_in(folder) if camera_path is None else read_camera(camera_path)
    run = _image_run(folder, bits)
    return run if camera is None else run.calibrated(camera)


def _image_run(folder: Path, bits: int | None) -> ImageRun:
    images = images_of_folder(folder)
    odometry = _odometry(folder)
    bits = bits_of_images(images) if bits is None else bits
    count, left_out = len(images), 0
    if odometry is not None:
        named = np.zeros(len(images), bool)
        count = 0
        for step in read_steps(odometry):
            count += 1
            with suppress(FrameError):  # reported when the frame is processed
                found = images.place_of(step.prefix)
                if found is not None:
                    if images.has_links:
                        images.checked(found)
                    named[found] = True
        left_out = int(np.count_nonzero(~named))
    frames = RunFrames(images, odometry, count, left_out, bits)
    return ImageRun(folder, frames, odometry, folder / "detected")


def read_image(
    frame: RunFrame, camera: Camera | None, working_folder: Path | None = None
) -> NDArray[np.uint8]:
    """The grey image of a frame.

    Parameters
    ----------
    frame : RunFrame
    camera : Camera or None
        Whose size the image must have, if any.
    working_folder : path, optional
        Folder that relative paths start from, if not the process's own working folder.

    Returns
    -------
    (H, W) uint8 array
        Brightness; 16 bits are brought to 8 (see `detect.sources.gray`).

    Raises
    ------
    FrameError
        If there is no image, it cannot be read, or has another size than the calibration.
    """
    name: object = frame.image or frame.step.prefix
    size = None if camera is None else (camera.width, camera.height)
    if frame.failure is not None:
        raise FrameError(frame.failure)
    if isinstance(frame.content, np.ndarray):
        image = frame.content
    elif frame.content is not None:
        image = decode_gray(frame.content, name, frame.bits, size)
    elif frame.image is None:
        raise FrameError(f"{frame.step.prefix}: no image of that name in the run")
    else:
        path = os.path.join(working_folder or "", frame.image)  # noqa: PTH118 - faster than a Path
        image = decode_gray(bounded_content(path, frame.image, size), name, frame.bits, size)
    if camera is not None and image.shape != (camera.height, camera.width):
        raise wrong_size(name, (image.shape[1], image.shape[0]), (camera.width, camera.height))
    return image


def camera_in(folder: Path) -> Camera | None:
    """The calibration in a run folder; None where there is none."""
    return only_calibration(folder, folder.resolve().name)


def _odometry(folder: Path) -> Path | None:
    for candidate in (folder / f"{folder.resolve().name}.txt", folder / "map.circles"):
        if candidate.is_file():
            return candidate
    return None
