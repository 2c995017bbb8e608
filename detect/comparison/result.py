"""Results of comparisons of the discs, or of the lines, of two runs, and figures of errors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from html import escape
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from scipy.special import chdtri

from detect.options import CompareOptions
from detect.projection import DiscProjection
from redetect.array_types import FloatArray
from redetect.json_text import json_text, plain
from redetect.landmarks import is_positive_definite, squared_mahalanobis
from redetect.messages import counted
from redetect.tables import Table

Kind = Literal["circles", "lines"]

WORST_FRAMES = 10  #: Number of worst frames to list.


class FrameMatch(NamedTuple):
    """Matching rows of one frame, all discs or all lines."""

    name: str  # of the image
    projection: DiscProjection | None  # into it; None: compared on the floor
    detected: Sequence[Any]  # all detected rows
    matched_reference: list[Any]  # reference rows
    matched: list[Any]  # the detected row of each; no row is in two pairs
    joined: list[Any]  # further reference rows that a matched line represents
    missed: list[Any]
    extra: list[Any]
    set_aside: list[Any]  # detected rows that match something that does not count
    #: Over all pairs: distance on the floor, both rows levelled alike (m), or of bearings (deg).
    largest_error: float | None


@dataclass(frozen=True)
class NormalisedError:
    """Squared errors in units of their covariance.

    `per_dof` is their mean per degree of freedom (two for each disc, one for each line): 1 if the
    covariance is right, more if it is too small; within `band` with 95 % probability if errors are
    normal, independent and have that covariance. `left_out` rows have no usable covariance.
    """

    per_dof: float | None
    dof: int
    band: tuple[float, float] | None
    left_out: int


@dataclass(frozen=True)
class FloorDifference:
    """Detected minus reference positions: distance (median, 95 %), and medians of directions."""

    pairs: int
    median_m: float | None
    most_m: float | None
    along_m: float | None  # the viewing direction, positive farther away
    across_m: float | None  # positive to the left


@dataclass(frozen=True)
class DistanceBin:
    """Discs at a range of forward distances (m), open at an end that is None.

    Differences are those of matched discs on the floor, as the rows are and levelled alike; the
    latter are None if all rows are levelled alike already.
    """

    from_m: float | None
    to_m: float | None
    reference: int
    missed: int
    detected: int
    extra: int
    recall: float | None
    precision: float | None
    error_median_m: float | None
    as_written: FloorDifference
    alike: FloorDifference | None

    def __str__(self) -> str:
        if self.from_m is None:
            return f"< {self.to_m:g}"
        return f">= {self.from_m:g}" if self.to_m is None else f"{self.from_m:g}-{self.to_m:g}"


@dataclass(frozen=True, eq=False)
class DiscPairs:
    """N matched discs on the floor (m)."""

    reference_xy: FloatArray  # (N, 2)
    as_written: FloatArray  # (N, 2) detected minus reference positions
    offset: FloatArray  # (N, 2) the same, both levelled alike: the errors
    covariance: FloatArray  # (N, 2, 2) for normalised errors
    away: FloatArray  # (N, 2) unit vectors of the viewing directions

    @property
    def levelled_apart(self) -> bool:
        """Whether some rows are not levelled alike in the files."""
        return not np.array_equal(self.as_written, self.offset)


@dataclass(frozen=True, eq=False)
class LinePairs:
    """N matched lines: bearings of reference rows, errors and sigmas of detected ones (rad)."""

    bearing_rad: FloatArray
    error_rad: FloatArray
    sigma_rad: FloatArray


@dataclass(frozen=True, eq=False)
class Comparison(Table, ABC):
    """How a run's detected rows compare with reference rows; figures are None without rows.

    Rows are counted as in `FrameMatch`; `found` rows were matched or joined. Recall is the share of
    reference rows that were found, precision the share of detected rows that were matched.
    """

    what: ClassVar[str]  # the landmarks that are compared
    unit: ClassVar[str]  # of `FrameMatch.largest_error`
    counts: ClassVar[tuple[str, ...]] = ("matched", "missed", "extra")  # of `FrameMatch`, shown

    reference_name: str
    detected_name: str
    options: CompareOptions
    reference: int
    detected: int
    matched: int
    joined: int
    found: int
    missed: int
    extra: int
    set_aside: int
    on_lookalikes: int | None  # extra rows on known look-alikes; None if unknown
    recall: float | None
    precision: float | None
    normalised_error: NormalisedError
    frames: tuple[FrameMatch, ...] = field(repr=False)
    frames_only_in_reference: tuple[str, ...] = field(repr=False)
    frames_only_in_detected: tuple[str, ...] = field(repr=False)

    def columns(self) -> dict[str, Any]:
        """One row per frame that is in both files."""
        rows = [self._row(match) for match in self.frames]
        return {name: [row[name] for row in rows] for name in (rows[0] if rows else ())}

    def _row(self, match: FrameMatch) -> dict[str, Any]:
        counts = {count: len(getattr(match, count)) for count in self.counts}
        return {"name": match.name, **counts, f"largest_error_{self.unit}": match.largest_error}

    def __str__(self) -> str:
        return "\n".join(self.sentences())

    def sentences(self) -> tuple[str, ...]:
        """Sentences on found, missed and extra rows, rows set aside, errors and covariances."""
        found = (
            f"{self.found} of {self.reference} {self.what} of the reference are found, "
            f"{self.missed} missed, in {counted(len(self.frames), 'frame')}."
        )
        if not self.reference:
            found = f"The reference has no {self.what} to find."
        extra = f"{self.matched} of {self.detected} detected rows are {self.what} of the reference;"
        alike = self.on_lookalikes
        if alike is None:
            extra += f" {self.extra} are on nothing that it has{self._beyond()}."
        else:
            extra += (
                f" {alike} are on things known to look like a disc, and "
                f"{self.extra - alike or 'none'} on nothing known."
            )
        if not self.detected:
            extra = f"No {self.what}{' that count' * bool(self.set_aside)} are detected."
        if self.set_aside:
            with_ids = " with an ID" if self.options.only_identified else ""
            aside = f"{self.set_aside} more {'is' if self.set_aside == 1 else 'are'}"
            extra += f" {aside} on {self.what} that the reference does not list{with_ids}."
        if not self.matched:
            return found, extra, "There are no errors: no rows match."
        return found, extra, self._errors(), self._agreement()

    def _beyond(self) -> str:
        """More on extra rows if look-alikes are not known."""
        return " (look-alikes are not known)"

    @abstractmethod
    def _errors(self) -> str:
        """A sentence on the errors."""

    def _agreement(self) -> str:
        """A sentence on whether errors agree with the covariances."""
        error = self.normalised_error.per_dof
        if error is None:
            return "There are no errors to compare with the stated covariances."
        figure = f"the mean squared normalised error is {error:.2f}"
        if 0.67 <= error <= 1.5:
            return f"The errors agree with the stated covariances: {figure}."
        size = "small" if error > 1.5 else "large"
        exact = " if the reference has no errors of its own" if error > 1.5 else ""
        return f"The stated covariances are too {size}{exact}: {figure}."

    def figures(self) -> dict[str, Any]:
        """All figures by name, for JSON: always the same names in the same order.

        In metres and degrees. The worst frames are listed, and frames that are in only one file.
        """
        figures = {each.name: getattr(self, each.name) for each in fields(self)} | {
            "frames": len(self.frames),
            "pairs": self.matched,
            "worst_frames": [self._row(match) for match in self.worst_frames(WORST_FRAMES)],
        }
        converted: dict[str, Any] = plain(figures)
        return converted

    def to_json(self) -> str:
        """`figures` as JSON; numbers are finite or null."""
        return f"{json_text(self.figures(), indent=2)}\n"

    def _repr_html_(self) -> str:
        words = "".join(f"<p>{escape(sentence)}</p>" for sentence in self.sentences())
        return words + super()._repr_html_()

    def worst_frames(self, count: int) -> list[FrameMatch]:
        """The frames with most missed and extra rows; ties are broken by the largest error."""

        def order(match: FrameMatch) -> tuple[float, float, str]:
            wrong = len(match.missed) + len(match.extra)
            return -wrong, -(match.largest_error or 0.0), match.name

        return sorted(self.frames, key=order)[:count]


@dataclass(frozen=True, eq=False)
class DiscComparison(Comparison):
    """How a run's detected discs compare with reference rows."""

    what, unit = "discs", "m"

    error_median_m: float | None
    error_95_m: float | None
    bins: tuple[DistanceBin, ...]
    extra_beyond: int  # extra rows farther away than all matched ones
    in_image: bool
    image_median_px: float | None
    image_95_px: float | None
    reference_levelled: int  # number of reference frames with rows levelled by a tilt
    detected_levelled: int
    reference_level: bool  # whether its other rows are level, too, as stated or by the images
    reference_whole_pixels: bool  # whether its rows are at whole pixels, as published ones are
    pairs: DiscPairs = field(repr=False)

    def _beyond(self) -> str:
        return f", {self.extra_beyond} of them farther away than any that is on one"

    def _errors(self) -> str:
        errors = (
            f"Positions on the floor err by {in_mm(self.error_median_m)} mm (median), "
            f"95 % of them by less than {in_mm(self.error_95_m)} mm."
        )
        if self.reference_level and not self.detected_levelled:
            errors += " They are not corrected for the robot's tilt, which `detect all` does."
        return errors

    def _agreement(self) -> str:
        error = self.normalised_error.per_dof
        if not self.reference_whole_pixels or error is None or error <= 1.5:
            return super()._agreement()
        return (
            "The reference's rows are at whole pixels: errors of about a pixel are its own, so the "
            f"mean squared normalised error, {error:.2f}, is not that of the stated covariances."
        )


