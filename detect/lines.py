"""The detector of verticals: from one image to lines with bearings and standard deviations.

The path of an image, each step a function of its own:

    response        how well a step along the local vertical explains the grey values
    starts          its maxima on the horizon (or what stands for it: `lut.verticals`)
    tracks          the edges through them, followed up and down
    fits            straight lines, refined on the grey values
    consensus       the tilt that most of them agree with; the others are no verticals
    tracks, fits    once more along the verticals of that tilt
    lines           bearings; one line for each edge, close ones joined

The first time is left out where the starts themselves, of which an edge has one on each of several
rows, leave no doubt about the tilt (`detect.verticals.chain_kernels`); a few edges will do if these
leave none. Where all edges turn out to be blurred, everything is done again with filters as wide as
the blur (`detect.verticals.blur`).
`detect_lines` goes it in one compiled call (`detect.verticals.image_kernels`).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detect.errors import FrameError
from detect.line_settings import DEFAULT, LineSettings
from detect.verticals.blur import widened, width_for
from detect.verticals.detections import LineDetections
from detect.verticals.filter import LineFilter, line_filter, start_band
from detect.verticals.judgement import (
    ACCEPTED,
    JOINED,
    grouping_of,
    judge_tracks,
    limits_of,
    refinement_of,
)
from detect.verticals.strip import strip_of
from detect.verticals.tilt import TiltEstimate
from detect.verticals.tracks import LineTracks, padded_pixels
from lut.verticals import VerticalTable

__all__ = ["ACCEPTED", "JOINED", "LineDetections", "detect_lines", "tilt_beyond_doubt"]

#: A few edges tell the tilt beyond doubt if so many lines and such a part of the votes agree with
#: it, and if it tells the lean of verticals as well as this everywhere in the image. A track that
#: yields to its points by 7 % follows a lean that is wrong by twice as much at 0.15 px from it.
_FIRST_LINES = 6
_FIRST_VOTES = 0.75
_FIRST_LEAN_RAD = math.radians(0.15)
#: Chains of the band are short: so many must agree, and the band must be so high, pixels.
_CHAINS = 7
_BAND_PX = 60.0
#: Edges that were followed by a tilt are followed again if the one that they show leaves tracks
#: farther behind their edges, pixels.
_LAG_PX = 0.1
#: The refinement's steps that lines need for that.
_FIRST_STEPS = 2


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
    from detect.verticals.image_kernels import find_lines

    image = np.ascontiguousarray(image)
    window, told = _told_beforehand(table, settings)
    found = LineDetections(find_lines(image, padded_pixels(image, window), *told))
    if settings.blurred_widths and found.sharpness < settings.blurred_sharpness:
        wider = widened(settings, width_for(found.sharpness, settings))
        return detect_lines(image, table, wider)
    return found


@lru_cache(maxsize=16)
def _told_beforehand(
    table: VerticalTable, settings: LineSettings
) -> tuple[LineFilter, tuple[Any, ...]]:
    """The filter, and what `find_lines` takes besides the image."""
    window, band, strip = line_filter(settings), start_band(table, settings), strip_of(table)
    filters, farthest = refinement_of(settings)
    few = [*range(len(farthest))[:_FIRST_STEPS], -2, -1]
    level = settings.alpha == "level"
    following = (
        window.regulariser,
        band.spacing,
        settings.threshold,
        window.weights.shape[1] // 2,
        settings.gap_rows,
        settings.border_rows,
        table.row_aspect,
        settings.guided_pull,
        settings.guided_reach_px,
        settings.guided,
        settings.first_edges,
        1.0 if level else -1.0,
        settings.consensus.building_rad if level else math.inf,
        band.supported,
        band.supported and 2.0 * settings.start_band_rows * table.row_aspect >= _BAND_PX,
        settings.blurred_sharpness if settings.blurred_widths else 0.0,
    )
    of_chains = (_CHAINS, _FIRST_VOTES, _FIRST_LEAN_RAD)
    # A track follows a lean that is wrong by so much that what it yields in a row makes up for it.
    lean = _LAG_PX * settings.guided_pull / table.row_aspect
    doubt = np.array([_FIRST_LINES, _FIRST_VOTES, _FIRST_LEAN_RAD, *of_chains, lean])
    told = (
        table.elevation_tan, table.bearing_rad, table.anchor_row, table.first_row,
        table.last_row, table.robot_from_camera, strip.column, strip.ends, strip.rise,
        strip.lean_by_pitch, strip.lean_by_roll, band.row, band.pixel, band.runs, band.lengths,
        band.odd, band.odd_bounds, band.part, band.scale, band.visible, band.weights,
        window.weights_between, window.along, filters.half, filters.begin, filters.height,
        filters.derivatives, farthest, filters.half[few], filters.begin[few],
        farthest[:_FIRST_STEPS], np.array(following, np.float64),
        limits_of(settings, table.row_aspect), doubt, grouping_of(settings),
    )  # fmt: skip
    return window, told


def tilt_beyond_doubt(
    image: NDArray[np.uint8], tracks: LineTracks, table: VerticalTable, settings: LineSettings
) -> TiltEstimate | None:
    """Tilt from a few edges, good enough to follow all of them by.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values, in scan order.
    tracks : LineTracks
        The few edges.
    table, settings
        As for `detect_lines`.

    Returns
    -------
    TiltEstimate or None
        None where it is in doubt. Lines are not refined to the end for it.
    """
    judged = judge_tracks(image, tracks, table, settings, steps=_FIRST_STEPS)
    if (
        judged.tilt is not None
        and judged.tilt.lines >= _FIRST_LINES
        and judged.votes >= _FIRST_VOTES
        and judged.lean_deviation_rad <= _FIRST_LEAN_RAD
    ):
        return judged.tilt
    return None
