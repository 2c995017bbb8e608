"""Compares each disc with the others of its image: discs of one site mostly look alike."""

from __future__ import annotations

import numpy as np

from redetect.array_types import BoolArray, FloatArray

#: Log-odds from which a disc is sure; doubtful discs are compared with the sure ones.
SURE = 2.5
_PALE = 0.5  #: A disc with less than this share of the others' contrast is pale.
_PER_FACTOR = 4.0  #: Penalty for each factor of e, log-odds.
_LEAST_OTHERS = 2  #: Least number of sure discs to compare with.
_DARKEST = 5.0  #: Lowest grey value used in a ratio.
_LEAST_RATIO = 1e-3  #: Of discs and floor, and of their contrasts.


def paleness_penalty(contrast: FloatArray, floor_grey: FloatArray, sure: BoolArray) -> FloatArray:
    """(N,) penalties, log-odds, for discs that are paler than the sure discs of their image.

    A candidate with much less contrast than the sure discs is mostly the reflection of one in a
    polished floor or in glass. A disc in shadow has less contrast, too, but its ratio to the floor
    is the same as elsewhere, so the better of both measures counts. The constants were chosen on
    the first 1,000 frames of run e; rendered buildings confirm them.

    The contrast is that between a disc and its floor, grey levels. Sure discs have no penalty; the
    others are compared with the sure discs of their own sign, if there are at least two.
    """
    disc, floor = (np.maximum(grey, _DARKEST) for grey in (floor_grey + contrast, floor_grey))
    ratio, penalty = np.abs(np.log(disc / floor)), np.zeros(len(contrast))
    for sign in (1.0, -1.0):
        alike = sign * contrast > 0.0
        if np.count_nonzero(alike & sure) < _LEAST_OTHERS:
            continue
        usual_contrast, usual_ratio = (np.median(x[alike & sure]) for x in (contrast, ratio))
        of_contrast = contrast / (_PALE * usual_contrast)
        of_ratio = ratio / max(usual_ratio, _LEAST_RATIO)
        paleness = np.clip(np.maximum(of_contrast, of_ratio), _LEAST_RATIO, 1.0)
        penalty[alike & ~sure] = -_PER_FACTOR * np.log(paleness[alike & ~sure])
    return penalty


def sign_penalty(contrast: FloatArray, sure: BoolArray) -> FloatArray:
    """(N,) penalties, log-odds, for discs whose sign is uncertain or less likely than the other.

    If m of n sure discs have a sign, the probability of that sign is (m + 1) / (n + 2) by Laplace's
    rule of succession; if the settings fix the polarity, it is 1.
    """
    light, dark = (1 + np.count_nonzero(sure & (s * contrast > 0.0)) for s in (1.0, -1.0))
    return np.asarray(np.log((light + dark) / np.where(contrast > 0.0, light, dark)))
