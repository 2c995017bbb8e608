"""Rows of landmarks straight from arrays: the bytes that their records give, sooner."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from detect.runs.row_text_kernels import LONGEST, write_circle_rows, write_rows

_TAIL = np.frombuffer(b" -1\n", np.uint8)
_HEADS = {
    keyword: np.frombuffer(keyword.encode(), np.uint8) for keyword in ("LANDMARK_C", "LANDMARK_L")
}


def unknown_rows(
    keyword: Literal["LANDMARK_C", "LANDMARK_L"], numbers: NDArray[np.float64]
) -> bytes | None:
    """Rows of landmarks with the identifier -1, as `landmarks.format_record` lays them out.

    Parameters
    ----------
    keyword : str
        What the rows begin with.
    numbers : (N, K) float64
        What follows.

    Returns
    -------
    bytes or None
        None where a number is not finite or one cannot be rounded with certainty: in some one of a
        million rows. Records will tell.
    """
    head = _HEADS[keyword]
    numbers = np.ascontiguousarray(numbers)  # for other layouts the kernel would be compiled again
    text = _room(len(numbers), len(head), numbers.shape[1])
    length = write_rows(head, numbers, _TAIL, text)
    return None if length < 0 else text[:length].tobytes()


def unknown_circles(
    floor_xy: NDArray[np.float64], quality: NDArray[np.float64], covariance: NDArray[np.float64]
) -> bytes | None:
    """Rows of discs with the identifier -1.

    Parameters
    ----------
    floor_xy, quality, covariance : (N, 2), (N,), (N, 2, 2) float64
        See `detect.circles.CircleDetections`.

    Returns
    -------
    bytes or None
        As of `unknown_rows`.
    """
    head = _HEADS["LANDMARK_C"]
    text = _room(len(quality), len(head), 6)
    length = write_circle_rows(
        head,
        np.ascontiguousarray(floor_xy),
        np.ascontiguousarray(quality),
        np.ascontiguousarray(covariance),
        _TAIL,
        text,
    )
    return None if length < 0 else text[:length].tobytes()


def _room(rows: int, head: int, numbers: int) -> NDArray[np.uint8]:
    """Where so many rows have room, whatever the numbers are."""
    return np.empty(rows * (head + LONGEST * numbers + len(_TAIL)), np.uint8)
