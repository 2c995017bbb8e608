"""Rows of landmarks straight from arrays: the bytes that their records give, sooner."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detect.runs.row_text_kernels import LONGEST, write_circle_rows, write_line_rows

_CIRCLE, _LINE, _TAIL = (
    np.frombuffer(text, np.uint8) for text in (b"LANDMARK_C", b"LANDMARK_L", b" -1\n")
)


def unknown_circles(
    floor_xy: NDArray[np.float64], quality: NDArray[np.float64], covariance: NDArray[np.float64]
) -> bytes | None:
    """Rows of discs with the identifier -1, as `landmarks.format_record` lays them out.

    Parameters
    ----------
    floor_xy, quality, covariance : (N, 2), (N,), (N, 2, 2) float64
        See `detect.circles.CircleDetections`.

    Returns
    -------
    bytes or None
        None where a number is not finite or one cannot be rounded with certainty: in some one of a
        million rows. Records will tell.
    """
    text = _room(len(quality), len(_CIRCLE), 6)
    # For other layouts the kernel would be compiled again.
    length = write_circle_rows(
        _CIRCLE,
        np.ascontiguousarray(floor_xy),
        np.ascontiguousarray(quality),
        np.ascontiguousarray(covariance),
        _TAIL,
        text,
    )
    return None if length < 0 else text[:length].tobytes()


def unknown_lines(lines: NDArray[np.float64]) -> bytes | None:
    """Rows of lines with the identifier -1 and, as in the data set's own files, quality 0.

    Parameters
    ----------
    lines : (8, N) float64
        See `detect.verticals.detections.LineDetections.line_numbers`.

    Returns
    -------
    bytes or None
        As of `unknown_circles`.
    """
    text = _room(lines.shape[1], len(_LINE), 8)
    length = write_line_rows(_LINE, lines, _TAIL, text)
    return None if length < 0 else text[:length].tobytes()


def _room(rows: int, head: int, numbers: int) -> NDArray[np.uint8]:
    """Where so many rows have room, whatever the numbers are."""
    return np.empty(rows * (head + LONGEST * numbers + len(_TAIL)), np.uint8)
