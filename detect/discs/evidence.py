"""The evidence that a fitted disc is one: a log-odds score.

What speaks for a disc: that it explains the grey values, has the right radius, an even outline and
a sharp edge. No single one must: glare or texture leave much unexplained about a sharp circle of
the right size, defocus blurs the edge of a disc that explains everything. So they are weighed by a
logistic regression. Its weights were fitted to some 18,000 discs, and to what else has a high
quality, in photographs and renders: as they are, and with glare, shade, defocus, motion blur, noise
and low contrast added. They are constants: that fitting is not part of the project.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from detect.discs.rim import Rim, median
from redetect.compiled import kernel

#: What no disc's fit violates: radius relative to the nominal one, explained variance, and the
#: share of the outline that has a step of the right sign.
RADIUS_RANGE = (0.75, 1.28)
LEAST_EXPLAINED = 0.35
LEAST_SECTORS = 0.75
#: A ring has no disc in its middle: the step of the middle, relative to the disc's.
LEAST_MIDDLE_STEP = 0.4
#: An outline may be this uneven where the disc explains more than the given share: with nothing
#: else there to disturb it, it is the shape that is wrong (a square of the same size, say).
MOST_UNEVEN = 1.2
UNDISTURBED = 0.75


@kernel(forceinline=True)
def evidence_of(
    explained: float,
    relative_radius: float,
    outline_deviation: float,
    sectors_good: float,
    middle_step: float,
    relative_blur: float,
    optics_px: float,
) -> float:
    """Log-odds that a fit (`detect.discs.fit.RESULT`) is one of a disc.

    Minus infinity where it cannot be one. As far as the blur of the camera's optics, pixels, goes
    beyond one pixel, it does not speak against a disc.
    """
    blur = min(max(relative_blur, 0.02), 2.5)
    # What is seen sharply must fit closely; a blurred outline may seem larger, smaller or uneven.
    uneven = outline_deviation / (0.03 + 0.2 * blur)
    possible = (
        RADIUS_RANGE[0] < relative_radius < RADIUS_RANGE[1]
        and explained >= LEAST_EXPLAINED
        and sectors_good > LEAST_SECTORS
        and middle_step > LEAST_MIDDLE_STEP
        and (uneven < MOST_UNEVEN or explained < UNDISTURBED)
    )
    if not possible:
        return -math.inf
    share = min(max(explained, 0.003), 0.997)
    off_radius = abs(math.log(relative_radius)) / (0.03 + 0.3 * blur)
    return (
        3.1 * math.log(share / (1.0 - share))
        - 1.8 * off_radius
        - 2.6 * uneven
        - 6.3 * math.log(max(blur / max(optics_px, 1.0), 0.02))
        - 11.7
    )


#: From this evidence of the fit on, a disc is certain enough without its rim.
CLEAR_EVIDENCE = 6.0
#: The rim is followed where a radius is this many pixels (the geometric mean over directions).
LEAST_RIM_PX = 5.0
#: Where the fit speaks against a disc, its rim needs this share in view, and this radius.
LEAST_RIM = 0.4
RIM_RADIUS_RANGE = (0.83, 1.12)
#: Radius of a rim that fits best, relative to the nominal one: where the grey value changes most
#: lies a little inside the edge.
RIM_RADIUS = 0.95
#: A rim is even whose step varies by less than this over the directions, relative to its mean.
_EVEN = 0.3
#: A disc of less than this share of the others' contrast is pale, and what it loses for each factor
#: of e, log-odds; the least number of others, and the least grey value that a ratio is taken of.
_PALE, _PER_FACTOR = 0.5, 4.0
_LEAST_OTHERS, _DARKEST = 2, 5.0


@kernel()
def evidence_with_rim(
    fitted: float, explained: float, contrast: float, quality: float, rim: Rim, radius: float
) -> float:
    """Log-odds that a candidate is a disc, from its fit and its rim together.

    `fitted` are the log-odds by the fit alone, of which `explained` and `contrast` (grey levels)
    are results, `quality` is Otsu's, `radius` the nominal one (m). The fit of a disc that something
    hides or touches explains little; then the rim decides. The weights are a logistic regression on
    some 5,000 candidates that the fit alone leaves in doubt, of real images, renders and
    photographs; those of the quality and of corners were then chosen on the first 1,000 frames of
    run e and on a rendered hall with square tiles. They are constants: that fitting is not part of
    the project.
    """
    relative = rim.radius / radius
    if fitted == -math.inf and not (
        rim.agreeing >= LEAST_RIM and RIM_RADIUS_RANGE[0] < relative < RIM_RADIUS_RANGE[1]
    ):
        return -math.inf
    # Third and fourth gaps of an even rim are a square's corners; movement makes a rim uneven.
    corners = min(max(rim.runs - 2, 0), 2) if rim.unevenness < _EVEN else 0
    return (
        -4.6
        + 0.18 * min(max(fitted, -6.0), 6.0)
        + 0.70 * _log_odds(quality)
        + 0.57 * _log_odds(explained)
        + 6.91 * rim.agreeing
        - 0.38 * min(rim.runs, 4)
        - 0.6 * corners
        - 3.77 * abs(math.log(max(relative, 0.1) / RIM_RADIUS))
        + 0.94 * math.log(min(max(abs(contrast), 1.0), 80.0) / 40.0)
        + math.log(min(max(abs(contrast), 1.0), 40.0) / 40.0)
    )


@kernel()
def _log_odds(share: float) -> float:
    bounded = min(max(share, 0.003), 0.997)
    return math.log(bounded / (1.0 - bounded))


@kernel()
def lost_by_paleness(
    contrast: NDArray[np.float64], floor_grey: NDArray[np.float64], sure: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Log-odds that discs of an image lose because they are paler than its sure discs.

    Discs of one place are mostly alike. What has much less contrast than the sure discs is mostly
    the reflection of one in a polished floor or in glass. In shadow a disc has less contrast, too,
    but its ratio to the floor stays what it is elsewhere: that speaks for it. Constants were chosen
    on the first 1,000 frames of run e; rendered buildings confirm them.

    Parameters
    ----------
    contrast, floor_grey : (N,) float64
        Grey levels: of each disc less its floor, and of the floor.
    sure : (N,) bool
        Which are certainly discs; each one is compared with the others of its sign that are, if
        there are two.

    Returns
    -------
    (N,) float64
        0 or more.
    """
    count = len(contrast)
    ratio, lost = np.empty(count), np.zeros(count)
    contrasts, ratios = np.empty(count), np.empty(count)
    for k in range(count):
        disc, floor = floor_grey[k] + contrast[k], floor_grey[k]
        ratio[k] = abs(math.log(max(disc, _DARKEST) / max(floor, _DARKEST)))
    for k in range(count):
        others = 0
        for j in range(count):
            if sure[j] and j != k and contrast[j] * contrast[k] > 0.0:
                contrasts[others], ratios[others] = abs(contrast[j]), ratio[j]
                others += 1
        if others >= _LEAST_OTHERS:
            paleness = max(
                abs(contrast[k]) / (_PALE * median(contrasts[:others])),
                ratio[k] / max(median(ratios[:others]), 1e-3),
                1e-3,
            )
            lost[k] = _PER_FACTOR * max(-math.log(paleness), 0.0)
    return lost
