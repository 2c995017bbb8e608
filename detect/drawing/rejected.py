"""What detectors rejected: tracks and response of lines, candidates for markers."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from detect.drawing.frame import LINE_COLOUR
from detect.drawing.strokes import Colour, canvas_of, draw_curve, with_legend
from detect.lines import ACCEPTED, JOINED, LineDetections
from detect.markers.detect import ACCEPTED as ACCEPTED_MARKER
from detect.markers.detect import SAME_MARKER, MarkerDetections
from detect.verticals.tracking import LineTracks
from lut.verticals import VerticalTable

FloatArray = NDArray[np.float64]

_CANDIDATE_COLOUR: Colour = (255, 150, 40)
_FATE_COLOURS: dict[str, Colour] = {
    ACCEPTED: LINE_COLOUR,
    JOINED: (255, 190, 0),
    "short": (120, 120, 120),
    "no maximum": (200, 0, 120),
    "little evidence": (200, 120, 60),
    "off the track": (200, 0, 200),
    "not straight": (0, 140, 255),
    "off the horizon": (200, 200, 0),
    "uncertain": (0, 200, 200),
    "soft": (160, 80, 200),
    "not vertical": (0, 0, 255),
    "same edge": (60, 120, 60),
    "beside a stronger edge": (0, 90, 160),
}


def draw_tracks(
    image: NDArray[np.uint8], table: VerticalTable, found: LineDetections
) -> NDArray[np.uint8]:
    """Draw the points of tracks, coloured by their fates, with a legend below."""
    canvas = canvas_of(image)
    for t, fate in enumerate(found.fate):
        points = np.rint(track_pixels(found.tracks, table, t)).astype(np.intp)
        canvas[points[:, 1], np.clip(points[:, 0], 0, image.shape[1] - 1)] = _FATE_COLOURS[fate]
    counts = sorted(Counter(found.fate).items())
    words = [(f"{fate}: {count}", _FATE_COLOURS[fate]) for fate, count in counts]
    return with_legend(canvas, words, 190, 0.38)


def draw_candidates(picture: NDArray[np.uint8], found: MarkerDetections) -> NDArray[np.uint8]:
    """The picture with candidates that are no markers, and below it why any were rejected."""
    for candidate in found.candidates:
        if candidate.fate not in (ACCEPTED_MARKER, SAME_MARKER):
            draw_curve(picture, candidate.outline, _CANDIDATE_COLOUR, closed=True)
    causes = sorted(found.rejected.items())
    words = [(f"{cause}: {count}", _CANDIDATE_COLOUR) for cause, count in causes]
    return with_legend(picture, words, 210, 0.36)


def draw_response(response: NDArray[np.float32], table: VerticalTable) -> NDArray[np.uint8]:
    """Draw a response (`detect.verticals.response.line_response`, (H, W)) as a picture (H, W, 3).

    Edges that are brighter on the right are red, on the left blue; the horizon is green.
    """
    strength = np.clip(np.abs(response) / (2.0 / np.pi), 0.0, 1.0)
    shade = (255.0 * np.sqrt(strength)).astype(np.uint8)
    canvas = np.zeros((*response.shape, 3), np.uint8)
    canvas[..., 0] = np.where(response < 0.0, shade, 0)
    canvas[..., 2] = np.where(response > 0.0, shade, 0)
    columns = np.flatnonzero(table.usable)
    canvas[np.rint(table.anchor_row[columns]).astype(np.intp), columns, 1] = 160
    return canvas


def track_pixels(tracks: LineTracks, table: VerticalTable, t: int) -> FloatArray:
    """(P, 2) image positions u, v of a track's points."""
    part = slice(tracks.bounds[t], tracks.bounds[t + 1])
    row, column = tracks.row[part], tracks.column[part]
    left = np.clip(column.astype(np.intp), 0, table.column.shape[1] - 2)
    share = column - left
    u = (1.0 - share) * table.column[row, left] + share * table.column[row, left + 1]
    u = np.where(np.isfinite(u), u, table.column[row, np.rint(column).astype(np.intp)])
    return np.stack([u, row.astype(np.float64)], axis=-1)
