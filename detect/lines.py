"""The detector of verticals: from one image to lines with bearings and standard deviations.

The stages of an image, each in its own function:

    starts          maxima of the response on the horizon (or the anchor: `lut.verticals`)
    tracks          the edges through them, followed up and down
    fits            straight lines, refined on the grey values
    consensus       the tilt on which most of them agree; the others are not vertical
    again           doubtful tracks, followed along the verticals of that tilt
    lines           bearings; one line for each edge, close ones joined

If all edges are blurred, everything is repeated with filters as wide as the blur
(`detect.verticals.blur`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from detect.errors import DetectError
from detect.grey_values import plain_image
from detect.line_settings import DEFAULT, LineNumbers, LineSettings
from detect.verticals.blur import median_sharpness, widened, width_for
from detect.verticals.joining import Lines, lines_of_tracks
from detect.verticals.judgement import FATES, JudgedTracks, fit_and_judge
from detect.verticals.refinement import StepFilters, step_filters
from detect.verticals.response import LineFilter, Strip, line_filter, strip_of
from detect.verticals.starts import StartBand, band_response, line_starts, start_band
from detect.verticals.tilt import TiltEstimate, with_error
from detect.verticals.tracking import NOTHING_BEFORE, Before, LineTracks, follow_edges
from lut.verticals import VerticalTable
from redetect.array_types import GreyImage
from redetect.landmarks import LineLandmark, wrap_angle
from redetect.tables import ByContent

#: Fates of tracks that are a line, or part of one.
ACCEPTED, JOINED = FATES[:2]
#: Largest difference of bearings of the same line, unless two standard deviations are larger.
_SAME_LINE_RAD = np.radians(0.5)


@dataclass(frozen=True, eq=False)
class LineDetections(ByContent):
    """Detections in one image."""

    lines: Lines  # the leftmost is the first, here and elsewhere
    tracks: LineTracks
    judged: JudgedTracks  # lines through all tracks, and their fates

    def __len__(self) -> int:
        return len(self.lines.alpha_rad)

    @property
    def tilt(self) -> TiltEstimate | None:
        """The tilt estimate; None if too few lines agree."""
        return self.judged.tilt

    @cached_property
    def fate(self) -> tuple[str, ...]:
        """(T,) "accepted", "joined" (to a stronger one), or why the track is not a line."""
        return tuple(FATES[number] for number in self.judged.fate.tolist())

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
    band, numbers = start_band(table, settings), LineNumbers.of(settings, table.row_aspect)
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
    tracks = follow_edges(image, strip, window, starts, numbers.tracking, NOTHING_BEFORE)
    judged = fit_and_judge(image, strip, tracks, steps, numbers)
    sharpness = median_sharpness(judged.fits)
    if settings.blurred_widths and sharpness < settings.blurred_sharpness:
        return detect_lines(image, table, widened(settings, width_for(sharpness, settings)))
    if settings.guided and judged.tilt is not None and judged.doubtful.any():
        before = Before(tracks, judged.doubtful, (judged.tilt.pitch_rad, judged.tilt.roll_rad))
        tracks = follow_edges(image, strip, window, starts, numbers.tracking, before)
        judged = fit_and_judge(image, strip, tracks, steps, numbers, judged)
    if judged.tilt is not None:
        error = with_error(judged.tilt, judged.verticals, judged.edge, numbers.tilt)
        judged = judged._replace(tilt=error)
    return LineDetections(lines_of_tracks(strip, tracks, judged, numbers.joining), tracks, judged)


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
