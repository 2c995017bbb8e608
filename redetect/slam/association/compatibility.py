"""Which rows show which known landmarks: individual gate, or joint compatibility (JCBB).

A frame's innovations are not independent: all of them carry the error of the one pose. Joint
compatibility tests whether a set of pairs is likely *together*; branch and bound finds the largest
such set (J. Neira, J. D. Tardos, "Data association in stochastic mapping using the joint
compatibility test", IEEE Transactions on Robotics and Automation 17(6), 2001).

Everything here is in terms of innovations and covariances, whatever the landmarks are: of n rows
and m landmarks that may be in view, each measured by d numbers (2 for a disc, 1 for a bearing).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from redetect.slam.association.compatibility_kernels import (
    individual_distances,
    pair_nearest_first,
    search_jointly,
)
from redetect.slam.errors import SlamError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

DEFAULT_GATE_PROBABILITY = 0.999
MOST_NODES = 20_000


@dataclass(frozen=True, eq=False)
class Pairing:
    """Rows and the landmarks they show.

    Attributes
    ----------
    landmark : (n,) int64
        Index of each row's landmark, -1 where it shows none of them; none is there twice.
    squared_distance : float
        Squared Mahalanobis distance of all pairs: joint for `joint_compatible`, the sum of the
        single ones for `nearest_compatible`.
    complete : bool
        Whether the search was finished: only then is no better pairing left.
    """

    landmark: IntArray
    squared_distance: float
    complete: bool = True


def nearest_compatible(
    innovations: ArrayLike,
    predicted_covariance: ArrayLike,
    noise: ArrayLike,
    *,
    gate_probability: float = DEFAULT_GATE_PROBABILITY,
) -> Pairing:
    """Nearest neighbour with Mahalanobis gate: closest pairs first, each row and landmark once.

    Takes `innovations` (n, m, d), `predicted_covariance` (m d, m d), `noise` (n, d, d).
    """
    innovation, predicted, measured = _checked(innovations, predicted_covariance, noise)
    width = innovation.shape[2]
    squared = individual_distances(innovation, predicted, measured)
    landmark = pair_nearest_first(squared, chi_squared_gates(gate_probability, width, 1)[1])
    paired = np.flatnonzero(landmark >= 0)
    return Pairing(landmark, float(np.sum(squared[paired, landmark[paired]])))


def joint_compatible(
    innovations: ArrayLike,
    predicted_covariance: ArrayLike,
    noise: ArrayLike,
    *,
    gate_probability: float = DEFAULT_GATE_PROBABILITY,
    most_nodes: int = MOST_NODES,
) -> Pairing:
    """The largest set of pairs that are compatible jointly; among equals the most likely one.

    Branch and bound. Every pair must pass the individual gate, and all k pairs together the gate of
    d k degrees of freedom. Unlike the published search, a branch is only given up where no set
    below it can pass, so that the result does not depend on the order of the rows.

    Takes `innovations` (n, m, d), `predicted_covariance` (m d, m d), `noise` (n, d, d).
    """
    innovation, predicted, measured = _checked(innovations, predicted_covariance, noise)
    n, _, width = innovation.shape
    squared = individual_distances(innovation, predicted, measured)
    gates = chi_squared_gates(gate_probability, width, n)
    landmark, distance, nodes = search_jointly(
        innovation, predicted, measured, squared, gates, most_nodes
    )
    return Pairing(landmark, float(distance), nodes < most_nodes)


def chi_squared_gates(probability: float, width: int, most_pairs: int) -> FloatArray:
    """Largest squared distances of 0, 1, 2, ... pairs that stay below with a probability.

    Returns (most_pairs, 1).
    """
    if not 0.0 < probability < 1.0:
        raise SlamError(f"gate_probability is {probability}: expected above 0 and below 1")
    return _gates(float(probability), int(width), max(int(most_pairs), 1)).copy()


@cache
def _gates(probability: float, width: int, most_pairs: int) -> FloatArray:
    gates = np.zeros(most_pairs + 1)
    gates[1:] = chdtri(width * np.arange(1, most_pairs + 1), 1.0 - probability)
    return gates


def _checked(
    innovations: ArrayLike, predicted_covariance: ArrayLike, noise: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    innovation = np.ascontiguousarray(innovations, dtype=np.float64)
    predicted = np.ascontiguousarray(predicted_covariance, dtype=np.float64)
    measured = np.ascontiguousarray(noise, dtype=np.float64)
    if innovation.ndim != 3:
        raise SlamError(f"innovations {innovation.shape}: expected (rows, landmarks, numbers)")
    n, m, width = innovation.shape
    if predicted.shape != (m * width, m * width) or measured.shape != (n, width, width):
        raise SlamError(
            f"predicted covariance {predicted.shape}, noise {measured.shape}: expected "
            f"{(m * width, m * width)} and {(n, width, width)} with innovations {innovation.shape}"
        )
    return innovation, predicted, measured
