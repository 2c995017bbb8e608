"""The detector of verticals: from one image to lines with bearings and standard deviations.

The stages of an image, each in its own function:

    starts          maxima of the response on the horizon (or the anchor: `lut.verticals`)
    tracks          the edges through them, followed up and down
    fits            straight lines, refined on the grey values
    consensus       the tilt on which most of them agree; the others are not vertical
    again           doubtful tracks, followed along the verticals of that tilt
    lines           bearings; one line for each edge, close ones joined

If all edges are blurred, everything is repeated with filters as wide as the blur. Rotation of the
robot and soft optics blur all edges of an image alike. If the blur is wider than the filter, the
steepest point of an edge is not unique: motion blur turns a step into a ramp of constant slope, in
which tracks drift. A filter as wide as the blur finds the middle of the ramp.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from detect.errors import DetectError
from detect.grey_values import plain_image
from detect.line_settings import (
    DEFAULT,
    WIDEST_FILTER_PX,
    LineNumbers,
    LineSettings,
    numbers_of,
)
from detect.verticals.joining import Lines, lines_of_tracks
from detect.verticals.judgement import OUTCOMES, JudgedTracks, fit_and_judge
from detect.verticals.refinement import LineFits, StepFilters, step_filters
from detect.verticals.response import LineFilter, Strip, line_filter, strip_of
from detect.verticals.starts import StartBand, band_response, line_starts, start_band
from detect.verticals.tilt import TiltEstimate, with_error
from detect.verticals.tracking import NOTHING_BEFORE, Before, LineTracks, follow_edges
from lut.verticals import VerticalTable
from redetect.array_types import GreyImage
from redetect.landmarks import LineLandmark, wrap_angle
from redetect.tables import ByContent

#: Outcomes of tracks that are a line, or part of one.
ACCEPTED, JOINED = OUTCOMES[:2]
#: Largest difference of bearings of the same line, unless two standard deviations are larger.
_SAME_LINE_RAD = np.radians(0.5)
_WIDE_ENOUGH = 0.68  #: Least width of the filter, as a share of the blur's width.
_WIDEST_STEP_PX = 19.0  #: Largest filter width of a refinement step, pixels.
_LEAST_EDGES = 3  #: Least number of edges from which the blur of an image is estimated.
#: Settings that scale with the width of the filter: pixels across an edge. They include a line's
#: standard deviation, since other edges within the blur displace it in proportion.
_ACROSS = (
    "sigma_across_px", "guided_reach_px", "fine_scale_px", "coarse_scale_px",
    "largest_scatter_px", "largest_shift_px", "largest_noise_px", "bend_px", "largest_lean_px",
    "same_edge_px", "join_px", "shoulder_px", "sigma_px",
)  # fmt: skip
_FILTERS = ("sigma_across_px", "fine_scale_px", "coarse_scale_px")


@dataclass(frozen=True, eq=False)
class LineDetections(ByContent):
    """Detections in one image."""

    lines: Lines  # the leftmost is the first, here and elsewhere
    tracks: LineTracks
    judged: JudgedTracks  # lines through all tracks, and their outcomes

    def __len__(self) -> int:
        return len(self.lines.alpha_rad)

    @property
    def tilt(self) -> TiltEstimate | None:
        """The tilt estimate; None if too few lines agree."""
        return self.judged.tilt

    @cached_property
    def outcome(self) -> tuple[str, ...]:
        """(T,) "accepted", "joined" (to a stronger one), or why the track is not a line."""
        return tuple(OUTCOMES[number] for number in self.judged.outcome.tolist())

    def landmarks(self) -> tuple[LineLandmark, ...]:
        """Rows for a landmark file, without identifiers; quality is 0 as in the data set's own."""
        lines = self.lines
        numbers = np.column_stack([lines.ends, lines.alpha_rad, lines.beta_rad, lines.sigma_rad])
        return tuple(
            LineLandmark(xtop, ytop, xbottom, ybottom, alpha, beta, 0.0, sigma, (-1,))
            for xtop, ytop, xbottom, ybottom, alpha, beta, sigma in numbers.tolist()
        )


@lru_cache(maxsize=16)
def _prepared(
    table: VerticalTable, settings: LineSettings
) -> tuple[Strip, LineFilter, StartBand, StepFilters, LineNumbers]:
    """Quantities that depend on the table and the settings only."""
    band, numbers = start_band(table, settings), numbers_of(settings, table.row_aspect)
    return strip_of(table), line_filter(settings), band, step_filters(settings), numbers


