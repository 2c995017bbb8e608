"""A run, its frames and their grey images, and the base classes of all image sources.

A frame is a STEP row, of zeros without odometry, with its image; frames are made on demand. Images
become 8-bit grey ones. Colour is 0.299 R + 0.587 G + 0.114 B, as in OpenCV (for a JPEG, its
luminance). Of values with 16 bits, the 8 highest of a bit depth are kept: those of a 12-bit camera
would be nearly black otherwise. It is one for the whole run: else discs would have another contrast
in each image, by the brightest things beside them. No image takes more memory than the images of
its run do, whatever its file contains or claims.
"""

from __future__ import annotations

import os
import re
from abc import ABC, abstractmethod
from collections.abc import Generator
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from camera import Camera, camera_in
from detect.errors import DetectError, FrameError
from redetect.array_types import GreyImage
from redetect.landmarks import Step
from redetect.storage.bounded import read_bounded
from redetect.storage.images import MOST_PIXELS, claimed_size, decoded_image

if TYPE_CHECKING:
    from detect.sources.poses import PoseStream

_BIT_DEPTHS = (8, 10, 12, 14, 16)  # of cameras
#: Number of images by which a run's bit depth is found, and their largest spacing in a bag.
_DEPTH_IMAGES = 32
_DEPTH_SPACING = 20
_HOT_PIXELS = 1e-4  #: Largest share of values that a bit depth need not hold: hot pixels.
# Limit of a file's size: uncompressed pixels, 16 bits in four channels, times two for formats that
# expand, plus thumbnails and other metadata of cameras.
_BYTES_PER_PIXEL = 16
_BYTES_BESIDE = 1 << 23


@dataclass(frozen=True, slots=True)
class RunFrame:
    """One frame of a run: its STEP row, and the image taken after it."""

    step: Step
    image: Path | None  # its file, if it has one
    #: The encoded image or (H, W) grey values, uint8 or uint16, if it has no file of its own.
    content: bytes | NDArray[Any] | None = field(default=None, compare=False, repr=False)
    time_s: float | None = None  # time of the image, if known
    failure: str | None = None  # why there is no image, although there should be
    #: Of values that are stored in 16 bits; None: the lowest that holds those of the image.
    bit_depth: int | None = None


class Frames(ABC):
    """The frames of a run, made on demand; iterating again starts over, unless they are live."""

    images_in_memory = True  # yields contents of images, not files
    expected: int | None = None  # approximate number of frames, if known
    is_recorded = True  # iterating again yields the same frames
    left_out = 0  # number of images, so far, that are not part of the run
    why_left_out = "images are left out"

    @abstractmethod
    def __iter__(self) -> Generator[RunFrame, None, None]: ...


