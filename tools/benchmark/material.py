"""The images of the benchmark: of runs, noise, photographs, and with painted landmarks."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from camera import Camera, write_camera
from detect.sources.interface import Run
from redetect.array_types import ByteArray, FloatArray
from redetect.landmarks import Frame, write_frames
from tools.evaluation.figures import StudyError
from tools.simulator.markers.things import photograph_files, photograph_of
from tools.simulator.pixels import noisy_image, subpixel_grid
from tools.simulator.single_disc import render_disc

_JPEG_QUALITY = 90

#: Number of distinct files in a long run: more than a processor's caches hold.
_MOST_COPIES = 1600

#: Noise that is added to scaled images (grey levels): enlarging removes theirs.
_SENSOR_NOISE = 2.0


@dataclass(frozen=True)
class Picture:
    """An image as the content of a file, and decoded."""

    encoded: ByteArray  # (N,) Content of an image file.
    grey: ByteArray  # (H, W) What it decodes to.


def decode(encoded: ByteArray) -> ByteArray:
    """(H, W) grey values of an image file's content."""
    grey = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise StudyError("an image file's content cannot be decoded: expected an image")
    return np.asarray(grey, dtype=np.uint8)


def jpeg_picture(grey: ByteArray) -> Picture:
    """An image through a JPEG of quality 90."""
    _, encoded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return Picture(encoded.ravel(), decode(encoded))


def run_pictures(run: Run, count: int) -> list[Picture]:
    """Some frames of a run, evenly spread over it, as their files are."""
    paths = _spread_out([frame.image for frame in run.frames if frame.image is not None], count)
    if not paths:
        raise StudyError(f"{run.folder}: no frame has an image: expected at least one")
    files = [np.fromfile(path, np.uint8) for path in paths]
    return [Picture(content, decode(content)) for content in files]


def noise_pictures(camera: Camera, count: int, seed: int) -> list[Picture]:
    """Uniform noise of the camera's size: no structure, everything everywhere."""
    rng = np.random.default_rng(seed)
    size = (camera.height, camera.width)
    return [jpeg_picture(rng.integers(0, 256, size, dtype=np.uint8)) for _ in range(count)]


def photograph_pictures(folder: Path, camera: Camera, count: int) -> list[Picture]:
    """Photographs found anywhere below a folder, scaled to the camera's size."""
    pictures = []
    for path in _spread_out(list(photograph_files(folder)), count):
        size = camera.width, camera.height
        scaled = cv2.resize(photograph_of(path), size, interpolation=cv2.INTER_AREA)
        pictures.append(jpeg_picture(np.asarray(scaled, dtype=np.uint8)))
    return pictures


