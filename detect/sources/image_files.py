"""Image files as a source, and the image of each step, which is never outside the run.

Only the names of the images are kept in memory.
"""

from __future__ import annotations

import fnmatch
import glob
import os
import re
from collections.abc import Generator, Mapping
from contextlib import suppress
from pathlib import Path

from camera import Camera, camera_in
from detect.errors import DetectError, FrameError
from detect.sources.interface import Frames, RunFrame, Source, frame_prefix, still
from redetect.landmarks import read_steps
from redetect.landmarks.frame_files import read_times
from redetect.messages import excerpt
from redetect.storage import IMAGE_SUFFIXES, demand_free
from redetect.storage.bounded import leads_out, link_out

_KINDS = " ".join(sorted(IMAGE_SUFFIXES))
WILDCARDS = frozenset("*?[")


def image_name(prefix: str) -> str:
    """Name of an image without directories (of either system) and image extension."""
    name = last_part(prefix)
    # Image suffixes only: the data set's prefixes end in a number, as in e.0067.
    stem, dot, extension = name.rpartition(".")
    return stem if stem and (dot + extension).lower() in IMAGE_SUFFIXES else name


def picture_name(prefix: str) -> str:
    """Name of an image's picture without its ending, which cannot lead out of a folder."""
    return image_name(prefix) or "frame"


def demand_pictures(frames: Frames, folder: Path, *, overwrite: bool) -> None:
    """Make the folder for pictures of frames; reject existing pictures if names are known now."""
    folder.mkdir(parents=True, exist_ok=True)
    if not frames.images_in_memory:
        names = (picture_name(frame.step.prefix) for frame in frames)
        demand_free((folder / f"{name}.png" for name in names), overwrite=overwrite)


def last_part(prefix: str) -> str:
    """A prefix without directories (of either system)."""
    return prefix.replace("\\", "/").rpartition("/")[2]


class ImageNames:
    """Names of a folder's image files that match a pattern, in natural order: numbers by value.

    Hidden files are skipped unless the pattern begins with a dot: some systems store metadata in
    files whose names are ``._`` followed by the image's name.
    """

    def __init__(self, folder: Path, pattern: str = "*") -> None:
        self.folder = folder
        # Links may lead to the folder of the images, or that of the run.
        own = Path(os.path.abspath(folder))  # noqa: PTH100 - links are not followed yet
        self._homes: tuple[Path, ...] = (own,)
        self.home = folder  # the run's folder
        if own.name == "images":
            self._homes = (own, own.parent)
            self.home = folder.parent if folder.name == "images" else own.parent
        matches = re.compile(fnmatch.translate(pattern)).match
        with os.scandir(folder) as entries:
            names = sorted(
                entry.name
                for entry in entries
                # A Path for each name is slow.
                if os.path.splitext(entry.name)[1].lower() in IMAGE_SUFFIXES  # noqa: PTH122
                and matches(entry.name)
                and (pattern.startswith(".") or not entry.name.startswith("."))
            )
        self.names = sorted(names, key=_natural_order)  # of equal numbers, 01 before 1
        self._called: dict[str, str] = {}  # first image by name with and without extension
        for name in self.names:
            for called in (name, name[: name.rindex(".")]):
                self._called.setdefault(called, name)

    def image_of(self, prefix: str) -> Path | None:
        """A step's image, by the last part of its prefix; None if there is none.

        FrameError if the prefix leads out of the run: steps cannot cause other files to be read.
        """
        name = prefix.strip('"')
        why = leads_out(name, *map(str, self._homes))
        if why is not None:
            raise FrameError(f"{excerpt(prefix)}: the prefix {why}: expected an image of the run")
        found = self._called.get(last_part(name))
        return None if found is None else self.checked(self.folder / found)

    def checked(self, path: Path) -> Path:
        """The path of an image; a link that leads out of the run is a FrameError."""
        if path.is_symlink() and link_out(path, *self._homes):
            raise FrameError(
                f"{path}: cannot be read: is a link that leads out of the run: expected an image "
                "inside, or that the whole folder is a link"
            )
        return path


def images_of_folder(folder: Path) -> ImageNames:
    """The images in ``images/`` or, failing that, in the folder itself."""
    for place in (folder / "images", folder):
        if place.is_dir():
            found = ImageNames(place)
            if found.names:
                return found
    raise DetectError(
        f"{folder}: no images: expected a run folder, or {_KINDS} in it or in {folder / 'images'}"
    )


