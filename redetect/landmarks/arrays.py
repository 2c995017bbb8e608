"""Landmark records as arrays and back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.landmarks.records import CircleLandmark, LandmarkError


@dataclass(frozen=True, slots=True, eq=False)
class CircleArrays:
    """N rows of discs as arrays.

    Attributes
    ----------
    xy : (N, 2) float64
        Centres in the robot frame (m).
    quality : (N,) float64
        Confidence, 0 to 1.
    covariance : (N, 2, 2) float64
        Of `xy` (m^2).
    ids : (N,) int64
        Each row's first identifier; -1 where it is unknown or missing.
    """

    xy: FloatArray
    quality: FloatArray
    covariance: FloatArray
    ids: IntArray


def circle_arrays(circles: Sequence[CircleLandmark]) -> CircleArrays:
    """Collect rows of discs in arrays (of length 0 if there are none)."""
    numbers = np.array(
        [(c.px, c.py, c.quality, c.cxx, c.cxy, c.cyy) for c in circles], dtype=np.float64
    ).reshape(-1, 6)
    return CircleArrays(
        xy=numbers[:, :2].copy(),
        quality=numbers[:, 2].copy(),
        covariance=numbers[:, [3, 4, 4, 5]].reshape(-1, 2, 2),
        ids=np.array([c.ids[0] if c.ids else -1 for c in circles], dtype=np.int64),
    )


def circle_landmarks(
    xy: ArrayLike, quality: ArrayLike, covariance: ArrayLike, ids: ArrayLike | None = None
) -> tuple[CircleLandmark, ...]:
    """Convert arrays to rows of discs.

    Parameters
    ----------
    xy : (N, 2) array_like
        Centres in the robot frame (m).
    quality : (N,) array_like
        Confidence, 0 to 1.
    covariance : (N, 2, 2) array_like
        Of `xy` (m^2).
    ids : (N,) array_like of int, optional
        Identifiers, -1 where unknown; by default the rows have none.

    Raises
    ------
    LandmarkError
        If the arrays' shapes do not fit or a number is not finite.
    """
    position = np.asarray(xy, dtype=np.float64)
    confidence = np.asarray(quality, dtype=np.float64)
    spread = np.asarray(covariance, dtype=np.float64)
    count = len(position)
    expected = ((count, 2), (count,), (count, 2, 2))
    if (position.shape, confidence.shape, spread.shape) != expected:
        raise LandmarkError(
            f"xy, quality and covariance have shapes {position.shape}, {confidence.shape} and "
            f"{spread.shape}: expected (N, 2), (N,) and (N, 2, 2)"
        )
    identifiers = np.zeros((count, 0), dtype=np.int64) if ids is None else np.reshape(ids, (-1, 1))
    if len(identifiers) != count or not np.issubdtype(identifiers.dtype, np.integer):
        raise LandmarkError(
            f"ids are {len(identifiers)} {identifiers.dtype}: expected {count} integers"
        )
    numbers = np.column_stack([position, confidence, spread.reshape(count, 4)[:, [0, 1, 3]]])
    return tuple(
        CircleLandmark(px, py, q, cxx, cxy, cyy, tuple(identifier))
        for (px, py, q, cxx, cxy, cyy), identifier in zip(numbers.tolist(), identifiers.tolist())
    )


def is_positive_definite(covariance: ArrayLike, least: float = 1e-12) -> BoolArray:
    """Which covariance matrices are positive definite, that is, can be inverted and used.

    Covariances are read from files unchecked; callers that need valid ones check them here.

    Parameters
    ----------
    covariance : (..., n, n) array_like
        Symmetric matrices.
    least : float
        What the smallest eigenvalue of the correlations must be above: where it is not, two
        quantities are one.

    Returns
    -------
    (...) bool
    """
    matrices = np.asarray(covariance, dtype=np.float64)
    scale = np.sqrt(np.clip(np.diagonal(matrices, axis1=-2, axis2=-1), 0.0, None))
    safe = np.where(scale > 0.0, scale, 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        correlation = matrices / safe[..., :, None] / safe[..., None, :]
    sane = np.all(scale > 0.0, axis=-1) & np.all(np.isfinite(correlation), axis=(-2, -1))
    correlation = np.where(sane[..., None, None], correlation, 0.0)
    return np.asarray(sane & (np.linalg.eigvalsh(correlation)[..., 0] > least))
