"""Straight pixels, quadrangles of them, and homographies of squares.

Edges of markers are straight only in a pinhole image. All fits to edges therefore use *straight*
positions, ``(scale x + offset)`` of the undistorted normalised coordinates, and their results are
distorted again. The rough corners of a region are those of the quadrangle of largest area in its
hull (algorithm B of RAWSEEDS deliverable D2.1 part 2, which searches by coordinate ascent, this
module over all diagonals). A square is (0, 0) top left, (1, 0), (1, 1) bottom right, (0, 1).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import cv2
import numpy as np

from camera import Camera
from detect.grey_values import estimate_noise, plain_image
from redetect.array_types import BoolArray, Float32Array, FloatArray, GreyImage
from redetect.compiled import kernel

#: Number of rows from which the image's noise is estimated.
_NOISE_ROWS = 64

#: Reasons for rejection, as reported.
UNSEEN = "where the lens sees nothing"
NOT_FOUR_CORNERS = "not four corners"
NO_QUADRANGLE = "no quadrangle"
#: Quadrangles whose corners are all this near (pixels, and in widths) are duplicates.
_SAME_PX, _SAME_WIDTHS = 1.0, 0.08
_NEXT = np.array([1, 2, 3, 0])
_SQUARE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]])


@dataclass(frozen=True, eq=False)
class Picture:
    """An image, the standard deviation of its noise, and its camera, if known."""

    grey: GreyImage  # (H, W)
    noise: float
    camera: Camera | None
    straight: Float32Array  # (H, W, 2) straight position of each pixel; NaN past the lens's fold

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """(N, 2) straight positions of (N, 2) pixels."""
        return pixels if self.camera is None else _straightened(self.camera, pixels)

    def distort(self, straight: FloatArray) -> FloatArray:
        """(N, 2) pixels of (N, 2) straight positions; NaN if there is none."""
        c = self.camera
        if c is None:
            return straight
        return c.distort((straight - [c.offset_x, c.offset_y]) / [c.scale_x, c.scale_y])

    def pixel_jacobians(self, pixels: FloatArray) -> FloatArray:
        """(N, 2, 2) d(pixel) / d(straight position) at (N, 2) pixels."""
        c = self.camera
        if c is None:
            return np.tile(np.eye(2), (len(pixels), 1, 1))
        return c.distort_jacobian(c.undistort(pixels)) / [c.scale_x, c.scale_y]


def picture_of(image: GreyImage, camera: Camera | None) -> Picture:
    """An image (H, W) with its noise and the distortion of its lens.

    Raises FrameError if the image is not an 8-bit grey image of the camera's size.
    """
    grey = plain_image(image, None if camera is None else (camera.height, camera.width))
    height, width = grey.shape
    noise = estimate_noise(grey, _NOISE_ROWS)
    return Picture(grey, noise, camera, _straight_positions(camera, width, height))


@functools.lru_cache(maxsize=4)
def _straight_positions(camera: Camera | None, width: int, height: int) -> Float32Array:
    pixels = np.moveaxis(np.mgrid[:height, :width][::-1], 0, -1).astype(np.float64)
    return np.asarray(pixels if camera is None else _straightened(camera, pixels), np.float32)


def _straightened(camera: Camera, pixels: FloatArray) -> FloatArray:
    scale, offset = [camera.scale_x, camera.scale_y], [camera.offset_x, camera.offset_y]
    return np.asarray(np.add(camera.undistort(pixels) * scale, offset))


def rough_corners(hull: FloatArray) -> FloatArray | None:
    """Four corners (4, 2) of a region from its convex hull (N, 2); None if that has fewer.

    Clockwise as seen in the image; the first is arbitrary.
    """
    if len(hull) < 4:
        return None
    corners = hull[list(largest_quadrangle(hull))]
    return np.ascontiguousarray(corners if signed_area(corners) > 0.0 else corners[::-1])


@kernel()
def largest_quadrangle(points: FloatArray) -> tuple[int, int, int, int]:
    """Indices of the largest quadrangle among points (N, 2), in order.

    For each diagonal, the highest triangles on both sides are combined.
    """
    n = len(points)
    largest, best = -1.0, (0, 0, 0, 0)
    for i in range(n - 2):
        for k in range(i + 2, n):
            dx, dy = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1]
            low, high, at_low, at_high = 0.0, 0.0, i, k
            for j in range(n):
                height = dx * (points[j, 1] - points[i, 1]) - dy * (points[j, 0] - points[i, 0])
                if height < low:
                    low, at_low = height, j
                elif height > high:
                    high, at_high = height, j
            if high - low > largest:
                largest, best = high - low, (i, at_low, k, at_high)
    return best


def signed_area(corners: FloatArray) -> FloatArray:
    """(...,) areas of quadrangles (..., 4, 2); positive if clockwise in the image (v down)."""
    a, b = corners[..., 2, :] - corners[..., 0, :], corners[..., 3, :] - corners[..., 1, :]
    return np.asarray(0.5 * (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]))


def is_convex(corners: FloatArray) -> bool:
    """Whether a clockwise quadrangle (4, 2) is strictly convex."""
    along = corners[_NEXT] - corners
    return bool(np.all(along[:, 0] * along[_NEXT, 1] > along[:, 1] * along[_NEXT, 0]))


def covered(quadrangle: FloatArray, others: FloatArray) -> bool:
    """Whether a quadrangle (4, 2) contains the centre of one of `others` (N, 4, 2), or vice versa.

    All are clockwise and convex.
    """

    def inside(corners: FloatArray, point: FloatArray) -> BoolArray:
        side, to = corners[..., _NEXT, :] - corners, point[..., None, :] - corners
        return np.asarray(np.all(side[..., 0] * to[..., 1] > side[..., 1] * to[..., 0], axis=-1))

    middles = others.mean(axis=1)
    return bool(np.any(inside(others, quadrangle.mean(axis=0)) | inside(quadrangle, middles)))


def count_same(first: FloatArray, others: FloatArray) -> int:
    """Number of quadrangles (N, 4, 2) with the same corners as the first, in any order."""
    apart = np.abs(first[:, None] - others[:, None]).max(axis=-1)
    farthest = apart.min(axis=2).max(axis=1)
    largest = _SAME_PX + _SAME_WIDTHS * np.sqrt(np.abs(signed_area(others)))
    return int(np.count_nonzero(farthest <= largest))


def square_homography(corners: FloatArray) -> FloatArray:
    """(3, 3) homography from the unit square to four corners (4, 2); its last entry is 1."""
    square = _SQUARE[:, :2].astype(np.float32)
    return np.asarray(cv2.getPerspectiveTransform(square, corners.astype(np.float32)))


def corners_of(homography: FloatArray) -> FloatArray:
    """(4, 2) corners of the unit square, mapped by a homography (3, 3)."""
    projected = _SQUARE @ homography.T
    return np.asarray(projected[:, :2] / projected[:, 2:])


def corners_by_homography(homography: FloatArray) -> FloatArray:
    """(8, 8) d(x0, y0, x1 ... y3) / d(h00, h01, h02, h10, h11, h12, h20, h21)."""
    shares = _SQUARE / (_SQUARE @ homography[2])[:, None]
    result = np.zeros((4, 2, 8))
    result[:, 0, :3] = result[:, 1, 3:6] = shares
    result[:, :, 6:] = -corners_of(homography)[:, :, None] * shares[:, None, :2]
    return result.reshape(8, 8)
