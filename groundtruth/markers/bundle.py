"""All poses of a chain at once: bundle adjustment of cameras, bodies and parts.

What is unknown here are poses, not points: a marker's four corners and a board's are rigid and of
known size, which is what gives the result its scale. Bundle adjusters for reconstruction (as
pycolmap's) move each point by itself and cannot hold a square square; so the least squares are
SciPy's, sparse, with the analytic Jacobians of `groundtruth.markers.chain`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from groundtruth.errors import GeometryError
from groundtruth.geometry.transforms import exp_se3, inverse, log_se3, right_jacobian
from groundtruth.markers.chain import ChainPoints, project_chain, project_chain_with_jacobians

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
PoseKind = Literal["camera", "body", "part"]

# Of whitened residuals: where the robust loss of the first pass begins to flatten.
_ROBUST_SCALE = 3.0


@dataclass(frozen=True, eq=False)
class PosePrior:
    """What is known of a pose beforehand: its value, and the covariance of right perturbations."""

    kind: PoseKind
    index: int
    pose: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class Bundle:
    """Points in images, the poses that they depend on, and which of those are free.

    Attributes
    ----------
    cameras : C cameras
    world_from_camera : (C, 4, 4) float64
    world_from_body : (B, 4, 4) float64
    body_from_part : (P, 4, 4) float64
    free_camera, free_body, free_part : (C | B | P,) bool
    seen : ChainPoints
    view : (N,) int64
        Which part in which image each point is of: 0 to V - 1.
    priors : tuple of PosePrior
    """

    cameras: tuple[Camera, ...]
    world_from_camera: FloatArray
    world_from_body: FloatArray
    body_from_part: FloatArray
    free_camera: BoolArray
    free_body: BoolArray
    free_part: BoolArray
    seen: ChainPoints
    view: IntArray
    priors: tuple[PosePrior, ...] = ()


@dataclass(frozen=True, eq=False)
class AdjustedBundle:
    """A bundle at its minimum.

    Attributes
    ----------
    bundle : Bundle
        With the adjusted poses.
    used : (N,) bool
        Points whose views were not found to be wrong.
    residuals : (N, 2) float64
        Pixels seen minus pixels expected, of all points.
    view_errors : (V,) float64
        Root mean square of each view's normalised residuals.
    view_rms_px : (V,) float64
    cost : float
        Squared normalised residuals of the used points and of the priors.
    degrees_of_freedom : int
    camera_covariance : (6 C, 6 C) float64
    part_covariance : (6 P, 6 P) float64
        Of right perturbations, all other poses marginalised; zeros for what was not free. They are
        those of the corners' covariances, not scaled by the residuals.
    """

    bundle: Bundle
    used: BoolArray
    residuals: FloatArray
    view_errors: FloatArray
    view_rms_px: FloatArray
    cost: float
    degrees_of_freedom: int
    camera_covariance: FloatArray
    part_covariance: FloatArray

    @property
    def reduced_cost(self) -> float:
        """Cost over degrees of freedom: 1 if the corners' covariances are right."""
        return self.cost / max(1, self.degrees_of_freedom)


def adjust_bundle(
    bundle: Bundle, *, outlier_sigma: float = 5.0, outlier_px: float = 1.0
) -> AdjustedBundle:
    """Adjust all free poses: robustly first, then by least squares without the wrong views.

    Parameters
    ----------
    bundle : Bundle
        Its poses are the start.
    outlier_sigma, outlier_px : float
        A view is wrong if its normalised error and its residuals (px) are larger than these.

    Returns
    -------
    AdjustedBundle

    Raises
    ------
    GeometryError
        If the start has a point behind its camera, or the points do not determine the poses.
    """
    everything = np.ones(len(bundle.seen), dtype=np.bool_)
    bundle = _minimised(bundle, everything, "soft_l1")
    used = everything
    for _ in range(5):
        errors, rms = _view_figures(bundle)
        wrong = (errors > outlier_sigma) & (rms > outlier_px)
        kept = ~wrong[bundle.view]
        if np.array_equal(kept, used) and used is not everything:
            break
        used = kept
        # A body of which nothing is left to be used stays where it is.
        seen = np.isin(np.arange(len(bundle.free_body)), bundle.seen.body[used])
        bundle = replace(bundle, free_body=bundle.free_body & seen)
        bundle = _minimised(bundle, used, "linear")
    return _result(bundle, used)