class SomeFrames(Frames):
    """Every n-th of the first `count` frames of another source (0: of all).

    With a `bit_depth`, images have that one instead of one found from each.
    """

    def __init__(
        self, frames: Frames, count: int = 0, every: int = 1, bit_depth: int | None = None
    ) -> None:
        self._frames, self._count, self._every = frames, count, every
        self._bit_depth = bit_depth
        self.images_in_memory, self.why_left_out = frames.images_in_memory, frames.why_left_out
        self.is_recorded = frames.is_recorded
        known = [number for number in (frames.expected, count or None) if number is not None]
        self.expected = -(-min(known) // every) if known else None

    def __iter__(self) -> Generator[RunFrame, None, None]:
        with closing(iter(self._frames)) as frames:
            for frame in islice(frames, 0, self._count or None, self._every):
                yield replace(frame, bit_depth=self._bit_depth) if self._bit_depth else frame
            self.left_out = self._frames.left_out


def spread_frames(frames: Frames, count: int, farthest: int | None = None) -> SomeFrames:
    """About `count` frames spread over a source, or over its beginning: the first ones if its
    length is not known, or ones that are `farthest` apart.
    """
    every = max((frames.expected or 0) // count, 1)
    every = every if farthest is None else min(every, farthest)
    return SomeFrames(frames, every * count, every)


class Source(Frames):
    """Images in order, as frames of a run in which the robot does not move."""

    name: str  # in messages
    output_base: Path  # path of results without their extensions
    beside: tuple[Path, str] | None = None  # folder and stem of a ``.cam`` file beside it
    has_times = True  # whether the times of the images are known
    is_8_bit = False  # whether no image can have more

    def calibration(self, *, posed: bool) -> Camera | None:
        """The calibration beside the source, or contained in it; None if there is none.

        Several are an error; if `posed`, a calibration without a pose above the floor is ignored.
        """
        return None if self.beside is None else camera_in(*self.beside)

    def poses(self, topic: str | None) -> PoseStream | None:
        """The source's own odometry: of a topic, or the only one; None if there is none."""
        if topic is not None:
            raise DetectError(f"{self.name}: has no topic {topic}: only bags do")
        return None


def frame_prefix(name: str) -> str:
    """A name as allowed in STEP rows and ``.times`` files: without separators."""
    return re.sub(r'[\s,#"\\]', "_", name) or "_"


def numbered_prefix(stem: str, number: int) -> str:
    """The prefix of an unnamed frame, in the data set's form: ``e.0000``."""
    return f"{frame_prefix(stem)}.{number:04d}"


def still(prefix: str) -> Step:
    """The STEP row of a robot that does not move."""
    return Step(prefix, *[0.0] * 9)


@dataclass(frozen=True)
class ImageRun:
    """A run whose files were found and read, with or without a calibration."""

    folder: Path  # for sources other than folders, the one that contains them
    frames: Frames
    odometry: Path | None  # source of the STEP rows
    output_base: Path  # results are called this, with an ending of their own
    has_times: bool = False  # whether times of frames are known, and written beside the results
    bit_depth: int | None = None  # of all frames, if their values are stored in 16 bits

    @property
    def name(self) -> str:
        """The recording's own name, or the folder's."""
        recording = self.output_base.name.removesuffix(".detected")
        return self.folder.resolve().name if recording == "detected" else recording

    def output(self, kind: str) -> Path:
        """The file for a kind of result."""
        return self.output_base.with_name(f"{self.output_base.name}.{kind}")


@dataclass(frozen=True)
class Run(ImageRun):
    """A run with a calibration."""

    camera: Camera = field(kw_only=True)


def read_image(
    frame: RunFrame, camera: Camera | None, working_folder: Path | None = None
) -> GreyImage:
    """The grey image (H, W) of a frame, of 8 bits (see `detect.sources.interface`).

    Paths are relative to `working_folder`, by default the process's own. FrameError if there is no
    image, it cannot be read, or has another size than the camera or values beyond the bit depth.
    """
    stored = stored_image(frame, camera, working_folder)
    return eight_bits(stored, frame.image or frame.step.prefix, frame.bit_depth)


def stored_image(
    frame: RunFrame, camera: Camera | None, working_folder: Path | None = None
) -> NDArray[Any]:
    """The grey values (H, W) of a frame, of 8 or 16 bits; parameters and errors as `read_image`."""
    name: object = frame.image or frame.step.prefix
    size = None if camera is None else (camera.width, camera.height)
    if frame.failure is not None:
        raise FrameError(frame.failure)
    image: NDArray[Any]
    if isinstance(frame.content, np.ndarray):
        image = frame.content
    elif frame.content is not None:
        image = decode_gray(frame.content, name, size)
    elif frame.image is None:
        raise FrameError(f"{frame.step.prefix}: no image of that name in the run")
    else:
        path = os.path.join(working_folder or "", frame.image)  # noqa: PTH118 - faster than a Path
        image = decode_gray(bounded_content(path, frame.image, size), name, size)
    if camera is not None and image.shape != (camera.height, camera.width):
        raise wrong_size(name, (image.shape[1], image.shape[0]), (camera.width, camera.height))
    return image


def decode_gray(content: bytes, name: object, size: tuple[int, int] | None = None) -> NDArray[Any]:
    """Decode a JPEG, PNG, PNM, BMP or TIFF file's content to (H, W) grey values, uint8 or uint16.

    An image with another width and height than `size` is not decoded. Raises FrameError, with
    `name` for the image, if the content is not an image, or is truncated.
    """
    if not content:
        raise FrameError(f"{name}: is empty: expected an image")
    if content.startswith(b"\xff\xd8") and content.rfind(b"\xff\xd9", len(content) // 2) < 0:
        raise FrameError(f"{name}: the JPEG is truncated: its end is missing")
    claimed = claimed_size(content)
    if claimed and size and size != claimed and claimed[0] * claimed[1] <= MOST_PIXELS:
        raise wrong_size(name, claimed, size)
    return gray_of_pixels(decoded_image(content, name, FrameError), name)


def gray_of_pixels(pixels: NDArray[Any], name: object) -> NDArray[Any]:
    """Convert pixels to (H, W) grey values of as many bits, contiguous and writable.

    From (H, W) or (H, W, 1) grey values, or (H, W, 3 or 4) blue, green, red and perhaps opacity, of
    8 or 16 bits, any byte order and strides; else FrameError, `name` as in `decode_gray`.
    """
    dtype = pixels.dtype.newbyteorder("=")
    if dtype not in (np.uint8, np.uint16):
        raise FrameError(
            f"{name}: holds {pixels.dtype}: expected images of 8 or 16 bits (uint8, uint16)"
        )
    channels = 1 if pixels.ndim == 2 else pixels.shape[-1]
    if pixels.ndim not in (2, 3) or channels not in (1, 3, 4) or not pixels.size:
        raise FrameError(
            f"{name}: is an array of shape {pixels.shape}: expected (height, width) grey values, "
            "or (height, width, 3 or 4) of colours in the order blue, green, red"
        )
    # For read-only arrays, as in messages, Numba would compile every kernel once more.
    gray: NDArray[Any] = np.require(pixels, dtype, ["C", "W"])
    if channels != 1:
        code = cv2.COLOR_BGR2GRAY if channels == 3 else cv2.COLOR_BGRA2GRAY
        gray = np.asarray(cv2.cvtColor(gray, code), dtype)
    elif gray.ndim == 3:
        gray = gray[:, :, 0]
    return gray


def eight_bits(stored: NDArray[Any], name: object, bit_depth: int | None = None) -> GreyImage:
    """The 8 highest bits of grey values (H, W), by default of the lowest bit depth that holds them.

    Raises FrameError, with `name` for the image, if a given one does not.
    """
    if stored.dtype == np.uint8:
        return stored
    bits = bit_depth or bits_needed(stored)
    if not _holds(bits, stored):
        raise FrameError(
            f"{name}: values of {bits_needed(stored)} bits: expected {bits}, as in the images by "
            f"which the run's bit depth was found, or as stated: --bit-depth {bits_needed(stored)}"
        )
    return np.asarray(np.minimum(stored >> (bits - 8), 255), np.uint8)


def bit_depth_of(frames: Frames, camera: Camera | None) -> int | None:
    """The bit depth of images whose values are stored in 16 bits, by some of them.

    None if the first that can be read has 8 bits; if later ones have more, each has its own depth.
    """
    depth = None
    # All messages of a bag before the last of these are read.
    farthest = _DEPTH_SPACING if frames.images_in_memory else None
    for frame in spread_frames(frames, _DEPTH_IMAGES, farthest):
        with suppress(FrameError):  # reported when the frame is processed
            stored = stored_image(frame, camera)
            if stored.dtype == np.uint16:
                depth = max(depth or 0, bits_needed(stored))
            elif depth is None:
                return None
    return depth


def bits_needed(stored: NDArray[Any]) -> int:
    """The lowest bit depth of cameras that holds grey values, apart from hot pixels."""
    return next(bits for bits in _BIT_DEPTHS if _holds(bits, stored))


def _holds(bits: int, stored: NDArray[Any]) -> bool:
    return bool(np.count_nonzero(stored >> bits) <= _HOT_PIXELS * stored.size)


def bounded_content(path: Path | str, name: object, size: tuple[int, int] | None) -> bytes:
    """The content of an image file; a FrameError if it is larger than such an image can be."""
    pixels = MOST_PIXELS if size is None else size[0] * size[1]
    try:
        return read_bounded(path, _BYTES_BESIDE + _BYTES_PER_PIXEL * pixels)
    except OSError as error:
        raise FrameError(f"{name}: cannot be read: {error.strerror}") from None


def wrong_size(name: object, found: tuple[int, int], expected: tuple[int, int]) -> FrameError:
    """The error for an image without the calibration's width and height."""
    return FrameError(
        f"{name}: is {found[0]}x{found[1]} px: "
        f"expected {expected[0]}x{expected[1]}, the calibration's size: "
        "name the calibration of these images by --camera"
    )
