"""Settings of the detectors of discs and markers, which are also flags of the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import arg

from detect.errors import DetectError
from redetect.bounds import (
    FINITE,
    PROBABILITY,
    Bounded,
    Bounds,
    Limit,
    MaybeFloat,
    NotNegative,
    Positive,
    Share,
    ShareAbove0,
    demand_fields,
    from_to,
    whole,
)

#: Standard deviation of the pitch and the roll of a robot on an even floor, degrees.
USUAL_TILT_DEG = 0.3
#: Least number of frames with a tilt: the errors of fewer cannot be separated from the run's tilt.
LEAST_FRAMES = 20

#: Settings of `CircleSettings` that have an effect only without `refine`.
UNREFINED = (
    "inner_ring", "outer_ring", "samples", "pairs_inside", "apart_px", "stride", "threshold",
    "least_contrast",
)  # fmt: skip

#: Tilt for which positions are corrected.
Levelling = Literal["none", "frame", "run"]
Polarity = Literal["any", "light", "dark"]

_INSIDE = Bounds("less than 1, the disc's edge, and above 0", lambda x: 0.0 < x < 1.0)
_OUTSIDE = Bounds("more than 1, the disc's edge", lambda x: 1.0 < x < math.inf)


@dataclass(frozen=True)
class CircleSettings(Bounded, error=DetectError):
    """All settings of the disc detector."""

    radius_m: Positive = 0.10  #: Radius of the discs, metres.
    #: Radius of the outline inside the disc's edge, as a share of the disc's.
    inner_ring: Annotated[float, _INSIDE] = 0.6
    #: Radius of the outline outside the disc's edge, as a share of the disc's.
    outer_ring: Annotated[float, _OUTSIDE] = 1.4
    samples: Annotated[int, whole(3, 128)] = 16  #: Samples on each outline.
    #: Least share of sample pairs (an inner and an outer one) inside the image; 0: samples are
    #: counted singly.
    pairs_inside: Share = 0.0
    #: If the samples of a pair are on the same pixel, one is moved inwards and one outwards, by the
    #: length on the floor of this many image rows.
    apart_px: NotNegative = 0.0
    #: Distance of neighbouring centres in a row: this share of the distance between the outlines,
    #: in image rows' length on the floor, rounded up to pixels; 0: every pixel is a centre.
    stride: NotNegative = 0.0
    #: Without a fit: least quality (between-class / total variance), 0 to 1.
    threshold: Annotated[ShareAbove0, arg(name="quality-threshold")] = 0.5
    #: Least distance of a centre from the image border, pixels.
    border_px: Annotated[int, whole(0)] = 6
    #: Limit of the distance: the floor moves at most this share of the radius per image row;
    #: infinite: no limit.
    far_limit: Limit = 1.2
    polarity: Polarity = "any"  #: Which discs to detect: lighter than the floor, darker, or both.
    #: Without a fit: the difference of the outlines' mean grey values has to exceed this.
    least_contrast: NotNegative = 0.0
    #: Least contrast of a disc, in standard deviations of the image's noise (or in grey levels,
    #: if the noise is less than one).
    noise_floor: NotNegative = 3.0
    #: Least distance of two detections on the floor, in radii: of closer ones only the best is
    #: reported; 0 reports all.
    separation: NotNegative = 1.4
    #: Find discs by their rims, and fit their positions; otherwise they are the pixels of the
    #: highest quality, as published.
    refine: bool = True
    #: Least evidence of a disc found by its rim, log-odds (`detect.discs.judgement`).
    evidence: Annotated[float, FINITE] = 0.2
    #: Systematic error of a refined position, pixels: added to its covariance.
    systematic_px: NotNegative = 0.002
    #: Error of a calibration without a covariance, pixels: commands add it to the covariance of
    #: refined positions. Calibrations commonly have residuals of 0.1-0.3 px.
    calibration_px: NotNegative = 0.15
    #: Standard deviation of the robot's pitch and roll, degrees: added to the covariance of refined
    #: positions if the frame's tilt is unknown. By default what some images of the run show, or 0.3
    #: where they show none.
    tilt_sigma_deg: Annotated[MaybeFloat, from_to(0.0, 90.0)] = None

    @property
    def tilt_sigma_rad(self) -> float:
        """Standard deviation of an unknown pitch or roll, radians."""
        return math.radians(USUAL_TILT_DEG if self.tilt_sigma_deg is None else self.tilt_sigma_deg)

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
        """Largest step of the floor per image row, metres."""
        return self.far_limit * self.radius_m

    @property
    def separation_m(self) -> float:
        """Least distance of two detections on the floor, metres."""
        return self.separation * self.radius_m

    @property
    def least_pairs(self) -> int:
        """Least number of sample pairs inside the image; 0: samples are counted singly."""
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
    refine=False,
    calibration_px=0.0,
)

#: The parameters that the data set report prints: other outlines, every pixel, all local maxima.
REPORT = CircleSettings(
    threshold=0.6,
    border_px=12,
    far_limit=0.5,
    noise_floor=0.0,
    separation=0.0,
    refine=False,
    calibration_px=0.0,
)

PRESETS = {"default": CircleSettings(), "published": PUBLISHED, "report": REPORT}

_LEAST_WIDTH = Bounds("4 or more", lambda x: 4.0 <= x < math.inf)


@dataclass(frozen=True)
class MarkerSettings:
    """All settings of the marker detector. The defaults are the best known."""

    #: Dictionary of the markers: rawseeds, artoolkitplus12, artoolkitplus8, or an OpenCV dictionary
    #: (4x4_50 ... 7x7_1000, aruco_original, aruco_mip_36h12, apriltag_16h5 ...).
    dictionary: str = "rawseeds"
    #: IDs of the expected markers; none: all of the dictionary.
    ids: Annotated[tuple[int, ...], whole(0)] = ()
    #: Expected width of the markers in the image, pixels, within a factor of about 2; 0: unknown,
    #: several scales are tried.
    width_px: NotNegative = 0.0
    #: A pixel is dark if 1 - I1/I2 of the image I1 and its closing I2 exceeds this; each threshold
    #: gives its own candidates.
    thresholds: Annotated[tuple[float, ...], PROBABILITY] = (0.5, 0.25, 0.12, 0.06, 0.03)
    #: Narrowest marker to search for (square root of its area), pixels, if no width is given.
    least_width_px: Annotated[float, _LEAST_WIDTH] = 9.0
    #: Largest number of white patches enclosed in a candidate.
    most_holes: Annotated[int, whole(0)] = 40
    #: Largest area of a candidate's holes over its whole area, relative to the dictionary's mean
    #: white share (3 of 1/8 in the report).
    most_white: NotNegative = 3.0
    #: Least contrast of each edge, in standard deviations of the image's noise.
    least_contrast: NotNegative = 1.4
    edge_balance: Share = 0.2  #: Least contrast of an edge relative to the strongest edge.
    #: Largest mean absolute difference between a marker's cells, rescaled to 0 to 1, and the
    #: pattern.
    largest_distance: Share = 0.3
    #: Least squared distance to the second best pattern minus that to the best, in cells.
    least_margin: NotNegative = 1.0
    #: Least share of the grey values' variance, noise aside, explained by the fitted marker.
    least_explained: Share = 0.9
    #: Systematic error of a corner, pixels: added to its covariance.
    systematic_px: NotNegative = 0.005

    def __post_init__(self) -> None:
        if not self.thresholds:
            raise DetectError("thresholds is (): expected at least one number")
        demand_fields(self, DetectError)
