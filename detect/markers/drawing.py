"""Draws detected markers and rejected candidates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detect.drawing.strokes import (
    Colour,
    canvas_of,
    draw_curve,
    draw_text,
    enlargement,
    with_legend,
)
from detect.markers.detect import ACCEPTED, SAME_MARKER, MarkerDetections

FloatArray = NDArray[np.float64]

_EDGE_COLOUR: Colour = (60, 220, 60)
_TOP_LEFT_COLOUR: Colour = (0, 0, 255)
_TEXT_COLOUR: Colour = (0, 230, 255)
_CANDIDATE_COLOUR: Colour = (255, 150, 40)
#: Size of the ellipses of the corners, in standard deviations.
_SIGMAS = 20.0


def draw_markers(
    image: NDArray[np.uint8], found: MarkerDetections, *, rejected: bool = True
) -> NDArray[np.uint8]:
    """Draw markers with their numbers, and below the image why candidates were rejected.

    The edges of markers are green, with a red circle at the top left corner; ellipses show 20
    standard deviations of the corners. Rejected candidates that came as far as having corners are
    drawn in blue.

    Parameters
    ----------
    image : (H, W) uint8
        The grey image.
    found : MarkerDetections
        The markers found in it.
    rejected : bool
        Whether to draw candidates that are no markers.

    Returns
    -------
    (H + h, W, 3) uint8
        In OpenCV's order blue, green, red; h is the height of the legend.
    """
    canvas = canvas_of(image)
    if rejected:
        for candidate in found.candidates:
            if candidate.fate not in (ACCEPTED, SAME_MARKER):
                draw_curve(canvas, candidate.outline, _CANDIDATE_COLOUR, closed=True)
    for number, corners, covariance in zip(found.ids, found.corners, found.covariance):
        mark_marker(canvas, number, corners, covariance)
    causes = sorted(found.rejected.items())
    words = [(f"{cause}: {count}", _CANDIDATE_COLOUR) for cause, count in causes]
    return with_legend(canvas, words, 210, 0.36)


def mark_marker(
    canvas: NDArray[np.uint8], number: int, corners: FloatArray, covariance: FloatArray
) -> None:
    """Draw a marker's edges, a circle at its top left corner, ellipses and its number.

    Parameters
    ----------
    canvas : (H, W, 3) uint8
        Drawn into.
    number : int
        The marker's ID.
    corners : (4, 2) float64
        Pixels, from the top left clockwise.
    covariance : (4, 2, 2) float64
        Of the corners, pixels squared; ellipses show 20 standard deviations.
    """
    times = enlargement(canvas)
    draw_curve(canvas, corners, _EDGE_COLOUR, closed=True)
    angle = np.linspace(0.0, 2.0 * np.pi, 33)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    for place, spread in zip(corners, covariance):
        values, vectors = np.linalg.eigh(spread)
        ellipse = place + _SIGMAS * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        draw_curve(canvas, ellipse, _EDGE_COLOUR, closed=True)
    draw_curve(canvas, corners[0] + 3.0 * times * circle, _TOP_LEFT_COLOUR, closed=True)
    middle = corners.mean(axis=0)
    at = (round(float(middle[0])) - 8 * times, round(float(middle[1])) + 5 * times)
    draw_text(canvas, f"{number}", at, _TEXT_COLOUR, 0.45)
