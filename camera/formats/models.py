"""The distortion models of other programs: OpenCV, ROS, Kalibr and COLMAP.

All of them are pinhole cameras with pixel centres at integers (COLMAP's half a pixel is subtracted
where its files are read) and a distortion of normalised coordinates x = X/Z, y = Y/Z:

radtan
    k1 k2 p1 p2 k3: polynomial in r^2, with Brown's tangential terms.
rational
    k1 k2 p1 p2 k3 k4 k5 k6: the same over 1 + k4 r^2 + k5 r^4 + k6 r^6.
fisheye
    k1 k2 k3 k4: polynomial in the angle (Kannala and Brandt; OpenCV's fisheye, ROS's and Kalibr's
    equidistant).

References
----------
OpenCV, Camera Calibration and 3D Reconstruction; COLMAP, src/colmap/sensor/models.h.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import cv2
import numpy as np

from camera.distortion import Tangential
from camera.errors import ConversionError
from camera.model import inverse_2x2
from redetect.array_types import FloatArray
from redetect.messages import excerpt

Model = Literal["radtan", "rational", "fisheye"]

#: Number of coefficients that `ForeignCamera.distortion` holds for each model.
COEFFICIENTS: dict[Model, int] = {"radtan": 5, "rational": 8, "fisheye": 4}

#: Place of p1, before p2, in those of `radtan` and `rational`.
P1 = 2

_LARGEST_SIDE_PX = 65536
# Number of steps from the image's centre in which the inverse is found.
_WALK = 24
_NEWTON_STEPS = 20
_ROUNDING_PX, _CONVERGED_PX = 1e-12, 1e-7
# Number of places between the centre and a pixel at which a fold would be noticed.
_WAY = 96


@dataclass(frozen=True)
class ForeignCamera:
    """A camera in another program's model.

    A ConversionError is raised if a number is not finite, or a size or focal length not positive.
    """

    model: Model  #: `radtan`, `rational` or `fisheye`
    #: Size of the image, pixels
    width: int
    height: int
    #: Focal lengths and principal point in pixels; the top left pixel's centre is (0, 0)
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]  #: All coefficients of the model, in the order above

    def __post_init__(self) -> None:
        for name, side in (("width", self.width), ("height", self.height)):
            if not 1 <= side <= _LARGEST_SIDE_PX:
                raise ConversionError(
                    f"{name} is {excerpt(side)}: expected 1 to {_LARGEST_SIDE_PX} pixels"
                )
        numbers = (*self.pinhole, *self.distortion)
        if not np.all(np.isfinite(numbers)):
            raise ConversionError(f"a number of the camera is not finite: {excerpt(numbers)}")
        if min(self.fx, self.fy) <= 0.0:
            raise ConversionError(
                f"focal lengths are {self.fx:g} and {self.fy:g}: expected pixels above 0"
            )
        if len(self.distortion) != COEFFICIENTS[self.model]:
            raise ConversionError(
                f"{self.model} has {len(self.distortion)} coefficients: expected "
                f"{COEFFICIENTS[self.model]}"
            )

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy."""
        return self.fx, self.fy, self.cx, self.cy

    @property
    def tangential(self) -> Tangential:
        """p1 and p2, which mean the same in all models that have them."""
        if self.model == "fisheye":
            return 0.0, 0.0
        return self.distortion[P1], self.distortion[P1 + 1]

    @property
    def matrix(self) -> list[float]:
        """The 9 numbers of the camera matrix, row by row."""
        return [self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0]

    def distort(self, normalised: FloatArray) -> FloatArray:
        """(..., 2) pixels of (..., 2) undistorted normalised coordinates."""
        return self._seen(normalised.reshape(-1, 2)).pixels.reshape(normalised.shape)

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """(N, 2) undistorted normalised coordinates of (N, 2) pixels.

        NaN past a fold of the distortion, and 90 degrees and more off the lens's axis. Newton's
        method, continued outwards from the centre to avoid branches past a fold.
        """
        centre = np.array([self.cx, self.cy])
        xy = np.zeros_like(pixels)
        with np.errstate(all="ignore"):
            for share in np.linspace(0.0, 1.0, _WALK + 1)[1:]:
                target = centre + share * (pixels - centre)
                for _ in range(_NEWTON_STEPS):
                    seen = self._seen(xy)
                    off = target - seen.pixels
                    xy = xy + (inverse_2x2(seen.by_normalised) @ off[..., None])[..., 0]
                    if not np.any(np.abs(off) >= _ROUNDING_PX):
                        break
            there = np.abs(self._seen(xy).pixels - pixels).max(axis=-1) < _CONVERGED_PX
            # A place beyond a fold may be seen at the same pixel, but there is a fold on the way.
            for share in np.linspace(0.0, 1.0, _WAY + 1)[1:]:
                there &= np.linalg.det(self._seen(share * xy).by_normalised) > 0.0
        return np.where(there[:, None], xy, np.nan)

    def _seen(self, normalised: FloatArray) -> Projected:
        return projected(self.model, np.array([*self.pinhole, *self.distortion]), normalised)


class Projected(NamedTuple):
    """Where N places are seen."""

    pixels: FloatArray  # (N, 2)
    by_parameters: FloatArray  # (N, 2, P) derivatives with respect to `parameters`
    by_normalised: FloatArray  # (N, 2, 2) derivatives with respect to `normalised`


def projected(model: Model, parameters: FloatArray, normalised: FloatArray) -> Projected:
    """Project undistorted normalised coordinates (N, 2), by OpenCV.

    `parameters` (P,) are fx, fy, cx, cy and the coefficients of the model.
    """
    fx, fy, cx, cy = parameters[:4]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    points = np.column_stack([normalised, np.ones(len(normalised))])[:, None]
    nowhere = np.zeros(3)
    # Derivatives with respect to the pose precede those to the parameters; a fisheye's follow them.
    if model == "fisheye":
        seen = cv2.fisheye.projectPoints(points, nowhere, nowhere, matrix, parameters[4:])
        own, translation = 0, 11
    else:
        seen = cv2.projectPoints(points, nowhere, nowhere, matrix, parameters[4:])
        own, translation = 6, 3
    pixels, derivatives = (np.asarray(part, np.float64) for part in seen)
    derivatives = derivatives.reshape(len(points), 2, -1)
    return Projected(
        pixels.reshape(-1, 2),
        derivatives[..., own : own + len(parameters)],
        derivatives[..., translation : translation + 2],
    )
