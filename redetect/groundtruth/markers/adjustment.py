"""All poses of a chain at once: bundle adjustment of cameras, bodies and parts.

Levenberg and Marquardt's method on the normal equations, whose structure makes each step cheap and
exact (`redetect.groundtruth.markers.normal_equations`); covariances come out of the same
elimination.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.markers.bundle import (
    Bundle,
    Whiteners,
    whitened_derivatives,
    whitened_residuals,
)
from redetect.groundtruth.markers.normal_equations import (
    UNDETERMINED,
    NormalEquations,
    normal_equations,
)

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Of whitened residuals: where the robust loss of the first pass begins to flatten.
_ROBUST_SCALE = 3.0
# How much of the diagonal is added at first, and at least and at most.
_DAMPING = 1e-4
_LEAST_DAMPING = 1e-14
_MOST_DAMPING = 1e12
_MOST_STEPS = 200
# Steps (m, rad) that are as good as none, and the share of the cost that rounding may hide. The
# robust pass only has to come near.
_STEP_TOLERANCE = 1e-10
_ROBUST_STEP_TOLERANCE = 1e-6
_COST_TOLERANCE = 1e-15


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
        Of right perturbations, all other poses marginalised; zeros for fixed ones. They are
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
    bundle = _minimised(bundle, everything, robust=True)
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
        bundle = _minimised(bundle, used, robust=False)
    return _result(bundle, used)


def _minimised(bundle: Bundle, used: BoolArray, *, robust: bool) -> Bundle:
    """The bundle at the minimum of the used points' cost (Levenberg-Marquardt)."""
    if bundle.unknowns == 0:
        return bundle
    part = bundle.only(used)
    whiten = Whiteners.of(part)
    residuals = whitened_residuals(part, whiten)
    if not np.all(np.isfinite(residuals)):
        raise GeometryError("the start has a point behind its camera or outside its lens")
    if len(residuals) < bundle.unknowns:
        raise GeometryError(
            f"{len(residuals)} residuals for {bundle.unknowns} unknowns: too little was seen"
        )
    tolerance = _ROBUST_STEP_TOLERANCE if robust else _STEP_TOLERANCE
    cost, damping = _cost(residuals, robust), _DAMPING
    equations = _equations(part, whiten, residuals, robust)
    for _ in range(_MOST_STEPS):
        try:
            shared, bodies, gain = _damped_step(equations, damping)
        except np.linalg.LinAlgError:
            damping = 10.0 * damping
            if damping > _MOST_DAMPING:
                raise GeometryError(UNDETERMINED) from None
            continue
        tried = _moved(part, shared, bodies)
        residuals = whitened_residuals(tried, whiten)
        tried_cost = _cost(residuals, robust)
        small = max(np.abs(shared).max(initial=0.0), np.abs(bodies).max(initial=0.0)) < tolerance
        # Near the minimum rounding decides which cost is less; such steps are right all the same.
        if tried_cost <= cost * (1.0 + _COST_TOLERANCE):
            part, cost = tried, tried_cost
            if small or gain <= _COST_TOLERANCE * cost:
                break
            damping = max(0.1 * damping, _LEAST_DAMPING)
            equations = _equations(part, whiten, residuals, robust)
        elif small or gain <= _COST_TOLERANCE * cost or damping > _MOST_DAMPING:
            break
        else:
            damping *= 10.0
    return replace(part, seen=bundle.seen, view=bundle.view)


def _cost(residuals: FloatArray, robust: bool) -> float:
    """Half the sum of the losses; infinite where a point cannot be seen."""
    if not np.all(np.isfinite(residuals)):
        return np.inf
    if not robust:
        return 0.5 * float(residuals @ residuals)
    squares = np.square(residuals / _ROBUST_SCALE)
    return _ROBUST_SCALE**2 * float(np.sum(np.sqrt(1.0 + squares) - 1.0))


def _equations(
    bundle: Bundle, whiten: Whiteners, residuals: FloatArray, robust: bool
) -> NormalEquations:
    """Normal equations of the loss: soft l1 if robust, with its curvature (Triggs, section 4.3)."""
    squares = np.square(residuals / _ROBUST_SCALE) if robust else np.zeros_like(residuals)
    return normal_equations(
        bundle,
        whitened_derivatives(bundle, whiten),
        residuals,
        (1.0 + squares) ** -0.5,
        (1.0 + squares) ** -1.5,
    )


def _damped_step(
    equations: NormalEquations, damping: float
) -> tuple[FloatArray, FloatArray, float]:
    """The step for a damping relative to the diagonal, and by how much it should lower the cost."""
    of_shared, of_bodies = (
        # Parameters on which no residual depends are kept fixed.
        damping * np.where(diagonal > 0.0, diagonal, 1.0)
        for diagonal in equations.diagonals
    )
    shared, bodies = equations.step(of_shared, of_bodies)
    gain = 0.5 * (
        float(shared @ (of_shared * shared - equations.shared_gradient))
        + float(np.sum(bodies * (of_bodies * bodies - equations.body_gradient)))
    )
    return shared, bodies, gain


def _moved(bundle: Bundle, shared: FloatArray, bodies: FloatArray) -> Bundle:
    steps = shared.reshape(-1, 6)
    cameras = int(bundle.free_camera.sum())
    return bundle.moved(steps[:cameras], bodies, steps[cameras:])


def _view_figures(bundle: Bundle) -> tuple[FloatArray, FloatArray]:
    """Each view's normalised error, and its root mean square residual in pixels."""
    difference = bundle.seen.pixels - bundle.pixels()
    white = (Whiteners.of(bundle).points @ difference[..., None])[..., 0]
    count = 2 * np.maximum(np.bincount(bundle.view), 1)
    errors = np.sqrt(np.bincount(bundle.view, np.sum(white**2, axis=1)) / count)
    rms = np.sqrt(np.bincount(bundle.view, np.sum(difference**2, axis=1)) / count)
    return np.nan_to_num(errors, nan=np.inf), np.nan_to_num(rms, nan=np.inf)


def _result(bundle: Bundle, used: BoolArray) -> AdjustedBundle:
    part = bundle.only(used)
    whiten = Whiteners.of(part)
    residuals = whitened_residuals(part, whiten)
    information = _equations(part, whiten, residuals, robust=False).shared_information()
    covariance = inverted_information(information)
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
        bundle.seen.pixels - bundle.pixels(),
        errors,
        rms,
        float(residuals @ residuals),
        len(residuals) - bundle.unknowns,
        camera_covariance,
        part_covariance,
    )


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
        raise GeometryError(UNDETERMINED)
    normalised = information / scale[:, None] / scale[None, :]
    if np.linalg.eigvalsh(normalised)[0] < 1e-12:
        raise GeometryError(UNDETERMINED)
    covariance = np.linalg.inv(normalised) / scale[:, None] / scale[None, :]
    return np.asarray(0.5 * (covariance + covariance.T))
