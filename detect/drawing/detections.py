"""Detections drawn into their images."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.drawing.strokes import Colour, canvas_of, draw_curve, draw_text, enlargement
from detect.seen import circle_on_floor
from detect.settings import CircleSettings

if TYPE_CHECKING:
    from detect.circles import CircleDetections

FloatArray = NDArray[np.float64]

EDGE_COLOUR: Colour = (0, 170, 255)
_OUTLINE_COLOUR: Colour = (60, 200, 60)
_TEXT_COLOUR: Colour = (0, 230, 255)


def draw_circles(
    image: NDArray[np.uint8],
    camera: Camera,
    found: CircleDetections,
    settings: CircleSettings,
) -> NDArray[np.uint8]:
    """Draw the outlines of detected discs and their quality (the report's figure 8).

    Parameters
    ----------
    image : (H, W) uint8
        The grey image.
    camera : Camera
        The calibrated camera, through which the outlines are drawn.
    found : CircleDetections
        The discs.
    settings : CircleSettings
        The radii of the outlines.

    Returns
    -------
    (H, W, 3) uint8
        In OpenCV's order blue, green, red.
    """
    canvas = canvas_of(image, camera)
    for centre, quality in zip(found.floor_xy, found.quality):
        outline_disc(canvas, camera.project_floor, centre, settings, f"{quality:.2f}")
    return canvas


def outline_disc(
    canvas: NDArray[np.uint8],
    project: Callable[[FloatArray], FloatArray],
    centre_xy: FloatArray,
    settings: CircleSettings,
    text: str,
    *,
    edge_colour: Colour = EDGE_COLOUR,
) -> None:
    """Draw a disc's edge and its two outlines, and a word above.

    Parameters
    ----------
    canvas : (H, W, 3) uint8
        Drawn into.
    project : callable
        From (N, 2) places on the floor (m) to (N, 2) pixels; NaN where they are not seen.
    centre_xy : (2,) float64
        The disc's centre (m).
    settings : CircleSettings
        The radii.
    text : str
        Written above.
    edge_colour : Colour
        Of the edge.
    """
    for radius, colour in (
        (settings.inner_radius_m, _OUTLINE_COLOUR),
        (settings.radius_m, edge_colour),
        (settings.outer_radius_m, _OUTLINE_COLOUR),
    ):
        draw_curve(canvas, project(circle_on_floor(centre_xy, radius)), colour, closed=True)
    u, v = project(centre_xy + np.array([0.0, -settings.outer_radius_m]))
    if np.isfinite(u) and np.isfinite(v):
        times = enlargement(canvas)
        at = (round(float(u)) - 14 * times, max(10 * times, round(float(v)) - 3 * times))
        draw_text(canvas, text, at, _TEXT_COLOUR)
