"""Corners of a ChArUco board: OpenCV reads the markers, and each corner is measured on its edges.

The markers fill most of the white squares. A window around a corner thus contains marker edges,
which bias the corner. Instead, two strips along the corner's own edges are measured, as wide as the
white margin between edge and marker. Corners whose markers were not read (small, oblique or cut off
by the image's border) are searched at positions predicted from their neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from scipy.ndimage import binary_dilation

from camera.boards.board import Board, charuco_of
from camera.errors import CalibrationError
from redetect.array_types import FloatArray, GreyImage, IntArray

# Greatest length of the strips along the edges, in squares and in pixels: the lens bends edges.
_ALONG, _LONGEST_PX = 0.4, 16.0
# Largest and smallest half-width of a strip (px).
_WIDEST_PX, _NARROWEST_PX = 3.0, 1.2
# By blur and the width of the gradient filter, the marker's edge reaches this far into the margin.
_REACH_PX = 1.5
_FARTHEST = 0.25  # From the predicted position, in squares.
_LEAST_AGREEMENT = 0.85  # Correlation with the printed pattern.
_ITERATIONS, _STILL_PX = 40, 1e-4
# Number of neighbours from which a missing corner is predicted.
_NEIGHBOURS = 12
# Fewest corners that determine a plane.
_FEWEST_FOUND = 4


def find_charuco(image: GreyImage, board: Board) -> tuple[IntArray, FloatArray]:
    """Which of a ChArUco board's points are in an image, ascending, and their (K, 2) pixels.

    K may be 0. A dictionary that is unknown, or too small for the board, is refused.
    """
    rows, columns = board.rows - 1, board.columns - 1
    grid = np.full((rows, columns, 2), np.nan)
    indices, pixels = _interpolated(image, board)
    if len(indices) < _FEWEST_FOUND:
        return np.empty(0, dtype=np.int64), np.empty((0, 2))
    grid[indices // columns, indices % columns] = pixels
    grid = measured_corners(image, grid, board.marker_m / board.square_m)
    found = np.flatnonzero(np.isfinite(grid[..., 0]).ravel())
    return found, grid.reshape(-1, 2)[found]


def _interpolated(image: GreyImage, board: Board) -> tuple[IntArray, FloatArray]:
    """Corners between the markers that OpenCV reads, in the image or in one of twice the height."""
    detector = cv2.aruco.CharucoDetector(charuco_of(board))
    best = np.empty(0, dtype=np.int64), np.empty((0, 2))
    for picture, in_image in both_heights(image):
        try:
            corners, identities, _, _ = detector.detectBoard(picture)
        except cv2.error as error:
            raise CalibrationError(f"no {board} in the image: OpenCV says {error.err}") from None
        if identities is None or len(identities) <= len(best[0]):
            continue
        found = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        best = np.asarray(identities, dtype=np.int64).ravel(), in_image(found)
        if len(best[0]) == (board.columns - 1) * (board.rows - 1):
            break
    return best


def both_heights(
    image: GreyImage,
) -> Iterator[tuple[GreyImage, Callable[[FloatArray], FloatArray]]]:
    """The image, and the image stretched to twice its height, each with its map of pixels back.

    Half-height images flatten squares and circles; their row v is at 2 v + 0.5 when stretched.
    """
    yield image, lambda pixels: pixels
    height, width = image.shape
    taller = cv2.resize(image, (width, 2 * height), interpolation=cv2.INTER_LINEAR)
    yield (
        np.asarray(taller, dtype=np.uint8),
        lambda pixels: np.column_stack([pixels[:, 0], 0.5 * (pixels[:, 1] - 0.5)]),
    )


def measured_corners(image: GreyImage, grid: FloatArray, marker_share: float) -> FloatArray:
    """Measure a (rows, columns, 2) grid of corners on their edges, and search those that are NaN.

    `marker_share` is the side of the markers in squares. Corners that cannot be seen stay NaN.
    """
    grey = image.astype(np.float64)
    slopes = [cv2.Scharr(grey, cv2.CV_64F, 1, 0), cv2.Scharr(grey, cv2.CV_64F, 0, 1)]
    gradient = np.array(slopes, dtype=np.float64)
    white = 0.5 * (1.0 - marker_share)
    known, result = grid, np.full(grid.shape, np.nan)
    wanted, tried = np.isfinite(grid[..., 0]), np.zeros(grid.shape[:2], dtype=bool)
    # First the given corners, then, ring by ring, the neighbours of those found.
    while wanted.any():
        present = np.isfinite(known[..., 0])
        # (3, 3) from (column, row) to pixels, by all corners; None if they are on a line.
        places, pixels = np.argwhere(present)[:, ::-1].astype(np.float64), known[present]
        if len(places) < _FEWEST_FOUND:
            break
        homography: FloatArray | None = cv2.findHomography(places, pixels)[0]  # type: ignore[assignment]
        if homography is None:
            break
        for row, column in np.argwhere(wanted):
            at, axes = _expected(homography, places, pixels, np.array([column, row], float))
            if present[row, column]:
                at = known[row, column]
            parity = int(row + column) % 2
            result[row, column] = _measured(grey, gradient, at, axes, white, parity)
        known, tried = result, tried | wanted
        wanted = binary_dilation(np.isfinite(result[..., 0]), np.ones((3, 3))) & ~tried
    return result


def _expected(
    homography: FloatArray, places: FloatArray, pixels: FloatArray, here: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where a corner is expected, (2,), and the pixels of a square to the right and down, (2, 2).

    The homography of all corners, plus the deviation of the nearest ones, due to the lens. Takes
    the `places` (column, row) of known corners, their pixels, and the corner's place.
    """
    near = np.argsort(np.sum((places - here) ** 2, axis=1), kind="stable")[:_NEIGHBOURS]
    relative = places[near] - here
    differs = pixels[near] - _mapped(homography, places[near])
    bend = np.linalg.lstsq(np.insert(relative, 0, 1.0, axis=1), differs, rcond=None)[0]
    step = 0.5 * np.eye(2)
    slope = _mapped(homography, here + step) - _mapped(homography, here - step)
    at = _mapped(homography, here[None])[0] + bend[0]
    return np.asarray(at), np.asarray((slope + bend[1:]).T)


