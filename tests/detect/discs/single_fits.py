"""Single discs fitted at pixels that are known, without the search around the fit."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.discs.descent import WORK
from detect.discs.fit import RESULT, fit_disc, fit_settings, fitted_positions
from detect.discs.model import Disc
from detect.discs.patch import Candidate, FitSettings
from redetect.array_types import BoolArray, ByteArray, FloatArray
from redetect.compiled import kernel


class DiscFits(NamedTuple):
    """Fits of N discs; of those that came to no result the other arrays mean nothing."""

    fitted: BoolArray  # (N,)
    floor_xy: FloatArray  # (N, 2) metres
    covariance: FloatArray  # (N, 2, 2) of the fit
    results: NDArray[Any]  # (N,) `detect.discs.fit.RESULT`


def fit_discs(
    image: ByteArray, floor_xy: NDArray[np.float32], pixels: NDArray[np.int64], radius_m: float,
    noise: float, *, blur_ratio: float = 1.0, blur_px: float = 0.6,
) -> DiscFits:  # fmt: skip
    """Fits that start at (N, 2) pixels."""
    settings = fit_settings(noise, blur_ratio)
    results, fitted = _fit_all(image, floor_xy, pixels, radius_m, blur_px, settings)
    return DiscFits(fitted, *fitted_positions(results), results)


@kernel()
def _fit_all(
    image: ByteArray, floor_xy: NDArray[np.float32], pixels: NDArray[np.int64], radius: float,
    blur_px: float, settings: FitSettings,
) -> tuple[Any, BoolArray]:  # fmt: skip
    results, fitted = np.zeros(len(pixels), RESULT), np.zeros(len(pixels), np.bool_)
    work = np.zeros(1, WORK)
    start = Disc(0.0, 0.0, 1.0, math.log(blur_px))
    for i in range(len(pixels)):
        candidate = Candidate(pixels[i, 0], pixels[i, 1], radius, blur_px)
        fitted[i] = fit_disc(image, floor_xy, candidate, settings, start, work[0], results[i])
    return results, fitted
