"""Rows of landmarks straight from arrays: the bytes that their records give, sooner."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from detect.row_text_kernels import LONGEST, write_rows

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
    room = len(numbers) * (len(head) + LONGEST * numbers.shape[1] + len(_TAIL))
    text = np.empty(room, np.uint8)
    length = write_rows(head, numbers, _TAIL, text)
    return None if length < 0 else text[:length].tobytes()
