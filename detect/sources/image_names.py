"""The images of a folder, and which of them belongs to a step: never one outside the run.

A run may have a million frames: the memory per frame is the name of its image, twice, and 4 bytes.
"""

from __future__ import annotations

import fnmatch
import hashlib
import os
import re
import stat
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from detect.errors import DetectError, FrameError
from storage.inside import leads_out, link_out
from storage.messages import excerpt

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".pgm", ".ppm", ".tif", ".tiff", ".bmp"})

#: Size in bytes and time of change in nanoseconds: they identify a state of a file.
FileStamp = tuple[int, int]

_DIGITS = re.compile(r"[0-9]+")
#: Longer names are known by their digest, bytes.
_LONGEST = 64


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
        # Where a run's images may be: in their folder, or that of the run.
        own = os.path.abspath(folder)  # noqa: PTH100 - links are not followed yet
        above, name = os.path.split(own)
        self._homes = (own, above) if name == "images" else (own,)
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
        if stem.endswith(self._suffixes):  # else there is no file of exactly that name
            names.append(stem)
        if len(names) == 1:
            return self._index.find(names[0])
        places = [self._index.find(name) for name in names]
        return min((place for place in places if place is not None), default=None)

    def place_of(self, prefix: str) -> int | None:
        """The place of a step's image, by its name alone; None if there is none.

        Raises
        ------
        FrameError
            If the step's prefix leads out of the run: a file of steps must not decide which other
            files are read.
        """
        name = prefix.strip('"')
        why = leads_out(name, *self._homes)
        if why is not None:
            raise FrameError(f"{excerpt(prefix)}: the prefix {why}: expected an image of the run")
        return self.find(name.replace("\\", "/").rsplit("/", 1)[-1])

    def checked(self, index: int) -> tuple[Path, FileStamp | None]:
        """The image at a place, and its file's stamp: None if it is a link, or nothing is there.

        Raises
        ------
        FrameError
            If it is a link that leads out of the run.
        """
        path = self.path(index)
        try:
            status = os.lstat(path)
        except (OSError, ValueError):
            return path, None
        if not stat.S_ISLNK(status.st_mode):
            return path, (status.st_size, status.st_mtime_ns)
        if link_out(path, *map(Path, self._homes)):
            raise FrameError(
                f"{path}: cannot be read: is a link that leads out of the run: expected an image "
                "in it"
            )
        return path, None


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


def _natural_order(name: str) -> str:
    """Sort key of names, with numbers by value, then by the name itself, which follows the last /.

    A number becomes NUL, how many digits it has, and the digits: longer numbers are larger ones.
    """

    def by_value(match: re.Match[str]) -> str:
        digits = match.group().lstrip("0")
        return f"\0{chr(1 + len(digits))}{digits}"

    begins_with_number = "1" if name[0].isdigit() else "0"
    return f"{begins_with_number}{_DIGITS.sub(by_value, name)}\0\0/{name}"


class NameIndex:
    """Finds the place of a name in a sequence; costs the width of the longest name and 4 bytes.

    Parameters
    ----------
    names : iterable of bytes
        Without NUL; longer ones than 64 bytes are known by their digest. Of equal ones the last
        counts.
    """

    def __init__(self, names: Iterable[bytes]) -> None:
        keys: NDArray[np.bytes_] = np.array([_key(name) for name in names], dtype=np.bytes_)
        order = np.argsort(keys, kind="stable")
        self._keys = keys[order]
        self._places = order.astype(np.uint32)
        self._next = 0  # in a run, after a name mostly comes its successor

    def __len__(self) -> int:
        return len(self._keys)

    def find(self, name: bytes) -> int | None:
        """The place of a name in the sequence; None if it is not there."""
        key = _key(name)
        keys = self._keys
        # For a wider needle numpy would copy the whole haystack to its width.
        if not len(keys) or len(key) > keys.itemsize:
            return None
        after = self._next + 1
        if after >= len(keys) or keys.item(after - 1) != key or keys.item(after) == key:
            after = int(keys.searchsorted(np.bytes_(key), side="right"))
            if not after or keys.item(after - 1) != key:
                return None
        self._next = after
        return self._places.item(after - 1)


def _key(name: bytes) -> bytes:
    return name if len(name) < _LONGEST else hashlib.sha256(name).hexdigest().encode()
