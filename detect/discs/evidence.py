"""Compares each disc with the others of its image: discs of one site mostly look alike."""

from __future__ import annotations

import numpy as np

from detect.discs.rim import median
from redetect.array_types import BoolArray, FloatArray

#: Log-odds from which a disc is sure; doubtful discs are compared with the sure ones.
SURE = 2.5
_PALE = 0.5  #: A disc with less than this share of the others' contrast is pale.
_PER_FACTOR = 4.0  #: Penalty for each factor of e, log-odds.
_LEAST_OTHERS = 2  #: Least number of sure discs to compare with.
_DARKEST = 5.0  #: Lowest grey value used in a ratio.


def paleness_penalty(contrast: FloatArray, floor_grey: FloatArray, sure: BoolArray) -> FloatArray:
    """(N,) penalties, log-odds, for discs that are paler than the sure discs of their image.

    A candidate with much less contrast than the sure discs is mostly the reflection of one in a
    polished floor or in glass. A disc in shadow has less contrast, too, but its ratio to the floor
    is the same as elsewhere, so the better of both measures counts. The constants were chosen on
    the first 1,000 frames of run e; rendered buildings confirm them.

    The contrast is that between a disc and its floor, grey levels. Sure discs have no penalty; the
    others are compared with the sure discs of their own sign, if there are at least two.
    """
    disc = np.maximum(floor_grey + contrast, _DARKEST)
    ratio = np.abs(np.log(disc / np.maximum(floor_grey, _DARKEST)))
    penalty = np.zeros(len(contrast))
    for alike in (contrast > 0.0, contrast < 0.0):
        others, doubtful = sure & alike, ~sure & alike
        if np.count_nonzero(others) >= _LEAST_OTHERS and doubtful.any():
            of_contrast = np.abs(contrast) / (_PALE * median(np.abs(contrast[others])))
            of_ratio = ratio / max(median(ratio[others]), 1e-3)
            paleness = np.maximum(np.maximum(of_contrast, of_ratio), 1e-3)[doubtful]
            penalty[doubtful] = _PER_FACTOR * np.maximum(-np.log(paleness), 0.0)
    return penalty


def sign_penalty(contrast: FloatArray, sure: BoolArray) -> FloatArray:
    """(N,) penalties, log-odds, for discs whose sign is uncertain or less likely than the other.

    If m of n sure discs have a sign, the probability of that sign is (m + 1) / (n + 2) by Laplace's
    rule of succession; if the settings fix the polarity, it is 1.
    """
    light = np.count_nonzero(sure & (contrast > 0.0))
    dark = np.count_nonzero(sure & (contrast < 0.0))
    alike = np.where(contrast > 0.0, light, dark)
    return np.asarray(np.log((light + dark + 2.0) / (alike + 1.0)))
