"""Times of images: rows ``prefix seconds`` between blanks or commas, ``#`` comments."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator
from pathlib import Path

from detect.errors import DetectError
from detect.sources.name_index import NameIndex

#: The head of a file of times.
TIMES_HEAD = "Times of the frames: <image> <seconds>, as their source gives them."

_LARGEST_ROW = 65536


class TimesByImage:
    """The times of a ``.times`` file, by image prefix; 8 bytes each, and the prefix.

    Parameters
    ----------
    path : path

    Raises
    ------
    DetectError
        If the file cannot be read or a row is malformed; it names file and line.
    """

    def __init__(self, path: Path) -> None:
        self._seconds = array("d")

        def prefixes() -> Iterator[bytes]:
            for prefix, time_s in _rows(path):
                self._seconds.append(time_s)
                yield _bytes(prefix)

        self._index = NameIndex(prefixes())

    def __len__(self) -> int:
        return len(self._seconds)

    def get(self, prefix: str) -> float | None:
        """The time of an image (s); None if the file has none."""
        place = self._index.find(_bytes(prefix))
        return None if place is None else self._seconds[place]


def format_time(prefix: str, time_s: float) -> str:
    """The row of an image, without line end."""
    return f"{prefix} {time_s:.6f}"


def _rows(path: Path) -> Iterator[tuple[str, float]]:
    try:
        with path.open(encoding="utf-8-sig", errors="surrogateescape") as stream:
            for number, line in enumerate(stream, start=1):
                words = line[:_LARGEST_ROW].partition("#")[0].replace(",", " ").split()
                if not words:
                    continue
                try:
                    prefix, seconds = words[0], float(words[1])
                except (IndexError, ValueError):
                    prefix, seconds = "", math.nan
                if len(words) != 2 or not math.isfinite(seconds):
                    raise DetectError(
                        f"{path}:{number}: {' '.join(words)[:60]!a}: "
                        "expected an image's prefix and seconds"
                    )
                yield prefix, seconds
    except FileNotFoundError:
        raise DetectError(f"{path}: no such file of times") from None
    except OSError as error:
        raise DetectError(f"{path}: cannot be read: {error.strerror}") from None


def _bytes(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")
