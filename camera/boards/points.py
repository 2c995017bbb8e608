"""Points of a board in an image (OpenCV)."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import center_of_mass

from camera.boards.board import Board
from camera.boards.charuco import both_heights, find_charuco
from camera.errors import CalibrationError
from redetect.array_types import FloatArray, GreyImage, IntArray

# Half the side of the window around a corner, as a share of its squares in the image.
_WINDOW = 0.3
_SMALLEST_HALF_WINDOW, _LARGEST_HALF_WINDOW = 2, 9
_FEWEST_POINTS = 8
# Lengths of the longer side (px) to which an image is reduced, one after the other, to search a
# checkerboard. The time of OpenCV's search grows faster than the image, especially without a board,
# and squares of a few pixels suffice.
_SEARCHED_PX = (1280, 2048)


def find_board(
    image: GreyImage, board: Board, *, window: float = _WINDOW
) -> tuple[IntArray, FloatArray]:
    """Find a board's points in an image.

    Parameters
    ----------
    image : (H, W) uint8 array
    board : Board
    window : float
        Half the side of the window in which a checkerboard's corner is refined, as a share of its
        squares in the image: a larger one averages more, but is more affected by distortion.

    Returns
    -------
    indices : (K,) int64 array
        Indices of `Board.points`, ascending.
    pixels : (K, 2) array
        Their positions (the top left pixel's centre is 0, 0).

    Raises
    ------
    CalibrationError
        If the board is not there, or too little of a ChArUco board is.
    """
    if board.kind == "charuco":
        indices, pixels = find_charuco(image, board)
        if len(indices) < _FEWEST_POINTS:
            raise CalibrationError(
                f"{len(indices)} corners of a {board} in the image: expected at least "
                f"{_FEWEST_POINTS}; is --dictionary {board.dictionary} right, and are the markers "
                "sharp and large enough to be read?"
            )
        return indices, pixels
    try:
        if board.kind == "checkerboard":
            grid = _checkerboard(image, board, window)
        else:
            grid = _circles(image, board)
    except cv2.error:  # as for pictures of a few rows or columns
        raise _not_found(board) from None
    return np.arange(board.columns * board.rows), grid.reshape(-1, 2)


def _not_found(board: Board) -> CalibrationError:
    return CalibrationError(
        f"no {board} in the image: is all of it visible, with a white border, sharp and evenly "
        "lit, and are --columns and --rows right?"
    )


def _checkerboard(image: GreyImage, board: Board, window: float) -> FloatArray:
    for reduced in _reductions(image):
        per_pixel = np.array([image.shape[1] / reduced.shape[1], image.shape[0] / reduced.shape[0]])
        for searched, in_image in both_heights(reduced):
            found, corners = cv2.findChessboardCorners(searched, (board.columns, board.rows))
            if not found:
                continue
            flat = in_image(np.asarray(corners, dtype=np.float64).reshape(-1, 2))
            flat = (flat + 0.5) * per_pixel - 0.5
            grid = flat.astype(np.float32).reshape(board.rows, board.columns, 2)
            return _in_order(image, _refined(image, grid, window))
    raise _not_found(board)


def corners_counted(image: GreyImage) -> tuple[int, int] | None:
    """Count the inner corners of a checkerboard in an image, the larger number first.

    None if none of at least 3 x 3 is found. A part of a board may be mistaken for all of it.
    """
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    for searched, _ in both_heights(next(_reductions(image), image)):
        found, _, meta = cv2.findChessboardCornersSBWithMeta(searched, (3, 3), flags)
        if found:
            rows, columns = np.asarray(meta).shape[:2]
            return max(rows, columns), min(rows, columns)
    return None


def _reductions(image: GreyImage) -> Iterator[GreyImage]:
    """The image in the reduced sizes that are searched, smallest first."""
    height, width = image.shape
    for longest in _SEARCHED_PX:
        if longest >= max(height, width):
            break
        scale = longest / max(height, width)
        reduced = (max(round(scale * width), 1), max(round(scale * height), 1))
        yield np.asarray(cv2.resize(image, reduced, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if max(height, width) <= _SEARCHED_PX[-1]:
        yield image


def _refined(image: GreyImage, grid: NDArray[np.float32], share: float) -> FloatArray:
    """Refine saddle points, each in a window without other features.

    Each corner has its own small window: a larger one is affected by distortion of the edges, and
    attracted by the next corner if it contains that. NaN corners remain NaN.
    """
    half = np.rint(share * _spacing(grid))
    half = np.clip(half, _SMALLEST_HALF_WINDOW, _LARGEST_HALF_WINDOW).astype(int)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    refined = np.full(grid.shape, np.nan)
    present = np.isfinite(grid[..., 0])
    for size in np.unique(half[present], axis=0):
        chosen = np.all(half == size, axis=-1) & present
        corners = np.ascontiguousarray(grid[chosen].reshape(-1, 1, 2))
        window = (int(size[0]), int(size[1]))
        found = cv2.cornerSubPix(image, corners, window, (-1, -1), stop)
        refined[chosen] = np.asarray(found, dtype=np.float64).reshape(-1, 2)
    return refined


def _spacing(grid: NDArray[np.float32]) -> FloatArray:
    """(rows, columns, 2) extent of a square at each corner along u and v, pixels."""
    extents = []
    for axis in (0, 1):
        step = np.abs(np.diff(grid, axis=axis, prepend=np.nan, append=np.nan))
        extents.append(np.fmin(np.delete(step, 0, axis), np.delete(step, -1, axis)))
    # A corner without neighbours gets the smallest windows.
    return np.asarray(np.nan_to_num(np.fmax(*extents)))


def _in_order(image: GreyImage, grid: FloatArray) -> FloatArray:
    """Bring a (rows, columns, 2) grid of corners into the board's own order.

    The board is seen from its printed side, so right x down points into the image; and the square
    right below the first corner is black, as the one beyond it is. A board that looks the same
    turned begins in the image's upper left.
    """
    grid = _from_the_front(grid)
    centres = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    columns = np.clip(np.rint(centres[..., 0]).astype(int), 0, image.shape[1] - 1)
    rows = np.clip(np.rint(centres[..., 1]).astype(int), 0, image.shape[0] - 1)
    grey = image[rows, columns].astype(np.float64)
    even = np.add.outer(np.arange(grey.shape[0]), np.arange(grey.shape[1])) % 2 == 0
    if grey[even].mean() > grey[~even].mean():
        grid = grid[::-1, ::-1]
    return np.ascontiguousarray(grid)


def _from_the_front(grid: FloatArray) -> FloatArray:
    right = grid[:, -1] - grid[:, 0]
    down = grid[-1] - grid[0]
    if np.sum(right[:, 0]) * np.sum(down[:, 1]) < np.sum(right[:, 1]) * np.sum(down[:, 0]):
        return grid[:, ::-1]
    return grid


def _circles(image: GreyImage, board: Board) -> FloatArray:
    flag = cv2.CALIB_CB_SYMMETRIC_GRID if board.kind == "circles" else cv2.CALIB_CB_ASYMMETRIC_GRID
    size = (board.columns, board.rows)
    pictures = image, 255 - image
    # Clustering tolerates more perspective, the plain search more clutter; light circles on a dark
    # ground are dark ones in the negative.
    for heights in zip(*map(both_heights, pictures)):
        for picture, (searched, in_image) in zip(pictures, heights):
            for extra in (0, cv2.CALIB_CB_CLUSTERING):
                found, centres = cv2.findCirclesGrid(searched, size, flags=flag | extra)
                if not found:
                    continue
                flat = in_image(np.asarray(centres, dtype=np.float64).reshape(-1, 2))
                grid = flat.reshape(board.rows, board.columns, 2)
                if board.kind == "circles":
                    grid = _from_the_front(grid)
                return circle_centroids(picture, grid)
    raise _not_found(board)


def circle_centroids(image: GreyImage, grid: FloatArray) -> FloatArray:
    """Area centroids of dark circles at most a radius from places of a (rows, columns, 2) grid.

    Places without a measurable circle are unchanged.
    """
    steps = [np.linalg.norm(np.diff(grid, axis=k), axis=-1) for k in (0, 1)]
    reach = 0.5 * min(each.min(initial=np.inf) for each in steps)
    result = grid.copy()
    for index in np.ndindex(grid.shape[:2]):
        # Twice, because the first window is around the finder's centre.
        for _ in range(2):
            moved = _centroid(image, result[index], reach)
            if moved is None:
                break
            result[index] = moved
    return result


def _centroid(image: GreyImage, at: FloatArray, reach: float) -> FloatArray | None:
    """Centroid of the dark blob in the square window around `at`; None if there is none."""
    half = max(int(reach), 3)
    u, v = np.clip(np.rint(at).astype(int), 0, np.array(image.shape[::-1]) - 1).tolist()
    top, left = max(v - half, 0), max(u - half, 0)
    window = image[top : v + half + 1, left : u + half + 1].astype(np.float64)
    if min(window.shape) < 5:
        return None
    light, dark = np.percentile(window, 90.0), float(image[v, u])
    if light - dark < 20.0:
        return None
    # Paper and ink are uniform; only pixels on the circle's edge have fractional weights.
    weight = np.clip((light - window) / (light - dark), 0.0, 1.0)
    weight[weight < 0.15] = 0.0
    _, labels = cv2.connectedComponents((weight > 0.0).astype(np.uint8), connectivity=4)
    blob = labels == labels[v - top, u - left]
    if blob[0].any() or blob[-1].any() or blob[:, 0].any() or blob[:, -1].any():
        return None  # it is cut off
    row, column = center_of_mass(weight, blob)
    return np.array([left + column, top + row])
