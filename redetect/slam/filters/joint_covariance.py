"""The joint covariance of EKF-SLAM, changed in place.

It is kept as P = B - W W^T. An update by a frame's rows subtracts a product of low rank, K S K^T,
from all of P; here its factor only becomes further columns of W, and is subtracted from B once W is
full, by one symmetric product of high rank (BLAS dsyrk). That is exact, and several times
quicker: a product of high rank keeps the processor busy, one of low rank waits for the memory. What
a frame needs of P (the columns of its landmarks) is computed from B and W.

Of B only the lower triangle is kept, so that P is symmetric whatever is done to it; and P changes
by congruences (F P F^T) and by symmetric products alone.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.blas import dsyrk
from scipy.linalg.lapack import dtrtrs

from redetect.array_types import FloatArray, IntArray
from redetect.slam.filters.frames import innovation_root

POSE_SIZE = 3

# Rows are added in chunks of this many; a chunk too many costs less than moving the matrix often.
_CHUNK = 64
# Columns of W before they are subtracted from B.
_PENDING = 128


class JointCovariance:
    """Covariance of a pose, at first (3, 3), and of a growing number of landmarks."""

    def __init__(self, pose_covariance: FloatArray) -> None:
        self.size = POSE_SIZE
        self._base = np.zeros((_CHUNK, _CHUNK), order="F")
        self._base[:POSE_SIZE, :POSE_SIZE] = pose_covariance
        self._factor = np.zeros((_CHUNK, _PENDING), order="F")
        self._pending = 0

    def block(self, index: IntArray) -> FloatArray:
        """Rows and columns `index` of the covariance: (k, k)."""
        factor = self._factor[index, : self._pending]
        low, high = np.minimum.outer(index, index), np.maximum.outer(index, index)
        return np.asarray(self._base[high, low] - factor @ factor.T)

    def projected(self, index: IntArray, jacobian: FloatArray) -> FloatArray:
        """Covariance of the state with a measurement: P[:, index] @ jacobian.T, (size, m)."""
        product = self._columns(index) @ jacobian.T
        if self._pending:
            factor = self._factor[: self.size, : self._pending]
            product -= factor @ (factor[index].T @ jacobian.T)
        return np.asarray(product)

    def move_pose(self, by_pose: FloatArray, noise: FloatArray) -> None:
        """The pose moves: P becomes F P F^T + Q, F the identity except for the pose.

        Takes `by_pose` (3, 3), `noise` (3, 3).
        """
        base, size = self._base, self.size
        base[POSE_SIZE:size, :POSE_SIZE] = base[POSE_SIZE:size, :POSE_SIZE] @ by_pose.T
        moved = by_pose @ base[:POSE_SIZE, :POSE_SIZE] @ by_pose.T + noise
        base[:POSE_SIZE, :POSE_SIZE] = 0.5 * (moved + moved.T)
        factor = self._factor[:POSE_SIZE, : self._pending]
        factor[:] = by_pose @ factor

    def measure(
        self, projected: FloatArray, innovation_covariance: FloatArray, innovation: FloatArray
    ) -> tuple[FloatArray, float]:
        """Subtract K S K^T.

        Takes `projected` (size, m), `innovation_covariance` (m, m), `innovation` (m,); returns
        `change`, `squared`.
        """
        root = innovation_root(innovation_covariance)
        rows = len(innovation)
        if self._pending + rows > self._factor.shape[1]:
            self._settle()
            if rows > self._factor.shape[1]:
                self._factor = np.zeros((self._factor.shape[0], rows), order="F")
        right = np.empty((self.size + 1, rows))
        right[:-1], right[-1] = projected, innovation
        whitened = dtrtrs(root, right.T, lower=1, overwrite_b=1)[0].T
        factor, last = whitened[:-1], whitened[-1]
        self._factor[: self.size, self._pending : self._pending + rows] = factor
        self._pending += rows
        return factor @ last, float(last @ last)

    def append(self, index: IntArray, jacobian: FloatArray, noise: FloatArray) -> int:
        """Add numbers that depend on the state and on a measurement.

        Takes `index` (k,), `jacobian` (d, k), `noise` (d, d).
        """
        first = self.size
        self._make_room(first + len(jacobian))
        self.size = first + len(jacobian)
        self.replace(first, index, jacobian, noise)
        return first

    def replace(self, first: int, index: IntArray, jacobian: FloatArray, noise: FloatArray) -> None:
        """Replace numbers from `first` on by others; see `append`."""
        count = len(jacobian)
        rows = jacobian @ self._columns(index).T
        own = rows[:, index] @ jacobian.T + noise
        rows[:, first : first + count] = 0.5 * (own + own.T)
        for r, row in enumerate(rows, first):
            self._base[r, : r + 1] = row[: r + 1]
            self._base[r + 1 : self.size, r] = row[r + 1 :]
        factor = self._factor[:, : self._pending]
        factor[first : first + count] = jacobian @ factor[index]

    def _columns(self, index: IntArray) -> FloatArray:
        """Columns of B: (size, k)."""
        columns = np.empty((self.size, len(index)), order="F")
        for k, c in enumerate(index.tolist()):
            columns[:c, k] = self._base[c, :c]
            columns[c:, k] = self._base[c : self.size, c]
        return columns

    def _settle(self) -> None:
        """Subtract W W^T from B."""
        if self._pending:
            used = self._factor[:, : self._pending]
            self._base = dsyrk(-1.0, used, 1.0, self._base, lower=1, overwrite_c=1)
            self._pending = 0
            # The pose's block is read and written whole.
            lower = np.tril(self._base[:POSE_SIZE, :POSE_SIZE])
            self._base[:POSE_SIZE, :POSE_SIZE] = lower + np.tril(lower, -1).T

    def _make_room(self, size: int) -> None:
        capacity = len(self._base)
        if size <= capacity:
            return
        wanted = -(-size // _CHUNK) * _CHUNK
        base = np.zeros((wanted, wanted), order="F")
        base[:capacity, :capacity] = self._base
        factor = np.zeros((wanted, self._factor.shape[1]), order="F")
        factor[:capacity] = self._factor
        self._base, self._factor = base, factor
