"""The axes of the data set and those of other tools.

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

from redetect.array_types import FloatArray

Axes = Literal["robotics", "dataset"]

#: What each kind of axes means, for the heads of files.
MEANING: dict[str, str] = {
    "robotics": "X forward, Y left",
    "dataset": "X left, Y backward",
}

# Which of the old coordinates becomes the new first, second, third, and with which sign.
_ORDER = np.array([1, 0, 2])
_TO_ROBOTICS = np.array([-1.0, 1.0, 1.0])
_TO_DATASET = np.array([1.0, -1.0, 1.0])


def from_dataset(values: ArrayLike, axes: Axes) -> FloatArray:
    """Vectors, poses or steps in the data set's axes, brought into others.

    Parameters
    ----------
    values : (..., 2) or (..., 3) array_like
        x, y and, of poses and steps, the angle.
    axes : str
        The axes to bring them into.

    Returns
    -------
    float64 of the same shape
    """
    return _turned(values, axes, _TO_ROBOTICS)


def to_dataset(values: ArrayLike, axes: Axes) -> FloatArray:
    """Undo `from_dataset`."""
    return _turned(values, axes, _TO_DATASET)


def covariance_from_dataset(covariance: ArrayLike, axes: Axes) -> FloatArray:
    """Covariances (or information matrices) in the data set's axes, brought into others.

    Parameters
    ----------
    covariance : (..., 2, 2) or (..., 3, 3) array_like
        Of x, y and, of poses and steps, the angle.
    axes : str
        The axes to bring them into.

    Returns
    -------
    float64 of the same shape
    """
    return _turned_covariance(covariance, axes, _TO_ROBOTICS)


def covariance_to_dataset(covariance: ArrayLike, axes: Axes) -> FloatArray:
    """Undo `covariance_from_dataset`."""
    return _turned_covariance(covariance, axes, _TO_DATASET)


def _turned(values: ArrayLike, axes: Axes, sign: FloatArray) -> FloatArray:
    old = np.array(values, dtype=np.float64)
    if axes == "dataset":
        return old
    size = old.shape[-1]
    return np.asarray(old[..., _ORDER[:size]] * sign[:size])


def _turned_covariance(covariance: ArrayLike, axes: Axes, sign: FloatArray) -> FloatArray:
    old = np.array(covariance, dtype=np.float64)
    if axes == "dataset":
        return old
    size = old.shape[-1]
    order = _ORDER[:size]
    return np.asarray(old[..., order[:, None], order] * np.outer(sign[:size], sign[:size]))
