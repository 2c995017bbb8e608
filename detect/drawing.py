"""Detections drawn into their images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.circles import CircleDetections
from detect.settings import CircleSettings

_POINTS = 64
_INNER_COLOUR, _EDGE_COLOUR, _OUTER_COLOUR = (60, 200, 60), (0, 170, 255), (60, 200, 60)
_TEXT_COLOUR = (0, 230, 255)
_SUBPIXEL_BITS = 4


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
    import cv2

    canvas = np.repeat(image[:, :, None], 3, axis=2)
    angle = 2.0 * np.pi * np.arange(_POINTS) / _POINTS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    outlines = (
        (settings.inner_radius_m, _INNER_COLOUR),
        (settings.radius_m, _EDGE_COLOUR),
        (settings.outer_radius_m, _OUTER_COLOUR),
    )
    for centre, quality in zip(found.floor_xy, found.quality):
        for radius, colour in outlines:
            points = camera.project_floor(centre + radius * circle)
            if np.all(np.isfinite(points)):
                fixed = np.rint(points * (1 << _SUBPIXEL_BITS)).astype(np.int32)
                cv2.polylines(canvas, [fixed], True, colour, 1, cv2.LINE_AA, _SUBPIXEL_BITS)
        u, v = camera.project_floor(centre + np.array([0.0, -settings.outer_radius_m]))
        if np.isfinite(u) and np.isfinite(v):
            origin = (round(float(u)) - 14, max(10, round(float(v)) - 3))
            cv2.putText(
                canvas, f"{quality:.2f}", origin, cv2.FONT_HERSHEY_SIMPLEX, 0.35, _TEXT_COLOUR, 1,
                cv2.LINE_AA,
            )  # fmt: skip
    return canvas
