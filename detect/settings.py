"""Settings of the detectors, which are also the flags of the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from detect.errors import DetectError
from redetect.storage.bounds import (
    FINITE,
    Bounds,
    Limit,
    NotNegative,
    Positive,
    Share,
    ShareAbove0,
    demand_fields,
    from_to,
    whole,
)
from redetect.storage.messages import excerpt

#: Tilt by which positions are corrected.
Levelling = Literal["none", "frame", "run"]
Polarity = Literal["any", "light", "dark"]

_INSIDE = Bounds("less than 1, the disc's edge, and above 0", 0.0, 1.0, above=True, below=True)
_OUTSIDE = Bounds("more than 1, the disc's edge", 1.0, above=True, below=True)


@dataclass(frozen=True)
class CircleSettings:
    """All settings of the disc detector."""

    radius_m: Positive = 0.10  #: Radius of the discs, metres.
    #: Radius of the outline inside the disc's edge, as a share of the disc's.
    inner_ring: Annotated[float, _INSIDE] = 0.6
    #: Radius of the outline outside the disc's edge, as a share of the disc's.
    outer_ring: Annotated[float, _OUTSIDE] = 1.4
    samples: Annotated[int, whole(3, 128)] = 16  #: Samples on each outline.
    #: Samples are counted in pairs, an inner and an outer one, and at least this share of them must
    #: be inside the image; 0: samples are counted singly.
    pairs_inside: Share = 0.0
    #: How far the samples of a pair that fall on the same pixel are moved, one inwards and one
    #: outwards: the length on the floor of this many pixels down the image.
    apart_px: NotNegative = 0.0
    #: From one centre to the next along a row: this share of the distance between the outlines, in
    #: pixels as long as one down the image, rounded up; 0: every pixel is a centre.
    stride: NotNegative = 0.0
    threshold: ShareAbove0 = 0.5  #: Least quality (between-class / total variance), 0 to 1.
    #: Centres keep this distance from the image's border, pixels.
    border_px: Annotated[int, whole(0)] = 6
    #: Centres are so near that the floor moves at most this share of the radius per image row;
    #: infinite: however far.
    far_limit: Limit = 1.2
    polarity: Polarity = "any"  #: Which discs to detect: lighter than the floor, darker, or both.
    #: If detections are fitted (`verify` and `refine`), rows of centres are skipped, as long as
    #: each row of a disc is at most this share of the distance between the disc's edge and the
    #: nearer outline from an evaluated row, and centres along a row, up to half of that; 0: every
    #: centre is evaluated.
    rows_apart: Share = 0.75
    #: Without a fit: the mean grey values of the outlines differ by more than this.
    least_contrast: NotNegative = 0.0
    #: Least contrast between the outlines, in standard deviations of the image's noise (or in grey
    #: levels, where the noise is less than one).
    noise_floor: NotNegative = 3.0
    #: Of detections closer than this on the floor, in radii, only the best is reported; 0 reports
    #: all.
    separation: NotNegative = 1.4
    #: Fit a disc to the grey values at each candidate and drop those without evidence of a disc.
    #: Without this and `refine` nothing is fitted.
    verify: bool = True
    #: Least evidence (log-odds, see `detect.discs.fit.disc_evidence`).
    evidence: Annotated[float, FINITE] = 0.6
    #: Standard deviation of the optics' blur along u, pixels. Blurred edges are evidence against a
    #: disc unless the camera blurs everything: the data set's own does, by about 6.
    blur_px: NotNegative = 1.0
    refine: bool = True  #: Report the fitted position and its covariance instead of the pixel's.
    #: Systematic error of a refined position, pixels: added to its covariance.
    systematic_px: NotNegative = 0.002
    #: Error of a calibration that does not state its covariance, pixels: added to a refined
    #: position's covariance by the commands. Calibrations commonly fit to 0.1-0.3 px.
    calibration_px: NotNegative = 0.15
    #: Standard deviation of the robot's pitch and of its roll about level, degrees: added to a
    #: refined position's covariance if the frame's tilt is unknown.
    tilt_sigma_deg: Annotated[float, from_to(0.0, 90.0)] = 0.3

    def __post_init__(self) -> None:
        demand_fields(self, DetectError)

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
    calibration_px=0.0,
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
    calibration_px=0.0,
)

PRESETS = {"default": CircleSettings(), "published": PUBLISHED, "report": REPORT}


def parameter_value(kind: type, name: str, text: str) -> Any:
    """Convert a word to the value of a field of a dataclass of parameters.

    Raises DetectError if there is no such field, it is no single value, or this is none of its.
    """
    known = {field.name for field in fields(kind)}
    if name not in known:
        raise DetectError(
            f"{name} is no parameter of {kind.__name__}: expected one of {', '.join(sorted(known))}"
        )
    wanted = get_type_hints(kind)[name]
    if wanted in (int, float):
        try:
            return wanted(text)
        except ValueError:
            expected = "a whole number" if wanted is int else "a number"
    elif wanted is bool:
        if text.lower() in ("true", "false"):
            return text.lower() == "true"
        expected = "True or False"
    elif get_origin(wanted) is Literal:
        if text in get_args(wanted):
            return text
        expected = f"one of {', '.join(get_args(wanted))}"
    else:
        raise DetectError(f"{name} is no single number or word: it cannot be varied")
    raise DetectError(f"{name} is {excerpt(text)}: expected {expected}")
