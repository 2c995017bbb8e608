"""Settings of the detector of square markers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from detect.errors import DetectError
from redetect.storage.bounds import (
    PROBABILITY,
    Bounds,
    NotNegative,
    Positive,
    Share,
    demand,
    demand_fields,
    whole,
)

Darkness = Literal["ratio", "difference"]
CornerAlgorithm = Literal["A", "B"]

_LEAST_WIDTH = Bounds("4 or more", 4.0, below=True)
_AREA_FACTOR = Bounds("above 1", 1.0, above=True, below=True)


@dataclass(frozen=True)
class MarkerSettings:
    """All settings of the marker detector. The defaults are the best known."""

    #: Dictionary of the markers: rawseeds, artoolkitplus12, artoolkitplus8, or an OpenCV dictionary
    #: (4x4_50 ... 7x7_1000, aruco_original, aruco_mip_36h12, apriltag_16h5 ...).
    dictionary: str = "rawseeds"
    #: The markers to expect; none: all of the dictionary.
    ids: Annotated[tuple[int, ...], whole(0)] = ()
    #: Expected width of the markers in the image, pixels, right to a factor of about 2; 0: unknown,
    #: several scales are tried.
    width_px: NotNegative = 0.0
    #: A pixel is dark if its darkness exceeds this; each threshold gives candidates of its own.
    thresholds: Annotated[tuple[float, ...], PROBABILITY] = (0.5, 0.25, 0.12, 0.06, 0.03)
    #: 1 - I1/I2 of image I1 and its closing I2, or I2 - I1 in parts of 255.
    darkness: Darkness = "ratio"
    disc_widths: Positive = 0.5  #: Radius of the closing's disc in widths of the marker.
    pyramid: bool = True  #: Search large markers in reduced images.
    #: Dark pixels are darker than the closing by at least this many standard deviations of the
    #: image's noise.
    dark_noise: NotNegative = 2.0
    #: Narrowest marker to search (square root of its area), pixels, where no width is given.
    least_width_px: Annotated[float, _LEAST_WIDTH] = 9.0
    #: A candidate's area is within this factor of the expected width squared.
    area_factor: Annotated[float, _AREA_FACTOR] = 6.0
    #: Least number of white patches enclosed in a candidate.
    least_holes: Annotated[int, whole(0)] = 0
    most_holes: Annotated[int, whole(0)] = 40  #: Greatest number of them.
    #: Area of a candidate, its holes filled, over that of its convex hull.
    least_solidity: Share = 0.75
    #: Least area of a candidate's holes over its whole area, in parts of the dictionary's mean
    #: white share (0.25 of 1/8 in the report).
    least_white: NotNegative = 0.0
    most_white: NotNegative = 3.0  #: Greatest such area (3 of 1/8 in the report).
    #: Rough corners: A the maxima of the distance from the barycentre, B the quadrangle of largest
    #: area.
    corners: CornerAlgorithm = "B"
    least_square: Share = 0.75  #: Area of the rough quadrangle over that of the convex hull.
    #: Fit the whole marker, cells included, to the grey values; its corners are more exact than
    #: those of four separate edges, and its residuals reveal false markers.
    joint: bool = True
    #: Least contrast of each edge, in standard deviations of the image's noise.
    least_contrast: NotNegative = 2.0
    edge_balance: Share = 0.3  #: Least contrast of an edge, in parts of the strongest edge's.
    #: Largest mean absolute difference between a marker's cells, rescaled to 0 to 1, and the
    #: pattern.
    largest_distance: Share = 0.3
    #: Least squared distance to the second best pattern less that to the best, in cells.
    least_margin: NotNegative = 1.0
    #: Least share of the grey values' variance, noise aside, explained by the fitted marker.
    least_explained: Share = 0.9
    #: Largest difference between the whiteness of any cell and that of the pattern.
    largest_cell_error: Share = 0.45
    #: Systematic error of a corner, pixels: added to its covariance.
    systematic_px: NotNegative = 0.005

    def __post_init__(self) -> None:
        if not self.thresholds:
            raise DetectError("thresholds is (): expected at least one number")
        demand_fields(self, DetectError)
        most_white = Bounds(f"0 to most_white ({self.most_white})", 0.0, self.most_white)
        most_holes = whole(0, self.most_holes)
        demand(self, DetectError, least_holes=most_holes, least_white=most_white)


DEFAULT = MarkerSettings()

#: The report's detector; what it does not give a number for is set as by default.
PUBLISHED = MarkerSettings(
    thresholds=(0.5,),
    pyramid=False,
    dark_noise=0.0,
    least_holes=1,
    least_solidity=0.9,
    least_white=0.25,
    most_white=3.0,
    joint=False,
)

PRESETS = {"default": DEFAULT, "published": PUBLISHED}
