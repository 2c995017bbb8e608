"""Settings of association and of added noise, for the command line and library callers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from redetect.bounds import PROBABILITY, Bounded, NotNegative, Positive, from_to, whole
from redetect.slam.errors import SlamError

#: A pose given by flags (m, m, rad), and its standard deviations.
Place = Annotated[tuple[float, float, float], from_to(-1e12, 1e12)]
PlaceSigma = Annotated[tuple[float, float, float], from_to(0.0, 1e12)]
#: How rows are paired with landmarks; `known`: by their identifiers.
Method = Literal["nearest", "joint"]
Association = Literal["known", "nearest", "joint"]
#: Solvers of the map, and how rows are compared with discs.
Solver = Literal["separable", "gtsam"]
RowErrors = Literal["corrected", "recorded"]
DEFAULT_GATE_PROBABILITY = 0.999
#: Ratio of chi-squared to its expectation above which covariances are too small, identifiers wrong,
#: or the start of least squares was.
MOST_FACTOR = 2.5


@dataclass(frozen=True)
class AssociateSettings(Bounded, error=SlamError):
    """How a run is associated."""

    # `nearest`: Mahalanobis distance of one row at a time; `joint`: joint compatibility of a
    # frame's rows (JCBB).
    method: Method = "joint"
    # Then close loops by matching local maps of landmarks.
    map_level: bool = True
    # Share of correct rows that pass.
    gate_probability: Annotated[float, PROBABILITY] = DEFAULT_GATE_PROBABILITY
    # Factor on the discs' standard deviations: tilt and calibration move a frame's discs together
    # by more than the file states.
    sigma_scale: Positive = 1.4
    # Standard deviation of the robot's sway about both axes of the floor, which moves all discs of
    # a frame together (degrees). Bearings are compensated for tilt.
    tilt_sigma_deg: Annotated[float, from_to(0.0, 45.0)] = 0.2
    # Share of a disc's correct rows that keep its ID at the map level, given the covariances in the
    # file; rows farther from its position in the map get -1.
    kept_probability: Annotated[float, PROBABILITY] = 0.99
    # Discs with fewer such rows count as clutter: their rows get -1.
    fewest_rows: Annotated[int, whole(1)] = 3

    @property
    def tilt_sigma_rad(self) -> float:
        """`tilt_sigma_deg` in radians."""
        return math.radians(self.tilt_sigma_deg)


@dataclass(frozen=True)
class AddedNoise(Bounded, error=SlamError):
    """Standard deviations of the added noise, independent for each number."""

    sigma: NotNegative = 0.0  # Added to disc positions along x and y (m).
    # Added to bearings of lines (rad). Their ends in the image stay as they are.
    bearing_sigma: NotNegative = 0.0
    step_sigma: NotNegative = 0.0  # Added to dx and dy of each step (m).
    turn_sigma: NotNegative = 0.0  # Added to dphi of each step (rad).
    # Seed of all random numbers. The files of discs and of lines of a run get the same odometry.
    seed: Annotated[int, whole(0)] = 1

    @property
    def nothing(self) -> bool:
        """Whether all are 0."""
        return not (self.sigma or self.bearing_sigma or self.step_sigma or self.turn_sigma)

    @property
    def comment(self) -> str:
        """The head of the file."""
        return (
            f"Noise was added, standard deviations: discs {self.sigma:g} m, bearings "
            f"{self.bearing_sigma:g} rad, dx and dy {self.step_sigma:g} m, dphi "
            f"{self.turn_sigma:g} rad; seed {self.seed}. The covariances are raised to match, of "
            "steps without one from the assumed noise of odometry."
        )
