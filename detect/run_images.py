"""Which images a run has, and which of them belongs to a step: never one outside the run."""

from __future__ import annotations

import os
from pathlib import Path

from detect.errors import DetectError, FrameError
from detect.image_names import IMAGE_SUFFIXES, ImageNames
from landmarks import Step
from storage.inside import leads_out, link_out
from storage.messages import excerpt


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


def image_of(step: Step, images: ImageNames, homes: tuple[str, ...]) -> Path | None:
    """A step's image; None if there is none.

    Raises
    ------
    FrameError
        If the step's prefix, or a link of that name, leads out of the run: whoever made the file of
        steps does not decide which other files are read.
    """
    found = place_of(step, images, homes)
    if found is None:
        return None
    path = images.path(found)
    demand_no_link_out(path, homes)
    return path


def place_of(step: Step, images: ImageNames, homes: tuple[str, ...]) -> int | None:
    """The place of a step's image, by its name alone; None if there is none.

    Raises
    ------
    FrameError
        If the step's prefix leads out of the run.
    """
    name = step.prefix.strip('"')
    why = leads_out(name, *homes)
    if why is not None:
        raise FrameError(f"{excerpt(step.prefix)}: the prefix {why}: expected an image of the run")
    return images.find(name.replace("\\", "/").rsplit("/", 1)[-1])


def demand_no_link_out(path: Path, homes: tuple[str, ...]) -> None:
    """Refuse an image that is a link to somewhere outside the folders `homes`.

    Raises
    ------
    FrameError
    """
    if os.path.islink(path) and link_out(path, *map(Path, homes)):  # noqa: PTH114 - much sooner
        raise FrameError(
            f"{path}: cannot be read: is a link that leads out of the run: expected an image in it"
        )


def homes_of(images: ImageNames) -> tuple[str, ...]:
    """Where a run's images may be: their folder, and that of the run."""
    folder = os.path.abspath(images.folder)  # noqa: PTH100 - links are not followed yet
    above, name = os.path.split(folder)
    return (folder, above) if name == "images" else (folder,)
