"""Estimates the radius of the discs in some images by maximising their total evidence.

Discs are searched for at radii that grow by a constant factor, first at every second one, then
beside the best of these; a parabola over the logarithms of the best three radii gives the peak.
The evidence is a log-odds (`detect.discs.judgement`) that depends on the radius of each rim, so its
sum over the discs is a likelihood of the radius.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from camera import Camera
from detect.circles import detect_circles, vote_shape
from detect.settings import CircleSettings
from lut import build_vote_table
from redetect.array_types import GreyImage

#: Range of the radii tried, metres, and the factor from one to the next.
SMALLEST_M, LARGEST_M = 0.02, 0.5
FACTOR = 1.1
#: Least number of discs at the best radius.
LEAST_DISCS = 3


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
    count = math.ceil(math.log(LARGEST_M / SMALLEST_M) / math.log(FACTOR))
    radii = SMALLEST_M * FACTOR ** np.arange(count + 1)
    evidence, discs = np.zeros(len(radii)), np.zeros(len(radii), np.int64)

    def try_radius(k: int) -> None:
        evidence[k], discs[k] = _evidence(images, camera, settings, float(radii[k]))

    def best_radius() -> int:
        return int(np.argmax(np.where(discs >= LEAST_DISCS, evidence, -np.inf)))

    for k in range(0, count + 1, 2):
        try_radius(k)
    coarse = best_radius()
    if discs[coarse] < LEAST_DISCS:
        return None
    for k in {max(coarse - 1, 0), min(coarse + 1, count)} - {coarse}:
        try_radius(k)
    best = best_radius()
    shift = _peak(*evidence[best - 1 : best + 2]) if 0 < best < count else 0.0
    radius_m = float(radii[best] * FACTOR**shift)
    # If the camera's tilt is not as calibrated, discs look some percent larger or smaller.
    sigma_m = 0.5 * radius_m * math.log(FACTOR)
    return RadiusEstimate(radius_m, sigma_m, int(discs[best]))


def ratio_of_radii(images: Sequence[GreyImage], camera: Camera, settings: CircleSettings) -> float:
    """How large discs look, as a share of the radius in the settings: 0.87 to 1.15."""
    radii = settings.radius_m * FACTOR ** np.arange(-1.0, 2.0)
    evidence = [_evidence(images, camera, settings, float(radius))[0] for radius in radii]
    return float(FACTOR ** np.clip(_peak(*evidence), -1.5, 1.5))


def _evidence(
    images: Sequence[GreyImage], camera: Camera, settings: CircleSettings, radius_m: float
) -> tuple[float, int]:
    """Total evidence of the discs of a radius, and their number."""
    tried = replace(settings, radius_m=radius_m, refine=True)
    table = build_vote_table(camera, vote_shape(tried))
    found = [detect_circles(image, camera, table, tried) for image in images]
    return float(sum(each.evidence.sum() for each in found)), sum(map(len, found))


def _peak(before: float, here: float, after: float) -> float:
    """Where a parabola over -1, 0 and 1 is highest."""
    return 0.5 * (after - before) / max(2.0 * here - before - after, 1e-9)
