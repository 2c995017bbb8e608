"""Compares the discs of an image: they mostly look alike, and the best of close ones are kept."""

from __future__ import annotations

import math

import cv2
import numpy as np

from detect.discs.rim import median
from redetect.array_types import BoolArray, Float32Array, FloatArray, IntArray
from redetect.compiled import kernel

#: Log-odds from which a disc is sure; doubtful discs are compared with the sure ones.
SURE = 2.5
_PALE = 0.5  #: A disc with less than this share of the others' contrast is pale.
_PER_FACTOR = 4.0  #: Penalty for each factor of e, log-odds.
_LEAST_OTHERS = 2  #: Least number of sure discs to compare with.
_DARKEST = 5.0  #: Lowest grey value used in a ratio.


def local_maxima(quality: FloatArray, threshold: float) -> BoolArray:
    """(H, W) mask of pixels of at least `threshold` that none of their 8 neighbours exceeds.

    Connected pixels of equal quality are one maximum, at the pixel nearest to their centroid: a
    plateau is neither lost nor found twice. Pixels of quality 0 are never maxima.
    """
    around = np.ones((3, 3), np.uint8)
    quality = np.where((quality >= threshold) & (quality > 0.0), quality, 0.0)
    highest = (quality > 0.0) & (quality >= cv2.dilate(quality, around))
    _, plateau = cv2.connectedComponents(highest.astype(np.uint8), connectivity=8)
    # Beside a plateau that touches a higher pixel is an equal one that is not among the highest.
    lost = highest & (cv2.dilate(np.where(highest, 0.0, quality), around) >= quality)
    highest &= ~np.isin(plateau, plateau[lost])
    rows, columns = np.nonzero(highest)
    _, number, size = np.unique(plateau[highest], return_inverse=True, return_counts=True)
    off = np.zeros(len(number))
    for place in (rows, columns):
        off += (place - (np.bincount(number, place) / size)[number]) ** 2
    order = np.lexsort((off, number))  # the first of those nearest
    middle = order[np.unique(number[order], return_index=True)[1]]
    maxima = np.zeros(quality.shape, np.bool_)
    maxima[rows[middle], columns[middle]] = True
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


@kernel()
def best_apart(
    floor_xy: FloatArray, score: FloatArray, least: float, separation: float
) -> IntArray:
    """Indices of positions with at least some score, without those too close to a better one."""
    kept = np.argsort(-score, kind="mergesort")
    kept = kept[: np.sum(score >= least)]
    return np.sort(suppress_close(floor_xy, kept, separation))


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


@kernel()
def paleness_penalty(contrast: FloatArray, floor_grey: FloatArray, sure: BoolArray) -> FloatArray:
    """(N,) penalties, log-odds, for discs that are paler than the sure discs of their image.

    A candidate with much less contrast than the sure discs is mostly the reflection of one in a
    polished floor or in glass. A disc in shadow has less contrast, too, but its ratio to the floor
    is the same as elsewhere, so the better of both measures counts. The constants were chosen on
    the first 1,000 frames of run e; rendered buildings confirm them.

    The contrast is that between a disc and its floor, grey levels. Sure discs have no penalty; the
    others are compared with the sure discs of their own sign, if there are at least two.
    """
    penalty, ratio = np.zeros(len(contrast)), np.empty(len(contrast))
    for k in range(len(contrast)):
        disc = max(floor_grey[k] + contrast[k], _DARKEST)
        ratio[k] = abs(math.log(disc / max(floor_grey[k], _DARKEST)))
    contrasts, ratios = np.empty(len(contrast)), np.empty(len(contrast))
    for sign in (1.0, -1.0):
        count = 0
        for k in range(len(contrast)):
            if sure[k] and sign * contrast[k] > 0.0:
                contrasts[count], ratios[count] = abs(contrast[k]), ratio[k]
                count += 1
        if count < _LEAST_OTHERS:
            continue
        usual_contrast, usual_ratio = median(contrasts[:count]), median(ratios[:count])
        for k in range(len(contrast)):
            if not sure[k] and sign * contrast[k] > 0.0:
                of_contrast = abs(contrast[k]) / (_PALE * usual_contrast)
                paleness = max(of_contrast, ratio[k] / max(usual_ratio, 1e-3), 1e-3)
                penalty[k] = _PER_FACTOR * max(-math.log(paleness), 0.0)
    return penalty


@kernel()
def sign_penalty(contrast: FloatArray, sure: BoolArray) -> FloatArray:
    """(N,) penalties, log-odds, for discs whose sign is uncertain or less likely than the other.

    If m of n sure discs have a sign, the probability of that sign is (m + 1) / (n + 2) by Laplace's
    rule of succession; if the settings fix the polarity, it is 1.
    """
    light, dark = 1, 1
    for k in range(len(contrast)):
        light += sure[k] and contrast[k] > 0.0
        dark += sure[k] and contrast[k] < 0.0
    penalty = np.empty(len(contrast))
    for k in range(len(contrast)):
        alike = light if contrast[k] > 0.0 else dark
        penalty[k] = math.log((light + dark) / alike)
    return penalty
