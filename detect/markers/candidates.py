"""Phase 1: where the image is dark among brighter surroundings.

The grayscale closing I2 of the image I1 with a disc fills everything dark that the disc does not
fit into; where I1 is much darker than I2 is a candidate for (a part of) a marker. RAWSEEDS
deliverable D2.1 part 2. The disc is an octagon here, which two squares and some crosses make up at
a cost that grows little with its size, and large markers are searched in reduced images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.markers.settings import Darkness, MarkerSettings

GreyImage = NDArray[np.uint8]

#: A disc of radius r as an octagon: half the side of its square, in r; its crosses do the rest.
_SQUARE_SHARE = math.sqrt(2.0) - 1.0
#: Radius of the disc in the reduced images, their pixels: markers of up to twice this, and mostly
#: more, in each level.
_LEVEL_RADIUS_PX = 12
#: Levels smaller than this hold no marker.
_LEAST_LEVEL_PX = 16
#: Where a width is given, the image is reduced until the disc's radius is no larger.
_LARGEST_GIVEN_RADIUS_PX = 12.0
#: Without a pyramid: radii tried where no width is given.
_PLAIN_RADII_PX = (8, 20, 50)
#: Thresholds below this are applied to a smoothed image.
_SMOOTH_BELOW = 0.2
#: With more noise than this it is smoothed more, grey levels.
_MUCH_NOISE = 2.5


@dataclass(frozen=True)
class Layer:
    """An image, possibly reduced, and its closing.

    Attributes
    ----------
    scale : int
        Pixels of the image per pixel of the layer, in both directions.
    radius : int
        Radius of the closing's disc, pixels of the layer.
    grey, closed : (h, w) uint8
        I1 and I2.
    """

    scale: int
    radius: int
    grey: GreyImage
    closed: GreyImage


@dataclass(frozen=True)
class Mask:
    """Where a layer is darker than a threshold: 1 there, 0 elsewhere."""

    layer: Layer
    threshold: float
    dark: GreyImage


def closing(grey: GreyImage, radius: int) -> GreyImage:
    """Grayscale closing with a disc, made an octagon.

    Parameters
    ----------
    grey : (H, W) uint8
        The image.
    radius : int
        Radius of the octagon's corners' circle, pixels.

    Returns
    -------
    (H, W) uint8
    """
    half = round(_SQUARE_SHARE * radius)
    square = np.ones((2 * half + 1, 2 * half + 1), np.uint8)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    crosses = radius - half
    result = cv2.dilate(grey, square)
    result = cv2.dilate(result, cross, iterations=crosses)
    result = cv2.erode(result, square)
    return np.asarray(cv2.erode(result, cross, iterations=crosses))


def candidate_layers(image: GreyImage, settings: MarkerSettings) -> tuple[Layer, ...]:
    """The image at the scales to be searched, with its closings.

    Parameters
    ----------
    image : (H, W) uint8
        The image.
    settings : MarkerSettings
        ``width_px``, ``disc_widths``, ``pyramid``, ``thresholds``.

    Returns
    -------
    tuple of Layer
        From fine to coarse.
    """
    if not settings.pyramid:
        given = settings.disc_widths * settings.width_px
        radii = (max(2, round(given)),) if settings.width_px else _PLAIN_RADII_PX
        return tuple(Layer(1, radius, image, closing(image, radius)) for radius in radii)
    if settings.width_px:
        wanted = settings.disc_widths * settings.width_px
        scale = 1
        while wanted / scale > _LARGEST_GIVEN_RADIUS_PX:
            scale *= 2
        radius = max(4, math.ceil(wanted / scale))
        levels = [(scale, radius)]
    else:
        scales = [1]
        while min(image.shape) // (2 * scales[-1]) >= _LEAST_LEVEL_PX:
            scales.append(2 * scales[-1])
        levels = [(scale, _LEVEL_RADIUS_PX) for scale in scales]
    layers = []
    for scale, radius in levels:
        grey = _reduced(image, scale)
        layers.append(Layer(scale, radius, grey, closing(grey, radius)))
    return tuple(layers)


def dark_masks(layer: Layer, noise: float, settings: MarkerSettings) -> tuple[Mask, ...]:
    """Where a layer is dark, for each threshold.

    Parameters
    ----------
    layer : Layer
        The layer.
    noise : float
        Standard deviation of the image's noise, grey levels.
    settings : MarkerSettings
        ``thresholds``, ``darkness``, ``dark_noise``.

    Returns
    -------
    tuple of Mask
    """
    gate = settings.dark_noise * noise / layer.scale
    masks = []
    smooth: Layer | None = None
    for threshold in settings.thresholds:
        source, least = layer, gate
        if layer.scale == 1 and settings.pyramid and threshold < _SMOOTH_BELOW:
            if smooth is None:
                window = (5, 5) if noise > _MUCH_NOISE else (3, 3)
                grey = np.asarray(cv2.GaussianBlur(layer.grey, window, 0), np.uint8)
                smooth = Layer(1, layer.radius, grey, closing(grey, layer.radius))
            source, least = smooth, 0.5 * gate
        masks.append(
            Mask(source, threshold, dark_pixels(source, threshold, least, settings.darkness))
        )
    return tuple(masks)


def dark_pixels(layer: Layer, threshold: float, gate: float, darkness: Darkness) -> GreyImage:
    """1 where a layer is darker than its closing by the threshold and by `gate` grey levels."""
    limit = np.arange(256.0)
    by_threshold = limit * (1.0 - threshold) if darkness == "ratio" else limit - 255.0 * threshold
    # I1 < limit(I2), for whole grey levels; the limit itself is not dark.
    table = np.clip(np.ceil(np.minimum(by_threshold, limit - gate)), 0, 255).astype(np.uint8)
    dark = cv2.compare(layer.grey, cv2.LUT(layer.closed, table), cv2.CMP_LT)
    return np.asarray(dark, np.uint8) & np.uint8(1)


def _reduced(image: GreyImage, scale: int) -> GreyImage:
    """Means over `scale` x `scale` pixels; rows and columns left over are dropped."""
    if scale == 1:
        return image
    height, width = image.shape[0] // scale, image.shape[1] // scale
    whole = image[: height * scale, : width * scale]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA))
