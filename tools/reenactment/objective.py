"""What a fit minimises: errors of rows, odometry and tilt, their weights, the normal equations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from camera import Camera
from tools.reenactment.model import Geometry, odometry_residuals, predict_pixels
from tools.reenactment.recording import Recording

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Weighting:
    """What counts as an error, and how much.

    Parameters
    ----------
    metric : "floor" or "pixel"
        Rows are compared on the floor under their shipped covariance, or in the image.
    pixel_sigma : float
        Standard deviation of a row in the image, pixels; "pixel" only.
    robust_scale : float, optional
        Errors well past this many standard deviations lose their pull (Geman-McClure), and discs
        may be out of sight; None: least squares.
    odometry_scale : float
        Factor on the odometry's standard deviations: above 1, the path follows the discs rather.
    mounting : bool
        Whether the camera's rotation and height are unknowns.
    tilt_sigma : float
        Standard deviation of a frame's pitch and roll, radians; 0: the robot doesn't tilt.
    """

    metric: Literal["floor", "pixel"] = "floor"
    pixel_sigma: float = 1.0
    robust_scale: float | None = None
    odometry_scale: float = 1.0
    mounting: bool = True
    tilt_sigma: float = 0.0


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """J^T J and J^T r at one geometry, the mounting's four columns apart.

    The other unknowns come in the order poses, discs, tilt (the last only where it is one).

    Parameters
    ----------
    matrix : (K, K) sparse array
        Of all unknowns but the mounting.
    gradient : (K,) float array
        Of the same.
    border : (K, 4) float array
        Between them and the mounting; (K, 0) where that is no unknown.
    corner : (4, 4) float array
        Of the mounting.
    border_gradient : (4,) float array
        Of the mounting.
    """

    matrix: sparse.csc_array
    gradient: FloatArray
    border: FloatArray
    corner: FloatArray
    border_gradient: FloatArray


def mahalanobis(
    camera: Camera, pixels: FloatArray, row_xy: FloatArray, row_covariance: FloatArray
) -> FloatArray:
    """How far pixels, put on the floor by the calibrated camera, are from rows.

    Parameters
    ----------
    camera : Camera
        As calibrated.
    pixels : (n, 2) float array
        Where discs are seen; NaN for out of sight.
    row_xy, row_covariance : (n, 2) and (n, 2, 2) float arrays
        Rows in the robot frame, metres, and their covariances.

    Returns
    -------
    (n,) float array
        In standard deviations; infinite where a disc is out of sight.
    """
    error = camera.floor_from_pixel(pixels) - row_xy
    whitened = np.linalg.solve(np.linalg.cholesky(row_covariance), error[..., None])
    distance = np.linalg.norm(whitened[..., 0], axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def row_distances(camera: Camera, recording: Recording, geometry: Geometry) -> FloatArray:
    """(n,) Mahalanobis distances of the rows that a geometry predicts from the recorded ones."""
    pixels, _ = predict_pixels(camera, geometry, recording.frame, recording.disc)
    return mahalanobis(camera, pixels, recording.row_xy, recording.row_covariance)


def cost(camera: Camera, recording: Recording, geometry: Geometry, weighting: Weighting) -> float:
    """Sum of (robust) squared errors; infinite where least squares meets a disc out of sight."""
    residual, _ = _row_residuals(camera, recording, geometry, weighting)
    rows, _ = _robust(np.sum(residual**2, axis=1), weighting)
    if not np.all(np.isfinite(rows)):
        return float("inf")
    steps, _, _ = odometry_residuals(geometry.poses, recording.steps)
    whitened = np.einsum("nij,nj->ni", _odometry_whitening(recording, weighting), steps)
    total = float(np.sum(rows) + np.sum(whitened**2))
    if weighting.tilt_sigma > 0.0:
        total += float(np.sum((geometry.tilt / weighting.tilt_sigma) ** 2))
    return total


def normal_equations(
    camera: Camera, recording: Recording, geometry: Geometry, weighting: Weighting
) -> NormalEquations:
    """Linearise the errors at a geometry; robust ones as reweighted least squares."""
    frames, discs = len(geometry.poses), len(geometry.disc_xy)
    tilted = weighting.tilt_sigma > 0.0
    first_disc, first_tilt = 3 * frames, 3 * frames + 2 * discs
    size = first_tilt + (2 * frames if tilted else 0)

    residual, jacobians = _row_residuals(camera, recording, geometry, weighting)
    _, weight = _robust(np.sum(residual**2, axis=1), weighting)
    root = np.sqrt(weight)[:, None]
    # A disc out of sight has no weight, but NaN times 0 is not 0.
    error = (np.nan_to_num(residual, nan=0.0) * root).ravel()
    by_pose, by_tilt, by_disc, by_mounting = (
        np.nan_to_num(jacobian, nan=0.0) * root[:, None] for jacobian in jacobians
    )
    blocks = [(3 * recording.frame, by_pose), (first_disc + 2 * recording.disc, by_disc)]
    if tilted:
        blocks.append((first_tilt + 2 * recording.frame, by_tilt))
    jacobian = _sparse_rows(blocks, size)
    border_jacobian = by_mounting.reshape(-1, 4)[:, : 4 if weighting.mounting else 0]

    steps, by_before, by_after = odometry_residuals(geometry.poses, recording.steps)
    whiten = _odometry_whitening(recording, weighting)
    by_before[0] = 0.0  # before the first step the robot stands at the map's origin
    after = 3 * np.arange(frames, dtype=np.int64)
    step_jacobian = _sparse_rows(
        [(np.maximum(after - 3, 0), whiten @ by_before), (after, whiten @ by_after)], size
    )
    step_error = np.einsum("nij,nj->ni", whiten, steps).ravel()

    matrix = jacobian.T @ jacobian + step_jacobian.T @ step_jacobian
    gradient = jacobian.T @ error + step_jacobian.T @ step_error
    if tilted:
        prior = np.zeros(size)
        prior[first_tilt:] = weighting.tilt_sigma**-2
        matrix = matrix + sparse.diags_array(prior)
        gradient[first_tilt:] += geometry.tilt.ravel() * weighting.tilt_sigma**-2
    return NormalEquations(
        matrix=matrix.tocsc(),
        gradient=gradient,
        border=np.asarray(jacobian.T @ border_jacobian),
        corner=border_jacobian.T @ border_jacobian,
        border_gradient=border_jacobian.T @ error,
    )


def _row_residuals(
    camera: Camera, recording: Recording, geometry: Geometry, weighting: Weighting
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Whitened row residuals (n, 2) and their derivatives by pose, tilt, disc and mounting."""
    pixels, by = predict_pixels(camera, geometry, recording.frame, recording.disc)
    if weighting.metric == "pixel":
        whiten = np.broadcast_to(np.eye(2) / weighting.pixel_sigma, (len(pixels), 2, 2))
        residual = (pixels - recording.pixels) / weighting.pixel_sigma
    else:
        inverse_root = np.linalg.inv(np.linalg.cholesky(recording.row_covariance))
        error = camera.floor_from_pixel(pixels) - recording.row_xy
        residual = np.einsum("nij,nj->ni", inverse_root, error)
        whiten = inverse_root @ camera.floor_jacobian(pixels)
    return residual, tuple(whiten @ j for j in (by.pose, by.tilt, by.disc, by.mounting))


