"""The detector of verticals: from one image to lines with bearings and standard deviations.

The path of an image, each step a function of its own:

    response        how well a step along the local vertical explains the grey values
    starts          its maxima on the horizon (or the anchor: `lut.verticals`)
    tracks          the edges through them, followed up and down
    fits            straight lines, refined on the grey values
    consensus       the tilt that most of them agree with; the others are no verticals
    tracks, fits    once more along the verticals of that tilt
    lines           bearings; one line for each edge, close ones joined

The first pass is omitted if the starts alone, of which an edge has one on each of several rows,
determine the tilt beyond doubt (`detect.verticals.judgement.tilt_of_chains`); a few edges suffice
if these do. If all edges are blurred, everything is repeated with filters as wide as the blur
(`detect.verticals.blur`).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.errors import FrameError
from detect.line_settings import DEFAULT, LineNumbers, LineSettings
from detect.verticals.blur import median_sharpness, widened, width_for
from detect.verticals.detections import LineDetections
from detect.verticals.joining import lines_of_tracks
from detect.verticals.judgement import (
    FATES,
    Judgement,
    fit_and_judge,
    tilt_of_chains,
)
from detect.verticals.refinement import StepFilters, step_filters
from detect.verticals.response import LineFilter, Strip, line_filter, strip_of, strip_response
from detect.verticals.starts import StartBand, band_response, find_maxima, line_starts, start_band
from detect.verticals.tilt import TiltEstimate, lean_deviation, with_error
from detect.verticals.tracking import LineTracks, follow_edges
from lut.verticals import VerticalTable

__all__ = ["ACCEPTED", "JOINED", "LineDetections", "detect_lines"]

#: Fates of tracks that are a line, or part of one.
ACCEPTED, JOINED = FATES[:2]

#: A few edges determine the tilt beyond doubt if at least this many lines and this share of the
#: votes agree with it, and if it predicts the lean of verticals to this accuracy everywhere in the
#: image. A track that is corrected by 7 % of its points' offsets follows a lean that is wrong by
#: twice as much at a distance of 0.15 px.
_FIRST_LINES = 6
_FIRST_VOTES = 0.75
_FIRST_LEAN_RAD = math.radians(0.15)
#: Chains of the band are short: least number that must agree, and least height of the band, pixels.
_CHAINS = 7
_BAND_PX = 60.0
#: Edges that were followed along a tilt are followed again if their own tilt differs so much that
#: tracks were farther than this from their edges, pixels.
_LAG_PX = 0.1
#: The refinement's steps that the first tilt needs.
_FIRST_STEPS = 2


class _Prepared(NamedTuple):
    """What a table and settings decide before the first image."""

    strip: Strip
    window: LineFilter
    band: StartBand
    first_steps: StepFilters
    all_steps: StepFilters
    numbers: LineNumbers


@lru_cache(maxsize=16)
def _prepared(table: VerticalTable, settings: LineSettings) -> _Prepared:
    return _Prepared(
        strip_of(table),
        line_filter(settings),
        start_band(table, settings),
        step_filters(settings, _FIRST_STEPS),
        step_filters(settings),
        LineNumbers.of(settings, table.row_aspect),
    )


def detect_lines(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings = DEFAULT
) -> LineDetections:
    """Find the building's verticals in an image.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        See there; `detect.line_settings.PUBLISHED` are the report's.

    Returns
    -------
    LineDetections
        Lines, leftmost first, and all that they were made from.

    Raises
    ------
    FrameError
        If the image is not of the table's size or not of 8 bit grey values.
    """
    if image.shape != table.column.shape or image.dtype != np.uint8:
        raise FrameError(
            f"image is {image.dtype} of shape {image.shape}: expected uint8 of the table's shape "
            f"{table.column.shape}"
        )
    image = np.ascontiguousarray(image)
    tools = _prepared(table, settings)
    tracks, judged = _tracks_of_verticals(image, tools, settings)
    sharpness = median_sharpness(judged.fits)
    if settings.blurred_widths and sharpness < settings.blurred_sharpness:
        return detect_lines(image, table, widened(settings, width_for(sharpness, settings)))
    if judged.tilt is not None:
        tilt = with_error(judged.tilt, judged.verticals, judged.edge, tools.numbers)
        judged = judged._replace(tilt=tilt)
    lines = lines_of_tracks(tools.strip, tracks, judged, tools.numbers)
    return LineDetections(lines, tracks, judged, sharpness)


def _tracks_of_verticals(
    image: NDArray[np.uint8], tools: _Prepared, settings: LineSettings
) -> tuple[LineTracks, Judgement]:
    """Tracks along the verticals of the image's tilt where that is found, and their fates."""
    strip, band, numbers = tools.strip, tools.band, tools.numbers
    in_band = band_response(image, band, settings.regulariser)
    maxima = find_maxima(in_band, settings.threshold)
    starts = line_starts(maxima, band)
    response = strip_response(image, strip, tools.window)

    guide: TiltEstimate | None = None
    passes = 1
    if settings.guided and settings.first_edges > 0:
        # The band is useless in images that are full of maxima everywhere.
        if band.chained and band.height_px >= _BAND_PX and len(starts.row) <= image.shape[1]:
            guide = tilt_of_chains(strip, maxima, band, numbers)
        if beyond_doubt(guide, _CHAINS, strip):
            passes = 2
        else:
            tracks = follow_edges(response, strip, starts, numbers, enough=settings.first_edges)
            guide = fit_and_judge(image, strip, tracks, tools.first_steps, numbers).tilt
            if not beyond_doubt(guide, _FIRST_LINES, strip):
                guide = None
    if guide is None:
        tracks = follow_edges(response, strip, starts, numbers)
        judged = fit_and_judge(image, strip, tracks, tools.all_steps, numbers)
        guide = judged.tilt if settings.guided else None
    # Once more if the band's tilt, by which they were followed, was not quite that of the lines.
    while guide is not None and passes > 0:
        tracks = follow_edges(response, strip, starts, numbers, (guide.pitch_rad, guide.roll_rad))
        judged = fit_and_judge(image, strip, tracks, tools.all_steps, numbers)
        if judged.tilt is None or _lag_px(judged.tilt, guide, strip, settings) <= _LAG_PX:
            break
        guide, passes = judged.tilt, passes - 1
    return tracks, judged


def beyond_doubt(tilt: TiltEstimate | None, least_lines: int, strip: Strip) -> bool:
    """Whether a tilt of `least_lines` lines or more is good enough to follow all edges along it."""
    if tilt is None or tilt.lines < least_lines or tilt.votes < _FIRST_VOTES:
        return False
    (pp, pr), (_, rr) = tilt.covariance.tolist()
    return bool(lean_deviation(pp, pr, rr, strip.sine, strip.cosine) <= _FIRST_LEAN_RAD)


def _lag_px(tilt: TiltEstimate, guide: TiltEstimate, strip: Strip, settings: LineSettings) -> float:
    """How far tracks along `guide` were from edges of a tilt, where that is most, pixels."""
    pitch, roll = tilt.pitch_rad - guide.pitch_rad, tilt.roll_rad - guide.roll_rad
    lean = lean_deviation(pitch * pitch, pitch * roll, roll * roll, strip.sine, strip.cosine)
    # A track follows a wrong lean at the distance where its correction per row equals it.
    return float(lean * strip.row_aspect / settings.guided_pull)
