"""From light to grey values: uneven light, optics, contrast, noise, eight bits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tools.simulator.markers.clutter import Grey
from tools.simulator.markers.kernels import grey_values

# Blurs wider than this are all but the same on whole pixels, and cheaper, pixels.
_FINE_BELOW_PX = 1.0
_COARSE = 4


@dataclass(frozen=True)
class Imaging:
    """How light becomes grey values."""

    blur_px: float = 0.7
    """Standard deviation of the optics' Gaussian blur, pixels."""
    black_level: float = 10.0
    """Grey value of no light at all."""
    gain: float = 220.0
    """Grey levels per reflectance in full light."""
    noise_grey: float = 2.0
    """Standard deviation of the noise, grey levels."""

    @property
    def fine(self) -> bool:
        """Whether the blur is so narrow that light is needed on a grid of half pixels."""
        return self.blur_px < _FINE_BELOW_PX


def grey_image(
    light: Grey, illumination: Grey | float, imaging: Imaging, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The image that a camera gives.

    Parameters
    ----------
    light : (2 H, 2 W) float32, or (H, W) where the blur is not `Imaging.fine`
        From `rendering.render_light`.
    illumination : (H, W) float32, or a number
        Factor by which the light differs from place to place.
    imaging : Imaging
        Optics and electronics.
    rng : numpy Generator
        Source of the noise.

    Returns
    -------
    (H, W) uint8
    """
    grey = exact_grey(light, illumination, imaging)
    noise = rng.standard_normal(grey.shape, dtype=np.float32)
    return np.asarray(grey_values(grey, noise, imaging.noise_grey))


def exact_grey(light: Grey, illumination: Grey | float, imaging: Imaging) -> Grey:
    """(H, W) float32 grey values before noise and rounding; parameters as in `grey_image`."""
    import cv2

    sigma = imaging.blur_px
    pixels = light
    if imaging.fine:
        # So narrow a blur is no Gaussian when taken at whole pixels only.
        rows, columns = light.shape
        blurred = _blurred(light, 2.0 * sigma) if sigma > 0.0 else light
        size = columns // 2, rows // 2
        pixels = np.asarray(cv2.resize(blurred, size, interpolation=cv2.INTER_AREA))
    else:
        pixels = _blurred(light, sigma)
    grey = np.asarray(pixels, dtype=np.float32) * np.float32(imaging.gain)
    grey *= illumination
    grey += np.float32(imaging.black_level)
    return grey


def _blurred(image: Grey, sigma: float) -> Grey:
    import cv2

    reach = int(np.ceil(4.5 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel /= kernel.sum()
    return np.asarray(
        cv2.sepFilter2D(image, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
    )


def uneven_light(
    rng: np.random.Generator, width: int, height: int, strength: float, shadows: int
) -> Grey:
    """Light that falls off over the image, with soft shadows and vignetting.

    Parameters
    ----------
    rng : numpy Generator
        Source of chance.
    width, height : int
        Of the image, pixels.
    strength : float
        0 even light; at 1 the light falls by a factor of some 3 from side to side.
    shadows : int
        How many soft-edged shadows; each leaves 35 to 80 % of the light.

    Returns
    -------
    (height, width) float32
        Factors, at most 1.
    """
    import cv2

    rows, columns = -(-height // _COARSE), -(-width // _COARSE)
    y, x = np.mgrid[-1.0 : 1.0 : rows * 1j, -1.0 : 1.0 : columns * 1j].astype(np.float32)
    direction = rng.uniform(0.0, 2.0 * np.pi)
    slope = 0.55 * strength * rng.uniform(0.3, 1.0)
    light = np.exp(slope * (np.cos(direction) * x + np.sin(direction) * y))
    light *= 1.0 - 0.3 * strength * rng.random() * (x * x + y * y) / 2.0
    for _ in range(shadows):
        # The edge of a shadow: a line, or a disc's rim.
        softness = rng.uniform(0.02, 0.3)
        if rng.random() < 0.5:
            angle, offset = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.7, 0.7)
            inside = np.cos(angle) * x + np.sin(angle) * y - offset
        else:
            centre, radius = rng.uniform(-0.8, 0.8, 2), rng.uniform(0.15, 0.6)
            inside = radius - np.hypot(x - centre[0], y - centre[1])
        depth = rng.uniform(0.2, 0.65)
        light *= 1.0 - depth / (1.0 + np.exp(-np.clip(inside / (0.25 * softness), -30.0, 30.0)))
    light = (light / light.max()).astype(np.float32)
    fine = cv2.resize(light, (columns * _COARSE, rows * _COARSE), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(fine[:height, :width], dtype=np.float32)
