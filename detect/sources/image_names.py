"""The images of a folder, and which of them belongs to a step: never one outside the run.

A run may have a million frames: the memory per frame is the name of its image, twice, and 4 bytes.
"""

from __future__ import annotations

import fnmatch
import hashlib
import os
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from detect.errors import DetectError, FrameError
from redetect.storage.inside import leads_out, link_out
from redetect.storage.messages import excerpt

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".pgm", ".ppm", ".tif", ".tiff", ".bmp"})

#: Longer names are known by their digest, bytes.
_LONGEST = 64


def image_name(prefix: str) -> str:
    """Name of an image without directories (of either system) and image extension."""
    name = last_part(prefix)
    # Not just any suffix: the data set's prefixes end in a number, as in e.0067.
    stem, dot, extension = name.rpartition(".")
    return stem if stem and (dot + extension).lower() in IMAGE_SUFFIXES else name


def last_part(prefix: str) -> str:
    """A prefix without directories (of either system)."""
    return prefix.replace("\\", "/").rpartition("/")[2]


class ImageNames:
    """Names of a folder's image files that match a pattern, in natural order: numbers by value.

    The folder is listed once; `has_links` says whether any of them is a symbolic link.
    """

    def __init__(self, folder: Path, pattern: str = "*") -> None:
        self.folder = folder
        # Where a run's images may be: in their folder, or that of the run.
        own = Path(os.path.abspath(folder))  # noqa: PTH100 - links are not followed yet
        self._homes = (own, own.parent) if own.name == "images" else (own,)
        matches = re.compile(fnmatch.translate(pattern)).match
        with os.scandir(folder) as entries:
            found = [
                entry
                for entry in entries
                if _suffix(entry.name) in IMAGE_SUFFIXES and matches(entry.name)
            ]
        self.has_links = any(entry.is_symlink() for entry in found)
        names = sorted(entry.name for entry in found)
        names.sort(key=_natural_order)
        encoded = [os.fsencode(name) for name in names]
        self._names: NDArray[np.bytes_] = np.array(encoded, dtype=np.bytes_)
        self._index = NameIndex(encoded)
        self._suffixes = sorted({name[name.rindex(b".") :] for name in encoded})

    def __len__(self) -> int:
        return len(self._names)

    def path(self, index: int) -> Path:
        """The image at a place in the order."""
        return self.folder / os.fsdecode(self._names[index])

    def find(self, name: str) -> int | None:
        """The place of the image of a name, with or without its ending; the first of several."""
        stem = name.encode("utf-8", "surrogateescape")
        places = [self._index.find(stem + suffix) for suffix in (b"", *self._suffixes)]
        return min((place for place in places if place is not None), default=None)

    def place_of(self, prefix: str) -> int | None:
        """The place of a step's image, by its name alone; None if there is none.

        A prefix that leads out of the run is a FrameError: a file of steps must not decide which
        other files are read.
        """
        name = prefix.strip('"')
        why = leads_out(name, *map(str, self._homes))
        if why is not None:
            raise FrameError(f"{excerpt(prefix)}: the prefix {why}: expected an image of the run")
        return self.find(last_part(name))

    def checked(self, index: int) -> Path:
        """The image at a place; a link that leads out of the run is a FrameError."""
        path = self.path(index)
        if path.is_symlink() and link_out(path, *self._homes):
            raise FrameError(
                f"{path}: cannot be read: is a link that leads out of the run: expected an image "
                "in it"
            )
        return path


def images_of_folder(folder: Path) -> ImageNames:
    """The images in ``images/`` or, failing that, in the folder itself."""
    for place in (folder / "images", folder):
        if place.is_dir():
            found = ImageNames(place)
            if len(found):
                return found
    kinds = " ".join(sorted(IMAGE_SUFFIXES))
    raise DetectError(f"{folder}: no images: expected {kinds} in it or in {folder / 'images'}")


class NameIndex:
    """Finds the place of a name in a sequence; of equal names, which have no NUL, the last one.

    It costs the width of the longest name and 4 bytes per name.
    """

    def __init__(self, names: Iterable[bytes]) -> None:
        keys: NDArray[np.bytes_] = np.array([_key(name) for name in names], dtype=np.bytes_)
        self._places = np.argsort(keys, kind="stable").astype(np.uint32)
        self._keys = keys[self._places]

    def __len__(self) -> int:
        return len(self._keys)

    def find(self, name: bytes) -> int | None:
        """The place of a name in the sequence; None if it is not there."""
        key = _key(name)
        if len(key) > self._keys.itemsize:  # numpy would copy all keys to this width
            return None
        after = int(self._keys.searchsorted(np.bytes_(key), side="right"))
        if not after or self._keys[after - 1] != key:
            return None
        return int(self._places[after - 1])


def _key(name: bytes) -> bytes:
    return name if len(name) < _LONGEST else hashlib.sha256(name).hexdigest().encode()


def _suffix(name: str) -> str:
    return os.path.splitext(name)[1].lower()  # noqa: PTH122 - a Path for each name is slow


def _natural_order(name: str) -> str:
    """Sort key of names with numbers by value: before its digits, how many there are."""

    def by_value(found: re.Match[str]) -> str:
        digits = found[0].lstrip("0")
        return f"\0{chr(1 + len(digits))}{digits}"

    return f"{name[0].isdigit():d}{re.sub('[0-9]+', by_value, name)}"
