"""The stages of the detector of verticals one by one, for tests: from a table and settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from detect.line_settings import DEFAULT, LineSettings, numbers_of
from detect.verticals import starts
from detect.verticals.judgement import JudgedTracks, fit_and_judge
from detect.verticals.refinement import step_filters
from detect.verticals.response import line_filter, strip_of
from detect.verticals.starts import LineStarts, StartBand, band_response, start_band
from detect.verticals.tilt import TiltEstimate, Verticals, agree_on_tilt, with_error
from detect.verticals.tracking import NOTHING_BEFORE, Before, LineTracks, follow_edges
from lut.verticals import VerticalTable
from redetect.array_types import FloatArray


def start_response(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> tuple[NDArray[np.float32], StartBand]:
    """The response on the rows on which tracks start, and which rows these are."""
    band = start_band(table, settings)
    return band_response(image, band, settings.regulariser), band


def line_starts(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> LineStarts:
    """Chains of maxima of the response on the horizon and on rows near it, the highest first."""
    response, band = start_response(image, table, settings)
    return starts.line_starts(response, band, settings.threshold)


def line_tracks(
    image: NDArray[np.uint8], starts: LineStarts, table: VerticalTable, settings: LineSettings
) -> LineTracks:
    """Edges followed from starts."""
    numbers = numbers_of(settings, table.row_aspect)
    return follow_edges(
        image, strip_of(table), line_filter(settings), starts, numbers, NOTHING_BEFORE
    )


def tracks_again(
    image: NDArray[np.uint8], starts: LineStarts, tracks: LineTracks, again: NDArray[np.bool_],
    tilt_rad: tuple[float, float], table: VerticalTable, settings: LineSettings,
) -> LineTracks:  # fmt: skip
    """Some of the tracks followed again along the verticals of a tilt."""
    numbers = numbers_of(settings, table.row_aspect)
    window, strip = line_filter(settings), strip_of(table)
    return follow_edges(image, strip, window, starts, numbers, Before(tracks, again, tilt_rad))


def judge_tracks(
    image: NDArray[np.uint8],
    tracks: LineTracks,
    table: VerticalTable,
    settings: LineSettings,
    steps: int | None = None,
    before: JudgedTracks | None = None,
) -> JudgedTracks:
    """Lines through tracks, refined in all or some steps, their outcomes, and the tilt."""
    numbers = numbers_of(settings, table.row_aspect)
    filters = step_filters(replace(settings, refine_steps_px=settings.refine_steps_px[:steps]))
    judged = fit_and_judge(image, strip_of(table), tracks, filters, numbers, before)
    if judged.tilt is None:
        return judged
    tilt = with_error(judged.tilt, judged.verticals, judged.edge, numbers)
    return judged._replace(tilt=tilt)


def verticals(
    normal: FloatArray,
    variance: ArrayLike,
    tolerance_rad: ArrayLike = 0.01,
    weight: ArrayLike = 1.0,
) -> Verticals:
    """Lines of these normals; what is given as a number is that of all."""
    given = (variance, tolerance_rad, weight)
    return Verticals(normal, *(np.array(np.broadcast_to(v, len(normal)), float) for v in given))


def consensus(
    lines: Verticals, settings: LineSettings = DEFAULT
) -> tuple[TiltEstimate | None, NDArray[np.bool_]]:
    """The tilt by lines that are edges of their own, with its error, and which agree with it."""
    numbers = numbers_of(settings)
    tilt, consistent = agree_on_tilt(lines, numbers)
    if tilt.lines == 0:
        return None, consistent
    return with_error(tilt, lines, np.arange(len(lines.weight)), numbers), consistent


def last_rows(tracks: LineTracks) -> NDArray[np.int32]:
    """(T,) the last row of each track."""
    return tracks.row[tracks.bounds[1:] - 1]
