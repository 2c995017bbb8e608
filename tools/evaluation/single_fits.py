"""Single discs fitted at pixels that are known, without the search around the fit."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.discs.descent import PATIENT, WORK
from detect.discs.evidence import evidence_of
from detect.discs.fit import RESULT, fit_disc, fit_settings, fitted_positions
from detect.discs.model import Disc
from detect.discs.patch import FULL, LOOK, Candidate, Effort, FitSettings
from redetect.array_types import ByteArray, FloatArray
from redetect.compiled import kernel

_BLUR_PX = 0.6


class DiscFits(NamedTuple):
    """Fits of N discs; of those that came to no result the other arrays mean nothing."""

    fitted: NDArray[np.bool_]  # (N,)
    floor_xy: FloatArray  # (N, 2) metres
    covariance: FloatArray  # (N, 2, 2) of the fit
    results: NDArray[Any]  # (N,) `detect.discs.fit.RESULT`


def fit_discs(
    image: ByteArray, floor_xy: NDArray[np.float32], pixels: NDArray[np.int64], radius_m: float,
    noise: float, *, blur_ratio: float = 1.0, blur_px: float = _BLUR_PX, first_look: bool = False,
) -> DiscFits:  # fmt: skip
    """Fits that start at (N, 2) pixels.

    A first look uses some of the pixels and few steps, and leaves out covariance and outline.
    """
    effort = LOOK if first_look else FULL
    settings = fit_settings(noise, blur_ratio)
    results, fitted = _fit_all(image, floor_xy, pixels, radius_m, blur_px, settings, effort)
    return DiscFits(fitted, *fitted_positions(results), results)


@kernel()
def _fit_all(
    image: ByteArray, floor_xy: NDArray[np.float32], pixels: NDArray[np.int64], radius: float,
    blur_px: float, settings: FitSettings, effort: Effort,
) -> tuple[Any, NDArray[np.bool_]]:  # fmt: skip
    results, fitted = np.zeros(len(pixels), RESULT), np.zeros(len(pixels), np.bool_)
    work = np.zeros(1, WORK)
    start = Disc(0.0, 0.0, 1.0, math.log(blur_px))
    for i in range(len(pixels)):
        candidate = Candidate(pixels[i, 0], pixels[i, 1], radius, blur_px)
        fitted[i] = fit_disc(
            image, floor_xy, candidate, settings, start, effort, PATIENT, work[0], results[i]
        )
    return results, fitted


def disc_evidence(fits: DiscFits, radius_m: float) -> FloatArray:
    """(N,) log-odds that they are discs; minus infinity where there is no fit."""
    evidence = np.full(len(fits.results), -np.inf)
    for k in np.flatnonzero(fits.fitted):
        fit = fits.results[k]
        evidence[k] = evidence_of(
            fit["explained"], fit["radius"] / radius_m, fit["outline_deviation"],
            fit["sectors_good"], fit["middle_step"], fit["relative_blur"], 1.0,
        )  # fmt: skip
    return evidence
