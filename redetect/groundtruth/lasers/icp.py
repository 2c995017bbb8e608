"""Planar ICP: points to points, or to line segments such as an outline or a building map.

Each step pairs every point with the nearest target point within a gate, keeps the best share of the
pairs and fits the rigid motion by singular values (in the plane: in closed form), until the root
mean square error changes by less than a threshold.

References
----------
P. J. Besl, N. D. McKay, "A method for registration of 3-D shapes", PAMI 14, 1992.
D. Chetverikov et al., "The trimmed iterative closest point algorithm", ICPR 2002.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.lasers.icp_kernels import moved, nearest_on_segments, rigid_fit
from redetect.storage.bounds import ABOVE_0, SHARE_ABOVE_0, demand, whole

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class IcpSettings:
    """Settings of an ICP.

    Parameters
    ----------
    gate_m : float
        Pairs farther apart than this do not count (m).
    kept : float
        Share of the pairs within the gate that counts: the best.
    threshold_m : float
        The ICP ends when the root mean square error changes by less than this (m).
    most_steps : int
        Largest number of steps; after these the ICP has not converged.
    weak_sigma_m : float
        A direction is undetermined if the pose's standard deviation along it is larger than this
        (m; a rotation counts by what it does to the points, root mean square).

    Raises
    ------
    GroundTruthError
        If a number is out of range.
    """

    gate_m: float = 0.2
    kept: float = 0.95
    threshold_m: float = 1e-7
    most_steps: int = 500
    weak_sigma_m: float = 0.05

    def __post_init__(self) -> None:
        demand(
            self,
            GroundTruthError,
            gate_m=ABOVE_0,
            kept=SHARE_ABOVE_0,
            threshold_m=ABOVE_0,
            most_steps=whole(1),
            weak_sigma_m=ABOVE_0,
        )


@dataclass(frozen=True, eq=False)
class IcpResult:
    """Where an ICP ended.

    Attributes
    ----------
    pose : (3,) float64
        x, y (m), theta (rad): takes the points to the target's frame.
    covariance : (3, 3) float64
        Of the pose, from the residuals' size and the geometry; infinite on the diagonal where the
        geometry determines nothing at all.
    rms_m : float
        Root mean square distance of the pairs that count.
    used : (n,) bool
        Which points count.
    steps : int
        Steps made.
    converged : bool
        False if the error was still changing.
    undetermined : (k, 3) float64
        Directions of (x, y, theta) that the geometry leaves open, of unit length with theta
        measured by what it does to the points; k is 0 for a good pose.
    """

    pose: FloatArray
    covariance: FloatArray
    rms_m: float
    used: BoolArray
    steps: int
    converged: bool
    undetermined: FloatArray


def icp_to_segments(
    points: ArrayLike,
    segments: ArrayLike,
    start: ArrayLike = (0.0, 0.0, 0.0),
    settings: IcpSettings | None = None,
) -> IcpResult:
    """Align points with line segments: an outline, a building map.

    Parameters
    ----------
    points : (n, 2) array
        To be moved (m).
    segments : (k, 4) array
        x1, y1, x2, y2 (m).
    start : (3,) array
        Pose to start from.
    settings : IcpSettings, optional

    Returns
    -------
    IcpResult

    Raises
    ------
    GeometryError
        If fewer than three pairs are within the gate.
    GroundTruthError
        If a shape is wrong or a number not finite.
    """
    lines = _checked(segments, 4, "segments")
    along = lines[:, 2:] - lines[:, :2]
    length = np.hypot(along[:, 0], along[:, 1])
    unit = along / np.where(length > 0.0, length, 1.0)[:, None]
    normals = np.stack([-unit[:, 1], unit[:, 0]], axis=-1)

    def nearest(world: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
        near, index, squared = nearest_on_segments(world, lines)
        return near, squared, index

    def normals_of(world: FloatArray, index: NDArray[np.int64]) -> FloatArray:
        return np.asarray(normals[index])

    return _icp(_checked(points, 2, "points"), nearest, normals_of, start, settings)


def trimmed_variance(kept: float) -> tuple[float, float]:
    """Factor of variances due to keeping only the best share of Gaussian residuals.

    Returns
    -------
    shrinkage : float
        Variance of the residuals kept, relative to all.
    inflation : float
        Variance of a mean of those kept by their own distance from it, relative to the mean of as
        many residuals as were kept.

    Notes
    -----
    With the cut c at +-c sigma and phi the normal density, both follow from
    v = kept - 2 c phi(c), the part of the variance within the cut, which is also the derivative of
    the estimating equation: shrinkage v / kept, variance v / v^2 per residual, kept or not.
    """
    if kept >= 1.0:
        return 1.0, 1.0
    cut = float(ndtri(0.5 * (1.0 + kept)))
    inside = kept - 2.0 * cut * math.exp(-0.5 * cut * cut) / math.sqrt(2.0 * math.pi)
    return inside / kept, kept / inside


def open_directions(information: FloatArray, scale_m: float, weak_sigma_m: float) -> FloatArray:
    """Directions (k, 3) of (x, y, theta) along which information (3, 3) is too little.

    Parameters
    ----------
    information : (3, 3) array
        Information about x, y (m) and theta (rad).
    scale_m : float
        Metres that count as much as a radian.
    weak_sigma_m : float
        Largest standard deviation of a direction that is determined (m).
    """
    scale = np.array([1.0, 1.0, 1.0 / max(scale_m, 1e-9)])
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale[None, :])
    return np.asarray(vectors[:, values < 1.0 / weak_sigma_m**2].T)


def _icp(
    points: FloatArray,
    nearest: Callable[[FloatArray], tuple[FloatArray, FloatArray, Any]],
    normals_of: Callable[[FloatArray, Any], FloatArray],
    start: ArrayLike,
    settings: IcpSettings | None,
) -> IcpResult:
    s = IcpSettings() if settings is None else settings
    pose = np.array(start, dtype=np.float64)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise GroundTruthError(f"start {start!r}: expected three finite numbers")
    before, converged, step = math.inf, False, 0
    while True:
        world = moved(points, pose)
        target, squared, index = nearest(world)
        used = best_share(squared, s.gate_m, s.kept)
        if int(used.sum()) < 3:
            raise GeometryError(
                f"{int(used.sum())} of {len(points)} points within {s.gate_m:g} m of the target: "
                "expected 3 or more"
            )
        rms = math.sqrt(float(squared[used].mean()))
        converged = abs(before - rms) < s.threshold_m
        if converged or step == s.most_steps:
            break
        before, step = rms, step + 1
        pose = rigid_fit(points, target, used)
    normals = normals_of(world[used], index[used])
    covariance, undetermined = _uncertainty(pose, world[used], target[used], normals, s)
    return IcpResult(pose, covariance, rms, used, step, converged, undetermined)


def best_share(squared: FloatArray, gate_m: float, kept: float) -> BoolArray:
    """Which of (n,) squared distances (m^2) are within the gate and among the best share."""
    within = np.asarray(squared <= gate_m * gate_m)
    count = int(within.sum())
    if kept < 1.0 and count > 0:
        last = math.ceil(kept * count) - 1
        limit = np.partition(squared[within], last)[last]
        within &= squared <= limit
    return within


def _uncertainty(
    pose: FloatArray, world: FloatArray, target: FloatArray, normals: FloatArray, s: IcpSettings
) -> tuple[FloatArray, FloatArray]:
    """Covariance (3, 3) of a converged pose, and the directions (k, 3) that are open."""
    lever = world - pose[:2]
    rows = np.column_stack([normals, normals[:, 1] * lever[:, 0] - normals[:, 0] * lever[:, 1]])
    residual = np.sum(normals * (world - target), axis=1)
    on_lines = np.any(normals != 0.0, axis=1)
    freedom = max(int(on_lines.sum()) - 3, 1)
    shrinkage, inflation = trimmed_variance(s.kept)
    variance = float(residual @ residual) / freedom / shrinkage
    # Exactly fitting points do not make a pose exact to less than rounding.
    information = rows.T @ rows / max(variance * inflation, 1e-18)
    # About the middle of the points, where rotation and translation are least correlated.
    middle = lever.mean(axis=0)
    scale_m = math.sqrt(float(np.mean(np.sum((lever - middle) ** 2, axis=1))))
    shift = np.array([[1.0, 0.0, middle[1]], [0.0, 1.0, -middle[0]], [0.0, 0.0, 1.0]])
    undetermined = open_directions(shift.T @ information @ shift, scale_m, s.weak_sigma_m)
    values, vectors = np.linalg.eigh(information)
    if values[0] <= 1e-12 * values[2]:
        return np.diag(np.full(3, np.inf)), undetermined
    return np.asarray((vectors / values) @ vectors.T), undetermined


def _checked(values: ArrayLike, columns: int, name: str) -> FloatArray:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != columns or len(array) == 0:
        raise GroundTruthError(f"{name} of shape {array.shape}: expected (n, {columns}), n > 0")
    if not np.isfinite(array).all():
        raise GroundTruthError(f"{name} with a number that is not finite")
    return array
