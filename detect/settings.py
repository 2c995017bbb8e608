"""What decides the detectors' results: configuration and command line flags in one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from detect.errors import DetectError

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
        Centres are so near that the floor moves at most this far per image row, metres.
    polarity : {"any", "light", "dark"}
        Which discs to look for: lighter than the floor, darker, or both.
    noise_floor : float
        Least contrast between the outlines, in standard deviations of the image's noise (or in
        grey levels, where the noise is less than one).
    separation_m : float
        Of detections closer than this on the floor only the best is reported; 0 reports all.
    verify : bool
        Fit a disc to the grey values at each candidate and drop those without evidence of a disc.
    evidence : float
        Least evidence (log-odds, see `detect.disc_fit.disc_evidence`).
    blur_px : float
        Standard deviation of the optics' blur along u, pixels. Blurred edges speak against a disc
        unless the camera blurs everything: the data set's own does, by about 6.
    refine : bool
        Report the fitted position and its covariance instead of the pixel's.
    systematic_px : float
        Systematic error of a refined position, pixels: added to its covariance.
    tilt_sigma_deg : float
        Uncertainty of the robot's pitch and roll, degrees: added to a refined position's
        covariance.
    """

    radius_m: float = 0.10
    inner_radius_m: float = 0.06
    outer_radius_m: float = 0.14
    samples: int = 16
    threshold: float = 0.4
    border_px: int = 12
    far_limit_m_per_px: float = 0.12
    polarity: Polarity = "any"
    noise_floor: float = 3.0
    separation_m: float = 0.14
    verify: bool = True
    evidence: float = 1.1
    blur_px: float = 1.0
    refine: bool = True
    systematic_px: float = 0.002
    tilt_sigma_deg: float = 0.0

    def __post_init__(self) -> None:
        _expect(0.0 < self.threshold <= 1.0, "threshold", self.threshold, "above 0, at most 1")
        _expect(0.0 < self.radius_m < math.inf, "radius_m", self.radius_m, "above 0")
        _expect(
            self.inner_radius_m < self.radius_m < self.outer_radius_m,
            "radius_m",
            self.radius_m,
            f"between the outlines ({self.inner_radius_m:g} and {self.outer_radius_m:g})",
        )
        for name in ("noise_floor", "separation_m", "blur_px", "systematic_px", "tilt_sigma_deg"):
            value = getattr(self, name)
            _expect(0.0 <= value < math.inf, name, value, "0 or more")
        _expect(math.isfinite(self.evidence), "evidence", self.evidence, "a finite number")


#: The report's detector to the letter.
PUBLISHED = CircleSettings(
    threshold=0.6,
    far_limit_m_per_px=0.05,
    noise_floor=0.0,
    separation_m=0.0,
    verify=False,
    refine=False,
)
