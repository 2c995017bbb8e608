"""Figures of comparisons that are None where there is nothing to compute them from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from detect.comparison.result import NormalisedError
from landmarks import is_positive_definite, squared_mahalanobis

FloatArray = NDArray[np.float64]

_BAND = (0.025, 0.975)


def fraction(count: int, total: int) -> float | None:
    """Return `count` / `total`."""
    return count / total if total else None


def quantile(values: FloatArray, q: float) -> float | None:
    """Quantile of `values`, interpolated linearly."""
    return float(np.quantile(values, q)) if len(values) else None


def normalised_error(
    squared: FloatArray, *, dof_per_row: int, left_out: int = 0
) -> NormalisedError:
    """Mean of squared normalised errors and the interval where it should be.

    Parameters
    ----------
    squared : (N,) float64
        Squared errors in units of their covariance.
    dof_per_row : int
        Components of each error.
    left_out : int
        Errors that have no usable covariance.

    Returns
    -------
    NormalisedError
        With the central 95 % of the chi-square distribution as band.
    """
    dof = dof_per_row * len(squared)
    if dof == 0:
        return NormalisedError(per_dof=None, dof=0, band=None, left_out=left_out)
    low, high = (float(chdtri(dof, 1.0 - p)) / dof for p in _BAND)
    return NormalisedError(float(squared.sum()) / dof, dof, (low, high), left_out)


def disc_normalised_error(offset_xy: FloatArray, covariance: FloatArray) -> NormalisedError:
    """Of (N, 2) offsets on the floor with (N, 2, 2) covariances, positive definite ones alone."""
    usable = is_positive_definite(covariance)
    return normalised_error(
        squared_mahalanobis(offset_xy[usable], covariance[usable]),
        dof_per_row=2,
        left_out=int((~usable).sum()),
    )
