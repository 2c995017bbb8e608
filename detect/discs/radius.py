"""Estimates the radius of the discs in some images by maximising their total evidence.

Discs are searched for at radii that grow by a constant factor, first at every second one, then
beside the best of these. The evidence is a log-odds (`detect.discs.judgement`) that depends on the
radius of each rim, so its sum over the discs is a likelihood of the radius. From the best one on,
the median radius of the rims is followed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from camera import Camera
from detect.circles import detect_circles, judged_discs, scene_of, vote_shape
from detect.settings import CircleSettings
from lut import build_vote_table
from redetect.array_types import GreyImage

#: Range of the radii tried, metres, and the factor from one to the next.
SMALLEST_M, LARGEST_M = 0.02, 0.5
FACTOR = 1.1
LEAST_DISCS = 3  #: Least number of discs at the best radius.
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
    count = math.ceil(math.log(LARGEST_M / SMALLEST_M) / math.log(FACTOR))
    radii = SMALLEST_M * FACTOR ** np.arange(count + 1)
    evidence, discs = np.zeros(len(radii)), np.zeros(len(radii), np.int64)

    def try_radius(k: int) -> None:
        tried = replace(settings, radius_m=float(radii[k]), refine=True)
        table = build_vote_table(camera, vote_shape(tried))
        for image in images:
            found = detect_circles(image, camera, table, tried)
            evidence[k] += found.evidence.sum()
            discs[k] += len(found)

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
    radius_m = float(radii[best])
    for _ in range(_ROUNDS):
        radius_m *= ratio_of_radii(images, camera, replace(settings, radius_m=radius_m)) or 1.0
    # If the camera's tilt is not as calibrated, discs look some percent larger or smaller.
    sigma_m = 0.5 * radius_m * math.log(FACTOR)
    return RadiusEstimate(radius_m, sigma_m, int(discs[best]))


def ratio_of_radii(
    images: Sequence[GreyImage], camera: Camera, settings: CircleSettings
) -> float | None:
    """How large discs look: the median radius of their rims, as a share of that in the settings.

    None for fewer than `LEAST_DISCS` discs.
    """
    table = build_vote_table(camera, vote_shape(settings))
    scenes = (scene_of(image, camera, table, settings) for image in images)
    judged = [judged_discs(scene, table, settings) for scene in scenes]
    radii = np.concatenate([np.empty(0), *(discs.radius for discs, _ in judged)])
    return float(np.median(radii)) / settings.radius_m if len(radii) >= LEAST_DISCS else None
