"""The stages of the detector of verticals one by one, for tests: from a table and settings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.verticals.judgement import Judgement, fit_and_judge, limits_of
from detect.verticals.refinement import refinement_of
from detect.verticals.response import StripResponse, line_filter, strip_of, strip_response
from detect.verticals.starts import (
    LineStarts,
    StartBand,
    band_response,
    find_maxima,
    ordered_starts,
    start_band,
)
from detect.verticals.tilt import TiltEstimate, with_error
from detect.verticals.tracking import ALL_EDGES, LineTracks, follow_edges, following_of
from lut.verticals import VerticalTable


def start_response(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> tuple[NDArray[np.float32], StartBand]:
    """The response on the rows on which tracks start, and which rows these are."""
    band = start_band(table, settings)
    return band_response(image.reshape(-1), band, line_filter(settings).regulariser), band


def line_starts(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> LineStarts:
    """Maxima of the response on the horizon and on rows near it, the highest first."""
    response, band = start_response(image, table, settings)
    maxima = find_maxima(response, band.row, settings.threshold, band.supported)
    return ordered_starts(response, band.row, maxima)


def response_to(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> StripResponse:
    """The response to an image, of which nothing is evaluated yet."""
    return strip_response(image.reshape(-1), strip_of(table), line_filter(settings))


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
    following = following_of(settings, table.row_aspect, tilt is not None, enough)
    expected = (0.0, 0.0) if tilt is None else (float(tilt.pitch_rad), float(tilt.roll_rad))
    return follow_edges(response, strip_of(table), starts, following, expected)


def judge_tracks(
    image: NDArray[np.uint8],
    tracks: LineTracks,
    table: VerticalTable,
    settings: LineSettings,
    steps: int | None = None,
) -> Judgement:
    """Lines through tracks, refined in all or some steps, their fates, and the tilt."""
    limits = limits_of(settings, table.row_aspect)
    judged, lines, edge = fit_and_judge(
        image, strip_of(table), tracks, refinement_of(settings, steps), limits
    )
    return judged._replace(tilt=with_error(judged.tilt, lines, edge, limits.consensus))
