"""Settings of laser tracking, for the command line and library callers."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from redetect.groundtruth.errors import GroundTruthError
from redetect.storage.bounds import SHARE_ABOVE_0, demand, whole


@dataclass(frozen=True)
class LaserSettings:
    """Settings of laser tracking.

    Parameters
    ----------
    gate_m : float
        Farthest that a reading may lie from the robot's outline (m).
    kept : float
        Share of the readings within the gate that the ICP counts: the best.
    threshold_m : float
        The ICP ends when its root mean square error changes by less than this (m).
    most_steps : int
        Largest number of steps of the ICP.
    floor_m : float
        Standard deviation of a reading's distance from the outline that does not depend on the
        scanner's noise: the outline is drawn to millimetres (m).
    least_slope : float
        Readings along a face, whose beam and normal have a smaller cosine, count as if it were
        this: their distances from the face are small whatever the pose.
    gate_sigma : float
        The final pose uses readings up to this many standard deviations off.
    weak_sigma_m : float
        A direction is undetermined if the pose's standard deviation along it is larger (m;
        a turn counts by what it does to the farthest corner).
    least_readings : int
        A pose needs as many.
    acquire_readings : int
        A robot that is found again needs as many.
    coast_s : float
        The robot is lost after so long without a pose (s).
    acquire_s : float
        When the robot is lost, it is searched this often (s).
    headings : int
        Headings that the search begins from.
    link_m : float
        New readings nearer to each other than this may be of one object (m).
    least_agreement : float
        Share of the beams that should see the robot, or see something beside it, that must agree
        with a pose found.
    symmetry_m : float
        The outline counts as symmetric if it is nowhere farther from itself when rotated (m).
    front_sigma : float
        The readings identify the front if the residuals differ by this many standard errors.
    forward_m : float
        Otherwise the front is known after the robot has driven this much farther forward than
        backward (m).

    Raises
    ------
    GroundTruthError
        If a number is out of range.
    """

    gate_m: float = 0.2
    kept: float = 0.95
    threshold_m: float = 1e-5
    most_steps: int = 60
    floor_m: float = 0.001
    least_slope: float = 0.35
    gate_sigma: float = 3.5
    weak_sigma_m: float = 0.03
    least_readings: int = 8
    acquire_readings: int = 16
    coast_s: float = 0.25
    acquire_s: float = 0.05
    headings: int = 24
    link_m: float = 0.3
    least_agreement: float = 0.75
    symmetry_m: float = 0.12
    front_sigma: float = 5.0
    forward_m: float = 0.3

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            zero = entry.name in ("floor_m", "acquire_s", "coast_s")
            if not (math.isfinite(value) and (value > 0 or (zero and value == 0))):
                least = "0 or more" if zero else "more than 0"
                raise GroundTruthError(f"{entry.name} is {value!r}: expected {least}")
        demand(
            self,
            GroundTruthError,
            kept=SHARE_ABOVE_0,
            least_agreement=SHARE_ABOVE_0,
            most_steps=whole(1),
            least_readings=whole(1),
            acquire_readings=whole(1),
            headings=whole(1),
        )
