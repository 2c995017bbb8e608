"""Image files as a source: a folder of them, one, or a pattern such as ``drive/*.png``."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

from camera import Camera
from detect.errors import DetectError
from detect.run import RunFrame
from detect.sources.gray import significant_bits_of_file
from detect.sources.image_names import IMAGE_SUFFIXES, ImageNames, images_of_folder
from detect.sources.interface import Source, frame_prefix, only_calibration, still
from detect.sources.times import read_image_times

WILDCARDS = frozenset("*?[")

# Number of images, spread over all, that determine the significant bits.
_SAMPLES = 5


class ImageFiles(Source):
    """Images in natural order of their names.

    Calibration and times (``<folder>.times``, if not named) are in the run's folder, and results
    are written there: the folder of the images, or the one above ``images/``. 16-bit images have
    the significant bits that some of them need, if not named.
    """

    ships_images = False
    times_own = False

    def __init__(self, name: Path, times: str = "", bits: int | None = None) -> None:
        self.name = str(name)
        if name.is_dir():
            self._names, self._home = images_of_folder(name), name
        else:
            self._names, self._home = _matching_images(name), name.parent
            if name.parent.resolve().name == "images":
                self._home = name.parent.parent
        self.output_base = self._home / "detected"
        self.expected = len(self._names)
        times_file = Path(times) if times else self._home / f"{self._home.resolve().name}.times"
        self._times = read_image_times(times_file) if times or times_file.is_file() else {}
        self.has_times = bool(times) or times_file.is_file()
        self._bits = bits_of_images(self._names) if bits is None else bits

    def __iter__(self) -> Generator[RunFrame, None, None]:
        for place in range(len(self._names)):
            path = self._names.path(place)
            step = still(frame_prefix(path.stem))
            yield RunFrame(step, path, time_s=self._times.get(path.stem), bits=self._bits)

    def calibration(self, *, posed: bool) -> Camera | None:
        """The ``.cam`` file in the run's folder."""
        return only_calibration(self._home, self._home.resolve().name)


def bits_of_images(names: ImageNames) -> int:
    """Significant bits of 16-bit images: what some, spread over all, need; 16 if there are none."""
    last = len(names) - 1
    places = {round(k * last / (_SAMPLES - 1)) for k in range(_SAMPLES)}
    found = [significant_bits_of_file(names.path(place)) for place in places if last >= 0]
    return max((bits for bits in found if bits is not None), default=16)


def _matching_images(pattern: Path) -> ImageNames:
    """The images that a pattern matches, or one image."""
    if WILDCARDS & set(str(pattern.parent)):
        raise DetectError(
            f"{pattern}: wildcards in the folder's name: expected them in the last part only"
        )
    if not pattern.parent.is_dir():
        raise DetectError(f"{pattern}: no such folder: {pattern.parent}")
    found = ImageNames(pattern.parent, pattern.name)
    if not len(found):
        kinds = " ".join(sorted(IMAGE_SUFFIXES))
        raise DetectError(f"{pattern}: no image matches: expected {kinds}")
    return found
