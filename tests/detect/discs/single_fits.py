"""Single discs fitted at pixels that are known, without the search around the fit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import camera_numbers
from detect.discs.fit import Fit, FitSettings, Scene, Start, fit_disc, working_space
from detect.discs.placing import RADIUS_SIGMA, WHOLE
from redetect.array_types import BoolArray, ByteArray, FloatArray


class DiscFits(NamedTuple):
    """Fits of N discs; of those that came to no result the other arrays mean nothing."""

    fitted: BoolArray  # (N,)
    floor_xy: FloatArray  # (N, 2) metres
    covariance: FloatArray  # (N, 2, 2) of the fit
    fits: list[Fit]


def fit_discs(
    camera: Camera, image: ByteArray, floor_xy: NDArray[np.float32], pixels: NDArray[np.int64],
    radius_m: float, noise: float, *, blur_ratio: float = 1.0, blur_px: float = 0.6,
) -> DiscFits:  # fmt: skip
    """Fits of whole discs that start at (N, 2) pixels."""
    scene = Scene(image, floor_xy, radius_m, noise, blur_ratio, camera_numbers(camera))
    settings = FitSettings(False, radius_m, RADIUS_SIGMA, WHOLE)
    fits = []
    for u, v in pixels:
        x, y = floor_xy[v, u].astype(float)
        fits.append(fit_disc(scene, Start(x, y, radius_m, blur_px), settings, working_space()[0]))
    return DiscFits(
        np.array([fit.converged for fit in fits]),
        np.array([(fit.x, fit.y) for fit in fits]),
        np.array([((f.cov_xx, f.cov_xy), (f.cov_xy, f.cov_yy)) for f in fits]),
        fits,
    )
