"""The images of a folder, as compact as they can be looked up in.

A run may have a million frames: what is kept of one is the name of its image, twice, and 4 bytes.
"""

from __future__ import annotations

import fnmatch
import os
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from detect.runs.name_index import NameIndex

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".pgm", ".ppm", ".tif", ".tiff", ".bmp"})

_DIGITS = re.compile(r"[0-9]+")


def image_name(prefix: str) -> str:
    """Name of an image without directories (of either system) and image extension."""
    name = prefix.replace("\\", "/").rpartition("/")[2]
    # Not just any suffix: the data set's prefixes end in a number, as in e.0067.
    stem, dot, extension = name.rpartition(".")
    return stem if stem and (dot + extension).lower() in IMAGE_SUFFIXES else name


class ImageNames:
    """Names of image files, in natural order: numbers by value.

    Parameters
    ----------
    folder : path
        Where the images are. It is listed once.
    pattern : str
        What the names of files must match, as in `fnmatch`.

    Attributes
    ----------
    folder : path
    has_links : bool
        Whether any of them is a symbolic link.
    """

    def __init__(self, folder: Path, pattern: str = "*") -> None:
        self.folder = folder
        self.has_links = False
        suffixes = set()
        keys = []
        matches = re.compile("" if pattern == "*" else fnmatch.translate(pattern)).match
        with os.scandir(folder) as entries:
            for entry in entries:
                suffix = os.path.splitext(entry.name)[1]  # noqa: PTH122 - a Path for each is slow
                if suffix.lower() in IMAGE_SUFFIXES and matches(entry.name):
                    self.has_links |= entry.is_symlink()
                    suffixes.add(os.fsencode(suffix))
                    keys.append(_natural_order(entry.name))
        keys.sort()
        self._names: NDArray[np.bytes_] = np.array(
            [os.fsencode(key.rpartition("/")[2]) for key in keys], dtype=np.bytes_
        )
        self._index = NameIndex(bytes(name) for name in self._names)
        self._suffixes = tuple(sorted(suffixes))

    def __len__(self) -> int:
        return len(self._names)

    def path(self, index: int) -> Path:
        """The image at a place in the order."""
        return self.folder / os.fsdecode(self._names[index])

    def find(self, name: str) -> int | None:
        """The place of the image of a name, with or without its ending; the first of several."""
        stem = name.encode("utf-8", "surrogateescape")
        names = [stem + suffix for suffix in self._suffixes]
        if stem.endswith(self._suffixes):  # else there is nothing of that name as it stands
            names.append(stem)
        if len(names) == 1:
            return self._index.find(names[0])
        places = [self._index.find(name) for name in names]
        return min((place for place in places if place is not None), default=None)


def _natural_order(name: str) -> str:
    """What sorts names with numbers by value, then by the name itself, which follows the last /.

    A number becomes NUL, how many digits it has, and the digits: longer numbers are larger ones.
    """

    def by_value(match: re.Match[str]) -> str:
        digits = match.group().lstrip("0")
        return f"\0{chr(1 + len(digits))}{digits}"

    begins_with_number = "1" if name[0].isdigit() else "0"
    return f"{begins_with_number}{_DIGITS.sub(by_value, name)}\0\0/{name}"
