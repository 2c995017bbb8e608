"""Detected lines, the response and rejected tracks drawn for people."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.drawing.frame import line_curves
from detect.drawing.strokes import (
    Colour,
    canvas_of,
    draw_bar,
    draw_curve,
    draw_text,
    enlargement,
    with_legend,
)
from detect.lines import ACCEPTED, JOINED, LineDetections
from detect.verticals.tracking import LineTracks
from lut.verticals import VerticalTable

FloatArray = NDArray[np.float64]

_LINE_COLOUR: Colour = (60, 220, 60)
_JOINED_COLOUR: Colour = (255, 190, 0)
_SIGMA_COLOUR: Colour = (0, 170, 255)
_REJECTED_COLOURS: dict[str, Colour] = {
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


def draw_lines(
    image: NDArray[np.uint8], camera: Camera, table: VerticalTable, found: LineDetections
) -> NDArray[np.uint8]:
    """Draw lines through the distortion, with bars of their standard deviations on the horizon.

    Lines joined from several edges are drawn in another colour. A bar reaches one standard
    deviation to each side of the column where the line's own edge crosses the horizon (the report's
    figure 6).

    Parameters
    ----------
    image : (H, W) uint8
        The grey image.
    camera : Camera
        The calibrated camera.
    table : VerticalTable
        Its verticals.
    found : LineDetections
        The lines.

    Returns
    -------
    (H, W, 3) uint8
        In OpenCV's order blue, green, red.
    """
    canvas = canvas_of(image, camera)
    curves = line_curves(camera, found.ends)
    for points, sigma, members in zip(curves, found.sigma_rad, found.members):
        draw_curve(canvas, points, _LINE_COLOUR if len(members) == 1 else _JOINED_COLOUR)
        u, v = _horizon_crossing(table, found, members[0])
        reach = sigma / found.fits.pixel_rad[members[0]]
        draw_bar(canvas, np.array([[u - reach, v], [u + reach, v]]), _SIGMA_COLOUR)
    if found.tilt is None:
        text = "no tilt"
    else:
        pitch, roll = np.degrees([found.tilt.pitch_rad, found.tilt.roll_rad])
        text = f"pitch {pitch:.2f}  roll {roll:.2f} deg  ({found.tilt.lines} lines)"
    times = enlargement(canvas)
    draw_text(canvas, text, (4 * times, image.shape[0] - 5 * times), _SIGMA_COLOUR, 0.4)
    return canvas


def draw_tracks(
    image: NDArray[np.uint8],
    table: VerticalTable,
    found: LineDetections,
    *,
    rejected: bool = True,
    reasons: bool = True,
) -> NDArray[np.uint8]:
    """Draw the points of tracks, coloured by their fates, with a legend.

    Parameters
    ----------
    image : (H, W) uint8
        The grey image.
    table : VerticalTable
        Its camera's verticals.
    found : LineDetections
        The tracks and their fates.
    rejected : bool
        Whether to draw the tracks that are no lines.
    reasons : bool
        Whether to list below the image how many tracks there are of each fate.

    Returns
    -------
    (H + h, W, 3) uint8
        In OpenCV's order blue, green, red; h is the height of the legend.
    """
    canvas = canvas_of(image)
    counts: dict[str, int] = {}
    for t, fate in enumerate(found.fate):
        if not rejected and fate not in (ACCEPTED, JOINED):
            continue
        counts[fate] = counts.get(fate, 0) + 1
        points = np.rint(track_pixels(found.tracks, table, t)).astype(np.intp)
        canvas[points[:, 1], np.clip(points[:, 0], 0, image.shape[1] - 1)] = _colour(fate)
    if not reasons:
        return canvas
    words = [(f"{fate}: {counts[fate]}", _colour(fate)) for fate in sorted(counts)]
    return with_legend(canvas, words, 190, 0.38)


def draw_response(response: NDArray[np.float32], table: VerticalTable) -> NDArray[np.uint8]:
    """Draw the response of the strip image, where the building's verticals are vertical.

    Parameters
    ----------
    response : (H, W) float32
        See `detect.verticals.response.line_response`.
    table : VerticalTable
        Its camera's verticals; the horizon is drawn in green.

    Returns
    -------
    (H, W, 3) uint8
        In OpenCV's order: edges that are brighter on the right are red, on the left blue.
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


def _horizon_crossing(
    table: VerticalTable, found: LineDetections, track: int
) -> tuple[float, float]:
    bearing = found.fits.reference_rad[track] + np.arctan(found.fits.line[track, 0])
    u = float(table.columns_at(np.array([bearing]))[0])
    columns = np.flatnonzero(table.usable)
    return u, float(np.interp(u, columns, table.anchor_row[columns]))


def _colour(fate: str) -> Colour:
    if fate == ACCEPTED:
        return _LINE_COLOUR
    return _JOINED_COLOUR if fate == JOINED else _REJECTED_COLOURS[fate]
