"""Checks of camera parameters; messages use the names of the ``.cam`` file."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from camera.distortion import LARGEST_COEFFICIENT
from camera.errors import CameraError
from redetect.array_types import BoolArray, FloatArray

if TYPE_CHECKING:
    from camera.model import Camera, Pose

_ROTATION_TOLERANCE = 1e-3
_LARGEST_SIDE_PX = 65536
#: Least share of the image that must see anything.
LEAST_SEEN_SHARE = 0.5
# Number of places along each side of the image that are checked.
_PLACES = 65


def check_numbers(camera: Camera) -> None:
    """Reject sizes, scales and coefficients that are impossible by themselves."""
    for name, side in (("width", camera.width), ("height", camera.height)):
        if not 1 <= side <= _LARGEST_SIDE_PX:
            raise CameraError(f"{name} is {side}: expected 1 to {_LARGEST_SIDE_PX} pixels")
    numbers = dict(zip(("scaleX", "scaleY", "offsetX", "offsetY"), camera.pinhole))
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
    """Reject a distortion whose fold leaves less than half of the image usable."""
    beyond = _first_unseen(camera)
    if beyond is None or (share := seen_share(camera)) >= LEAST_SEEN_SHARE:
        return
    parts = (("tangential", "p1 p2"), ("polynomial", "k1 k2 k3"))
    terms = ", ".join(
        f"{name} {symbols} = {' '.join(f'{value:g}' for value in getattr(camera, name))}"
        for name, symbols in parts
        if any(getattr(camera, name))
    )
    u, v = beyond
    raise CameraError(
        f"the distortion folds inside the image: {f'with {terms} ' if terms else ''}it is "
        f"one-to-one only up to r = {camera.r_max:.6g}, which pixel ({u:g}, {v:g}) lies beyond; "
        f"{100.0 * share:.0f} % of the image see anything, expected {100.0 * LEAST_SEEN_SHARE:.0f}"
    )


def seen_share(camera: Camera) -> float:
    """Share of the image's pixels with a direction: 1 if the distortion folds outside the image.

    Fits with few coefficients often fold in the corners, where there was no board.
    """
    if _first_unseen(camera) is None:
        return 1.0
    middles = (np.arange(_PLACES) + 0.5) / _PLACES
    u, v = camera.width * middles - 0.5, camera.height * middles - 0.5
    return float(_is_seen(camera, np.stack(np.meshgrid(u, v), axis=-1)).mean())


def _first_unseen(camera: Camera) -> FloatArray | None:
    """The first pixel along the border that sees nothing.

    What a lens sees has no holes: it contains an image whose border it contains.
    """
    border = border_pixels(camera.width, camera.height, _PLACES)
    seen = _is_seen(camera, border)
    return None if seen.all() else border[np.argmin(seen)]


def _is_seen(camera: Camera, pixels: FloatArray) -> BoolArray:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.isfinite(camera.undistort(pixels)[..., 0])


@lru_cache(maxsize=16)
def border_pixels(width: int, height: int, places: int) -> FloatArray:
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
