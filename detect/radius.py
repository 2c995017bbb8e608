"""Estimates the radius of the discs in some images.

Discs are searched for at radii that grow by a constant factor. Of the rims found at one place, the
one with the highest log-odds remains, with its own radius. Discs have one radius, the grains of a
floor have any, so a radius is supported by the log-odds of rims with about that radius beyond those
of rims that are somewhat smaller or larger.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from camera import Camera
from detect.circles import searched_images, select_discs, vote_shape
from detect.settings import CircleSettings
from lut import build_vote_table
from redetect.array_types import FloatArray, GreyImage

#: Range of the radii, metres, and the factor from one that is tried to the next.
SMALLEST_M, LARGEST_M = 0.02, 0.5
FACTOR = 1.21
#: Relative standard deviation: discs look some percent larger or smaller if the camera's tilt is
#: not as calibrated.
_SIGMA = 0.05
LEAST_DISCS = 3  #: Least number of discs of the radius.
_ALIKE = math.log(1.1)  #: Rims whose radii differ by less can be of the same discs.
_BESIDE = 2.5 * _ALIKE  #: Where rims of smaller and larger radii are counted.
#: By which factor the log-odds of a floor's grains may differ there, and which of them is few.
_VARIATION, _FEW = 1.5, 5.0
_ROUNDS = 2  #: How often the radius of the rims is taken: each is found near the radius before.


class RadiusEstimate(NamedTuple):
    """A radius, its standard deviation (metres), and the number of discs used."""

    radius_m: float
    sigma_m: float
    discs: int


def find_radius(
    images: Sequence[GreyImage], camera: Camera, settings: CircleSettings
) -> RadiusEstimate | None:
    """Find the radius of the discs in some images; the radius in the settings is ignored.

    None if fewer than `LEAST_DISCS` discs are found at any radius.
    """
    # Two radii below the range show whether rims are more frequent the smaller they are.
    count = math.ceil(math.log(LARGEST_M / SMALLEST_M) / math.log(FACTOR))
    tried = [
        replace(settings, radius_m=float(SMALLEST_M * FACTOR**k), refine=True)
        for k in range(-2, count + 1)
    ]
    found = [_rims(images, camera, each) for each in tried]
    rims = np.concatenate(
        [np.empty((0, 4)), *(_best_of_each_place(np.concatenate(each)) for each in zip(*found))]
    )
    size, log_odds = np.log(rims[:, 2]), rims[:, 3]
    candidates = size[(size > math.log(SMALLEST_M)) & (size < math.log(LARGEST_M))]
    if not len(candidates):
        return None
    support = [_support(size - each, log_odds) for each in candidates]
    alike = abs(size - candidates[np.argmax(support)]) < _ALIKE
    if max(support) <= 0.0 or alike.sum() < LEAST_DISCS:
        return None
    radius_m = math.exp(np.median(size[alike]))
    for _ in range(_ROUNDS):
        radius_m *= ratio_of_radii(images, camera, replace(settings, radius_m=radius_m)) or 1.0
    return RadiusEstimate(radius_m, _SIGMA * radius_m, int(alike.sum()))


def _rims(
    images: Sequence[GreyImage], camera: Camera, settings: CircleSettings
) -> list[FloatArray]:
    """The rims in each image: (N, 4) positions and radii, metres, and log-odds."""
    table = build_vote_table(camera, vote_shape(settings))
    found = [
        select_discs(searched_images(each, camera, table, settings), settings) for each in images
    ]
    return [np.column_stack([discs.floor_xy, discs.radius, log_odds]) for discs, log_odds in found]


def _best_of_each_place(rims: FloatArray) -> FloatArray:
    """Those of (N, 4) rims that are not around the centre of a better one, nor inside it."""
    rims = rims[np.argsort(-rims[:, 3], kind="stable")]
    kept = np.ones(len(rims), np.bool_)
    for k in range(1, len(rims)):
        better = rims[:k][kept[:k]]
        apart = np.hypot(*(better[:, :2] - rims[k, :2]).T)
        kept[k] = bool(np.all(apart > np.maximum(better[:, 2], rims[k, 2])))
    return rims[kept]


def _support(relative: FloatArray, log_odds: FloatArray) -> float:
    """How much the log-odds of the rims of one radius exceed those of smaller or larger ones.

    The log likelihood ratio of a Poisson variable, for which the larger of the sums on both sides
    is expected, times a factor; `relative` are (N,) logarithms of radii less that of the radius.
    """
    here, *beside = (
        float(log_odds[abs(relative - middle) < _ALIKE].sum())
        for middle in (0.0, -_BESIDE, _BESIDE)
    )
    expected = _VARIATION * max(beside)
    if here <= expected:
        return 0.0
    return here * math.log((here + _FEW) / (expected + _FEW)) - (here - expected)


def ratio_of_radii(
    images: Sequence[GreyImage], camera: Camera, settings: CircleSettings
) -> float | None:
    """How large discs look: the median radius of their rims, as a share of that in the settings.

    None for fewer than `LEAST_DISCS` discs.
    """
    radii = np.concatenate([np.empty((0, 4)), *_rims(images, camera, settings)])[:, 2]
    return float(np.median(radii)) / settings.radius_m if len(radii) >= LEAST_DISCS else None
