"""Settings of the detector of verticals."""

from __future__ import annotations

import math
from collections import namedtuple
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from tyro.conf import arg

from detect.errors import DetectError
from redetect.bounds import (
    NOT_NEGATIVE,
    Bounds,
    LimitOr0,
    MaybeFloat,
    NotNegative,
    Positive,
    Share,
    ShareAbove0,
    demand_fields,
    from_to,
    whole,
)

BearingConvention = Literal["level", "published"]
Joining = Literal["evidence", "equal"]

#: Widths of filters: wider ones see no line, and take memory without bound.
WIDEST_FILTER_PX = 100.0
FilterWidth = Annotated[float, Bounds("above 0, at most 100", lambda x: 0.0 < x <= 100.0)]
_WIDTH = Bounds("a number above 1, at most 10", lambda x: 1.0 < x <= 10.0)


@dataclass(frozen=True)
class LineSettings:
    """Parameters of the detector of verticals.

    Lengths along a line are in pixel widths, so that they apply to full frames and to single
    fields, whose rows are twice as high; parameters of the filter are in rows. Parameters named
    `largest_...` may be infinite: no limit.
    """

    sigma_across_px: FilterWidth = 0.8  #: Gaussian window of the filter across the line.
    sigma_along_rows: FilterWidth = 2.0  #: Gaussian window of the filter along the line.
    #: Added to the variance in the window, grey values squared: suppresses steps much smaller than
    #: its square root.
    regulariser: Positive = 40.0
    #: Least response of a point, 0 to 1; an ideal step has 2/pi.
    threshold: Annotated[ShareAbove0, arg(name="response-threshold")] = 0.12
    #: Number of rows to ignore at the upper and lower border.
    border_rows: Annotated[int, whole(0)] = 2
    #: Tracks start on the horizon and on rows up to this far from it.
    start_band_rows: Annotated[int, whole(0)] = 20
    start_spacing_rows: Annotated[int, whole(1)] = 4  #: Only every n-th of these rows is used.
    gap_rows: Annotated[int, whole(0)] = 6  #: Largest gap that a track bridges, rows.
    #: Whether tracks predict straight lines; else they follow any curve.
    guided: bool = True
    guided_reach_px: Positive = 0.6  #: Largest offset of a point from the prediction.
    #: Steps in which lines are refined on the grey values: width of the Gaussian and largest
    #: displacement of a line by the step; none for the eigen-decomposition of the tracked points
    #: alone. Small widths exclude neighbouring edges but suffer from aliasing: if a final wide step
    #: agrees with them, the edge is isolated and the wide one is more accurate.
    refine_steps_px: tuple[tuple[float, float], ...] = (
        (1.2, math.inf),
        (0.8, 1.5),
        (0.8, 1.5),
        (1.8, 0.1),
    )
    fine_scale_px: FilterWidth = 0.8  #: Fine width at which an edge's contrast is measured.
    #: Coarse width; the ratio of the contrasts at both is the edge's sharpness.
    coarse_scale_px: FilterWidth = 1.6
    least_rows: Annotated[int, whole(5)] = 14  #: Least number of points of a line.
    least_length_px: NotNegative = 24.0  #: The same as a length.
    #: Least evidence: responses summed over the length in pixel widths, times squared sharpness.
    least_evidence: NotNegative = 7.0
    #: Least sharpness of edges fainter than the image's median, relative to the lower quartile of
    #: the sharpness: fainter and softer edges are shadows and glare.
    least_sharpness: NotNegative = 0.87
    #: Largest distance of a line's end from the horizon (or from the anchor that replaces it if the
    #: horizon is not visible: `lut.verticals`).
    largest_horizon_gap_px: LimitOr0 = 11.0
    #: Largest root-mean-square distance of the points from the line.
    largest_scatter_px: LimitOr0 = 1.0
    largest_shift_px: LimitOr0 = 1.0  #: Largest displacement of a line by the refinement.
    #: Largest standard deviation of a line's position at the horizon due to noise.
    largest_noise_px: LimitOr0 = 0.3
    #: Standard deviation of a line's lean over its length due to causes other than noise.
    bend_px: NotNegative = 0.06
    #: Variance of a line's lean due to noise, relative to that of noise which is independent from
    #: row to row: the surroundings of an edge and its blur are correlated over many rows.
    lean_noise: NotNegative = 3.0
    #: Largest lean of a line from the vertical; the next one is added in quadrature.
    largest_lean_deg: LimitOr0 = 0.7
    largest_lean_px: LimitOr0 = 1.5  #: The same in pixels over the line's length.
    largest_tilt_deg: Positive = 8.0  #: Largest absolute pitch and roll.
    #: Prior standard deviation of the tilt; decides only between tilts with equal support.
    tilt_prior_deg: Positive = 2.0
    building_deg: Positive = 0.025  #: Standard deviation of real verticals about the vertical.
    #: Candidates for the tilt are computed from pairs of this number of lines, the strongest.
    proposers: Annotated[int, whole(2, 1000)] = 24
    least_lines: Annotated[int, whole(2)] = 3  #: Least number of lines that agree on a tilt.
    #: Share of lines that are not vertical: the tilt's covariance is then the mean square error of
    #: `detect.verticals.tilt`; 0 for that of least squares.
    stray_share: Annotated[float, from_to(0.0, 0.5)] = 0.15
    #: Of two lines of equal polarity closer than this at the horizon, only the stronger is kept.
    same_edge_px: NotNegative = 2.0
    join_px: NotNegative = 2.7  #: Lines closer than this at the horizon are joined to one row.
    #: Lines whose bearings are closer than this (radians) are joined; overrides `--join-px`.
    join_rad: Annotated[MaybeFloat, NOT_NEGATIVE, arg(name="join-threshold")] = None
    #: Lines with less than this share of the other's evidence are dropped instead.
    join_share: NotNegative = 0.5
    #: Joined lines are weighted by their evidence, and the row has the ends of the strongest; or
    #: all have equal weight, and ends and inclination are means, too, as in the data set's own
    #: rows.
    joined: Joining = "evidence"
    #: Fainter lines closer than this to another one are lighting effects of its edge: dropped.
    shoulder_px: NotNegative = 5.0
    #: Standard deviation of an edge about the building's line that causes it.
    sigma_px: Positive = 0.9
    #: Images with a median sharpness of edges below this are processed again with a wider filter.
    blurred_sharpness: Share = 0.62
    #: Factors on the filter's widths, of which one is chosen by the blur (see
    #: `detect.lines`); none: never.
    blurred_widths: Annotated[tuple[float, ...], _WIDTH] = (1.5, 2.0, 3.0, 4.0, 6.0)
    #: Bearings compensated for the tilt, or with the sign of the data set's own rows.
    alpha: BearingConvention = "level"

    def __post_init__(self) -> None:
        demand_fields(self, DetectError)
        for scale, most in self.refine_steps_px:
            if not 0.3 <= scale < 20.0:
                raise DetectError(f"refine_steps_px is {scale:g}: expected a width of 0.3 to 20")
            if not most >= 0.0:
                raise DetectError(f"refine_steps_px is {most:g}: expected a distance, 0 or more")

    def least_points(self, row_aspect: float) -> int:
        """Least number of points of a line, given the height of a row in pixel widths."""
        return max(self.least_rows, math.ceil(self.least_length_px / row_aspect))


