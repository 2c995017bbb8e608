"""The joint covariance of EKF-SLAM, changed in place by congruences and symmetric products."""

from __future__ import annotations

import numpy as np
from scipy.linalg.blas import dgemm
from scipy.linalg.lapack import dtrtrs

from redetect.array_types import FloatArray, IntArray
from redetect.slam.filters.frames import innovation_root

POSE_SIZE = 3

# Rows are added in chunks of this many; a chunk too many costs less than moving the matrix often.
_CHUNK = 64


class JointCovariance:
    """Covariance of a pose, at first (3, 3), and of a growing number of landmarks."""

    def __init__(self, pose_covariance: FloatArray) -> None:
        self.size = POSE_SIZE
        # With room for more; columns lie in memory one after the other, as BLAS has them.
        self._matrix = np.zeros((_CHUNK, _CHUNK), order="F")
        self._matrix[:POSE_SIZE, :POSE_SIZE] = pose_covariance

    def block(self, index: IntArray) -> FloatArray:
        """Rows and columns `index` of the covariance: (k, k)."""
        return np.asarray(self._matrix[np.ix_(index, index)])

    def projected(self, index: IntArray, jacobian: FloatArray) -> FloatArray:
        """Covariance of the state with a measurement: P[:, index] @ jacobian.T, (size, m)."""
        return np.asarray(self._matrix[: self.size, index] @ jacobian.T)

    def move_pose(self, by_pose: FloatArray, noise: FloatArray) -> None:
        """The pose moves: P becomes F P F^T + Q, F the identity except for the pose.

        Takes `by_pose` (3, 3), `noise` (3, 3).
        """
        moved = self._matrix[: self.size, :POSE_SIZE] @ by_pose.T
        own = by_pose @ moved[:POSE_SIZE] + noise
        moved[:POSE_SIZE] = 0.5 * (own + own.T)
        self._matrix[: self.size, :POSE_SIZE] = moved
        self._matrix[:POSE_SIZE, : self.size] = moved.T

    def measure(
        self, projected: FloatArray, innovation_covariance: FloatArray, innovation: FloatArray
    ) -> tuple[FloatArray, float]:
        """Subtract K S K^T.

        Takes `projected` (size, m), `innovation_covariance` (m, m), `innovation` (m,); returns the
        `change` of the state (size,), and the `squared` innovation in units of its covariance.
        """
        right = np.zeros((len(self._matrix) + 1, len(innovation)))
        right[: self.size], right[-1] = projected, innovation
        root = innovation_root(innovation_covariance)
        whitened = dtrtrs(root, right.T, lower=1, overwrite_b=1)[0].T
        factor, last = whitened[:-1], whitened[-1]
        self._matrix = dgemm(-1.0, factor, factor, 1.0, self._matrix, trans_b=1, overwrite_c=1)
        return factor[: self.size] @ last, float(last @ last)

    def append(self, index: IntArray, jacobian: FloatArray, noise: FloatArray) -> int:
        """Add numbers that depend on the state and on a measurement; returns where they begin.

        Takes `index` (k,), `jacobian` (d, k), `noise` (d, d).
        """
        first, self.size = self.size, self.size + len(jacobian)
        if self.size > len(self._matrix):
            larger = np.zeros((len(self._matrix) + _CHUNK,) * 2, order="F")
            larger[:first, :first] = self._matrix[:first, :first]
            self._matrix = larger
        self.replace(first, index, jacobian, noise)
        return first

    def replace(self, first: int, index: IntArray, jacobian: FloatArray, noise: FloatArray) -> None:
        """Replace numbers from `first` on by others; see `append`."""
        columns = self._matrix[: self.size, index] @ jacobian.T
        own = jacobian @ columns[index] + noise
        columns[first : first + len(own)] = 0.5 * (own + own.T)
        self._matrix[: self.size, first : first + len(own)] = columns
        self._matrix[first : first + len(own), : self.size] = columns.T