def _robust(squared: FloatArray, weighting: Weighting) -> tuple[FloatArray, FloatArray]:
    """Geman-McClure costs of squared errors, and the weights of the equivalent least squares."""
    if weighting.robust_scale is None:
        return squared, np.ones_like(squared)
    c2 = weighting.robust_scale**2
    seen = np.isfinite(squared)
    return (
        np.where(seen, squared * c2 / (c2 + squared), c2),
        np.where(seen, (c2 / (c2 + squared)) ** 2, 0.0),
    )


def _odometry_whitening(recording: Recording, weighting: Weighting) -> FloatArray:
    root = np.linalg.cholesky(recording.step_covariance) * weighting.odometry_scale
    return np.asarray(np.linalg.inv(root))


def _sparse_rows(blocks: list[tuple[IntArray, FloatArray]], size: int) -> sparse.csr_array:
    """A Jacobian of `size` columns out of dense blocks (n, k, m) at column offsets (n,)."""
    values, rows, columns = [], [], []
    for offset, block in blocks:
        count, height, width = block.shape
        row = np.arange(count * height, dtype=np.int64).reshape(count, height, 1)
        column = offset[:, None, None] + np.arange(width, dtype=np.int64)
        values.append(block.ravel())
        rows.append(np.broadcast_to(row, block.shape).ravel())
        columns.append(np.broadcast_to(column, block.shape).ravel())
    count, height, _ = blocks[0][1].shape
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_array(entries, shape=(count * height, size))
