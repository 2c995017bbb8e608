"""A run: its frames, its odometry, and, if it has one, its calibration.

A frame is a STEP row with its image; without odometry, an image with a STEP row of zeros. A run may
be long: frames are made on demand.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.errors import FrameError
from detect.sources.gray import bounded_content, decode_gray, wrong_size
from detect.sources.interface import Frames, RunFrame, only_calibration


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


def read_image(
    frame: RunFrame, camera: Camera | None, working_folder: Path | None = None
) -> NDArray[np.uint8]:
    """The grey image of a frame (H, W); 16 bits are brought to 8 (see `detect.sources.gray`).

    It must have the size of the camera, if any. Relative paths start from `working_folder`, by
    default the process's own. Raises FrameError if there is no image, it cannot be read, or has
    another size.
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
