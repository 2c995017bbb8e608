"""What decides the detectors' results: configuration and command line flags in one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from detect.errors import DetectError
from storage.bounds import (
    ABOVE_0,
    FINITE,
    LIMIT,
    NOT_NEGATIVE,
    SHARE_ABOVE_0,
    demand,
    from_to,
    whole,
)

Polarity = Literal["any", "light", "dark"]


def _expect(condition: bool, name: str, value: float, expected: str) -> None:
    if not condition:
        raise DetectError(f"{name} is {value:g}: expected {expected}")


@dataclass(frozen=True)
class CircleSettings:
    """Everything that decides what the disc detector finds.

    Parameters
    ----------
    radius_m : float
        Radius of the discs, metres.
    inner_radius_m : float
        Radius of the outline inside the disc's edge, metres.
    outer_radius_m : float
        Radius of the outline outside the disc's edge, metres.
    samples : int
        Samples on each outline.
    threshold : float
        Least quality (between-class / total variance), 0 to 1.
    border_px : int
        Centres keep this distance from the image's border, pixels.
    far_limit_m_per_px : float
        Centres are so near that the floor moves at most this far per image row, metres; infinite:
        however far.
    polarity : {"any", "light", "dark"}
        Which discs to look for: lighter than the floor, darker, or both.
    rows_apart : float
        Where all that is found is fitted (`verify` and `refine`), so many rows of centres are left
        out that none of a disc's is farther from one that is looked at than this share of the
        distance between the disc's edge and the nearer outline; 0: every row is looked at.
    noise_floor : float
        Least contrast between the outlines, in standard deviations of the image's noise (or in
        grey levels, where the noise is less than one).
    separation_m : float
        Of detections closer than this on the floor only the best is reported; 0 reports all.
    verify : bool
        Fit a disc to the grey values at each candidate and drop those without evidence of a disc.
    evidence : float
        Least evidence (log-odds, see `detect.discs.fit.disc_evidence`).
    blur_px : float
        Standard deviation of the optics' blur along u, pixels. Blurred edges speak against a disc
        unless the camera blurs everything: the data set's own does, by about 6.
    refine : bool
        Report the fitted position and its covariance instead of the pixel's.
    systematic_px : float
        Systematic error of a refined position, pixels: added to its covariance.
    tilt_sigma_deg : float
        Standard deviation of the robot's pitch and of its roll about level, degrees: added to a
        refined position's covariance. Where the frame's verticals tell the tilt, both are put
        together instead (`detect.levelling.with_prior`).
    """

    radius_m: float = 0.10
    inner_radius_m: float = 0.06
    outer_radius_m: float = 0.14
    samples: int = 16
    threshold: float = 0.5
    border_px: int = 12
    far_limit_m_per_px: float = 0.12
    polarity: Polarity = "any"
    rows_apart: float = 0.75
    noise_floor: float = 3.0
    separation_m: float = 0.14
    verify: bool = True
    evidence: float = 1.1
    blur_px: float = 1.0
    refine: bool = True
    systematic_px: float = 0.002
    tilt_sigma_deg: float = 0.0

    def __post_init__(self) -> None:
        demand(
            self,
            DetectError,
            threshold=SHARE_ABOVE_0,
            radius_m=ABOVE_0,
            inner_radius_m=ABOVE_0,
            outer_radius_m=ABOVE_0,
            samples=whole(3, 128),
            border_px=whole(0),
            far_limit_m_per_px=LIMIT,
            rows_apart=from_to(0.0, 1.0),
            noise_floor=NOT_NEGATIVE,
            separation_m=NOT_NEGATIVE,
            evidence=FINITE,
            blur_px=NOT_NEGATIVE,
            systematic_px=NOT_NEGATIVE,
            tilt_sigma_deg=from_to(0.0, 90.0),
        )
        _expect(
            self.inner_radius_m < self.radius_m < self.outer_radius_m,
            "radius_m",
            self.radius_m,
            f"between the outlines ({self.inner_radius_m:g} and {self.outer_radius_m:g})",
        )


#: The report's detector to the letter.
PUBLISHED = CircleSettings(
    threshold=0.6,
    far_limit_m_per_px=0.05,
    noise_floor=0.0,
    separation_m=0.0,
    verify=False,
    refine=False,
)
