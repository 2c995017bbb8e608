"""Rotation vectors: their matrices and derivatives, for arrays of them."""

from __future__ import annotations

import numpy as np

from redetect.array_types import FloatArray


def rotation_of(vectors: FloatArray) -> FloatArray:
    """(..., 3, 3) rotations of (..., 3) rotation vectors."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    cross = cross_matrices(vectors)
    # Rodrigues' formula; `np.sinc` is the normalised one, with a factor pi.
    of_square = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * cross + of_square * (cross @ cross))


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """(..., 3, 3) matrices [v]x with [v]x w = v x w, of (..., 3) vectors."""
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    cross = np.zeros((*x.shape, 3, 3))
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -z, y, -x
    cross[..., 1, 0], cross[..., 2, 0], cross[..., 2, 1] = z, -y, x
    return cross


def left_jacobian(vectors: FloatArray) -> FloatArray:
    """(..., 3, 3) left Jacobians J of rotations, of (..., 3) rotation vectors.

    To first order in d, ``exp([v + d]x) = exp([J d]x) exp([v]x)``.
    """
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    # (1 - cos a)/a^2 and (a - sin a)/a^3, both defined at a = 0.
    versine = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    small = angle < 1e-2
    safe = np.where(small, 1.0, angle)
    series = 1.0 / 6.0 - angle**2 / 120.0 * (1.0 - angle**2 / 42.0)
    third = np.where(small, series, (safe - np.sin(safe)) / safe**3)
    cross = cross_matrices(vectors)
    return np.asarray(np.eye(3) + versine * cross + third * (cross @ cross))
