"""The stages of the detector of verticals one by one, for tests: from a table and settings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineNumbers, LineSettings
from detect.verticals import starts
from detect.verticals.judgement import Judgement, fit_and_judge
from detect.verticals.refinement import step_filters
from detect.verticals.response import StripResponse, line_filter, strip_of, strip_response
from detect.verticals.starts import LineStarts, StartBand, band_response, find_maxima, start_band
from detect.verticals.tilt import TiltEstimate, with_error
from detect.verticals.tracking import ALL_EDGES, LineTracks, follow_edges
from lut.verticals import VerticalTable


def start_response(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> tuple[NDArray[np.float32], StartBand]:
    """The response on the rows on which tracks start, and which rows these are."""
    band = start_band(table, settings)
    return band_response(image, band, settings.regulariser), band


def line_starts(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> LineStarts:
    """Maxima of the response on the horizon and on rows near it, the highest first."""
    response, band = start_response(image, table, settings)
    return starts.line_starts(find_maxima(response, settings.threshold), band)


def response_to(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> StripResponse:
    """The response to an image, of which nothing is evaluated yet."""
    return strip_response(image, strip_of(table), line_filter(settings))


def line_tracks(
    image: NDArray[np.uint8] | StripResponse,
    starts: LineStarts,
    table: VerticalTable,
    settings: LineSettings,
    tilt: TiltEstimate | None = None,
    enough: int = ALL_EDGES,
) -> LineTracks:
    """Edges followed from starts: along the verticals of a tilt, or in any direction."""
    response = image if isinstance(image, StripResponse) else response_to(image, table, settings)
    expected = None if tilt is None else (float(tilt.pitch_rad), float(tilt.roll_rad))
    numbers = LineNumbers.of(settings, table.row_aspect)
    return follow_edges(response, strip_of(table), starts, numbers, expected, enough)


def judge_tracks(
    image: NDArray[np.uint8],
    tracks: LineTracks,
    table: VerticalTable,
    settings: LineSettings,
    steps: int | None = None,
) -> Judgement:
    """Lines through tracks, refined in all or some steps, their fates, and the tilt."""
    numbers = LineNumbers.of(settings, table.row_aspect)
    judged = fit_and_judge(image, strip_of(table), tracks, step_filters(settings, steps), numbers)
    if judged.tilt is None:
        return judged
    tilt = with_error(judged.tilt, judged.verticals, judged.edge, numbers)
    return judged._replace(tilt=tilt)
