"""Compiled: the evidence that a fitted disc is one (see `detect.discs.fit.disc_evidence`)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

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


@njit(cache=True, error_model="numpy", forceinline=True)
def evidence_of(
    explained: float,
    relative_radius: float,
    outline_deviation: float,
    sectors_good: float,
    middle_step: float,
    relative_blur: float,
    optics_px: float,
) -> float:
    """Log-odds that a fit is one of a disc; minus infinity where it cannot be one."""
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


@njit(cache=True, error_model="numpy")
def evidence_of_all(
    fitted: NDArray[np.bool_],
    explained: NDArray[np.float64],
    relative_radius: NDArray[np.float64],
    outline_deviation: NDArray[np.float64],
    sectors_good: NDArray[np.float64],
    middle_step: NDArray[np.float64],
    relative_blur: NDArray[np.float64],
    optics_px: float,
) -> NDArray[np.float64]:
    """`evidence_of` N fits; minus infinity where `fitted` is false."""
    score = np.full(len(fitted), -np.inf)
    for k in range(len(fitted)):
        if fitted[k]:
            score[k] = evidence_of(
                explained[k], relative_radius[k], outline_deviation[k], sectors_good[k],
                middle_step[k], relative_blur[k], optics_px,
            )  # fmt: skip
    return score