def _mapped(homography: FloatArray, places: FloatArray) -> FloatArray:
    return np.asarray(cv2.perspectiveTransform(places[None], homography)[0])


def _measured(
    grey: FloatArray,
    gradient: FloatArray,
    start: FloatArray,
    axes: FloatArray,
    white: float,
    parity: int,
) -> FloatArray:
    """A corner as the point that its edges' gradients are at right angles to (Foerstner 1987).

    The columns of `axes` are the pixels of one square to the right and one down; `white` is the
    margin's width in squares; `parity` is 0 where the square right below is black. NaN if none.
    """
    nothing = np.full(2, np.nan)
    area = abs(float(np.linalg.det(axes)))
    if not np.isfinite(area) or area < 9.0 or not np.all(np.isfinite(start)):
        return nothing
    # Width of a square across the edge to the right (rows) and across the one down (columns).
    across = area / np.linalg.norm(axes, axis=0)
    half_px = np.clip(white * across - _REACH_PX, _NARROWEST_PX, _WIDEST_PX)
    to_squares = np.linalg.inv(axes)
    # Large enough for the window at any position within the search range.
    extent = (_ALONG + _FARTHEST) * np.abs(axes).sum(axis=1) + 1.0
    low = np.maximum(np.floor(start - extent), 1.0).astype(int)
    high = np.minimum(np.ceil(start + extent), np.array(grey.shape[::-1]) - 2.0).astype(int)
    if np.any(high - low < 4):
        return nothing
    u, v = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1).astype(np.float64)
    slope = gradient[:, low[1] : high[1] + 1, low[0] : high[0] + 1].reshape(2, -1)
    at = start
    for _ in range(_ITERATIONS):
        square = (pixels - at) @ to_squares.T
        weighted = slope * _strips(square, across, half_px)
        normal = weighted @ slope.T
        if np.linalg.det(normal) <= 1e-3 * normal[0, 0] * normal[1, 1]:
            return nothing
        step = np.linalg.solve(normal, weighted @ np.sum(slope.T * (pixels - at), axis=1))
        at = at + step
        if np.any(np.abs(to_squares @ (at - start)) > _FARTHEST):
            return nothing
        if np.abs(step).max() < _STILL_PX:
            break
    if not np.all((at >= low) & (at <= high)):
        return nothing
    square = (pixels - at) @ to_squares.T
    window = grey[low[1] : high[1] + 1, low[0] : high[0] + 1].ravel()
    weight = _strips(square, across, half_px)
    agreement = _agreement(window, square * across[::-1], weight, parity)
    return at if agreement >= _LEAST_AGREEMENT else nothing


def _strips(square: FloatArray, across: FloatArray, half_px: FloatArray) -> FloatArray:
    """Weights of pixels at places in squares from the corner: the strips, with soft ends."""
    away = np.abs(square)
    # Pixels to the edge that goes right (along which x grows), and to the one that goes down.
    right = np.clip(half_px[0] + 0.5 - away[:, 1] * across[0], 0.0, 1.0)
    down = np.clip(half_px[1] + 0.5 - away[:, 0] * across[1], 0.0, 1.0)
    near = np.clip(1.0 - away / np.minimum(_ALONG, _LONGEST_PX / across[::-1]), 0.0, 1.0)
    return np.asarray(np.maximum(right * near[:, 0], down * near[:, 1]))


def _agreement(window: FloatArray, away_px: FloatArray, weight: FloatArray, parity: int) -> float:
    """Weighted correlation of grey values with the print: +1 as printed, -1 its negative."""
    soft = np.clip(away_px / _REACH_PX, -1.0, 1.0)
    light = soft[:, 0] * soft[:, 1] * (-1.0 if parity == 0 else 1.0)
    if weight.sum() <= 0.0:
        return 0.0
    covariance = np.cov(window, light, bias=True, aweights=weight)
    both = covariance[0, 0] * covariance[1, 1]
    return float(covariance[0, 1] / np.sqrt(both)) if both > 0.0 else 0.0
