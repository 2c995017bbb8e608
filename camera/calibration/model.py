"""Model of the calibration: the projection with its derivatives, and which parameters are free.

Intrinsics are always the vector ``(scaleX, scaleY, offsetX, offsetY, a2, a3, b1, b2, b3, p1, p2,
k1, k2, k3)``, the order of the ``.cam`` file. The columns of a matrix `span` are the free ones:
equal scales are one column, and a coefficient that is kept at 0 has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from camera import distortion
from camera.errors import CalibrationError
from camera.model import normalised_points
from camera.model_checks import border_pixels
from redetect.array_types import FloatArray
from redetect.bounds import ABOVE_0, demand, whole

#: Names of the intrinsics, in order.
INTRINSICS = (
    "scaleX", "scaleY", "offsetX", "offsetY", "a2", "a3", "b1", "b2", "b3", "p1", "p2", "k1", "k2",
    "k3",
)  # fmt: skip

#: Their number.
COUNT = len(INTRINSICS)

#: Names of the tangential terms.
TANGENTIAL = ("p1", "p2")

#: Names of the even polynomial's coefficients.
POLYNOMIAL = ("k1", "k2", "k3")

#: Power of r that each distortion coefficient goes with, relative to the radius.
POWERS = np.array([1.0, 2.0, 1.0, 2.0, 3.0, 1.0, 1.0, 2.0, 4.0, 6.0])

#: Which coefficients are free, by their number: even powers first, for a lens is smooth in its
#: middle; then what the published camera needs.
FREE_COEFFICIENTS: tuple[tuple[str, ...], ...] = (
    (),
    ("a3",),
    ("a3", "b2"),
    ("a3", "b1", "b2"),
    ("a3", "b1", "b2", "b3"),
    ("a2", "a3", "b1", "b2", "b3"),
)

# The image's border must be seen at radii that stay below the fold by this share.
_FOLD_MARGIN = 0.01
# A pole must be farther than the image by this share.
_POLE_MARGIN = 0.1
# Directions in which a lens's limit is computed, and number of places on each side of the image.
_ANGLES = np.linspace(-np.pi, np.pi, 128)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
_BORDER_PLACES = 9


def lens_of(intrinsics: FloatArray) -> distortion.Lens:
    """The distortion of an intrinsics vector."""
    a2, a3, b1, b2, b3, p1, p2, k1, k2, k3 = intrinsics[4:].tolist()
    return distortion.Lens((a2, a3, b1, b2, b3), (k1, k2, k3), (p1, p2))


def pixels_of_points(intrinsics: FloatArray, points_camera: FloatArray) -> FloatArray:
    """The (N, 2) pixels of `project_points`, without derivatives: a third of its time."""
    lens = lens_of(intrinsics)
    xy = distortion.before_fold(normalised_points(points_camera)[0], lens)
    return np.asarray(intrinsics[:2] * distortion.distort(xy, lens) + intrinsics[2:4])


def project_points(
    intrinsics: FloatArray, points_camera: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels of points in the camera frame and their derivatives.

    Takes `intrinsics` (14,), `points_camera` (N, 3); returns `pixels` (N, 2), `by_intrinsics` (N,
    2, 14), `by_point` (N, 2, 3).
    """
    scale, offset = intrinsics[:2], intrinsics[2:4]
    lens = lens_of(intrinsics)
    xy = distortion.before_fold(normalised_points(points_camera)[0], lens)
    seen = distortion.distort(xy, lens)
    r = np.hypot(xy[:, 0], xy[:, 1])
    a2, a3, b1, b2, b3 = lens.coef
    denominator = 1.0 + r * (b1 + r * (b2 + r * b3))
    ratio = r * (a2 + r * a3) / denominator

    by_intrinsics = np.zeros((len(r), 2, COUNT))
    by_intrinsics[:, [0, 1], [0, 1]] = seen
    by_intrinsics[:, [0, 1], [2, 3]] = 1.0
    by_factor = (scale * xy)[:, :, None]
    by_coefficient = np.stack([r, r**2, -ratio * r, -ratio * r**2, -ratio * r**3], axis=-1)
    by_intrinsics[:, :, 4:9] = by_factor * (by_coefficient / denominator[:, None])[:, None, :]
    # By q = (p2, p1).
    by_q = 2.0 * xy[:, :, None] * xy[:, None, :] + (r**2)[:, None, None] * np.eye(2)
    by_intrinsics[:, :, [10, 9]] = scale[:, None] * by_q
    by_intrinsics[:, :, 11:14] = by_factor * (r[:, None] ** [2, 4, 6])[:, None, :]

    by_xy = scale[:, None] * distortion.distorted_jacobian(xy, lens)
    by_depth = -by_xy @ xy[:, :, None]
    by_point = np.concatenate([by_xy, by_depth], axis=-1) / points_camera[:, 2, None, None]
    return scale * seen + offset, by_intrinsics, by_point


