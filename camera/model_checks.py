"""Checks of camera parameters; messages use the names of the ``.cam`` file."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera.distortion import (
    LARGEST_COEFFICIENT,
    first_unseen,
    fold_radius,
    largest_distorted_radius,
    one_to_one_radius,
)
from camera.errors import CameraError

if TYPE_CHECKING:
    from camera.model import Camera, Pose

_ROTATION_TOLERANCE = 1e-3
_LARGEST_SIDE_PX = 65536
#: Least share of the image that must see anything.
LEAST_SEEN_SHARE = 0.5
# Number of places along each side of the image that are checked to be inside the lens's limit.
_PLACES = 65


def check_numbers(camera: Camera) -> None:
    """Refuse sizes, scales and coefficients that are impossible each for itself."""
    for name, side in (("width", camera.width), ("height", camera.height)):
        if not 1 <= side <= _LARGEST_SIDE_PX:
            raise CameraError(f"{name} is {side}: expected 1 to {_LARGEST_SIDE_PX} pixels")
    numbers = {
        "scaleX": camera.scale_x,
        "scaleY": camera.scale_y,
        "offsetX": camera.offset_x,
        "offsetY": camera.offset_y,
    }
    for name, symbols in (
        ("coef", "a2 a3 b1 b2 b3"), ("tangential", "p1 p2"), ("polynomial", "k1 k2 k3"),
    ):  # fmt: skip
        values, expected = getattr(camera, name), symbols.split()
        if len(values) != len(expected):
            raise CameraError(
                f"{name} has {len(values)} numbers: expected {len(expected)} ({symbols})"
            )
        if max(abs(c) for c in values) > LARGEST_COEFFICIENT and all(map(math.isfinite, values)):
            raise CameraError(f"{name} is {values}: expected at most {LARGEST_COEFFICIENT:g} each")
        numbers |= {f"{name} {symbol}": c for symbol, c in zip(expected, values)}
    for name, value in numbers.items():
        if not math.isfinite(value):
            raise CameraError(f"{name} is {value}: expected a finite number")
    for name, value in (("scaleX", camera.scale_x), ("scaleY", camera.scale_y)):
        if value <= 0.0:
            raise CameraError(f"{name} is {value}: expected a positive number of pixels")


def check_one_to_one(camera: Camera) -> None:
    """Refuse a distortion that folds so far inside the image that less than half of it is left."""
    fold = _fold_inside(camera)
    share = seen_share(camera) if fold else 1.0
    if share < LEAST_SEEN_SHARE:
        raise CameraError(
            f"the distortion folds inside the image: {fold}; {100.0 * share:.0f} % of the image "
            f"see anything, expected {100.0 * LEAST_SEEN_SHARE:.0f}"
        )


def seen_share(camera: Camera) -> float:
    """Share of the image's pixels that see anything: 1, if the distortion folds beyond the image.

    Fits of few coefficients often fold in the corners, where no board was.
    """
    if not _fold_inside(camera):
        return 1.0
    middles = (np.arange(_PLACES) + 0.5) / _PLACES
    u, v = camera.width * middles - 0.5, camera.height * middles - 0.5
    with np.errstate(over="ignore", invalid="ignore"):
        seen = camera.undistort(np.stack(np.meshgrid(u, v), axis=-1))
    return float(np.isfinite(seen[..., 0]).mean())


def _fold_inside(camera: Camera) -> str:
    """Where the distortion folds, if it does so inside the image; else nothing."""
    if any(camera.tangential):
        return _fold_inside_border(camera)
    x = max(abs(camera.offset_x), abs(camera.width - 1 - camera.offset_x)) / camera.scale_x
    y = max(abs(camera.offset_y), abs(camera.height - 1 - camera.offset_y)) / camera.scale_y
    corner = math.hypot(x, y)
    seen = largest_distorted_radius(camera.coef, camera.polynomial)
    if corner < seen:
        return ""
    fold = fold_radius(camera.coef, camera.polynomial)
    k1, k2, k3 = camera.polynomial
    values = f"with polynomial k1 = {k1:g}, k2 = {k2:g} and k3 = {k3:g} "
    return (
        f"{values if any(camera.polynomial) else ''}it grows only up to r = {fold:.6g}, seen at "
        f"{seen:.6g}, while the image's corner lies at {corner:.6g}"
    )


def _fold_inside_border(camera: Camera) -> str:
    """What is one-to-one is so within a circle: its image holds the whole image, or it folds."""
    pixels = border_pixels(camera.width, camera.height, _PLACES)
    with np.errstate(over="ignore"):
        border = (pixels - [camera.offset_x, camera.offset_y]) / [camera.scale_x, camera.scale_y]
    unseen = first_unseen(border, camera.coef, camera.brown)
    if unseen < 0:
        return ""
    k1, k2, p1, p2, k3 = camera.brown
    more = f", polynomial k1 = {k1:g}, k2 = {k2:g} and k3 = {k3:g}"
    more = more if any(camera.polynomial) else ""
    u, v = pixels[unseen]
    r_max = one_to_one_radius(camera.coef, camera.brown)
    return (
        f"with tangential p1 = {p1:g} and p2 = {p2:g}{more} it is one-to-one only up to "
        f"r = {r_max:.6g}, which pixel ({u:g}, {v:g}) lies beyond"
    )


def border_pixels(width: int, height: int, places: int) -> NDArray[np.float64]:
    """(4 * places, 2) pixels along the border of an image, each side from corner to corner."""
    along = np.linspace(0.0, 1.0, places)
    zero, one = np.zeros(places), np.ones(places)
    sides = [(along, zero), (along, one), (zero, along), (one, along)]
    unit = np.concatenate([np.stack(side, axis=-1) for side in sides])
    return np.asarray(unit * [width - 1, height - 1], dtype=np.float64)


def checked_pose(name: str, rows: ArrayLike) -> Pose:
    """Check a 3x4 rigid transform and return it as tuples."""
    array = np.asarray(rows, dtype=np.float64)
    if array.shape != (3, 4):
        raise CameraError(f"{name} has shape {array.shape}: expected 3 rows of 4 numbers")
    if not np.all(np.isfinite(array)):
        raise CameraError(f"{name} has a number that is not finite")
    rotation = array[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not deviation <= _ROTATION_TOLERANCE:
        raise CameraError(
            f"{name} is not a rotation: R R^T differs from the identity by {deviation:.3g} "
            f"(at most {_ROTATION_TOLERANCE:g})"
        )
    if np.linalg.det(rotation) < 0.0:
        raise CameraError(f"{name} is not a rotation but a reflection: its determinant is -1")
    return tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in array)


def checked_covariance(numbers: Iterable[float], count: int) -> tuple[float, ...]:
    """Check the lower triangle of a covariance of `count` parameters and return it as a tuple."""
    values = tuple(float(x) for x in numbers)
    expected = count * (count + 1) // 2
    if len(values) != expected:
        raise CameraError(
            f"covariance has {len(values)} numbers: expected {expected}, the lower triangle of "
            f"{count} parameters"
        )
    if not all(map(math.isfinite, values)):
        raise CameraError("covariance has a number that is not finite")
    if min(values[k * (k + 3) // 2] for k in range(count)) < 0.0:
        raise CameraError("covariance has a negative variance")
    return values


def checked_whole(name: str, value: int) -> int:
    """The whole number that a value is, of whatever type."""
    try:
        return operator.index(value)
    except TypeError:
        raise CameraError(f"{name} is {value!r}: expected a whole number") from None
