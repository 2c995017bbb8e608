"""What was found in one image: lines, their tilt, and all that they were made from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from detect.verticals.fit import FIT_NUMBERS, LineFits
from detect.verticals.judgement import FATES
from detect.verticals.tilt import TILT_NUMBERS, TiltEstimate, tilt_of_numbers
from detect.verticals.tracks import LineTracks
from landmarks import LineLandmark

FloatArray = NDArray[np.float64]

#: How many numbers of counts stand first: tracks, their points, lines, their members.
COUNTS = 4

_LINE_NUMBERS = 8


@dataclass(frozen=True, eq=False)
class LineDetections:
    """What was found in one image.

    Parameters
    ----------
    numbers : (K,) float64
        Counts of tracks, points, lines and members; the tilt's numbers; then, as far as they are
        told below, lines, members and where those of each line begin, evidence, fates, fits,
        polarities and bounds of tracks, rows, columns and scores of their points; last the
        sharpness. Compiled code returns one array in the time that it takes to return any.
    """

    numbers: FloatArray

    def __len__(self) -> int:
        return int(self.numbers[2])

    @cached_property
    def _counts(self) -> tuple[int, int, int, int]:
        tracks, points, lines, members = self.numbers[:COUNTS].tolist()
        return int(tracks), int(points), int(lines), int(members)

    @cached_property
    def _parts(self) -> list[FloatArray]:
        """Behind the counts: what `numbers` holds, one after the other."""
        tracks, points, lines, members = self._counts
        sizes = (
            TILT_NUMBERS, _LINE_NUMBERS * lines, members, lines + 1, tracks, tracks,
            FIT_NUMBERS * tracks, tracks, tracks + 1, points, points, points,
        )  # fmt: skip
        parts, at = [], COUNTS
        for size in sizes:
            parts.append(self.numbers[at : at + size])
            at += size
        return parts

    @property
    def line_numbers(self) -> FloatArray:
        """(8, N) ends, bearings, inclinations and deviations, as told below, one after the other.

        The leftmost line is the first, here and elsewhere.
        """
        count = len(self)
        at = COUNTS + TILT_NUMBERS
        return self.numbers[at : at + _LINE_NUMBERS * count].reshape(_LINE_NUMBERS, count)

    @property
    def ends(self) -> FloatArray:
        """(N, 4) xtop, ytop, xbottom, ybottom: undistorted normalised coordinates."""
        return self.line_numbers[:4].T

    @property
    def alpha_rad(self) -> FloatArray:
        """(N,) bearings."""
        return self._of_lines(4)

    @property
    def beta_rad(self) -> FloatArray:
        """(N,) inclinations."""
        return self._of_lines(5)

    @property
    def sigma_rad(self) -> FloatArray:
        """(N,) standard deviations of the bearings."""
        return self._of_lines(6)

    @property
    def noise_rad(self) -> FloatArray:
        """(N,) the part of them that is due to noise in the grey values."""
        return self._of_lines(7)

    def _of_lines(self, which: int) -> FloatArray:
        numbers: FloatArray = self.line_numbers[which]
        return numbers

    @cached_property
    def members(self) -> tuple[tuple[int, ...], ...]:
        """The tracks that each line was made of, the strongest first; its ends are that one's."""
        own = self._parts[2].astype(np.int64).tolist()
        at = self._parts[3].astype(np.int64).tolist()
        return tuple(tuple(own[a:b]) for a, b in pairwise(at))

    @property
    def sharpness(self) -> float:
        """Median sharpness of the edges (`detect.verticals.blur.median_sharpness`)."""
        return float(self.numbers[-1])

    @cached_property
    def tilt(self) -> TiltEstimate | None:
        """None where too few lines agree."""
        return tilt_of_numbers(self.numbers[COUNTS : COUNTS + TILT_NUMBERS])

    @property
    def evidence(self) -> FloatArray:
        """(T,) evidence for each track."""
        return self._parts[4]

    @cached_property
    def fate(self) -> tuple[str, ...]:
        """(T,) "accepted", "joined" (to a stronger one), or why the track is no line."""
        return tuple(FATES[int(number)] for number in self._parts[5].tolist())

    @cached_property
    def fits(self) -> LineFits:
        """The lines of all tracks."""
        return LineFits(self._parts[6])

    @cached_property
    def tracks(self) -> LineTracks:
        """All tracks."""
        polarity, bounds, row, column, score = self._parts[7:]
        return LineTracks(
            polarity,
            bounds.astype(np.int64),
            row.astype(np.int32),
            column,
            score.astype(np.float32),
            complete=True,
        )

    def landmarks(self) -> tuple[LineLandmark, ...]:
        """Rows for a landmark file, without identifiers; quality is 0 as in the data set's own."""
        return tuple(
            LineLandmark(
                xtop, ytop, xbottom, ybottom, alpha, beta, quality=0.0, sigma=sigma, ids=(-1,)
            )
            for (xtop, ytop, xbottom, ybottom), alpha, beta, sigma in zip(
                self.ends.tolist(),
                self.alpha_rad.tolist(),
                self.beta_rad.tolist(),
                self.sigma_rad.tolist(),
            )
        )
