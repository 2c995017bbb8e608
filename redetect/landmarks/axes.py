"""Axes of the data set's robot, X left and Y backward, and those of other tools, X forward, Y left.

A rotation about Z by 90 degrees, ``(x, y) -> (-y, x)``, converts the first to the second, both the
robot's frame and the map's (docs/slam/formats.md): positions and covariances are rotated, angles
and bearings stay. Only numbers and signs are exchanged, without rounding: the conversion back gives
the same bits.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray

Axes = Literal["robotics", "dataset"]

#: Meaning of the axes.
MEANING: dict[str, str] = {"robotics": "X forward, Y left", "dataset": "X left, Y backward"}

# Indices and signs of the old coordinates that become the new first, second and third; for the
# conversion back, the signs of the first two differ.
_ORDER = np.array([1, 0, 2])
_SIGNS = np.array([-1.0, 1.0, 1.0])


def from_dataset(values: ArrayLike, axes: Axes = "robotics", *, back: bool = False) -> FloatArray:
    """Convert vectors, poses or steps from the data set's axes to others, or `back`.

    Takes (..., 2) or (..., 3): x, y and, for poses and steps, the angle; returns the same shape.
    """
    old = np.array(values, dtype=np.float64)
    if axes == "dataset":
        return old
    order = _ORDER[: old.shape[-1]]
    return np.asarray(old[..., order] * (_SIGNS[order] if back else _SIGNS[: len(order)]))


def to_dataset(values: ArrayLike) -> FloatArray:
    """Undo `from_dataset`."""
    return from_dataset(values, back=True)


def covariance_from_dataset(
    covariance: ArrayLike, axes: Axes = "robotics", *, back: bool = False
) -> FloatArray:
    """Convert covariances (or information matrices) (..., d, d) like `from_dataset`."""
    old = np.array(covariance, dtype=np.float64)
    if axes == "dataset":
        return old
    order, sign = _ORDER[: old.shape[-1]], from_dataset(np.ones(old.shape[-1]), back=back)
    return np.asarray(old[..., order[:, None], order] * np.outer(sign, sign))
