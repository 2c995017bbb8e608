"""Common parts of other tools' text formats: axes, rows and numbers.

The data set's robot has X left and Y backward; other tools expect X forward and Y left. One
rotation about Z by a quarter turn, ``p_robotics = Rz p_dataset`` with ``(x, y) -> (-y, x)``, leads
from the first to the second. It is applied to the robot's frame and to the map's alike: a pose or
step T becomes Rz T Rz^-1, that is, its position is rotated and its angle stays. Covariances become
Rz C Rz^T; rotating the means alone would leave ellipses across instead of along. Bearings count
from forward, positive to the left, in both.

All is done by exchanging numbers and signs: nothing is rounded, and there and back gives the same
bits.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray, IntArray
from redetect.slam.errors import SlamError
from redetect.storage import write_bytes
from redetect.storage.bounded import read_content

Axes = Literal["robotics", "dataset"]

#: What each kind of axes means, for the heads of files.
MEANING: dict[str, str] = {
    "robotics": "X forward, Y left",
    "dataset": "X left, Y backward",
}

# Which of the old coordinates becomes the new first, second, third, and with which sign; on the way
# back it is the sign of the first two that differs.
_ORDER = np.array([1, 0, 2])
_SIGNS = np.array([-1.0, 1.0, 1.0])


def from_dataset(values: ArrayLike, axes: Axes, *, back: bool = False) -> FloatArray:
    """Vectors, poses or steps in the data set's axes, brought into others, or `back`.

    Takes (..., 2) or (..., 3): x, y and, of poses and steps, the angle; returns the same shape.
    """
    old = np.array(values, dtype=np.float64)
    if axes == "dataset":
        return old
    order, sign = _turn(old.shape[-1], back)
    return np.asarray(old[..., order] * sign)


def to_dataset(values: ArrayLike, axes: Axes) -> FloatArray:
    """Undo `from_dataset`."""
    return from_dataset(values, axes, back=True)


def covariance_from_dataset(covariance: ArrayLike, axes: Axes, *, back: bool = False) -> FloatArray:
    """Covariances (or information matrices) (..., d, d) of what `from_dataset` turns, turned."""
    old = np.array(covariance, dtype=np.float64)
    if axes == "dataset":
        return old
    order, sign = _turn(old.shape[-1], back)
    return np.asarray(old[..., order[:, None], order] * np.outer(sign, sign))


def _turn(size: int, back: bool) -> tuple[IntArray, FloatArray]:
    order = _ORDER[:size]
    return order, (_SIGNS[order] if back else _SIGNS[:size])


#: Begins the comment that says which axes a file is in.
AXES_COMMENT = "# AXES"

#: The largest number of a vertex: other tools keep it in 31 bits.
LARGEST_NUMBER = 2**31 - 1

_LARGEST_FILE_BYTES = 1 << 28
# Narrower than `float` and `int`, which also take nan, infinity and 1_000.
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?", re.ASCII)
_WHOLE = re.compile(r"[0-9]{1,10}", re.ASCII)


def write_text(path: str | os.PathLike[str], rows: Iterable[str], *, overwrite: bool) -> None:
    """Write rows of text, whole or not at all."""
    content = "".join(f"{row}\n" for row in rows).encode("utf-8", "surrogateescape")
    write_bytes(path, content, overwrite=overwrite)


def text_rows(path: str | os.PathLike[str]) -> Iterator[tuple[int, str]]:
    """Rows of a text file with their line numbers, without blank ones; comments are among them."""
    content = read_content(path, _LARGEST_FILE_BYTES, "file", SlamError)
    for number, source in enumerate(content.split(b"\n"), 1):
        text = source.decode("utf-8", "surrogateescape").strip()
        if text:
            yield number, text


def finite(path: str | os.PathLike[str], line: int, name: str, word: str) -> float:
    """A word as a finite number; `SlamError` where it is none."""
    value = float(word) if len(word) <= 400 and _NUMBER.fullmatch(word) else math.nan
    if not math.isfinite(value):
        raise SlamError(f"{path}:{line}: {name} is {word[:30]!a}: expected a finite number")
    return value


def whole(path: str | os.PathLike[str], line: int, name: str, word: str) -> int:
    """A word as the number of a vertex; `SlamError` where it is none."""
    value = int(word) if _WHOLE.fullmatch(word) else LARGEST_NUMBER + 1
    if value > LARGEST_NUMBER:
        raise SlamError(
            f"{path}:{line}: {name} is {word[:30]!a}: expected a whole number of 0 to "
            f"{LARGEST_NUMBER}"
        )
    return value


def demand_axes(path: str | os.PathLike[str], line: int, comment: str, axes: Axes) -> None:
    """Refuse a file whose comment says that it is in other axes than those requested."""
    if comment.startswith(AXES_COMMENT + " "):
        said = (comment[len(AXES_COMMENT) :].split() or [""])[0]
        if said != axes:
            raise SlamError(
                f"{path}:{line}: the file's axes are {said[:20]!a}: expected {axes}, or --axes to "
                "name them"
            )
