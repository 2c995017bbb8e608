"""A run on disk: its camera, its frames, its odometry.

Either a run folder of the data set (``images/``, ``<run>.cam``, ``<run>.txt``, ``map.circles``),
or any folder of images with a ``.cam`` in it. A frame is a STEP row with its image; without
odometry, an image with a STEP row of zeros.

A run may be long. All that is kept of it are the names of its images, some 20 bytes each; the
odometry is read along with the frames, and once before, so that what is wrong with it is told
before any work is done.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from camera import Camera, read_camera
from detect.errors import DetectError, FrameError
from detect.image_bounds import bounded_content, demand_bounded
from detect.image_names import IMAGE_SUFFIXES, ImageNames
from landmarks import Step, read_rows

_JPEG_BEGIN, _JPEG_END = b"\xff\xd8", b"\xff\xd9"


@dataclass(frozen=True, slots=True)
class RunFrame:
    """One frame of a run: its STEP row, and the image taken after it (None where there is none)."""

    step: Step
    image: Path | None


class RunFrames:
    """The frames of a run, made as they are asked for: in the order of the odometry, or of names.

    Iterating again begins anew.
    """

    def __init__(self, images: ImageNames, odometry: Path | None, count: int) -> None:
        self._images = images
        self._odometry = odometry
        self._count = count

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[RunFrame]:
        if self._odometry is None:
            for place in range(len(self._images)):
                path = self._images.path(place)
                yield RunFrame(_standing_still(path.stem), path)
            return
        for step in _steps(self._odometry):
            found = self._images.find(_base_name(step.prefix))
            yield RunFrame(step, None if found is None else self._images.path(found))


@dataclass(frozen=True)
class ImageRun:
    """A run folder that was looked through, whether or not there is a calibration.

    Attributes
    ----------
    folder : path
    frames : RunFrames
        In the order of the odometry, or of the images' names.
    odometry : path or None
        Where the STEP rows come from.
    images_without_step : int
        How many images the odometry does not name: they are not part of the run.
    """

    folder: Path
    frames: RunFrames
    odometry: Path | None
    images_without_step: int

    @property
    def name(self) -> str:
        """The folder's own name."""
        return self.folder.resolve().name


@dataclass(frozen=True)
class Run(ImageRun):
    """A run folder with a calibration.

    Attributes
    ----------
    camera : Camera
    """

    camera: Camera


def open_run(folder: Path, camera_path: Path | None = None) -> Run:
    """Look through a run folder.

    Parameters
    ----------
    folder : path
        A run folder of the data set's layout, or a folder of images.
    camera_path : path, optional
        The calibration; by default the one ``.cam`` in the folder (``<run>.cam`` if there are
        several).

    Returns
    -------
    Run

    Raises
    ------
    DetectError
        If there is no such folder, no image, no calibration, or more than one to choose from.
    camera.CameraError, landmarks.LandmarkFileError
        If the calibration or the odometry cannot be read.
    """
    _demand_folder(folder)
    camera = read_camera(camera_path if camera_path is not None else _only_camera(folder))
    run = _image_run(folder)
    return Run(folder, run.frames, run.odometry, run.images_without_step, camera)


def open_images(folder: Path, camera_path: Path | None = None) -> ImageRun:
    """Look through a run folder that may be without a calibration.

    Parameters
    ----------
    folder, camera_path
        As in `open_run`.

    Returns
    -------
    ImageRun
        A `Run` if there is a calibration.

    Raises
    ------
    DetectError, camera.CameraError, landmarks.LandmarkFileError
        As `open_run` does, but for a missing calibration.
    """
    _demand_folder(folder)
    if camera_path is None and not any(folder.glob("*.cam")):
        return _image_run(folder)
    return open_run(folder, camera_path)


def _demand_folder(folder: Path) -> None:
    if not folder.is_dir():
        raise DetectError(f"{folder}: no such folder: expected a run folder or a folder of images")


def _image_run(folder: Path) -> ImageRun:
    images = _images(folder)
    odometry = _odometry(folder)
    if odometry is None:
        return ImageRun(folder, RunFrames(images, None, len(images)), None, 0)
    named = np.zeros(len(images), bool)
    count = 0
    for step in _steps(odometry):
        count += 1
        found = images.find(_base_name(step.prefix))
        if found is not None:
            named[found] = True
    frames = RunFrames(images, odometry, count)
    return ImageRun(folder, frames, odometry, int(np.count_nonzero(~named)))


def read_image(
    frame: RunFrame, camera: Camera | None, working_folder: Path | None = None
) -> NDArray[np.uint8]:
    """The grey image of a frame.

    Colour images are converted, 16-bit images brought to 8 bits.

    Parameters
    ----------
    frame : RunFrame
    camera : Camera or None
        Whose size the image must have, if any.
    working_folder : path, optional
        What relative paths are relative to, if not the process's own working folder.

    Returns
    -------
    (H, W) uint8 array

    Raises
    ------
    FrameError
        If there is no image, it cannot be read, or has another size than the calibration.
    """
    import cv2

    if frame.image is None:
        raise FrameError(f"{frame.step.prefix}: no image of that name in the run")
    size = None if camera is None else (camera.width, camera.height)
    content = bounded_content((working_folder or Path()) / frame.image, frame.image, size)
    if not content:
        raise FrameError(f"{frame.image}: is empty: expected an image")
    if content.startswith(_JPEG_BEGIN) and _JPEG_END not in content[len(content) // 2 :]:
        raise FrameError(f"{frame.image}: the JPEG is cut off: its end is missing")
    demand_bounded(content, frame.image, size)
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:  # sizes beyond OpenCV's bounds are no None
        image = None
    if image is None:
        raise FrameError(f"{frame.image}: cannot be decoded: expected an image")
    if camera is not None and image.shape != (camera.height, camera.width):
        raise FrameError(
            f"{frame.image}: is {image.shape[1]}x{image.shape[0]} px: "
            f"expected {camera.width}x{camera.height}, the calibration's size"
        )
    return np.asarray(image, dtype=np.uint8)


def _only_camera(folder: Path) -> Path:
    cameras = sorted(folder.glob("*.cam"))
    if not cameras:
        raise DetectError(
            f"{folder}: no calibration: expected a .cam file in it, or one named by --camera"
        )
    own = folder / f"{folder.resolve().name}.cam"
    if own in cameras:
        return own
    if len(cameras) > 1:
        names = ", ".join(path.name for path in cameras[:4])
        raise DetectError(f"{folder}: several calibrations ({names}): name one by --camera")
    return cameras[0]


def _images(folder: Path) -> ImageNames:
    """Images in ``images/`` or, failing that, in the folder."""
    for place in (folder / "images", folder):
        if place.is_dir():
            found = ImageNames(place)
            if len(found):
                return found
    kinds = " ".join(sorted(IMAGE_SUFFIXES))
    raise DetectError(f"{folder}: no images: expected {kinds} in it or in {folder / 'images'}")


def _steps(odometry: Path) -> Iterator[Step]:
    return (row.record for row in read_rows(odometry) if isinstance(row.record, Step))


def _odometry(folder: Path) -> Path | None:
    for candidate in (folder / f"{folder.resolve().name}.txt", folder / "map.circles"):
        if candidate.is_file():
            return candidate
    return None


def _base_name(prefix: str) -> str:
    return prefix.strip('"').replace("\\", "/").rsplit("/", 1)[-1]


def _standing_still(prefix: str) -> Step:
    return Step(re.sub(r"\s", "_", prefix), *[0.0] * 9)