@dataclass(frozen=True, eq=False)
class _Layout:
    """Where each free pose's six numbers stand among all unknowns; -1 for fixed ones."""

    camera: IntArray
    body: IntArray
    part: IntArray
    unknowns: int

    @classmethod
    def of(cls, bundle: Bundle) -> _Layout:
        columns, at = [], 0
        for free in (bundle.free_camera, bundle.free_part, bundle.free_body):
            column = np.full(len(free), -1, dtype=np.int64)
            column[free] = at + 6 * np.arange(int(free.sum()))
            columns.append(column)
            at += 6 * int(free.sum())
        return cls(columns[0], columns[2], columns[1], at)

    def moved(self, bundle: Bundle, x: FloatArray) -> Bundle:
        return replace(
            bundle,
            world_from_camera=_moved(bundle.world_from_camera, self.camera, x),
            world_from_body=_moved(bundle.world_from_body, self.body, x),
            body_from_part=_moved(bundle.body_from_part, self.part, x),
        )


def _moved(poses: FloatArray, columns: IntArray, x: FloatArray) -> FloatArray:
    free = columns >= 0
    if not np.any(free):
        return poses
    moved = poses.copy()
    moved[free] = poses[free] @ exp_se3(_tangents(columns[free], x))
    return moved


def _tangents(columns: IntArray, x: FloatArray) -> FloatArray:
    return np.asarray(x[columns[:, None] + np.arange(6)])


def _minimised(bundle: Bundle, used: BoolArray, loss: str) -> Bundle:
    from scipy.optimize import least_squares

    layout = _Layout.of(bundle)
    if layout.unknowns == 0:
        return bundle
    part = replace(bundle, seen=bundle.seen.only(used), view=bundle.view[used])
    whiten = _whiteners(part.seen)
    zero = np.zeros(layout.unknowns)
    first = _residuals(part, layout, whiten, zero)
    if not np.all(np.isfinite(first)):
        raise GeometryError("the start has a point behind its camera or outside its lens")
    if len(first) < layout.unknowns:
        raise GeometryError(
            f"{len(first)} residuals for {layout.unknowns} unknowns: too little was seen"
        )
    # The robust pass only has to come near. The other is begun anew where it ended until it stays:
    # SciPy's tolerances are relative, and steps about zero tell better.
    robust = loss != "linear"
    for _ in range(1 if robust else 3):
        found = least_squares(
            lambda x, at=part: _residuals(at, layout, whiten, x),
            zero,
            jac=lambda x, at=part: _jacobian(at, layout, whiten, x),
            x_scale="jac",
            loss=loss,
            f_scale=_ROBUST_SCALE,
            ftol=1e-7 if robust else 1e-13,
            xtol=1e-7 if robust else 1e-11,
            gtol=1e-12,
            max_nfev=60,
            tr_solver="lsmr",
            tr_options={"atol": 1e-13, "btol": 1e-13, "maxiter": 20 * layout.unknowns},
        )
        part = layout.moved(part, found.x)
        if np.abs(found.x).max() < 1e-8:
            break
    return replace(part, seen=bundle.seen, view=bundle.view)


def _whiteners(seen: ChainPoints) -> FloatArray:
    """(N, 2, 2) inverse Cholesky factors of the corners' covariances."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(seen.covariances)))


def _residuals(bundle: Bundle, layout: _Layout, whiten: FloatArray, x: FloatArray) -> FloatArray:
    moved = layout.moved(bundle, x)
    difference = moved.seen.pixels - _pixels(moved)
    parts = [(whiten @ difference[..., None]).ravel()]
    for prior in bundle.priors:
        error = log_se3(inverse(prior.pose) @ _pose(moved, prior))
        parts.append(_prior_whitener(prior) @ error)
    return np.concatenate(parts)


def _jacobian(bundle: Bundle, layout: _Layout, whiten: FloatArray, x: FloatArray) -> Any:
    from scipy.sparse import csr_matrix

    moved = layout.moved(bundle, x)
    seen = bundle.seen
    projection = project_chain_with_jacobians(
        moved.cameras,
        moved.world_from_camera,
        moved.world_from_body,
        moved.body_from_part,
        seen,
    )
    rows, columns, values = [], [], []
    row = 2 * np.arange(len(seen))[:, None, None] + np.arange(2)[:, None]
    for column, index, jacobian in (
        (layout.camera, seen.camera, projection.by_camera),
        (layout.body, seen.body, projection.by_body),
        (layout.part, seen.part, projection.by_part),
    ):
        chosen = column[index] >= 0
        if np.any(chosen):
            start = column[index[chosen]]
            chain = right_jacobian(_tangents(start, x))
            block = -whiten[chosen] @ jacobian[chosen] @ chain
            rows.append(np.broadcast_to(row[chosen], block.shape).ravel())
            columns.append(
                np.broadcast_to(start[:, None, None] + np.arange(6), block.shape).ravel()
            )
            values.append(block.ravel())
    height = 2 * len(seen)
    for prior in bundle.priors:
        at = int(getattr(layout, prior.kind)[prior.index])
        error = log_se3(inverse(prior.pose) @ _pose(moved, prior))
        block = (
            _prior_whitener(prior)
            @ np.linalg.inv(right_jacobian(error))
            @ right_jacobian(x[at : at + 6])
        )
        rows.append(np.repeat(height + np.arange(6), 6))
        columns.append(np.tile(at + np.arange(6), 6))
        values.append(block.ravel())
        height += 6
    return csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(height, layout.unknowns),
    )


def _pixels(bundle: Bundle) -> FloatArray:
    return project_chain(
        bundle.cameras,
        bundle.world_from_camera,
        bundle.world_from_body,
        bundle.body_from_part,
        bundle.seen,
    )


def _pose(bundle: Bundle, prior: PosePrior) -> FloatArray:
    poses = {
        "camera": bundle.world_from_camera,
        "body": bundle.world_from_body,
        "part": bundle.body_from_part,
    }
    return np.asarray(poses[prior.kind][prior.index])


def _prior_whitener(prior: PosePrior) -> FloatArray:
    return np.asarray(np.linalg.inv(np.linalg.cholesky(prior.covariance)))


def _view_figures(bundle: Bundle) -> tuple[FloatArray, FloatArray]:
    """Each view's normalised error, and its root mean square residual in pixels."""
    difference = bundle.seen.pixels - _pixels(bundle)
    white = (_whiteners(bundle.seen) @ difference[..., None])[..., 0]
    count = 2 * np.maximum(np.bincount(bundle.view), 1)
    errors = np.sqrt(np.bincount(bundle.view, np.sum(white**2, axis=1)) / count)
    rms = np.sqrt(np.bincount(bundle.view, np.sum(difference**2, axis=1)) / count)
    return np.nan_to_num(errors, nan=np.inf), np.nan_to_num(rms, nan=np.inf)


