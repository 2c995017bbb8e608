"""Result of the detector of markers: the markers of one image, and the rejected candidates."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.markers.candidates import Mask
from detect.markers.refinement import RefinedQuadrangle
from landmarks import MarkerCorner, MarkerLandmark

FloatArray = NDArray[np.float64]

#: Fates of candidates, beside the causes of rejection.
ACCEPTED = "accepted"
SAME_MARKER = "a marker already found"


@dataclass(frozen=True)
class Candidate:
    """A region that came as far as having corners, and what became of it.

    Attributes
    ----------
    outline : (4, 2) float64
        Its rough corners, pixels of the image.
    fate : str
        ``accepted`` or why not.
    refined : RefinedQuadrangle or None
        Its fitted edges, if it came so far.
    """

    outline: FloatArray
    fate: str
    refined: RefinedQuadrangle | None = None


@dataclass(frozen=True)
class MarkerDetections:
    """The markers found in one image, by ID and place, and the rejected candidates.

    Attributes
    ----------
    dictionary : str
        Name of the dictionary.
    ids : (N,) int64
        The markers' numbers.
    corners : (N, 4, 2) float64
        Top left, top right, bottom right, bottom left of each marker as printed; pixels (u, v) of
        the image as it is.
    covariance : (N, 4, 2, 2) float64
        Of each corner, pixels squared.
    quality : (N,) float64
        1 less the mean absolute difference between the cells' whiteness and the pattern.
    margin : (N,) float64
        How much nearer the pattern is than the second best, in cells.
    explained : (N,) float64
        Share of the grey values' variance, noise aside, that the fit explains; NaN without
        ``joint``.
    candidates : tuple of Candidate
        All regions that came as far as having corners.
    rejected : Counter
        How many regions and candidates were not taken, by cause.
    masks : tuple of Mask
        The dark pixels of phase 1, if they were to be kept.
    """

    dictionary: str
    ids: NDArray[np.int64]
    corners: FloatArray
    covariance: FloatArray
    quality: FloatArray
    margin: FloatArray
    explained: FloatArray
    candidates: tuple[Candidate, ...]
    rejected: Counter[str]
    masks: tuple[Mask, ...]

    def __len__(self) -> int:
        return len(self.ids)

    def landmarks(self) -> tuple[MarkerLandmark, ...]:
        """The markers as rows of a file."""
        rows = []
        for k, number in enumerate(self.ids):
            first, second, third, fourth = (
                MarkerCorner(*map(float, (*place, spread[0, 0], spread[0, 1], spread[1, 1])))
                for place, spread in zip(self.corners[k], self.covariance[k])
            )
            corners = (first, second, third, fourth)
            rows.append(
                MarkerLandmark(self.dictionary, int(number), float(self.quality[k]), corners)
            )
        return tuple(rows)
