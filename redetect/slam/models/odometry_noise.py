"""Noise of odometry to assume where its source states none.

A trajectory of a file, or wheel ticks, come without covariances, and zeros in a STEP row mean just
that. Errors of wheels grow with the way and with the turn, and there is a least one by the digits
and the clock of the source (S. Thrun, W. Burgard and D. Fox, Probabilistic Robotics, 2005, 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from redetect.array_types import FloatArray
from redetect.slam.errors import SlamError
from redetect.storage.bounds import ABOVE_0, NOT_NEGATIVE, demand


@dataclass(frozen=True)
class OdometryNoise:
    """Standard deviations of the steps of odometry that state none."""

    per_metre: float = 0.05  # of the way, as a share of it
    per_radian: float = 0.05  # of the turn, as a share of it
    turn_per_metre: float = 0.03  # of the turn by the way, radians per metre
    least_m: float = 0.005  # of every step's way, metres
    least_rad: float = 0.002  # of every step's turn, radians

    def __post_init__(self) -> None:
        demand(
            self,
            SlamError,
            per_metre=NOT_NEGATIVE,
            per_radian=NOT_NEGATIVE,
            turn_per_metre=NOT_NEGATIVE,
            least_m=ABOVE_0,
            least_rad=ABOVE_0,
        )

    def covariance(self, steps: FloatArray) -> FloatArray:
        """(N, 3, 3) covariances of (N, 3) steps dx, dy (m), dphi (rad)."""
        way, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
        of_way = (self.per_metre * way) ** 2 + self.least_m**2
        of_turn = (self.per_radian * turn) ** 2 + (self.turn_per_metre * way) ** 2
        diagonal = np.stack([of_way, of_way, of_turn + self.least_rad**2], axis=-1)
        return np.asarray(diagonal[:, :, None] * np.eye(3))

    def sentence(self) -> str:
        """Description of the assumed noise."""
        return (
            f"{100.0 * self.per_metre:g} % of the way, {100.0 * self.per_radian:g} % of the turn "
            f"and {self.turn_per_metre:g} rad per metre, at least {self.least_m:g} m and "
            f"{self.least_rad:g} rad"
        )
