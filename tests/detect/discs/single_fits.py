"""Single discs fitted at pixels that are known, without the search around the fit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import camera_numbers
from detect.discs.fit import START, Scene, fit_discs, working_space
from detect.discs.placing import RADIUS_SIGMA, WHOLE
from redetect.array_types import ByteArray


def fits_at(
    camera: Camera, image: ByteArray, floor_xy: NDArray[np.float32], pixels: NDArray[np.int64],
    radius_m: float, noise: float, *, blur_ratio: float = 1.0, blur_px: float = 0.6,
) -> Any:  # fmt: skip
    """(N,) record array `FIT` of whole discs that start at (N, 2) pixels."""
    scene = Scene(image, floor_xy, radius_m, noise, blur_ratio, camera_numbers(camera))
    starts = np.zeros(len(pixels), START)
    starts["floor_xy"], starts["blur"] = floor_xy[pixels[:, 1], pixels[:, 0]], blur_px
    starts["radius"], starts["size"] = radius_m, radius_m
    starts["size_sigma"] = RADIUS_SIGMA * radius_m
    return fit_discs(scene, starts, WHOLE, working_space()[0]).view(np.recarray)
