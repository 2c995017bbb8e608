"""Options and results of comparisons of the discs, or of the lines, of two runs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import isfinite
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

ErrorCovariance = Literal["detected", "reference", "sum"]


class CompareError(ValueError):
    """Two runs that cannot be compared; the message says which file or frame and why."""


@dataclass(frozen=True, slots=True)
class CompareOptions:
    """What counts as the same disc, and which rows count.

    Attributes
    ----------
    gate_m : float or None
        Compare positions on the floor: the largest distance between a detected and a reference row
        of the same disc (m). By default the image is compared where there is a calibration: each
        row where it was seen; without one, 0.1 m.
    sigma : float or None
        Compare on the floor, too: the largest Mahalanobis distance under the reference row's
        covariance (standard deviations).
    least_px : float
        In the image, rows are the same if they differ by at most half the width and height of the
        disc's own image, or by this (px), whichever is more.
    only_identified : bool
        Count only reference rows that have an ID. Detected rows that fit a reference row without
        one are then neither right nor wrong: they are set aside.
    all_frames : bool
        Count frames that only one file has, too: all their rows are missed, or extra.
    error_covariance : {"detected", "reference", "sum"}
        Which covariance position errors are measured in: the detected row's, the reference row's,
        or, where both err independently, their sum.
    """

    gate_m: float | None = None
    sigma: float | None = None
    least_px: float = 3.0
    only_identified: bool = False
    all_frames: bool = False
    error_covariance: ErrorCovariance = "detected"

    def __post_init__(self) -> None:
        gates = {"gate_m": self.gate_m, "sigma": self.sigma, "least_px": self.least_px}
        for name, gate in gates.items():
            if gate is not None and not (isfinite(gate) and gate > 0):
                raise CompareError(f"{name} is {gate}: expected a positive number")

    @property
    def on_floor(self) -> bool:
        """Whether rows are to be compared on the floor even where there is a calibration."""
        return self.gate_m is not None or self.sigma is not None


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
class FrameScore:
    """Result for one frame's discs."""

    name: str
    matched: int
    missed: int
    extra: int
    largest_error_m: float | None

    @property
    def largest_error(self) -> float | None:
        """That of any pair."""
        return self.largest_error_m


@dataclass(frozen=True, slots=True)
class LineFrameScore:
    """Result for one frame's lines; `joined` ones were found with another row's match."""

    name: str
    matched: int
    joined: int
    missed: int
    extra: int
    largest_error_deg: float | None

    @property
    def largest_error(self) -> float | None:
        """That of any pair."""
        return self.largest_error_deg


Score = TypeVar("Score", FrameScore, LineFrameScore)


def _worst(frames: Iterable[Score], count: int) -> tuple[Score, ...]:
    """The frames with most missed and extra rows; of equals, with the largest error first."""
    ranked = sorted(
        frames, key=lambda f: (-(f.missed + f.extra), -(f.largest_error or 0.0), f.name)
    )
    return tuple(ranked[:count])


@dataclass(frozen=True, slots=True)
class DistanceBin:
    """Rows at a range of forward distances; reference and detected rows each by their own.

    Figures are None where there are no rows to compute them from.
    """

    from_m: float | None
    to_m: float | None
    reference: int
    missed: int
    detected: int
    extra: int
    recall: float | None
    precision: float | None
    reference_quality_median: float | None
    detected_quality_median: float | None
    error_median_m: float | None

    @property
    def quality_difference(self) -> float | None:
        """Detected minus reference quality (of the medians)."""
        if self.reference_quality_median is None or self.detected_quality_median is None:
            return None
        return self.detected_quality_median - self.reference_quality_median


@dataclass(frozen=True, slots=True)
class NormalisedError:
    """Squared errors in units of their covariance.

    Attributes
    ----------
    per_dof : float or None
        Mean per degree of freedom: 1 if the covariance is right, more if it is too small.
    dof : int
        Degrees of freedom: two for each matched disc, one for each matched line.
    band : (float, float) or None
        Interval of `per_dof` with 95 % probability if errors are normal, independent and have that
        covariance.
    left_out : int
        Matched rows whose covariance is not positive definite, or whose sigma is not positive.
    """

    per_dof: float | None
    dof: int
    band: tuple[float, float] | None
    left_out: int


@dataclass(frozen=True, slots=True)
class Levelling:
    """How many frames' rows are levelled, and by what (medians, degrees; None where none are).

    `true` says that rows are level positions that no tilt was applied to.
    """

    frames: int
    levelled: int
    true: bool
    pitch_deg: float | None = None
    roll_deg: float | None = None


@dataclass(frozen=True, slots=True)
class FloorDifference:
    """Detected minus reference positions on the floor of matched rows.

    Attributes
    ----------
    pairs : int
    median_m, most_m : float or None
        Median and 95 % quantile of the distance.
    along_m, across_m : float or None
        Medians along the viewing direction (positive: farther away) and across (to the left).
    """

    pairs: int
    median_m: float | None
    most_m: float | None
    along_m: float | None
    across_m: float | None


