"""What the other discs of an image say of one: those of one place are mostly alike."""

from __future__ import annotations

import numpy as np

from detect.discs.rim import median
from redetect.array_types import BoolArray, FloatArray

#: Discs of these log-odds are sure: others are compared with them.
SURE = 2.5
#: A disc of less than this share of the others' contrast is pale, and what it loses for each factor
#: of e, log-odds; the least number of others, and the least grey value that a ratio is taken of.
_PALE, _PER_FACTOR = 0.5, 4.0
_LEAST_OTHERS, _DARKEST = 2, 5.0


def lost_by_paleness(contrast: FloatArray, floor_grey: FloatArray, sure: BoolArray) -> FloatArray:
    """(N,) log-odds that discs of an image lose because they are paler than its sure discs.

    What has much less contrast than the sure discs is mostly the reflection of one in a polished
    floor or in glass. In shadow a disc has less contrast, too, but its ratio to the floor stays
    what it is elsewhere: that speaks for it. Constants were chosen on the first 1,000 frames of
    run e; rendered buildings confirm them.

    The contrast of a disc is that to its floor, grey levels. Those that are certainly discs lose
    nothing, and the others are compared with those of their sign, if there are two.
    """
    disc = np.maximum(floor_grey + contrast, _DARKEST)
    ratio = np.abs(np.log(disc / np.maximum(floor_grey, _DARKEST)))
    lost = np.zeros(len(contrast))
    for alike in (contrast > 0.0, contrast < 0.0):
        others, doubtful = sure & alike, ~sure & alike
        if np.count_nonzero(others) >= _LEAST_OTHERS and doubtful.any():
            of_contrast = np.abs(contrast) / (_PALE * median(np.abs(contrast[others])))
            of_ratio = ratio / max(median(ratio[others]), 1e-3)
            paleness = np.maximum(np.maximum(of_contrast, of_ratio), 1e-3)[doubtful]
            lost[doubtful] = _PER_FACTOR * np.maximum(-np.log(paleness), 0.0)
    return lost


def lost_by_sign(contrast: FloatArray, sure: BoolArray) -> FloatArray:
    """(N,) log-odds that discs lose because either sign is possible, or the other is likely.

    With m of n sure discs of a sign, the share of that sign is (m + 1) / (n + 2) by Laplace's rule
    of succession: what is stated about polarity would make it 1.
    """
    light = np.count_nonzero(sure & (contrast > 0.0))
    dark = np.count_nonzero(sure & (contrast < 0.0))
    alike = np.where(contrast > 0.0, light, dark)
    return np.asarray(np.log((light + dark + 2.0) / (alike + 1.0)))
