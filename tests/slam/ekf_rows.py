"""Rows of single frames, and a robot in a map."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray
from redetect.landmarks.map_file import LandmarkMap, MapLandmarks
from redetect.slam.filters.base import FrameRows
from redetect.slam.filters.localizer import Localizer
from redetect.slam.recording import CircleRows, LineRows

CAMERA_XY = np.array([0.0179777, -0.0808609])


def spd(rng: np.random.Generator, size: int, scale: float) -> FloatArray:
    """A random covariance whose numbers are correlated."""
    root = rng.normal(0, 1, (size, size))
    return np.asarray(scale**2 * (root @ root.T / size + 0.3 * np.eye(size)))


def circle_rows(rows: Iterable[tuple[int, ArrayLike, ArrayLike, int]] = ()) -> CircleRows:
    """Rows of frame, centre (2,), covariance (2, 2) and identifier."""
    table = list(rows)
    return CircleRows(
        np.array([row[0] for row in table], dtype=np.int64),
        np.array([row[1] for row in table], dtype=np.float64).reshape(-1, 2),
        np.array([row[2] for row in table], dtype=np.float64).reshape(-1, 2, 2),
        np.array([row[3] for row in table], dtype=np.int64),
    )


def rows_of(discs: list[tuple[int, FloatArray, FloatArray]]) -> FrameRows:
    rows = circle_rows((0, xy, covariance, number) for number, xy, covariance in discs)
    return FrameRows(rows, LineRows.of())


def bearings_of(lines: list[tuple[tuple[int, ...], float, float]]) -> FrameRows:
    rows = LineRows.of((0, bearing, sigma, numbers) for numbers, bearing, sigma in lines)
    return FrameRows(circle_rows(), rows)


def localizer(pose: ArrayLike, discs: ArrayLike, lines: ArrayLike) -> Localizer:
    """A robot in a map whose discs and lines are numbered from 0."""

    def landmarks(places: ArrayLike) -> MapLandmarks:
        xy = np.reshape(places, (-1, 2))
        count = len(xy)
        return MapLandmarks(np.arange(count), xy, np.zeros((count, 2, 2)), np.ones(count, np.int64))

    return Localizer(LandmarkMap(landmarks(discs), landmarks(lines)), pose, camera_xy=CAMERA_XY)