@dataclass(frozen=True, slots=True)
class FloorBin:
    """Floor differences at a range of forward distances, before and after the common lean."""

    from_m: float | None
    to_m: float | None
    before: FloorDifference
    after: FloorDifference | None


@dataclass(frozen=True, slots=True)
class CommonLean:
    """Constant tilt and height of the camera that explain the differences, and the residuals.

    Each figure with its standard deviation; positive pitch and roll as in a ``.tilt`` file.
    """

    pitch_deg: float
    pitch_sigma_deg: float
    roll_deg: float
    roll_sigma_deg: float
    raised_m: float
    raised_sigma_m: float
    left: FloorDifference
    normalised_error: NormalisedError


@dataclass(frozen=True, slots=True, eq=False)
class DiscPairs:
    """Matched rows.

    Attributes
    ----------
    reference_xy : (N, 2) float64
        Metres.
    offset, left : (N, 2) float64
        Detected minus reference positions on the floor (m), before and after the common lean.
    covariance : (N, 2, 2) float64
        That errors are measured in.
    away : (N, 2) float64
        Unit vectors on the floor along which the camera sees the discs.
    """

    reference_xy: NDArray[np.float64]
    offset: NDArray[np.float64]
    left: NDArray[np.float64]
    covariance: NDArray[np.float64]
    away: NDArray[np.float64]


NO_PAIRS = DiscPairs(*(np.zeros((0, 2)),) * 3, np.zeros((0, 2, 2)), np.zeros((0, 2)))


@dataclass(frozen=True, slots=True)
class _Counts:
    """What comparisons of discs and of lines have in common.

    Attributes
    ----------
    reference_name, detected_name : str
        The files.
    options : CompareOptions or LineCompareOptions
        What counted as the same landmark.
    reference, detected : int
        Rows that count.
    matched : int
        Pairs of a reference and a detected row; no row is in two of them.
    """

    reference_name: str
    detected_name: str
    options: CompareOptions | LineCompareOptions
    reference: int
    detected: int
    matched: int

    @property
    def found(self) -> int:
        """Reference rows that a detected row represents."""
        return self.matched

    @property
    def missed(self) -> int:
        """Reference rows that no detected row represents."""
        return self.reference - self.found

    @property
    def extra(self) -> int:
        """Detected rows that fit no reference row."""
        return self.detected - self.matched


@dataclass(frozen=True, slots=True)
class Comparison(_Counts):
    """How a run's detected discs compare with reference rows.

    Figures are None where there are no rows to compute them from. Qualities are medians. Rows set
    aside count neither as matched nor as extra; `on_lookalikes` of the extra rows are on something
    that is known to look like a disc.
    """

    options: CompareOptions
    set_aside: int
    on_lookalikes: int | None
    recall: float | None
    precision: float | None
    error_median_m: float | None
    error_95_m: float | None
    normalised_error: NormalisedError
    reference_quality_matched: float | None
    reference_quality_missed: float | None
    detected_quality_matched: float | None
    detected_quality_extra: float | None
    bins: tuple[DistanceBin, ...]
    in_image: bool
    image_median_px: float | None
    image_95_px: float | None
    reference_levelling: Levelling
    detected_levelling: Levelling
    floor: tuple[FloorBin, ...]
    lean: CommonLean | None
    pairs: DiscPairs = field(repr=False)
    frames: tuple[FrameScore, ...] = field(repr=False)
    frames_only_in_reference: tuple[str, ...] = field(repr=False)
    frames_only_in_detected: tuple[str, ...] = field(repr=False)

    def worst_frames(self, count: int) -> tuple[FrameScore, ...]:
        """The frames with most missed and extra rows; of equals, with the largest error first."""
        return _worst(self.frames, count)


@dataclass(frozen=True, slots=True)
class LineComparison(_Counts):
    """How a run's detected lines compare with reference rows.

    Figures are None where there are no rows to compute them from.

    Attributes
    ----------
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

    options: LineCompareOptions
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

    def worst_frames(self, count: int) -> tuple[LineFrameScore, ...]:
        """The frames with most missed and extra rows; of equals, with the largest error first."""
        return _worst(self.frames, count)


def unmet_demands(
    comparison: Comparison | LineComparison,
    *,
    min_recall: float | None = None,
    min_precision: float | None = None,
) -> tuple[str, ...]:
    """Say which demands a comparison fails: a command that made them exits 1 if there are any.

    Parameters
    ----------
    comparison : Comparison or LineComparison
        The figures.
    min_recall, min_precision : float, optional
        Least values. A figure that there are no rows for fails its demand.

    Returns
    -------
    tuple of str
        One sentence for each demand that fails.
    """
    demands = (
        ("recall", comparison.recall, min_recall),
        ("precision", comparison.precision, min_precision),
    )
    return tuple(
        f"{name} is {'unknown' if value is None else f'{value:.4f}'}: at least {least:g} demanded"
        for name, value, least in demands
        if least is not None and (value is None or value < least)
    )
