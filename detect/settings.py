"""Settings of the detectors, which are also the flags of the command line."""

from __future__ import annotations

import math
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

#: Tilt by which positions are corrected.
Levelling = Literal["none", "frame", "run"]
Polarity = Literal["any", "light", "dark"]


@dataclass(frozen=True)
class CircleSettings:
    """All settings of the disc detector.

    Parameters
    ----------
    radius_m : float
        Radius of the discs, metres.
    inner_ring : float
        Radius of the outline inside the disc's edge, as a share of the disc's.
    outer_ring : float
        Radius of the outline outside the disc's edge, as a share of the disc's.
    samples : int
        Samples on each outline.
    pairs_inside : float
        Samples are counted in pairs, an inner and an outer one, and at least this share of them
        must be inside the image; 0: samples are counted singly.
    apart_px : float
        How far the samples of a pair that fall on the same pixel are moved, one inwards and one
        outwards: the length on the floor of this many pixels down the image.
    stride : float
        From one centre to the next along a row: this share of the distance between the outlines,
        in pixels as long as one down the image, rounded up; 0: every pixel is a centre.
    threshold : float
        Least quality (between-class / total variance), 0 to 1.
    border_px : int
        Centres keep this distance from the image's border, pixels.
    far_limit : float
        Centres are so near that the floor moves at most this share of the radius per image row;
        infinite: however far.
    polarity : {"any", "light", "dark"}
        Which discs to detect: lighter than the floor, darker, or both.
    rows_apart : float
        If detections are fitted (`verify` and `refine`), rows of centres are skipped, as long as
        each row of a disc is at most this share of the distance between the disc's edge and the
        nearer outline from an evaluated row, and centres along a row, up to half of that; 0: every
        centre is evaluated.
    least_contrast : float
        Without a fit: the mean grey values of the outlines differ by more than this.
    noise_floor : float
        Least contrast between the outlines, in standard deviations of the image's noise (or in
        grey levels, where the noise is less than one).
    separation : float
        Of detections closer than this on the floor, in radii, only the best is reported; 0 reports
        all.
    verify : bool
        Fit a disc to the grey values at each candidate and drop those without evidence of a disc.
        Without this and `refine` nothing is fitted.
    evidence : float
        Least evidence (log-odds, see `detect.discs.fit.disc_evidence`).
    blur_px : float
        Standard deviation of the optics' blur along u, pixels. Blurred edges are evidence against a
        disc unless the camera blurs everything: the data set's own does, by about 6.
    refine : bool
        Report the fitted position and its covariance instead of the pixel's.
    systematic_px : float
        Systematic error of a refined position, pixels: added to its covariance.
    tilt_sigma_deg : float
        Standard deviation of the robot's pitch and of its roll about level, degrees: added to a
        refined position's covariance if the frame's tilt is unknown.
    """

    radius_m: float = 0.10
    inner_ring: float = 0.6
    outer_ring: float = 1.4
    samples: int = 16
    pairs_inside: float = 0.0
    apart_px: float = 0.0
    stride: float = 0.0
    threshold: float = 0.5
    border_px: int = 6
    far_limit: float = 1.2
    polarity: Polarity = "any"
    rows_apart: float = 0.75
    least_contrast: float = 0.0
    noise_floor: float = 3.0
    separation: float = 1.4
    verify: bool = True
    evidence: float = 0.6
    blur_px: float = 1.0
    refine: bool = True
    systematic_px: float = 0.002
    tilt_sigma_deg: float = 0.3

    def __post_init__(self) -> None:
        demand(
            self,
            DetectError,
            threshold=SHARE_ABOVE_0,
            radius_m=ABOVE_0,
            inner_ring=ABOVE_0,
            outer_ring=ABOVE_0,
            samples=whole(3, 128),
            pairs_inside=from_to(0.0, 1.0),
            apart_px=NOT_NEGATIVE,
            stride=NOT_NEGATIVE,
            border_px=whole(0),
            far_limit=LIMIT,
            rows_apart=from_to(0.0, 1.0),
            least_contrast=NOT_NEGATIVE,
            noise_floor=NOT_NEGATIVE,
            separation=NOT_NEGATIVE,
            evidence=FINITE,
            blur_px=NOT_NEGATIVE,
            systematic_px=NOT_NEGATIVE,
            tilt_sigma_deg=from_to(0.0, 90.0),
        )
        for name, least, most in (("inner_ring", 0.0, 1.0), ("outer_ring", 1.0, math.inf)):
            value = getattr(self, name)
            expected = "less" if name == "inner_ring" else "more"
            if not least < value < most:
                raise DetectError(
                    f"{name} is {value:g}: expected {expected} than 1, the disc's edge"
                )

    @property
    def inner_radius_m(self) -> float:
        """Radius of the outline inside the disc's edge, metres."""
        return self.inner_ring * self.radius_m

    @property
    def outer_radius_m(self) -> float:
        """Radius of the outline outside the disc's edge, metres."""
        return self.outer_ring * self.radius_m

    @property
    def far_limit_m_per_px(self) -> float:
        """How far the floor moves per image row at most, metres."""
        return self.far_limit * self.radius_m

    @property
    def separation_m(self) -> float:
        """Of detections closer than this on the floor only the best is reported, metres."""
        return self.separation * self.radius_m

    @property
    def least_pairs(self) -> int:
        """Pairs of samples that must be inside the image; 0: samples are counted singly."""
        return math.ceil(self.pairs_inside * self.samples)


#: The detector that made the data set's own rows: all of them, and only those.
PUBLISHED = CircleSettings(
    inner_ring=0.8,
    outer_ring=1.2,
    pairs_inside=13 / 16,
    apart_px=0.5,
    stride=1.0,
    threshold=0.6,
    border_px=0,
    far_limit=0.5,
    least_contrast=5.0,
    noise_floor=0.0,
    separation=2.0,
    verify=False,
    refine=False,
)

#: The parameters in the report on the data set: other outlines, every pixel, all local maxima.
REPORT = CircleSettings(
    threshold=0.6,
    border_px=12,
    far_limit=0.5,
    noise_floor=0.0,
    separation=0.0,
    verify=False,
    refine=False,
)

PRESETS = {"default": CircleSettings(), "published": PUBLISHED, "report": REPORT}
