"""The quality of centres and its maxima as plainly as they can be computed.

Every sample is projected through the camera and looked up by itself; every pixel is compared with
its neighbours. No tables, no blocks, no vectors.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.projection import circle_on_floor
from detect.settings import Polarity
from lut import DiscShape
from redetect.array_types import BoolArray, FloatArray, IntArray


@dataclasses.dataclass(frozen=True)
class PlainOutlines:
    """The pixels around all usable centres.

    Attributes
    ----------
    shape : (H, W)
        Of the image.
    rows, columns : (N,) int64
        The usable centres, in scan order.
    index : (N, 2 samples) int64
        Pixels of the inner and then the outer outline, in scan order; H W where outside the image.
    """

    shape: tuple[int, int]
    rows: IntArray
    columns: IntArray
    index: IntArray


def plain_outlines(camera: Camera, shape: DiscShape, usable: BoolArray) -> PlainOutlines:
    """Project the outlines of the usable centres, some thousands at a time."""
    height, width = camera.height, camera.width
    radii = shape.inner_radius_m, shape.outer_radius_m
    rings = np.concatenate([circle_on_floor((0.0, 0.0), r, shape.samples) for r in radii])
    rows, columns = np.nonzero(usable)
    index = np.empty((len(rows), len(rings)), np.int64)
    for k in range(0, len(rows), 10_000):
        part = slice(k, k + 10_000)
        centres = np.stack([columns[part], rows[part]], axis=-1).astype(float)
        seen = camera.project_floor(camera.floor_from_pixel(centres)[:, None] + rings)
        with np.errstate(invalid="ignore"):
            nearest = np.floor(seen + 0.5)
            inside = np.all((nearest >= 0) & (nearest < [width, height]), axis=-1)
        nearest = np.where(inside[..., None], nearest, 0.0).astype(np.int64)
        index[part] = np.where(inside, nearest[..., 1] * width + nearest[..., 0], height * width)
    return PlainOutlines((height, width), rows, columns, index)


def plain_quality(
    image: NDArray[np.uint8], outlines: PlainOutlines
) -> tuple[FloatArray, NDArray[np.float32]]:
    """Maps of quality and contrast: whole numbers until the last division."""
    pixels = np.append(image.ravel(), np.uint8(0)).astype(np.int64)
    grey = pixels[outlines.index]
    votes = outlines.index < image.size
    samples = votes.shape[1] // 2
    n_inner, n_outer = votes[:, :samples].sum(axis=1), votes[:, samples:].sum(axis=1)
    inner, outer = grey[:, :samples].sum(axis=1), grey[:, samples:].sum(axis=1)
    spread = (n_inner + n_outer) * (grey**2).sum(axis=1) - (inner + outer) ** 2
    difference = n_outer * inner - n_inner * outer
    pairs = n_inner * n_outer
    quality, contrast = np.zeros(outlines.shape), np.zeros(outlines.shape, np.float32)
    varied = spread > 0
    place = outlines.rows, outlines.columns
    quality[place] = np.where(varied, difference**2 / np.where(varied, pairs * spread, 1), 0.0)
    contrast[place] = difference / pairs
    return quality, contrast


def plain_maxima(quality: FloatArray, threshold: float) -> list[list[tuple[int, int]]]:
    """Of each maximum the pixels (u, v) that are nearest to its centroid, exactly equally near."""
    height, width = quality.shape
    visited = np.zeros(quality.shape, bool)
    found = []
    for v, u in np.argwhere((quality >= threshold) & (quality > 0.0)).tolist():
        if visited[v, u]:
            continue
        visited[v, u] = True
        plateau, highest = [(v, u)], True
        for vp, up in plateau:  # grows meanwhile
            for vn in range(max(0, vp - 1), min(height, vp + 2)):
                for un in range(max(0, up - 1), min(width, up + 2)):
                    if quality[vn, un] > quality[v, u]:
                        highest = False
                    elif quality[vn, un] == quality[v, u] and not visited[vn, un]:
                        visited[vn, un] = True
                        plateau.append((vn, un))
        if highest:
            n, sum_v, sum_u = len(plateau), *map(sum, zip(*plateau, strict=True))
            off = {(u, v): (n * v - sum_v) ** 2 + (n * u - sum_u) ** 2 for v, u in plateau}
            found.append([place for place in off if off[place] == min(off.values())])
    return found


def plain_best_centres(
    image: NDArray[np.uint8], outlines: PlainOutlines, threshold: float, polarity: Polarity = "any"
) -> tuple[IntArray, FloatArray, NDArray[np.float32]]:
    """The plain maxima, of one polarity, in scan order; each has one nearest pixel."""
    quality, contrast = plain_quality(image, outlines)
    if polarity != "any":
        quality[contrast * (1.0 if polarity == "light" else -1.0) <= 0.0] = 0.0
    maxima = [place for (place,) in plain_maxima(quality, threshold)]
    pixels = np.array(sorted(maxima, key=lambda place: place[::-1]), np.int64).reshape(-1, 2)
    u, v = pixels.T
    return pixels, quality[v, u], contrast[v, u]