def _result(bundle: Bundle, used: BoolArray) -> AdjustedBundle:
    layout = _Layout.of(bundle)
    part = replace(bundle, seen=bundle.seen.only(used), view=bundle.view[used])
    whiten = _whiteners(part.seen)
    zero = np.zeros(layout.unknowns)
    residuals = _residuals(part, layout, whiten, zero)
    covariance = _shared_covariance(part, layout, whiten)
    errors, rms = _view_figures(bundle)
    cameras, parts = 6 * len(bundle.free_camera), 6 * len(bundle.free_part)
    camera_index = np.flatnonzero(np.repeat(bundle.free_camera, 6))
    part_index = np.flatnonzero(np.repeat(bundle.free_part, 6))
    camera_covariance, part_covariance = np.zeros((cameras, cameras)), np.zeros((parts, parts))
    split = len(camera_index)
    camera_covariance[np.ix_(camera_index, camera_index)] = covariance[:split, :split]
    part_covariance[np.ix_(part_index, part_index)] = covariance[split:, split:]
    return AdjustedBundle(
        bundle,
        used,
        bundle.seen.pixels - _pixels(bundle),
        errors,
        rms,
        float(residuals @ residuals),
        len(residuals) - layout.unknowns,
        camera_covariance,
        part_covariance,
    )


def _shared_covariance(bundle: Bundle, layout: _Layout, whiten: FloatArray) -> FloatArray:
    """Covariance of free cameras and parts, bodies marginalised by their Schur complement."""
    jacobian = _jacobian(bundle, layout, whiten, np.zeros(layout.unknowns))
    normal = (jacobian.T @ jacobian).tocsr()
    shared = 6 * int(bundle.free_camera.sum() + bundle.free_part.sum())
    information = normal[:shared, :shared].toarray()
    coupling = normal[shared:, :shared].tocsr()
    own = normal[shared:, shared:].tocsr()
    for at in range(0, layout.unknowns - shared, 6):
        block = own[at : at + 6, at : at + 6].toarray()
        rows = coupling[at : at + 6].toarray()
        try:
            information -= rows.T @ np.linalg.solve(block, rows)
        except np.linalg.LinAlgError:
            raise GeometryError("the points do not determine all poses") from None
    return inverted_information(information)


def inverted_information(information: FloatArray) -> FloatArray:
    """Covariance of an information matrix.

    Raises
    ------
    GeometryError
        If it is singular: something that is free was not seen.
    """
    if not len(information):
        return information
    scale = np.sqrt(np.clip(np.diagonal(information), 0.0, None))
    if not np.all(scale > 0.0):
        raise GeometryError("the points do not determine all poses")
    normalised = information / scale[:, None] / scale[None, :]
    if np.linalg.eigvalsh(normalised)[0] < 1e-12:
        raise GeometryError("the points do not determine all poses")
    covariance = np.linalg.inv(normalised) / scale[:, None] / scale[None, :]
    return np.asarray(0.5 * (covariance + covariance.T))
