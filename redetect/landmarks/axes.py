"""Axes of the data set's robot, and those of other tools.

The data set's robot has X left and Y backward; other tools expect X forward and Y left. One
rotation about Z by a quarter turn, ``p_robotics = Rz p_dataset`` with ``(x, y) -> (-y, x)``, leads
from the first to the second. It is applied to the robot's frame and to the map's alike: a pose or
step T becomes Rz T Rz^-1, that is, its position is rotated and its angle stays. Covariances become
Rz C Rz^T; rotating the means alone would leave ellipses across instead of along. Bearings count
from forward, positive to the left, in both.

All is done by exchanging numbers and signs: nothing is rounded, and there and back gives the same
bits.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray, IntArray

Axes = Literal["robotics", "dataset"]

#: What each kind of axes means.
MEANING: dict[str, str] = {
    "robotics": "X forward, Y left",
    "dataset": "X left, Y backward",
}

# Which of the old coordinates becomes the new first, second, third, and with which sign; on the way
# back it is the sign of the first two that differs.
_ORDER = np.array([1, 0, 2])
_SIGNS = np.array([-1.0, 1.0, 1.0])


def from_dataset(values: ArrayLike, axes: Axes = "robotics", *, back: bool = False) -> FloatArray:
    """Vectors, poses or steps in the data set's axes, brought into others, or `back`.

    Takes (..., 2) or (..., 3): x, y and, of poses and steps, the angle; returns the same shape.
    """
    old = np.array(values, dtype=np.float64)
    if axes == "dataset":
        return old
    order, sign = _turn(old.shape[-1], back)
    return np.asarray(old[..., order] * sign)


def to_dataset(values: ArrayLike) -> FloatArray:
    """Undo `from_dataset`."""
    return from_dataset(values, back=True)


def covariance_from_dataset(
    covariance: ArrayLike, axes: Axes = "robotics", *, back: bool = False
) -> FloatArray:
    """Covariances (or information matrices) (..., d, d) of what `from_dataset` turns, turned."""
    old = np.array(covariance, dtype=np.float64)
    if axes == "dataset":
        return old
    order, sign = _turn(old.shape[-1], back)
    return np.asarray(old[..., order[:, None], order] * np.outer(sign, sign))


def _turn(size: int, back: bool) -> tuple[IntArray, FloatArray]:
    order = _ORDER[:size]
    return order, (_SIGNS[order] if back else _SIGNS[:size])
