"""Options and result of a comparison of the lines of two runs."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite

from detect.comparison.result import CompareError, NormalisedError


@dataclass(frozen=True, slots=True)
class LineCompareOptions:
    """What counts as the same line, and which rows count.

    Attributes
    ----------
    tolerance_deg : float
        Bearings of the same line may always differ by this much (degrees).
    sigmas : float
        They may also differ by as many of the detected row's standard deviations, and all reference
        rows that near a matched row are found with it.
    only_identified : bool
        Count only reference rows that have an ID. Detected rows that fit a reference row without
        one are then neither right nor wrong: they are set aside.
    all_frames : bool
        Count frames that only one file has, too: all their rows are missed, or extra.
    """

    tolerance_deg: float = 0.5
    sigmas: float = 2.0
    only_identified: bool = False
    all_frames: bool = False

    def __post_init__(self) -> None:
        if not (isfinite(self.tolerance_deg) and self.tolerance_deg > 0):
            raise CompareError(f"tolerance_deg is {self.tolerance_deg}: expected a positive number")
        if not (isfinite(self.sigmas) and self.sigmas >= 0):
            raise CompareError(f"sigmas is {self.sigmas}: expected a number of at least 0")


@dataclass(frozen=True, slots=True)
class LineFrameScore:
    """Result for one frame's rows; `joined` ones were found with another row's match."""

    name: str
    matched: int
    joined: int
    missed: int
    extra: int
    largest_error_deg: float | None


@dataclass(frozen=True, slots=True)
class LineComparison:
    """How a run's detected lines compare with reference rows.

    Figures are None where there are no rows to compute them from.

    Attributes
    ----------
    reference_name, detected_name : str
        The files.
    options : LineCompareOptions
        What counted as the same line.
    reference, detected : int
        Rows that count.
    matched : int
        Pairs of a reference and a detected row; no row is in two of them.
    joined : int
        Further reference rows within the deviation of a matched detected row, which represents
        several lines.
    set_aside : int
        Detected rows on reference rows that do not count.
    recall, precision : float or None
        Shares of the reference rows that were found, and of the detected rows that were matched.
    bearing_median_deg, bearing_95_deg : float or None
        Median and 95 % quantile of the differences in alpha of the pairs, without sign (degrees).
    normalised_error : NormalisedError
        Of these differences in units of the detected rows' sigmas.
    ends_median : float or None
        Median distance between the pairs' ends, top and bottom alike (normalised image
        coordinates).
    beta_median_deg : float or None
        Median difference in beta of the pairs, without sign (degrees).
    frames : tuple of LineFrameScore
        Each frame that was compared.
    frames_only_in_reference, frames_only_in_detected : tuple of str
        Images that only one file has.
    """

    reference_name: str
    detected_name: str
    options: LineCompareOptions
    reference: int
    detected: int
    matched: int
    joined: int
    set_aside: int
    recall: float | None
    precision: float | None
    bearing_median_deg: float | None
    bearing_95_deg: float | None
    normalised_error: NormalisedError
    ends_median: float | None
    beta_median_deg: float | None
    frames: tuple[LineFrameScore, ...] = field(repr=False)
    frames_only_in_reference: tuple[str, ...] = field(repr=False)
    frames_only_in_detected: tuple[str, ...] = field(repr=False)

    @property
    def found(self) -> int:
        """Reference rows that a detected row represents, alone or with others."""
        return self.matched + self.joined

    @property
    def missed(self) -> int:
        """Reference rows that no detected row represents."""
        return self.reference - self.found

    @property
    def extra(self) -> int:
        """Detected rows that fit no reference row."""
        return self.detected - self.matched

    def worst_frames(self, count: int) -> tuple[LineFrameScore, ...]:
        """The frames with most missed and extra rows; of equals, with the largest error first."""
        ranked = sorted(
            self.frames,
            key=lambda f: (-(f.missed + f.extra), -(f.largest_error_deg or 0.0), f.name),
        )
        return tuple(ranked[:count])
