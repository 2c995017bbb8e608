"""Non-maximum suppression: keeps the best of centres that are close to each other."""

from __future__ import annotations

import numpy as np

from redetect.array_types import BoolArray, Float32Array, FloatArray, IntArray
from redetect.compiled import kernel


def local_maxima(quality: FloatArray, threshold: float) -> BoolArray:
    """(H, W) mask of pixels of at least `threshold` that none of their 8 neighbours exceeds.

    Connected pixels of equal quality are one maximum, at the pixel nearest to their centroid: a
    plateau is neither lost nor found twice. Pixels of quality 0 are never maxima.
    """
    from skimage import measure, morphology  # of the report's detector alone, and slow to import

    quality = np.where((quality >= threshold) & (quality > 0.0), quality, 0.0)
    # Within a border of zeros, an image of one quality is a plateau, too.
    highest = morphology.local_maxima(np.pad(quality, 1), connectivity=2)[1:-1, 1:-1]
    maxima = np.zeros(quality.shape, np.bool_)
    for plateau in measure.regionprops(measure.label(highest, connectivity=2)):
        off = ((plateau.coords - plateau.coords.mean(axis=0)) ** 2).sum(axis=1)
        maxima[tuple(plateau.coords[np.argmin(off)])] = True  # the first of those nearest
    return maxima


@kernel()
def suppress_close(floor_xy: FloatArray, order: IntArray, separation: float) -> IntArray:
    """Indices, in this order, of positions at least `separation` away from all kept before."""
    kept, count = np.empty(len(order), np.int64), 0
    x, y = np.empty(len(order)), np.empty(len(order))
    for i in order:
        alone = True
        for k in range(count):
            dx, dy = x[k] - floor_xy[i, 0], y[k] - floor_xy[i, 1]
            alone &= dx * dx + dy * dy >= separation * separation
        if alone:
            kept[count], x[count], y[count] = i, floor_xy[i, 0], floor_xy[i, 1]
            count += 1
    return kept[:count]


def best_apart(
    floor_xy: FloatArray, score: FloatArray, least: float, separation: float
) -> IntArray:
    """Indices of positions with at least some score, without those too close to a better one."""
    order = np.argsort(-score, kind="stable")[: np.count_nonzero(score >= least)]
    return np.sort(suppress_close(floor_xy, order, separation))


@kernel()
def suppress_published(
    pixels: IntArray, quality: FloatArray, floor_xy: Float32Array,
    separation: float,
) -> BoolArray:  # fmt: skip
    """(N,) mask of centres, in scan order, without a centre of higher quality nearby.

    A centre is dropped, too, if an earlier one of equal quality nearby is kept. Nearby means closer
    than `separation` (m) on the floor; `floor_xy` (H, W, 2) is the floor position of each pixel.
    """
    kept = np.ones(len(quality), np.bool_)
    x, y = np.empty(len(quality)), np.empty(len(quality))
    for i in range(len(quality)):
        x[i], y[i] = floor_xy[pixels[i, 1], pixels[i, 0]]
    for i in range(len(quality)):
        for j in range(len(quality)):
            near = (x[j] - x[i]) ** 2 + (y[j] - y[i]) ** 2 < separation * separation
            before = quality[j] == quality[i] and j < i and kept[j]
            if near and (before or quality[j] > quality[i]):
                kept[i] = False
                break
    return kept
