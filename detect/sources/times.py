"""Times of images: rows ``prefix seconds`` between blanks or commas, ``#`` comments."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from detect.errors import DetectError

#: The head of a file of times.
TIMES_HEAD = "Times of the frames: <image> <seconds>, as their source gives them."

_LONGEST_ROW = 65536


def read_image_times(path: Path) -> dict[str, float]:
    """The times of images (s), by their prefixes."""
    times = {}
    for number, words in text_rows(path, "file of times", "surrogateescape"):
        try:
            prefix, seconds = words[0], float(words[1])
        except (IndexError, ValueError):
            prefix, seconds = "", math.nan
        if len(words) != 2 or not math.isfinite(seconds):
            raise DetectError(
                f"{path}:{number}: {' '.join(words)[:60]!a}: expected an image's prefix and seconds"
            )
        times[prefix] = seconds
    return times


def format_time(prefix: str, time_s: float) -> str:
    """The row of an image, without line end."""
    return f"{prefix} {time_s:.6f}"


def text_rows(path: Path, what: str, errors: str = "strict") -> Iterator[tuple[int, list[str]]]:
    """Number and words of each row of a text file, between blanks or commas, ``#`` comments."""
    try:
        with path.open(encoding="utf-8-sig", errors=errors) as stream:
            for number, line in enumerate(stream, start=1):
                words = line[:_LONGEST_ROW].partition("#")[0].replace(",", " ").split()
                if words:
                    yield number, words
    except FileNotFoundError:
        raise DetectError(f"{path}: no such {what}") from None
    except UnicodeDecodeError:
        raise DetectError(f"{path}: is no text: expected a {what}") from None
    except OSError as error:
        raise DetectError(f"{path}: cannot be read: {error.strerror}") from None
