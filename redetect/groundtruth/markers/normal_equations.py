"""Normal equations of a bundle, with every body eliminated by its own 6x6 block.

A point depends on one camera, one part and one body; so no two bodies (times at which something was
seen) share a residual, and their part of the matrix is block diagonal. What is left for cameras and
parts, a few dozen poses however many times there are, is its Schur complement: a dense matrix that
is factorised directly (Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, section 6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.markers.bundle import Bundle, Derivatives

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

UNDETERMINED = "the points do not determine all poses"
_CAMERA, _BODY, _PART = slice(0, 6), slice(6, 12), slice(12, 18)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The matrix J'J and gradient J'r of free poses: S shared ones (cameras, parts), B bodies.

    Attributes
    ----------
    shared : (6 S, 6 S) float64
    coupling : (B, 6, 6 S) float64
        Rows of bodies, columns of shared poses.
    bodies : (B, 6, 6) float64
        The blocks of the bodies' part.
    shared_gradient, body_gradient : (6 S,), (B, 6) float64
    """

    shared: FloatArray
    coupling: FloatArray
    bodies: FloatArray
    shared_gradient: FloatArray
    body_gradient: FloatArray

    @property
    def diagonals(self) -> tuple[FloatArray, FloatArray]:
        """(6 S,) and (B, 6) diagonals."""
        return np.diagonal(self.shared).copy(), np.diagonal(self.bodies, axis1=1, axis2=2).copy()

    def step(
        self, shared_damping: FloatArray, body_damping: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Steps of shared poses (6 S,) and of bodies (B, 6), with numbers added to the diagonal.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the matrix is singular.
        """
        own = self.bodies + body_damping[:, :, None] * np.eye(6)
        solved = np.linalg.solve(
            own, np.concatenate([self.coupling, self.body_gradient[:, :, None]], axis=2)
        )
        coupling, gradient = solved[:, :, :-1], solved[:, :, -1]
        reduced = self.shared + np.diag(shared_damping) - self._eliminated(coupling)
        right = np.einsum("bij,bi->j", self.coupling, gradient) - self.shared_gradient
        shared_step = np.linalg.solve(reduced, right)
        return shared_step, -gradient - coupling @ shared_step

    def shared_information(self) -> FloatArray:
        """(6 S, 6 S) inverse covariance of the shared poses, bodies marginalised.

        Raises
        ------
        GeometryError
            If a body's own pose is not determined.
        """
        try:
            coupling = np.asarray(np.linalg.solve(self.bodies, self.coupling), dtype=np.float64)
        except np.linalg.LinAlgError:
            raise GeometryError(UNDETERMINED) from None
        return self.shared - self._eliminated(coupling)

    def _eliminated(self, solved: FloatArray) -> FloatArray:
        """The Schur complement's term of the bodies, given inverse blocks times coupling."""
        width = self.shared.shape[0]
        rows = 6 * len(self.bodies)
        return np.asarray(self.coupling.reshape(rows, width).T @ solved.reshape(rows, width))


def normal_equations(
    bundle: Bundle,
    derivatives: Derivatives,
    residuals: FloatArray,
    gradient_weights: FloatArray,
    curvature_weights: FloatArray,
) -> NormalEquations:
    """Sum up the normal equations.

    Parameters
    ----------
    bundle : Bundle
    derivatives : Derivatives
    residuals, gradient_weights, curvature_weights : (2 N + 6 priors,) arrays
        Whitened residuals, and what each counts in the gradient and in the matrix: 1, but for a
        robust loss.

    Returns
    -------
    NormalEquations
    """
    camera_at, part_at = _numbers(bundle.free_camera, 0), _numbers(bundle.free_part, 0)
    part_at[part_at >= 0] += int(bundle.free_camera.sum())
    body_at = _numbers(bundle.free_body, 0)
    shared_count = int(bundle.free_camera.sum() + bundle.free_part.sum())
    body_count = int(bundle.free_body.sum())
    shared = np.zeros((shared_count, shared_count, 6, 6))
    coupling = np.zeros((body_count, shared_count, 6, 6))
    bodies = np.zeros((body_count, 6, 6))
    shared_gradient, body_gradient = np.zeros((shared_count, 6)), np.zeros((body_count, 6))

    chains, matrices, gradients = _by_chain(
        bundle, derivatives, residuals, gradient_weights, curvature_weights
    )
    body = body_at[chains[:, 1]]
    both = ((camera_at[chains[:, 0]], _CAMERA), (part_at[chains[:, 2]], _PART))
    free = body >= 0
    np.add.at(bodies, body[free], matrices[free, _BODY, _BODY])
    np.add.at(body_gradient, body[free], gradients[free, _BODY])
    for row, rows in both:
        free = row >= 0
        np.add.at(shared_gradient, row[free], gradients[free, rows])
        free &= body >= 0
        np.add.at(coupling, (body[free], row[free]), matrices[free, _BODY, rows])
        for column, columns in both:
            free = (row >= 0) & (column >= 0)
            np.add.at(
                shared,
                (row[free], column[free]),
                matrices[free, rows, columns],
            )
    height = 2 * len(bundle.seen)
    for prior, block in zip(bundle.priors, derivatives.by_prior, strict=True):
        rows = slice(height, height + 6)
        matrix = block.T @ (curvature_weights[rows, None] * block)
        gradient = block.T @ (gradient_weights[rows] * residuals[rows])
        if prior.kind == "body":
            bodies[body_at[prior.index]] += matrix
            body_gradient[body_at[prior.index]] += gradient
        else:
            at = (camera_at if prior.kind == "camera" else part_at)[prior.index]
            shared[at, at] += matrix
            shared_gradient[at] += gradient
        height += 6
    width = 6 * shared_count
    return NormalEquations(
        np.swapaxes(shared, 1, 2).reshape(width, width),
        np.swapaxes(coupling, 1, 2).reshape(body_count, 6, width),
        bodies,
        shared_gradient.ravel(),
        body_gradient,
    )


def _numbers(free: NDArray[np.bool_], begin: int) -> IntArray:
    """The number of each free pose among them; -1 for fixed ones."""
    numbers = np.full(len(free), -1, dtype=np.int64)
    numbers[free] = begin + np.arange(int(free.sum()))
    return numbers


def _by_chain(
    bundle: Bundle,
    derivatives: Derivatives,
    residuals: FloatArray,
    gradient_weights: FloatArray,
    curvature_weights: FloatArray,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Sums over points with the same camera, body and part: (V, 3) which, (V, 18, 18), (V, 18)."""
    seen = bundle.seen
    order = np.lexsort((seen.part, seen.camera, seen.body))
    which = np.column_stack([seen.camera, seen.body, seen.part])[order]
    starts = np.flatnonzero(np.concatenate([[True], np.any(np.diff(which, axis=0) != 0, axis=1)]))
    sizes = np.diff(np.append(starts, len(order)))
    matrices, gradients = np.empty((len(starts), 18, 18)), np.empty((len(starts), 18))
    rows = np.concatenate([derivatives.by_camera, derivatives.by_body, derivatives.by_part], axis=2)
    points = 2 * len(seen)
    right = (gradient_weights * residuals)[:points].reshape(-1, 2)
    to_matrix = curvature_weights[:points].reshape(-1, 2, 1)
    # Markers have four corners and boards are seen whole: there are but few different sizes.
    for size in np.unique(sizes):
        chains = np.flatnonzero(sizes == size)
        chosen = order[starts[chains, None] + np.arange(size)]
        own = rows[chosen].reshape(len(chains), 2 * size, 18)
        columns = np.swapaxes(own, 1, 2)
        weighted = (to_matrix[chosen] * rows[chosen]).reshape(own.shape)
        matrices[chains] = columns @ weighted
        gradients[chains] = (columns @ right[chosen].reshape(len(chains), -1, 1))[..., 0]
    return which[starts], matrices, gradients
