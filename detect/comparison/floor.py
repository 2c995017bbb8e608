"""Figures of errors, None where there is nothing to compute them from."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from detect.comparison.result import FloorDifference, NormalisedError
from redetect.array_types import FloatArray
from redetect.landmarks import is_positive_definite, squared_mahalanobis


def quantile(values: FloatArray, q: float = 0.5) -> float | None:
    """Quantile of `values`, interpolated linearly; by default the median."""
    return float(np.quantile(values, q)) if len(values) else None


def normalised_error(offset: FloatArray, covariance: FloatArray) -> NormalisedError:
    """Mean of squared normalised errors (N, n), with the central 95 % of chi-square.

    Errors whose covariance (N, n, n) is not positive definite are left out.
    """
    usable = is_positive_definite(covariance)
    left_out = int((~usable).sum())
    dof = offset[usable].size
    if dof == 0:
        return NormalisedError(per_dof=None, dof=0, band=None, left_out=left_out)
    squared = squared_mahalanobis(offset[usable], covariance[usable])
    low, high = (float(chdtri(dof, 1.0 - p)) / dof for p in (0.025, 0.975))
    return NormalisedError(float(squared.sum()) / dof, dof, (low, high), left_out)


def floor_difference(offset: FloatArray, away: FloatArray) -> FloorDifference:
    """Figures of differences (N, 2) on the floor (m), seen along unit vectors `away` (N, 2)."""
    size = np.asarray(np.linalg.norm(offset, axis=1))
    return FloorDifference(
        pairs=len(offset),
        median_m=quantile(size),
        most_m=quantile(size, 0.95),
        along_m=quantile((offset * away).sum(axis=1)),
        # Forward is -Y and left is X: left of a direction is it turned from -Y to X.
        across_m=quantile(away[:, 0] * offset[:, 1] - away[:, 1] * offset[:, 0]),
    )