@dataclass(frozen=True, eq=False)
class LineComparison(Comparison):
    """How a run's detected lines compare with reference rows: absolute differences."""

    what, unit = "verticals", "deg"
    counts = ("matched", "joined", "missed", "extra")

    bearing_median_deg: float | None
    bearing_95_deg: float | None
    ends_median: float | None  # normalised image coordinates, top and bottom alike
    beta_median_deg: float | None
    pairs: LinePairs = field(repr=False)

    def _errors(self) -> str:
        return (
            f"Bearings err by {number(self.bearing_median_deg, 3)} degrees (median), 95 % of them "
            f"by less than {number(self.bearing_95_deg, 3)}."
        )


def number(value: float | None, decimals: int) -> str:
    """A figure, or a dash where there is none."""
    if value is None:
        return "-"
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # adding 0 makes -0 a 0


def in_mm(value_m: float | None) -> str:
    """A length as a figure in millimetres, with one decimal."""
    return number(None if value_m is None else 1e3 * value_m, 1)


def quantile(values: FloatArray, q: float = 0.5) -> float | None:
    """Quantile of `values`, interpolated linearly; by default the median."""
    return float(np.quantile(values, q)) if len(values) else None


def normalised_error(offset: FloatArray, covariance: FloatArray) -> NormalisedError:
    """Mean of squared normalised errors (N, n), with the central 95 % of chi-square.

    Errors whose covariance (N, n, n) is not positive definite are left out.
    """
    usable = is_positive_definite(covariance)
    left_out = int((~usable).sum())
    dof = offset[usable].size
    if dof == 0:
        return NormalisedError(per_dof=None, dof=0, band=None, left_out=left_out)
    squared = squared_mahalanobis(offset[usable], covariance[usable])
    low, high = (float(chdtri(dof, 1.0 - p)) / dof for p in (0.025, 0.975))
    return NormalisedError(float(squared.sum()) / dof, dof, (low, high), left_out)


def floor_difference(offset: FloatArray, away: FloatArray) -> FloorDifference:
    """Figures of differences (N, 2) on the floor (m), with unit viewing vectors `away` (N, 2)."""
    size = np.asarray(np.linalg.norm(offset, axis=1))
    return FloorDifference(
        pairs=len(offset),
        median_m=quantile(size),
        most_m=quantile(size, 0.95),
        along_m=quantile((offset * away).sum(axis=1)),
        # Forward is -Y and left is X: left of a direction is it turned from -Y to X.
        across_m=quantile(away[:, 0] * offset[:, 1] - away[:, 1] * offset[:, 0]),
    )