def is_possible(intrinsics: FloatArray, width: int, height: int) -> bool:
    """Whether scales are positive, and the image lies within what the lens sees up to its fold."""
    if not np.all(np.isfinite(intrinsics)) or min(intrinsics[:2]) <= 0.0:
        return False
    return _is_within(intrinsics, width, height, share=1.0, margin=_FOLD_MARGIN)


def has_pole(intrinsics: FloatArray, width: int, height: int) -> bool:
    """Whether a possible lens has a pole in the image, or near it.

    All of the image beyond a pole would be seen at nearly one radius.
    """
    size = width, height
    # Before a pole the image grows far beyond its border, before a fold by 1.5 %.
    return not _is_within(intrinsics, *size, share=1.0 - _POLE_MARGIN, margin=0.0) and _is_within(
        intrinsics, *size, share=1.0, margin=_POLE_MARGIN
    )


def _is_within(
    intrinsics: FloatArray, width: int, height: int, *, share: float, margin: float
) -> bool:
    """Whether the image, enlarged by a margin, is within a share of the largest radius."""
    lens = lens_of(intrinsics)
    r = share * min(distortion.one_to_one_radius(lens), distortion.RADIUS_LIMIT)
    border = (border_pixels(width, height, _BORDER_PLACES) - intrinsics[2:4]) / intrinsics[:2]
    reach = _reach(r, lens, border)
    return bool(np.all(np.hypot(border[:, 0], border[:, 1]) * (1.0 + margin) < reach))


def _reach(r: float, lens: distortion.Lens, towards: FloatArray) -> FloatArray:
    """Distorted radii of an undistorted one, in the directions of places (N, 2)."""
    if not any(lens.tangential):  # the same in all directions
        return np.asarray(r * distortion.radial_factor(np.array(r), lens))
    edge = distortion.distort(r * _DIRECTIONS, lens)
    return np.interp(
        np.arctan2(towards[:, 1], towards[:, 0]),
        np.unwrap(np.arctan2(edge[:, 1], edge[:, 0])),
        np.hypot(edge[:, 0], edge[:, 1]),
        period=2.0 * np.pi,
    )


def corner_radius(intrinsics: FloatArray, width: int, height: int) -> float:
    """Distorted normalised radius of the image's corner that is farthest from the centre."""
    sx, sy, ox, oy = (float(value) for value in intrinsics[:4])
    x = max(abs(ox), abs(width - 1 - ox)) / sx
    y = max(abs(oy), abs(height - 1 - oy)) / sy
    return float(np.hypot(x, y))


class FreeLens(NamedTuple):
    """Which of the distortion's coefficients are free."""

    coefficients: int  #: Number of the rational ones, 0 to 5 (`FREE_COEFFICIENTS`)
    tangential: bool = False  #: Whether p1 and p2 are
    polynomial: int = 0  #: Number of k1, k2, k3 that are

    def span(self, aspect: float | None) -> FloatArray:
        """(14, K) directions in which intrinsics may change: scales, principal point, coefficients.

        `aspect` is scaleY / scaleX; None: the scales are independent.
        """
        scales = np.zeros((COUNT, 1 if aspect is not None else 2))
        scales[0, 0] = 1.0
        scales[1, -1] = 1.0 if aspect is None else aspect
        others = [INTRINSICS.index(name) for name in ("offsetX", "offsetY", *self.names)]
        return np.hstack([scales, np.eye(COUNT)[:, others]])

    @property
    def names(self) -> list[str]:
        """Names of the free coefficients."""
        radial = [*FREE_COEFFICIENTS[self.coefficients], *POLYNOMIAL[: self.polynomial]]
        return [*radial, *(TANGENTIAL if self.tangential else ())]

    def __str__(self) -> str:
        return " ".join(self.names) or "none"


@dataclass(frozen=True)
class CalibrationSettings:
    """Settings of a calibration; None means automatic, as for the flags of `camera calibrate`."""

    #: scaleY / scaleX: 1 for square pixels, 0.5 for every second line of them; None if both scales
    #: are free
    aspect: float | None = 1.0
    #: Number of free radial coefficients: 0 to 5 of the rational function, 0 to 3 of a polynomial
    coefficients: int | None = None
    tangential: bool | None = None  #: Whether the tangential terms p1 and p2 are free
    polynomial: bool | None = None  #: Whether the radial distortion is the polynomial k1, k2, k3
    robust: bool = True  #: Huber's loss; points found wrongly pull less
    keep_outliers: bool = False

    def __post_init__(self) -> None:
        if self.aspect is not None:
            demand(self, CalibrationError, aspect=ABOVE_0)
        if self.coefficients is not None:
            demand(self, CalibrationError, coefficients=whole(0, self._all))

    @property
    def _all(self) -> int:
        return len(POLYNOMIAL) if self.polynomial else len(FREE_COEFFICIENTS) - 1

    @property
    def most(self) -> int:
        """The largest number of radial coefficients that may be free."""
        return self._all if self.coefficients is None else self.coefficients

    def lens(self, count: int, *, tangential: bool = False) -> FreeLens:
        """The lens with `count` free radial coefficients."""
        return FreeLens(0, tangential, count) if self.polynomial else FreeLens(count, tangential)
