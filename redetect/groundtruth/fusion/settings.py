"""Assumed errors of odometry, and limits of measured poses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError

_DEVIATIONS = (
    "distance_sigma",
    "lateral_sigma",
    "turn_sigma",
    "turn_per_metre_sigma",
    "turn_scale_sigma",
    "turn_bias_per_metre_sigma",
    "distance_scale_sigma",
)


@dataclass(frozen=True)
class FuseSettings:
    """How odometry errs, and how far a measurement may be off.

    Parameters
    ----------
    distance_sigma : float
        Standard deviation of odometry's distance after a metre (m); it grows with the root.
    lateral_sigma : float
        How far the robot slips sideways within a metre (m), its standard deviation; it grows with
        the root. The lateral error by a wrong heading is not part of it.
    turn_sigma : float
        Standard deviation of its heading after turning a radian (rad).
    turn_per_metre_sigma : float
        The same after a metre driven (rad).
    learn_noise : bool
        Scale these deviations (distance's, the sideways one, and both of the heading together) by
        what makes the measurements likeliest; they only begin the search then.
    turn_scale_sigma, turn_bias_per_metre_sigma, distance_scale_sigma : float
        Standard deviations, before anything was measured, of what odometry is off by: the share of
        each turn, the turn per metre (rad), the share of each way. Terms that make no better
        predictions are left out.
    gate_probability : float
        Share of right poses that pass the gate.
    covariance_scale : dict of str to float
        Factors on the measurements' covariances, by the stream's name; others count as 1.

    Raises
    ------
    GroundTruthError
        If a number is not finite, negative, or no probability.
    """

    distance_sigma: float = 0.02
    lateral_sigma: float = 0.01
    turn_sigma: float = 0.02
    turn_per_metre_sigma: float = 0.01
    learn_noise: bool = True
    turn_scale_sigma: float = 0.03
    turn_bias_per_metre_sigma: float = 0.01
    distance_scale_sigma: float = 0.03
    gate_probability: float = 0.9999
    covariance_scale: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        for name in _DEVIATIONS:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise GroundTruthError(f"{name} is {value}: expected 0 or more")
        if not 0.0 < self.gate_probability < 1.0:
            raise GroundTruthError(
                f"gate_probability is {self.gate_probability}: expected between 0 and 1"
            )
        for name, value in (self.covariance_scale or {}).items():
            if not (math.isfinite(value) and value > 0.0):
                raise GroundTruthError(f"covariance scale of {name} is {value}: expected above 0")

    def systematic_sigmas(self) -> NDArray[np.float64]:
        """(3,) of the turns' share, the turn per metre (rad) and the ways' share."""
        return np.array(
            [self.turn_scale_sigma, self.turn_bias_per_metre_sigma, self.distance_scale_sigma]
        )

    def with_terms(self, kept: NDArray[np.bool_]) -> FuseSettings:
        """With some of these three alone; the others are taken to be 0."""
        turn, bend, way = np.where(kept, self.systematic_sigmas(), 0.0).tolist()
        return replace(
            self,
            turn_scale_sigma=turn,
            turn_bias_per_metre_sigma=bend,
            distance_scale_sigma=way,
        )
