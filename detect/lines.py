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
(`detect.verticals.blur`). `detect_lines` does all of this in one compiled call (`find_lines`).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.errors import FrameError
from detect.line_settings import DEFAULT, LineSettings
from detect.verticals.blur import median_sharpness, widened, width_for
from detect.verticals.detections import LineDetections
from detect.verticals.joining import JoiningLimits, Lines, joining_of, lines_of_tracks
from detect.verticals.judgement import (
    FATES,
    Judgement,
    JudgementLimits,
    fit_and_judge,
    limits_of,
    tilt_of_chains,
)
from detect.verticals.refinement import LineFits, StepFilters, refinement_of
from detect.verticals.response import (
    LineFilter,
    Strip,
    line_filter,
    strip_of,
    strip_response,
)
from detect.verticals.starts import (
    StartBand,
    band_response,
    find_maxima,
    ordered_starts,
    start_band,
)
from detect.verticals.tilt import TiltEstimate, largest_lean, no_tilt, with_error
from detect.verticals.tracking import Following, LineTracks, follow_edges, following_of
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
#: The refinement's steps that lines need for that.
_FIRST_STEPS = 2


class Search(NamedTuple):
    """Inputs of `find_lines` besides the image.

    Attributes
    ----------
    strip, window, band
        The table, the filter, the rows on which tracks start.
    filters, few_filters : StepFilters
        Steps of the refinement, and those for the few edges that are followed first.
    free, few, guided : Following
        How edges are followed: all without a tilt, a few of them, and along a tilt.
    limits, joining
        Limits for accepting tracks and joining lines.
    is_guided : bool
        Whether edges are followed along a tilt at all.
    by_few : bool
        Whether a few are followed first.
    by_chains : bool
        Whether the band is high enough for chains of starts.
    lag_rad : float
        Edges followed along a tilt are followed again if their own tilt changes the lean by more.
    least_sharpness : float
        Images of less are done again with wider filters.
    """

    strip: Strip
    window: LineFilter
    band: StartBand
    filters: StepFilters
    few_filters: StepFilters
    free: Following
    few: Following
    guided: Following
    limits: JudgementLimits
    joining: JoiningLimits
    is_guided: bool
    by_few: bool
    by_chains: bool
    lag_rad: float
    least_sharpness: float


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
    search = _search(table, settings)
    lines, tracks, fits, judged, tilt, sharpness = find_lines(np.ascontiguousarray(image), search)
    evidence, fate = judged
    judgement = Judgement(LineFits(*fits), evidence, fate, TiltEstimate(*tilt))
    found = LineDetections(Lines(*lines), LineTracks(*tracks), judgement, sharpness)
    if found.sharpness < search.least_sharpness:
        wider = widened(settings, width_for(found.sharpness, settings))
        return detect_lines(image, table, wider)
    return found


@lru_cache(maxsize=16)
def _search(table: VerticalTable, settings: LineSettings) -> Search:
    band, aspect = start_band(table, settings), table.row_aspect
    band_px = 2.0 * settings.start_band_rows * aspect
    by_few = settings.guided and settings.first_edges > 0
    return Search(
        strip=strip_of(table),
        window=line_filter(settings),
        band=band,
        filters=refinement_of(settings),
        few_filters=refinement_of(settings, _FIRST_STEPS),
        free=following_of(settings, aspect, guided=False),
        few=following_of(settings, aspect, guided=False, enough=settings.first_edges),
        guided=following_of(settings, aspect, guided=True),
        limits=limits_of(settings, aspect),
        joining=joining_of(settings),
        is_guided=settings.guided,
        by_few=by_few,
        by_chains=by_few and band.supported and band_px >= _BAND_PX,
        # A track follows a wrong lean at the distance where its correction per row equals it.
        lag_rad=_LAG_PX * settings.guided_pull / aspect,
        least_sharpness=float(settings.blurred_sharpness) if settings.blurred_widths else 0.0,
    )


@njit(cache=True, error_model="numpy")
def beyond_doubt(tilt: TiltEstimate, least_lines: int) -> bool:
    """Whether a tilt of `least_lines` lines or more is good enough to follow all edges along it."""
    # NaN is not.
    sure = tilt.lines >= least_lines and tilt.votes >= _FIRST_VOTES
    return bool(sure and tilt.lean_rad <= _FIRST_LEAN_RAD)


@njit(cache=True, error_model="numpy")
def find_lines(image: NDArray[np.uint8], search: Search) -> tuple[Any, ...]:
    """`detect_lines`, compiled.

    Returns
    -------
    tuple
        The numbers of `Lines`, of `LineTracks`, of `LineFits`, evidence and fate of each track, the
        numbers of `TiltEstimate`, and the median sharpness. These are plain tuples: to make named
        ones, compiled code calls Python, where an interrupt would be lost.
    """
    strip, band, pixels = search.strip, search.band, image.reshape(-1)
    along_band = band_response(pixels, band, search.window.regulariser)
    maxima = find_maxima(along_band, band.row, search.free.threshold, band.supported)
    tilt = no_tilt()
    # The band is useless in images that are full of maxima everywhere.
    if search.by_chains and len(maxima.level) <= image.shape[1]:
        tilt = tilt_of_chains(along_band, band.row, maxima, strip, search.limits)
    starts = ordered_starts(along_band, band.row, maxima)

    response = strip_response(pixels, strip, search.window)
    # All by the tilt of the band, if that leaves no doubt about it, and once more if they show
    # another one. Else a few edges, if they leave none; else all; then all by their tilt.
    by_tilt = beyond_doubt(tilt, _CHAINS)
    few = search.by_few and not by_tilt
    times = 0
    most = 2 if by_tilt else 1
    while True:
        expected = (0.0, 0.0)
        following = search.few if few else search.free
        if by_tilt:
            expected = (tilt.pitch_rad, tilt.roll_rad)
            following = search.guided
            times += 1
        tracks = follow_edges(response, strip, starts, following, expected)
        few = not tracks.complete
        filters = search.few_filters if few else search.filters
        judged, verticals, edge = fit_and_judge(image, strip, tracks, filters, search.limits)
        tilt = judged.tilt
        sharpness = median_sharpness(judged.fits)
        if sharpness < search.least_sharpness:
            # All of it will be done again with wider filters.
            break
        if few and not beyond_doubt(tilt, _FIRST_LINES):
            few = False
            continue
        few = False
        if not search.is_guided or np.isnan(tilt.pitch_rad) or times == most:
            break
        changed = largest_lean(
            strip.bearing, tilt.pitch_rad - expected[0], tilt.roll_rad - expected[1]
        )
        if by_tilt and changed <= search.lag_rad:
            break
        by_tilt = True
    tilt = with_error(tilt, verticals, edge, search.limits.consensus)
    judged = Judgement(judged.fits, judged.evidence, judged.fate, tilt)
    lines = lines_of_tracks(strip, tracks, judged, search.joining)
    fates = (judged.evidence, judged.fate)
    return lines[:], tracks[:], judged.fits[:], fates, tilt[:], sharpness