DEFAULT = LineSettings()
#: Lower bound of the gain by which a point's offset corrects the prediction of a straight line.
_PULL = 0.07

# Numbers of `LineSettings` for kernels, and some that follow from them.
LineNumbers = namedtuple(
    "LineNumbers",
    # Tracking.
    "threshold border_rows gap_rows guided_pull guided_reach_px "
    # Judgement of tracks, and the tilt.
    "least_points least_evidence least_sharpness largest_horizon_gap_px "
    "largest_scatter_px largest_shift_px largest_noise_px bend_px lean_noise building_deg "
    "largest_lean_deg largest_lean_px same_edge_px "
    "largest_tilt_deg tilt_prior_deg proposers least_lines stray_share "
    # Joining, and the bearings.
    "join_px join_rad join_share joined_equally shoulder_px sigma_px level",
)


def numbers_of(settings: LineSettings, row_aspect: float = 1.0) -> LineNumbers:
    """The numbers of some settings, for rows of some height in pixel widths."""
    # Kernels are compiled for 1 and 1.0 separately: each number gets its default's type.
    given = {
        name: type(usual)(getattr(settings, name))
        for name, usual in vars(DEFAULT).items()
        if usual is not None
    }
    given |= {
        "join_rad": math.nan if settings.join_rad is None else settings.join_rad,
        "least_points": settings.least_points(row_aspect),
        "joined_equally": settings.joined == "equal",
        "level": settings.alpha == "level",
        "guided_pull": _PULL,
    }
    if not settings.guided:
        # Any curve, and not only lines.
        given |= {"guided_pull": 1.0, "guided_reach_px": 1.0}
    return LineNumbers(**{name: given[name] for name in LineNumbers._fields})


#: Reproduces the data set's own rows as far as these are known (docs/verticals.md).
PUBLISHED = LineSettings(
    sigma_across_px=2.015,
    sigma_along_rows=7.25,
    regulariser=116.0,
    threshold=0.0445,
    border_rows=23,
    start_band_rows=0,
    start_spacing_rows=1,
    guided=False,
    refine_steps_px=(),
    least_rows=53,
    least_length_px=0.0,
    least_evidence=0.0,
    least_sharpness=0.0,
    largest_horizon_gap_px=math.inf,
    largest_scatter_px=1.5,
    largest_shift_px=math.inf,
    largest_noise_px=math.inf,
    bend_px=0.7,
    lean_noise=1.0,
    building_deg=0.036,
    stray_share=0.0,
    join_px=10.0,
    join_share=0.0,
    joined="equal",
    sigma_px=math.sqrt(2.0),
    blurred_widths=(),
    alpha="published",
)

#: The parameters that the report prints.
REPORT = replace(
    PUBLISHED,
    sigma_across_px=2.5,
    sigma_along_rows=7.0,
    regulariser=9.0,
    threshold=0.4,
    border_rows=22,
    least_rows=30,
    largest_scatter_px=1.0,
    join_px=2.7,
    joined="evidence",
    sigma_px=1.0,
)

PRESETS = {"default": DEFAULT, "published": PUBLISHED, "report": REPORT}
