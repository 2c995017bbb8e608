"""Compares each disc with the others of its image: discs of one site mostly look alike."""

from __future__ import annotations

import math

import numpy as np

from detect.discs.rim import median
from redetect.array_types import BoolArray, FloatArray
from redetect.compiled import kernel

#: Log-odds from which a disc is sure; doubtful discs are compared with the sure ones.
SURE = 2.5
_PALE = 0.5  #: A disc with less than this share of the others' contrast is pale.
_PER_FACTOR = 4.0  #: Penalty for each factor of e, log-odds.
_LEAST_OTHERS = 2  #: Least number of sure discs to compare with.
_DARKEST = 5.0  #: Lowest grey value used in a ratio.


@kernel()
def paleness_penalty(contrast: FloatArray, floor_grey: FloatArray, sure: BoolArray) -> FloatArray:
    """(N,) penalties, log-odds, for discs that are paler than the sure discs of their image.

    A candidate with much less contrast than the sure discs is mostly the reflection of one in a
    polished floor or in glass. A disc in shadow has less contrast, too, but its ratio to the floor
    is the same as elsewhere, so the better of both measures counts. The constants were chosen on
    the first 1,000 frames of run e; rendered buildings confirm them.

    The contrast is that between a disc and its floor, grey levels. Sure discs have no penalty; the
    others are compared with the sure discs of their own sign, if there are at least two.
    """
    penalty, ratio = np.zeros(len(contrast)), np.empty(len(contrast))
    for k in range(len(contrast)):
        disc = max(floor_grey[k] + contrast[k], _DARKEST)
        ratio[k] = abs(math.log(disc / max(floor_grey[k], _DARKEST)))
    contrasts, ratios = np.empty(len(contrast)), np.empty(len(contrast))
    for sign in (1.0, -1.0):
        count = 0
        for k in range(len(contrast)):
            if sure[k] and sign * contrast[k] > 0.0:
                contrasts[count], ratios[count] = abs(contrast[k]), ratio[k]
                count += 1
        if count < _LEAST_OTHERS:
            continue
        usual_contrast, usual_ratio = median(contrasts[:count]), median(ratios[:count])
        for k in range(len(contrast)):
            if not sure[k] and sign * contrast[k] > 0.0:
                of_contrast = abs(contrast[k]) / (_PALE * usual_contrast)
                paleness = max(of_contrast, ratio[k] / max(usual_ratio, 1e-3), 1e-3)
                penalty[k] = _PER_FACTOR * max(-math.log(paleness), 0.0)
    return penalty


@kernel()
def sign_penalty(contrast: FloatArray, sure: BoolArray) -> FloatArray:
    """(N,) penalties, log-odds, for discs whose sign is uncertain or less likely than the other.

    If m of n sure discs have a sign, the probability of that sign is (m + 1) / (n + 2) by Laplace's
    rule of succession; if the settings fix the polarity, it is 1.
    """
    light, dark = 1, 1
    for k in range(len(contrast)):
        light += sure[k] and contrast[k] > 0.0
        dark += sure[k] and contrast[k] < 0.0
    penalty = np.empty(len(contrast))
    for k in range(len(contrast)):
        alike = light if contrast[k] > 0.0 else dark
        penalty[k] = math.log((light + dark) / alike)
    return penalty