def detect_lines(
    image: GreyImage, table: VerticalTable, settings: LineSettings = DEFAULT
) -> LineDetections:
    """Find the building's verticals in an image.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    table : VerticalTable
        The table of the image's camera.
    settings : LineSettings
        `detect.line_settings.REPORT` are those of the report.

    Returns
    -------
    LineDetections
        Lines, leftmost first, and their tracks and fits.

    Raises
    ------
    FrameError
        If the image is not an 8-bit grey image of the table's size.
    DetectError
        If the table is another one, such as `detect_circles` takes.
    """
    if not isinstance(table, VerticalTable):
        raise DetectError(f"the table is a {type(table).__name__}: expected a VerticalTable")
    image = plain_image(image, table.column.shape)
    strip, window, band, steps, numbers = _prepared(table, settings)
    response = band_response(image, band, settings.regulariser)
    starts = line_starts(response, band, settings.threshold)
    tracks = follow_edges(image, strip, window, starts, numbers, NOTHING_BEFORE)
    judged = fit_and_judge(image, strip, tracks, steps, numbers)
    sharpness = median_sharpness(judged.fits)
    if settings.blurred_widths and sharpness < settings.blurred_sharpness:
        return detect_lines(image, table, widened(settings, width_for(sharpness, settings)))
    if settings.guided and judged.tilt is not None and judged.doubtful.any():
        before = Before(tracks, judged.doubtful, (judged.tilt.pitch_rad, judged.tilt.roll_rad))
        tracks = follow_edges(image, strip, window, starts, numbers, before)
        judged = fit_and_judge(image, strip, tracks, steps, numbers, judged)
    if judged.tilt is not None:
        error = with_error(judged.tilt, judged.verticals, judged.edge, numbers)
        judged = judged._replace(tilt=error)
    return LineDetections(lines_of_tracks(strip, tracks, judged, numbers), tracks, judged)


def blur_of_sharpness(sharpness: float, fine_px: float, coarse_px: float) -> float:
    """Standard deviation of the Gaussian blur of a step edge with a given sharpness, pixels.

    The derivative of a Gaussian of width s measures a step blurred by b with the contrast
    s / sqrt(s^2 + b^2); sharpness is the ratio of that for two widths. Infinite if the sharpness is
    below its limit for large blur, fine_px / coarse_px.
    """
    ratio = (sharpness * coarse_px / fine_px) ** 2
    if ratio <= 1.0:
        return math.inf
    return math.sqrt(max(coarse_px**2 - ratio * fine_px**2, 0.0) / (ratio - 1.0))


def width_for(sharpness: float, settings: LineSettings) -> float:
    """The smallest of `blurred_widths` that suits edges of a sharpness, or the largest."""
    blur_px = blur_of_sharpness(sharpness, settings.fine_scale_px, settings.coarse_scale_px)
    enough = [
        width
        for width in settings.blurred_widths
        if width * settings.sigma_across_px >= _WIDE_ENOUGH * blur_px
    ]
    return min(enough, default=max(settings.blurred_widths))


@lru_cache(maxsize=32)
def widened(settings: LineSettings, width: float) -> LineSettings:
    """The settings for edges `width` times as wide; only larger `blurred_widths` remain."""
    most = WIDEST_FILTER_PX / max(getattr(settings, name) for name in _FILTERS)
    wider = tuple(other / width for other in settings.blurred_widths if other > width)
    if width > most:
        width, wider = most, ()
    across = {name: width * getattr(settings, name) for name in _ACROSS}
    across |= {name: min(across[name], WIDEST_FILTER_PX) for name in _FILTERS}  # rounding
    steps = tuple(
        (min(width * scale, _WIDEST_STEP_PX), width * most)
        for scale, most in settings.refine_steps_px
    )
    return replace(settings, refine_steps_px=steps, blurred_widths=wider, **across)


def median_sharpness(fits: LineFits) -> float:
    """The (lower) median sharpness of all refined edges, lines or not; 1 if there are too few."""
    sharpness = np.sort(fits.sharpness[~np.isnan(fits.contrast)])
    return 1.0 if len(sharpness) < _LEAST_EDGES else float(sharpness[(len(sharpness) - 1) // 2])


def carry_ids(
    rows: Sequence[LineLandmark], reference: Sequence[LineLandmark]
) -> tuple[LineLandmark, ...]:
    """Detected lines of a frame with the IDs of unambiguously matching reference rows.

    A reference row whose bearing matches exactly one detected line (within half a degree or two
    standard deviations) gives it its IDs; a joined line can get several, one without a match -1.
    """
    alpha = np.array([row.alpha for row in rows])
    reach = np.maximum(_SAME_LINE_RAD, 2.0 * np.array([row.sigma for row in rows]))
    ids: list[list[int]] = [[] for _ in rows]
    for row in reference:
        fits = np.flatnonzero(np.abs(wrap_angle(alpha - row.alpha)) <= reach)
        if len(fits) == 1:
            ids[fits[0]] += [i for i in row.ids if i >= 0]
    carried = (tuple(dict.fromkeys(own)) or (-1,) for own in ids)
    return tuple(replace(row, ids=own) for row, own in zip(rows, carried))
