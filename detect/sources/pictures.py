"""Image files as a source: a folder of them, one, or a pattern such as ``drive/*.png``."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

from detect.errors import DetectError
from detect.sources.gray import significant_bits_of_file
from detect.sources.image_names import IMAGE_SUFFIXES, ImageNames
from detect.sources.interface import (
    Calibration,
    Source,
    SourceImage,
    frame_prefix,
    only_calibration,
)
from detect.sources.times import TimesByImage

WILDCARDS = frozenset("*?[")

# Number of images, spread over all, that determine the significant bits.
_LOOKED_AT = 5


class ImageFiles(Source):
    """Images in natural order of their names.

    Parameters
    ----------
    names : ImageNames
        The images.
    name : str
        What messages call them.
    home : path
        The run's folder: calibration and times are there, and results are written there.
    times : TimesByImage or None
        When they were taken.
    bits : int or None
        Significant bits of 16-bit images; by default what some of them need.
    """

    ships_images = False
    times_own = False

    def __init__(
        self,
        names: ImageNames,
        name: str,
        home: Path,
        times: TimesByImage | None,
        bits: int | None,
    ) -> None:
        self.name = name
        self.output_base = home / "detected"
        self.has_times = times is not None
        self._home = home
        self._names = names
        self.expected = len(names)
        self._times = times
        self._bits = bits if bits is not None else bits_of_images(names)

    def images(self) -> Generator[SourceImage, None, None]:
        """The images, by the names of their files."""
        for place in range(len(self._names)):
            path = self._names.path(place)
            time_s = None if self._times is None else self._times.get(path.stem)
            yield SourceImage(frame_prefix(path.stem), time_s, path, bits=self._bits)

    def calibration(self) -> Calibration | None:
        """The ``.cam`` file in the folder, or in the one above ``images/``."""
        return only_calibration(self._home, self._home.resolve().name)


def matching_images(pattern: str) -> ImageNames:
    """The images that a pattern names, or one image.

    Raises
    ------
    DetectError
        If there are wildcards in the folder's name, no such folder, or no image of that name.
    """
    path = Path(pattern)
    if WILDCARDS & set(str(path.parent)):
        raise DetectError(
            f"{pattern}: wildcards in the folder's name: expected them in the last part only"
        )
    if not path.parent.is_dir():
        raise DetectError(f"{pattern}: no such folder: {path.parent}")
    found = ImageNames(path.parent, path.name)
    if not len(found):
        kinds = " ".join(sorted(IMAGE_SUFFIXES))
        raise DetectError(f"{pattern}: no image matches: expected {kinds}")
    return found


def home_of(folder: Path) -> Path:
    """The run folder of a folder of images: that above ``images/``, else itself."""
    return folder.parent if folder.resolve().name == "images" else folder


def own_times(home: Path) -> Path | None:
    """The file of times in a run folder."""
    path = home / f"{home.resolve().name}.times"
    return path if path.is_file() else None


def bits_of_images(names: ImageNames) -> int:
    """Significant bits of 16-bit images: what some, spread over all, need; 16 if there are none."""
    count = len(names)
    places = sorted({round(k * (count - 1) / (_LOOKED_AT - 1)) for k in range(_LOOKED_AT)})
    found = [significant_bits_of_file(names.path(place)) for place in places if count]
    return max((bits for bits in found if bits is not None), default=16)
