"""Levenberg and Marquardt's method for poses, which are moved by tangents; sparse or dense.

SciPy's `least_squares` has unknowns in a vector space and no covariances of sparse problems; the
rest here is SciPy's and NumPy's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from scipy.sparse import diags_array, issparse
from scipy.sparse.linalg import splu

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GeometryError

Poses = TypeVar("Poses")

UNDETERMINED = "the points do not determine all poses"
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-14, 1e12
_MOST_STEPS = 200
# The share of the cost that rounding may hide.
_COST_TOLERANCE = 1e-15


@dataclass(frozen=True, eq=False)
class Linearised(Generic[Poses]):
    """A sum of losses about some poses."""

    cost: float  # Half the sum
    gradient: FloatArray  # (n,)
    normal: Any  # (n, n): J'J, weighted by the losses' curvature
    # The cost at other poses, with the weights of these; infinite where there is none.
    cost_at: Callable[[Poses], float]


def minimised(
    start: Poses,
    linearise: Callable[[Poses], Linearised[Poses]],
    moved: Callable[[Poses, FloatArray], Poses],
    tolerance: float,
) -> Poses:
    """The poses at the nearest minimum; steps (m, rad) below the tolerance end the search."""
    poses, here, damping = start, linearise(start), _DAMPING
    for _ in range(_MOST_STEPS):
        diagonal = here.normal.diagonal()
        # Parameters on which no residual depends are kept fixed.
        added = damping * np.where(diagonal > 0.0, diagonal, 1.0)
        try:
            step = -solved(here.normal, here.gradient, added)
        except np.linalg.LinAlgError:
            damping *= 10.0
            if damping > _MOST_DAMPING:
                raise GeometryError(UNDETERMINED) from None
            continue
        ahead = moved(poses, step)
        cost = here.cost_at(ahead)
        gain = 0.5 * float(step @ (added * step - here.gradient))
        settled = np.abs(step).max() < tolerance or gain <= _COST_TOLERANCE * here.cost
        # Near the minimum rounding decides which cost is less; such steps are right all the same.
        if cost <= here.cost * (1.0 + _COST_TOLERANCE) + 1e-20:
            poses = ahead
            if settled:
                break
            damping = max(0.1 * damping, _LEAST_DAMPING)
            here = linearise(poses)
        elif settled or damping > _MOST_DAMPING:
            break
        else:
            damping *= 10.0
    return poses


def solved(normal: Any, right: FloatArray, added: FloatArray | float = 0.0) -> FloatArray:
    """Solution of a symmetric system, sparse or dense, with numbers added to its diagonal."""
    on_diagonal = np.broadcast_to(added, len(right))
    if not issparse(normal):
        return np.asarray(np.linalg.solve(normal + np.diag(on_diagonal), right))
    try:
        factors = splu(
            (normal + diags_array(on_diagonal)).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            options={"SymmetricMode": True},
        )
    except RuntimeError:
        raise np.linalg.LinAlgError("singular") from None
    return np.asarray(factors.solve(right))


def inverted_information(information: FloatArray) -> FloatArray:
    """Covariance of an information matrix."""
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
