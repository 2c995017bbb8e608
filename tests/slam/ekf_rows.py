"""Rows of single frames, and a robot in a map."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray
from redetect.landmarks.map_file import LandmarkMap, Landmarks
from redetect.slam.filters.frames import FrameRows
from redetect.slam.filters.localizer import Localizer
from redetect.slam.recording import CircleRows, LineRows

CAMERA_XY = np.array([0.0179777, -0.0808609])


def spd(rng: np.random.Generator, size: int, scale: float) -> FloatArray:
    """A random covariance whose numbers are correlated."""
    root = rng.normal(0, 1, (size, size))
    return np.asarray(scale**2 * (root @ root.T / size + 0.3 * np.eye(size)))


def rows_of(discs: list[tuple[int, FloatArray, FloatArray]]) -> FrameRows:
    rows = CircleRows.of((0, xy, covariance, number) for number, xy, covariance in discs)
    return FrameRows(rows, LineRows.of())


def bearings_of(lines: list[tuple[tuple[int, ...], float, float]]) -> FrameRows:
    rows = LineRows.of((0, bearing, sigma, numbers) for numbers, bearing, sigma in lines)
    return FrameRows(CircleRows.of(), rows)


def localizer(pose: ArrayLike, discs: ArrayLike, lines: ArrayLike) -> Localizer:
    """A robot in a map whose discs and lines are numbered from 0."""

    def landmarks(places: ArrayLike) -> Landmarks:
        xy = np.reshape(places, (-1, 2))
        count = len(xy)
        return Landmarks(np.arange(count), xy, np.zeros((count, 2, 2)), np.ones(count, np.int64))

    return Localizer(LandmarkMap(landmarks(discs), landmarks(lines)), pose, camera_xy=CAMERA_XY)
