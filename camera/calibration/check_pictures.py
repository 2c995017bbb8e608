"""Pictures to check a calibration by: corners, and the floor as the camera is taken to see it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from camera.calibration.adjustment import project_estimate
from camera.calibration.calibrate import Calibration
from camera.model import Camera

FloatArray = NDArray[np.float64]
Picture = NDArray[np.uint8]

#: Blue, green, red.
_FOUND, _PROJECTED, _GRID, _HORIZON = (0, 200, 0), (0, 0, 255), (0, 200, 255), (255, 120, 0)
#: Width that small pictures are enlarged to (px), and of the rectified floor.
_LEAST_WIDTH_PX, _RECTIFIED_PX = 900, 800
#: Floor that is drawn: to the left and right, and ahead (m), and from one line to the next.
_ASIDE_M, _AHEAD_M, _GRID_M = 3.0, 6.0, 0.5
_STEPS = 400


def drawn_corners(image: Picture, calibration: Calibration, view: int) -> Picture:
    """A board's points where they were found (circles) and where they project (crosses)."""
    points, estimate = calibration.points, calibration.adjusted.estimate
    first = int(points.starts[view])
    rows = slice(first, first + int(points.counts[view]))
    found = points.pixels[rows]
    projected = project_estimate(estimate, points)[0][rows]
    picture, scale = _enlarged(image)
    for place in found:
        cv2.circle(picture, _dot(place, scale), 7 * 8, _FOUND, 1, cv2.LINE_AA, 3)
    for place in projected:
        cv2.drawMarker(
            picture, _whole(place, scale), _PROJECTED, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA
        )
    rms = float(np.sqrt(np.mean(np.sum((found - projected) ** 2, axis=1))))
    return _captioned(
        picture, f"{calibration.names[view]}: found (o), projected (+), RMS {rms:.2f} px"
    )


def drawn_floor(image: Picture, camera: Camera) -> Picture:
    """The floor's grid and the horizon in a photograph."""
    picture, scale = _enlarged(image)
    along = np.linspace(-_ASIDE_M, _ASIDE_M, _STEPS)
    ahead = -np.linspace(0.0, _AHEAD_M, _STEPS)
    for y in -np.arange(0.0, _AHEAD_M + 0.01, _GRID_M):
        line = camera.project_floor(np.column_stack([along, np.full(_STEPS, y)]))
        _polyline(picture, line, scale, _GRID, 2 if y % 1.0 == 0.0 else 1)
    for x in np.arange(-_ASIDE_M, _ASIDE_M + 0.01, _GRID_M):
        line = camera.project_floor(np.column_stack([np.full(_STEPS, x), ahead]))
        _polyline(picture, line, scale, _GRID, 2 if x % 1.0 == 0.0 else 1)
    for y in range(1, int(_AHEAD_M) + 1):
        _label(picture, camera.project_floor([0.0, -float(y)]), scale, f"{y} m", _GRID)
    bearing = np.linspace(-np.pi, np.pi, 4 * _STEPS)
    level = np.column_stack([np.sin(bearing), -np.cos(bearing), np.zeros(4 * _STEPS)])
    _polyline(picture, camera.project_robot(camera.centre + 1e6 * level), scale, _HORIZON, 2)
    return _captioned(
        picture, f"floor: a line every {_GRID_M:g} m, whole metres thick; blue: the horizon"
    )


def rectified_floor(image: Picture, camera: Camera) -> Picture:
    """The floor from above, ahead is up: what lies flat on it has its true shape."""
    per_metre = _RECTIFIED_PX / (2.0 * _ASIDE_M)
    height = round(_AHEAD_M * per_metre)
    u, v = np.meshgrid(np.arange(_RECTIFIED_PX), np.arange(height))
    # X is to the left, Y backward.
    xy = np.stack([_ASIDE_M - (u + 0.5) / per_metre, (v + 0.5) / per_metre - _AHEAD_M], axis=-1)
    pixels = np.nan_to_num(camera.project_floor(xy), nan=-1e4).astype(np.float32)
    seen = cv2.remap(image, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderValue=0)
    picture = np.asarray(cv2.cvtColor(seen, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for y in range(int(_AHEAD_M) + 1):
        row = round((_AHEAD_M - y) * per_metre)
        cv2.line(picture, (0, row), (_RECTIFIED_PX, row), _GRID, 1)
        cv2.putText(picture, f"{y} m", (4, row - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _GRID, 1)
    for x in np.arange(-_ASIDE_M, _ASIDE_M + 0.01):
        column = round((_ASIDE_M - float(x)) * per_metre)
        cv2.line(picture, (column, 0), (column, height), _GRID, 1)
    return _captioned(picture, "the floor from above; ahead is up, a line every metre")


def _enlarged(image: Picture) -> tuple[Picture, float]:
    """The image in colour and large enough to draw into, and how much it is enlarged."""
    scale = float(max(1, round(_LEAST_WIDTH_PX / image.shape[1])))
    size = int(scale * image.shape[1]), int(scale * image.shape[0])
    large = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(large, cv2.COLOR_GRAY2BGR), dtype=np.uint8), scale


def _dot(place: FloatArray, scale: float) -> tuple[int, int]:
    """A place in eighths of the enlarged picture's pixels."""
    u, v = np.rint(8.0 * ((place + 0.5) * scale - 0.5)).astype(int).tolist()
    return u, v


def _whole(place: FloatArray, scale: float) -> tuple[int, int]:
    u, v = np.rint((place + 0.5) * scale - 0.5).astype(int).tolist()
    return u, v


def _polyline(
    picture: Picture, line: FloatArray, scale: float, colour: tuple[int, int, int], width: int
) -> None:
    """Draw what of a line is seen, in pieces."""
    reach = 2.0 * max(picture.shape)
    near = np.isfinite(line).all(axis=1) & (np.abs(np.nan_to_num(line)) < reach).all(axis=1)
    for first, last in zip(line[:-1][near[:-1] & near[1:]], line[1:][near[:-1] & near[1:]]):
        cv2.line(picture, _dot(first, scale), _dot(last, scale), colour, width, cv2.LINE_AA, 3)


def _label(
    picture: Picture, place: FloatArray, scale: float, text: str, colour: tuple[int, int, int]
) -> None:
    if np.isfinite(place).all() and np.abs(place).max() < 1e4:
        u, v = _whole(place, scale)
        cv2.putText(picture, text, (u + 4, v - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1)


def _captioned(picture: Picture, text: str) -> Picture:
    band = np.full((24, picture.shape[1], 3), 255, np.uint8)
    cv2.putText(band, text, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([picture, band])
