"""Files of times: a row ``<image> <seconds>`` for each frame, with ``#`` comments."""

from __future__ import annotations

import os
from math import isfinite

from redetect.bounds import number_in
from redetect.landmarks.files import decode, opened, rows_of_words
from redetect.landmarks.records import LandmarkFileError
from redetect.messages import excerpt

#: The first line of written files.
TIMES_HEAD = "Times of the frames: <image> <seconds>, as their source gives them."


def read_times(path: str | os.PathLike[str]) -> dict[str, float]:
    """The times of images (s) by prefix; rows are separated by blanks or a comma.

    Raises LandmarkFileError if the file cannot be read, a row is malformed or an image has two.
    """
    times: dict[str, float] = {}
    with opened(path, "file of times") as stream:
        for row, _, line in rows_of_words(stream, os.fspath(path)):
            words = decode(b" ".join(row)).replace(",", " ").split()
            if not words:
                continue
            try:
                prefix, seconds = words[0], number_in(words[1])
            except (IndexError, ValueError):
                prefix, seconds = "", float("nan")
            if len(words) != 2 or not isfinite(seconds):
                found = f"{excerpt(' '.join(words))}: expected an image's prefix and seconds"
                raise LandmarkFileError(path, line, found)
            if prefix in times:
                raise LandmarkFileError(path, line, f"{excerpt(prefix)} is listed a second time")
            times[prefix] = seconds
    return times


def format_time(prefix: str, time_s: float) -> str:
    """The row of an image, without line end."""
    return f"{prefix} {time_s:.6f}"