def scaled_camera(camera: Camera, factor: float) -> Camera:
    """The camera whose image is the same with `factor` times as many pixels on each side.

    Pixel (0, 0) is a pixel's centre: the image's corner, at (-0.5, -0.5), remains where it is.
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
    size = (camera.width, camera.height)
    grey = np.asarray(cv2.resize(picture.grey, size, interpolation=cv2.INTER_CUBIC), np.float64)
    return jpeg_picture(noisy_image(grey, _SENSOR_NOISE, np.random.default_rng(seed)))


def repeated_run(run: Run, folder: Path, frames: int, most_copies: int | None = None) -> Path:
    """A run folder of any number of frames: those of a run, repeated.

    At most `most_copies` images (by default `_MOST_COPIES`, and at least those of the run) are
    copies; the others are hard links to them.
    """
    sources = [(frame.image, frame.step) for frame in run.frames if frame.image is not None]
    if not sources:
        raise StudyError(f"{run.folder}: no frame has an image: expected at least one")
    (folder / "images").mkdir(parents=True)
    write_camera(run.camera, folder / f"{folder.name}.cam")
    count = max(_MOST_COPIES if most_copies is None else most_copies, len(sources))
    steps, images = [], []
    for number in range(frames):
        source, step = sources[number % len(sources)]
        images.append(folder / "images" / f"e.{number:07d}{source.suffix}")
        if number < count:
            shutil.copyfile(source, images[-1])
        else:
            os.link(images[number % count], images[-1])
        steps.append(Frame(replace(step, prefix=images[-1].stem)))
    write_frames(folder / f"{folder.name}.txt", steps)
    return folder


def _spread_out(paths: list[Path], count: int) -> list[Path]:
    """At most `count` of some paths, evenly spread over them."""
    if len(paths) <= count:
        return paths
    return [paths[i * len(paths) // count] for i in range(count)]


_FLOOR, _DISC = 90.0, 200.0
_DARK, _LIGHT = 90.0, 160.0
_BLUR_PX = 0.7
_NOISE = 1.5
_RADIUS_M = 0.10

#: Discs are at least this far apart, at most this far away, and this far inside the image.
_APART_M = 0.35
_FARTHEST_M = 4.0
_MARGIN_PX = 30

#: Largest number of attempts to place discs.
_ATTEMPTS = 10_000

#: Samples per pixel and axis of a wall, and the wall's stripes' part of the view.
_FINE = 4
_WALL_SHARE = 0.8


def disc_places(camera: Camera, count: int, seed: int) -> FloatArray:
    """Floor positions of discs that the camera sees whole, with space between them.

    A larger count only adds places to those of a smaller one.

    Returns (count, 2).
    """
    rng = np.random.default_rng(seed)
    low = np.full(2, float(_MARGIN_PX))
    high = np.array([camera.width, camera.height]) - 1.0 - _MARGIN_PX
    places = np.zeros((0, 2))
    for _ in range(_ATTEMPTS):
        if len(places) == count:
            return places
        place = camera.floor_from_pixel(rng.uniform(low, high))
        near = float(np.hypot(*place)) <= _FARTHEST_M  # false for NaN, above the horizon
        if near and np.all(np.hypot(*(places - place).T) >= _APART_M):
            places = np.vstack([places, place])
    raise StudyError(f"{count} discs do not find room on the floor: expected fewer")


def floor_with_discs(camera: Camera, places: FloatArray, seed: int) -> ByteArray:
    """A bare floor with light discs, blurred and noisy. `places` (N, 2); returns (H, W)."""
    grey = np.full((camera.height, camera.width), _FLOOR)
    for place in places:
        crop = render_disc(camera, place, _RADIUS_M, _DISC, _FLOOR, _BLUR_PX)
        grey[crop.window] += crop.grey - _FLOOR
    return noisy_image(grey, _NOISE, np.random.default_rng(seed))


def wall_with_edges(camera: Camera, count: int, seed: int) -> ByteArray:
    """A wall all around, striped so that the camera sees a number of vertical edges.
    Returns (H, W).
    """
    direction = camera.directions_robot(subpixel_grid(camera, _FINE, _FINE))
    bearing = np.arctan2(direction[..., 0], -direction[..., 1])
    middle = bearing[len(bearing) // 2]
    half = 0.5 * _WALL_SHARE * (float(np.max(middle)) - float(np.min(middle)))
    centre = 0.5 * (float(np.max(middle)) + float(np.min(middle)))
    edges = centre + half * (2.0 * (np.arange(count) + 0.5) / max(count, 1) - 1.0)
    light = np.searchsorted(edges, bearing) % 2 == 1
    share = light.reshape(camera.height, _FINE, camera.width, _FINE).mean(axis=(1, 3))
    return noisy_image(_DARK + (_LIGHT - _DARK) * share, _NOISE, np.random.default_rng(seed))


def contents_of(paths: Sequence[Path]) -> list[ByteArray]:
    """Contents of files; a file that has several names is read once."""
    held: dict[tuple[int, int], ByteArray] = {}
    contents = []
    for path in paths:
        status = path.stat()
        key = (status.st_dev, status.st_ino)
        if key not in held:
            held[key] = np.fromfile(path, np.uint8)
        contents.append(held[key])
    return contents
