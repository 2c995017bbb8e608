"""Which images a run has, and which of them belongs to a step: never one outside the run."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from detect.errors import DetectError, FrameError
from detect.runs.image_names import IMAGE_SUFFIXES, ImageNames
from storage.inside import leads_out, link_out
from storage.messages import excerpt

#: Size in bytes and time of change in nanoseconds: what tells one state of a file from another.
FileStamp = tuple[int, int]


def images_of_folder(folder: Path) -> ImageNames:
    """The images in ``images/`` or, failing that, in the folder itself.

    Raises
    ------
    DetectError
        If there are none.
    """
    for place in (folder / "images", folder):
        if place.is_dir():
            found = ImageNames(place)
            if len(found):
                return found
    kinds = " ".join(sorted(IMAGE_SUFFIXES))
    raise DetectError(f"{folder}: no images: expected {kinds} in it or in {folder / 'images'}")


def image_of(
    prefix: str, images: ImageNames, homes: tuple[str, ...]
) -> tuple[Path, FileStamp | None] | None:
    """A step's image and the stamp of its file (see `demand_no_link_out`); None if there is none.

    Raises
    ------
    FrameError
        If the step's prefix, or a link of that name, leads out of the run: whoever made the file of
        steps does not decide which other files are read.
    """
    found = place_of(prefix, images, homes)
    if found is None:
        return None
    path = images.path(found)
    return path, demand_no_link_out(path, homes)


def place_of(prefix: str, images: ImageNames, homes: tuple[str, ...]) -> int | None:
    """The place of a step's image, by its name alone; None if there is none.

    Raises
    ------
    FrameError
        If the step's prefix leads out of the run.
    """
    name = prefix.strip('"')
    why = leads_out(name, *homes)
    if why is not None:
        raise FrameError(f"{excerpt(prefix)}: the prefix {why}: expected an image of the run")
    return images.find(name.replace("\\", "/").rsplit("/", 1)[-1])


def demand_no_link_out(path: Path, homes: tuple[str, ...]) -> FileStamp | None:
    """Refuse an image that is a link to somewhere outside the folders `homes`.

    Returns
    -------
    FileStamp or None
        None where it is a link, or nothing is there.

    Raises
    ------
    FrameError
    """
    try:
        status = os.lstat(path)
    except (OSError, ValueError):
        return None
    if not stat.S_ISLNK(status.st_mode):
        return status.st_size, status.st_mtime_ns
    if link_out(path, *map(Path, homes)):
        raise FrameError(
            f"{path}: cannot be read: is a link that leads out of the run: expected an image in it"
        )
    return None


def homes_of(images: ImageNames) -> tuple[str, ...]:
    """Where a run's images may be: their folder, and that of the run."""
    folder = os.path.abspath(images.folder)  # noqa: PTH100 - links are not followed yet
    above, name = os.path.split(folder)
    return (folder, above) if name == "images" else (folder,)
