"""Derivatives of Gaussians that are evaluated at sub-pixel positions, tabulated.

A step of the grey value at u is seen by H(u) = sum of d G(d) I / sigma^2 over the pixels, d their
distances from u and G a Gaussian: its height, if u is where the step is. H is largest there; its
first and second derivatives, times sigma^2, have the weights (q - 1) G and (q - 3) d / sigma^2 G,
q = d^2 / sigma^2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

#: Positions in a pixel for which weights are tabulated; between them the derivative helps out.
SUBPIXELS = 64

#: Beyond so many standard deviations there is nothing left of the Gaussian.
_REACH = 4.4


@dataclass(frozen=True, slots=True, eq=False)
class StepFilters:
    """Tables of weights, one behind the other, each of them once.

    Attributes
    ----------
    half : (K,) int64
        The filter at a position in pixels i to i + 1 covers ``2 half`` pixels, from i - half + 1.
    begin : (K,) int64
        Where each filter's weights begin: `SUBPIXELS` rows of ``2 half``, and one of zeros.
    height : (N,) float32
        Weights of the step's height; each row has the sum 0.
    derivatives : (2 N,) float32
        Those of its derivatives times sigma^2: `WORD` (`detect.vector_code`) of the
        first, then as many of the second, and so on.
    """

    half: NDArray[np.int64]
    begin: NDArray[np.int64]
    height: NDArray[np.float32]
    derivatives: NDArray[np.float32]


@lru_cache(maxsize=16)
def step_filters(sigmas_px: tuple[float, ...]) -> StepFilters:
    """Tables for Gaussians of some widths.

    Parameters
    ----------
    sigmas_px : tuple of float
        Standard deviations, pixels.

    Returns
    -------
    StepFilters
        One filter for each, in this order.
    """
    from detect.vector_code import WORD

    halves, tables = [], []
    # Equal ones share a table.
    widths = list(dict.fromkeys(sigmas_px))
    for sigma in widths:
        half = 4 * math.ceil(_REACH * sigma / 4.0)
        halves.append(half)
        position = (np.arange(SUBPIXELS)[:, None] + 0.5) / SUBPIXELS
        d = np.arange(-half + 1, half + 1) - position
        q = (d / sigma) ** 2
        gaussian = np.exp(-0.5 * q)
        weights = np.stack(
            [d / sigma**2 * gaussian, (q - 1.0) * gaussian, (q - 3.0) * d / sigma**2 * gaussian]
        )
        # What is cut off must not see the image's brightness.
        weights -= weights.mean(axis=-1, keepdims=True)
        weights = np.pad(weights, [(0, 0), (0, 1), (0, 0)])
        tables.append(weights.reshape(3, -1))
    height, first, second = np.concatenate(tables, axis=-1).astype(np.float32)
    begins = np.concatenate([[0], np.cumsum([(SUBPIXELS + 1) * 2 * half for half in halves])])
    which = [widths.index(sigma) for sigma in sigmas_px]
    return StepFilters(
        half=np.array(halves, np.int64)[which],
        begin=begins.astype(np.int64)[which],
        height=height,
        derivatives=np.stack([first.reshape(-1, WORD), second.reshape(-1, WORD)], 1).reshape(-1),
    )
