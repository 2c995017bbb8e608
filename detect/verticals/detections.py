"""Detections in one image: lines, their tilt, the tracks behind them, and IDs of known lines."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np

from detect.verticals.joining import Lines
from detect.verticals.judgement import FATES, Judgement
from detect.verticals.tilt import TiltEstimate
from detect.verticals.tracking import LineTracks
from redetect.landmarks import LineLandmark, wrap_angle

#: A reference line is the same as a detected one within this bearing, or two standard deviations.
_SAME_LINE_RAD = np.radians(0.5)


@dataclasses.dataclass(frozen=True, eq=False)
class LineDetections:
    """Detections in one image."""

    lines: Lines  # the leftmost is the first, here and elsewhere
    tracks: LineTracks
    judged: Judgement  # lines through all tracks, and their fates
    sharpness: float  # median sharpness of the edges (`detect.verticals.blur.median_sharpness`)

    def __len__(self) -> int:
        return len(self.lines.alpha_rad)

    @cached_property
    def members(self) -> tuple[tuple[int, ...], ...]:
        """The tracks that each line consists of, the strongest first; its ends are that one's."""
        own = self.lines.members.tolist()
        return tuple(tuple(own[a:b]) for a, b in pairwise(self.lines.bounds.tolist()))

    @property
    def tilt(self) -> TiltEstimate | None:
        """None where too few lines agree."""
        return self.judged.tilt

    @cached_property
    def fate(self) -> tuple[str, ...]:
        """(T,) "accepted", "joined" (to a stronger one), or why the track is no line."""
        return tuple(FATES[number] for number in self.judged.fate.tolist())

    def landmarks(self) -> tuple[LineLandmark, ...]:
        """Rows for a landmark file, without identifiers; quality is 0 as in the data set's own."""
        own = self.lines
        numbers = np.column_stack([own.ends, own.alpha_rad, own.beta_rad, own.sigma_rad])
        return tuple(
            LineLandmark(xtop, ytop, xbottom, ybottom, alpha, beta, 0.0, sigma, (-1,))
            for xtop, ytop, xbottom, ybottom, alpha, beta, sigma in numbers.tolist()
        )


def carry_ids(
    rows: Sequence[LineLandmark], reference: Sequence[LineLandmark]
) -> tuple[LineLandmark, ...]:
    """Detected lines of a frame with the IDs of the reference rows that are theirs beyond doubt.

    A reference row whose bearing fits exactly one detected line (within half a degree or two
    standard deviations) gives that line its IDs; a joined line can get several, and one that none
    fits has -1.
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