def _natural_order(name: str) -> list[tuple[int, str]]:
    """Sort key of names: numbers by value, before letters."""
    parts = re.findall("([0-9]+)|([^0-9]+)", name)
    return [(int(number), "") if number else (-1, word) for number, word in parts]


class RunFrames(Frames):
    """The frames of a file of STEP rows, in its order, with the images that the rows name."""

    images_in_memory = False
    why_left_out = "images are not named by a STEP row: left out"

    def __init__(self, images: ImageNames, odometry: Path, times: Mapping[str, float]) -> None:
        self._images, self._odometry, self._times = images, odometry, times
        # Errors in the odometry are raised here, before any work is done.
        named = set()
        self.expected = 0
        for step in read_steps(odometry):
            self.expected += 1
            with suppress(FrameError):  # reported when the frame is processed
                named.add(images.image_of(step.prefix))
        self.left_out = len(images.names) - len(named - {None})

    def __iter__(self) -> Generator[RunFrame, None, None]:
        for step in read_steps(self._odometry):
            try:
                image = self._images.image_of(step.prefix)
                time_s = None if image is None else _time_of(step.prefix, image, self._times)
                yield RunFrame(step, image, time_s=time_s)
            except FrameError as error:
                yield RunFrame(step, None, failure=str(error))


class ImageFiles(Source):
    """Images in natural order of their names.

    Calibration and times (by default ``<folder>.times``) are in the run's folder, and results are
    written there: the folder of the images, or the one above ``images/``.
    """

    images_in_memory = False

    def __init__(self, name: Path, times: str = "") -> None:
        self.name, self._is_pattern = str(name), not name.is_dir()
        self._names = _matching_images(name) if self._is_pattern else images_of_folder(name)
        self._home = self._names.home
        self.output_base = self._home / "detected"
        self.beside = self._home, self._home.resolve().name
        self.expected = len(self._names.names)
        times_file = Path(times) if times else self._home / f"{self._home.resolve().name}.times"
        self.has_times = bool(times) or times_file.is_file()
        self._times = read_times(times_file) if self.has_times else {}

    def __iter__(self) -> Generator[RunFrame, None, None]:
        prefixes: dict[str, str] = {}
        for name in self._names.names:
            first = prefixes.setdefault(frame_prefix(Path(name).stem), name)
            if first != name:
                raise DetectError(
                    f"{self.name}: {excerpt(first)} and {excerpt(name)} would be the same frame: "
                    "expected different names, or a pattern such as '*.png'"
                )
        for name in self._names.names:
            path = self._names.folder / name
            step = still(frame_prefix(path.stem))
            time_s = _time_of(step.prefix, path, self._times)
            try:
                if not self._is_pattern:  # a pattern names links explicitly, a folder does not
                    path = self._names.checked(path)
                yield RunFrame(step, path, time_s=time_s)
            except FrameError as error:
                yield RunFrame(step, None, time_s=time_s, failure=str(error))

    def calibration(self, *, posed: bool) -> Camera | None:
        """The calibration in the run's folder or, failing that, among the images."""
        return super().calibration(posed=posed) or camera_in(self._names.folder)

    def along(self, odometry: Path) -> RunFrames:
        """The images that a file of STEP rows names, in its order."""
        return RunFrames(self._names, odometry, self._times)


def _time_of(prefix: str, image: Path, times: Mapping[str, float]) -> float | None:
    """The time of an image, by the prefix of its frame or by its name without extension."""
    return times.get(prefix, times.get(image.stem))


def _matching_images(pattern: Path) -> ImageNames:
    """The images that a pattern matches, or one image, whose name may look like a pattern."""
    if not pattern.parent.is_dir():
        wild = "wildcards in a folder's name: expected them in the last part only"
        missing = f"no such folder: {pattern.parent}"
        raise DetectError(f"{pattern}: {wild if WILDCARDS & {*str(pattern.parent)} else missing}")
    name = glob.escape(pattern.name) if pattern.is_file() else pattern.name
    found = ImageNames(pattern.parent, name)
    if not found.names:
        raise DetectError(f"{pattern}: no image matches: expected {_KINDS}")
    return found
