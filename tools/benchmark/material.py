"""The images that are measured on."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from camera import Camera, write_camera
from detect.run import Run
from redetect.landmarks import Frame, write_frames
from tools.benchmark.errors import BenchmarkError

_JPEG_QUALITY = 90

#: A long run has so many files of its own: more than a processor's caches hold.
_MOST_COPIES = 1600
_PHOTOGRAPHS = frozenset({".jpg", ".jpeg", ".png"})

#: Noise that scaled images get (grey levels): enlarged ones have none of their own.
_SENSOR_NOISE = 2.0


@dataclass(frozen=True)
class Picture:
    """An image as a file holds it and as a detector gets it.

    Attributes
    ----------
    encoded : (N,) uint8
        Content of an image file.
    grey : (H, W) uint8
        What it decodes to.
    """

    encoded: NDArray[np.uint8]
    grey: NDArray[np.uint8]


def decode(encoded: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W) grey values of an image file's content."""
    import cv2

    grey = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise BenchmarkError("an image file's content cannot be decoded: expected an image")
    return np.asarray(grey, dtype=np.uint8)


def jpeg_picture(grey: NDArray[np.uint8]) -> Picture:
    """An image through a JPEG of quality 90."""
    import cv2

    _, encoded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return Picture(encoded.ravel(), decode(encoded))


def run_pictures(run: Run, count: int) -> list[Picture]:
    """Some frames of a run, evenly spread over it, as their files are.

    Raises
    ------
    BenchmarkError
        If the run has no images.
    """
    paths = _spread_out([frame.image for frame in run.frames if frame.image is not None], count)
    if not paths:
        raise BenchmarkError(f"{run.folder}: no frame has an image: expected at least one")
    files = [np.fromfile(path, np.uint8) for path in paths]
    return [Picture(content, decode(content)) for content in files]


def noise_pictures(camera: Camera, count: int, seed: int) -> list[Picture]:
    """Uniform noise of the camera's size: no structure, everything everywhere."""
    rng = np.random.default_rng(seed)
    size = (camera.height, camera.width)
    return [jpeg_picture(rng.integers(0, 256, size, dtype=np.uint8)) for _ in range(count)]


def photograph_pictures(folder: Path, camera: Camera, count: int) -> list[Picture]:
    """Photographs found anywhere below a folder, scaled to the camera's size.

    Parameters
    ----------
    folder : path
    camera : Camera
        Whose size they get.
    count : int
        At most this many, evenly spread over all in the order of their paths.

    Raises
    ------
    BenchmarkError
        If there is no image below the folder, or one cannot be read.
    """
    import cv2

    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _PHOTOGRAPHS)
    if not found:
        raise BenchmarkError(f"{folder}: no images in it or below: expected photographs")
    pictures = []
    for path in _spread_out(found, count):
        grey = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
        if grey is None:
            raise BenchmarkError(f"{path}: cannot be decoded: expected an image")
        scaled = cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        pictures.append(jpeg_picture(np.asarray(scaled, dtype=np.uint8)))
    return pictures


def scaled_camera(camera: Camera, factor: float) -> Camera:
    """The camera whose image is the same one with `factor` times as many pixels on each side.

    Pixel (0, 0) is a pixel's centre: the image's corner, at (-0.5, -0.5), stays what it is.
    """
    width, height = round(camera.width * factor), round(camera.height * factor)
    along, down = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        scale_x=camera.scale_x * along,
        scale_y=camera.scale_y * down,
        offset_x=(camera.offset_x + 0.5) * along - 0.5,
        offset_y=(camera.offset_y + 0.5) * down - 0.5,
    )


def scaled_picture(picture: Picture, camera: Camera, seed: int) -> Picture:
    """A picture enlarged to a scaled camera's size, with a sensor's noise."""
    import cv2

    size = (camera.width, camera.height)
    grey = np.asarray(cv2.resize(picture.grey, size, interpolation=cv2.INTER_CUBIC), np.float64)
    noisy = grey + np.random.default_rng(seed).normal(0.0, _SENSOR_NOISE, grey.shape)
    return jpeg_picture(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))


def repeated_run(run: Run, folder: Path, frames: int) -> Path:
    """A run folder of any number of frames: those of a run over and over.

    Parameters
    ----------
    run : Run
        The run whose image files are copied; beyond some, links to the copies will do.
    folder : path
        Where the new run folder is made.
    frames : int
        How many frames it has.

    Returns
    -------
    path
        The run folder, with the odometry of those frames.
    """
    sources = [(frame.image, frame.step) for frame in run.frames if frame.image is not None]
    if not sources:
        raise BenchmarkError(f"{run.folder}: no frame has an image: expected at least one")
    target = folder / f"frames{frames}"
    (target / "images").mkdir(parents=True)
    write_camera(run.camera, target / f"{target.name}.cam")
    steps = []
    copies: list[Path] = []
    for number in range(frames):
        source, step = sources[number % len(sources)]
        image = target / "images" / f"e.{number:06d}{source.suffix}"
        if number < max(_MOST_COPIES, len(sources)):
            shutil.copyfile(source, image)
            copies.append(image)
        else:
            os.link(copies[number % len(copies)], image)
        steps.append(Frame(replace(step, prefix=f"e.{number:06d}")))
    write_frames(target / f"{target.name}.txt", steps)
    return target


def _spread_out(paths: list[Path], count: int) -> list[Path]:
    """At most `count` of some paths, evenly spread over them."""
    if len(paths) <= count:
        return paths
    return [paths[i * len(paths) // count] for i in range(count)]
