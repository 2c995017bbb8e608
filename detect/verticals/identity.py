"""IDs of known lines, carried over to detected ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from landmarks import LineLandmark, wrap_angle

#: A reference line is the same as a detected one within this bearing, or two standard deviations.
_SAME_LINE_RAD = np.radians(0.5)


def carry_ids(
    rows: Sequence[LineLandmark], reference: Sequence[LineLandmark]
) -> tuple[LineLandmark, ...]:
    """Give detected lines the IDs of the reference rows that are theirs beyond doubt.

    A reference row whose bearing fits exactly one detected line (within half a degree or two
    standard deviations) gives that line its IDs; a joined line can get several.

    Parameters
    ----------
    rows : sequence of LineLandmark
        Detected lines of one frame.
    reference : sequence of LineLandmark
        The same frame's rows with IDs.

    Returns
    -------
    tuple of LineLandmark
        In the order of `rows`; without an ID (-1) where none fits.
    """
    if not rows or not reference:
        return tuple(rows)
    alpha = np.array([row.alpha for row in rows])
    reach = np.maximum(_SAME_LINE_RAD, 2.0 * np.array([row.sigma for row in rows]))
    ids: list[list[int]] = [[] for _ in rows]
    for row in reference:
        fits = np.flatnonzero(np.abs(wrap_angle(alpha - row.alpha)) <= reach)
        if len(fits) == 1:
            ids[fits[0]] += [i for i in row.ids if i >= 0]
    return tuple(
        dataclasses.replace(row, ids=tuple(dict.fromkeys(own)) if own else (-1,))
        for row, own in zip(rows, ids)
    )
