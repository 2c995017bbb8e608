"""Images of reduced size, in which discs are searched that are large in the full image.

In a large disc's surroundings, the grains of a carpet have as many edges as the disc, and vote for
centres as it does; and the networks know no examples of such sizes. Halved until the disc has a
radius of 10 to 20 pixels, an image shows the means of the grains.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from camera import Camera
from lut import VoteShape, VoteTable, build_vote_table
from lut.votes import largest_disc_px
from redetect.array_types import GreyImage

#: Factors by which images may be reduced, and the smallest side of such an image.
_FACTORS, _SMALLEST_SIDE_PX = (2, 4, 8, 16, 32), 16


class Octave(NamedTuple):
    """A factor by which images are reduced, with their camera and the table of their discs."""

    factor: int
    camera: Camera
    table: VoteTable

    def reduced(self, image: GreyImage) -> GreyImage:
        """A full image (H, W), reduced: means of squares of pixels."""
        size = self.camera.width, self.camera.height
        cut = image[: self.factor * size[1], : self.factor * size[0]]
        return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), np.uint8)


@lru_cache(maxsize=16)
def octaves_of(camera: Camera, shape: VoteShape) -> tuple[Octave, ...]:
    """The octaves that a camera needs besides its full images, until no disc is too large."""
    too_large = largest_disc_px(camera, shape) / shape.largest_px
    most = min(2.0 * too_large, min(camera.width, camera.height) / _SMALLEST_SIDE_PX)
    return tuple(_octave(factor, camera, shape) for factor in _FACTORS if factor < most)


def _octave(factor: int, camera: Camera, shape: VoteShape) -> Octave:
    smaller = replace(
        camera, width=camera.width // factor, height=camera.height // factor,
        scale_x=camera.scale_x / factor, scale_y=camera.scale_y / factor,
        offset_x=(camera.offset_x + 0.5) / factor - 0.5,
        offset_y=(camera.offset_y + 0.5) / factor - 0.5,
    )  # fmt: skip
    larger = replace(
        shape,
        border_px=shape.border_px // factor,
        far_limit_m_per_px=factor * shape.far_limit_m_per_px,
        smallest_px=0.5 * shape.largest_px,
    )
    return Octave(factor, smaller, build_vote_table(smaller, larger))
