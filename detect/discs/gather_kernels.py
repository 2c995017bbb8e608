"""Compiled choice of the pixels that a candidate is fitted to, and in which form."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.discs.grid_kernels import gather_grid
from detect.discs.list_kernels import gather_list, gather_sparse
from detect.discs.model_kernels import CAPACITY
from detect.discs.patch_kernels import COLUMNS, LIST, FitSettings, Patch, padded, view_of
from detect.uncounted import uncounted

#: How many pixels a fit uses.
LOOK, ALL = range(2)
#: About how many for a look.
_LOOK_PIXELS = 160

#: Of windows of more pixels than this, not all are used.
_DENSE_WINDOW = 2048

LEAST_BLUR, MOST_BLUR = 0.1, 8.0


class Gathered(NamedTuple):
    """What became of a patch."""

    shape: int
    """`LIST`, or lines of which image axis (see `detect.discs.patch_kernels`)."""
    n: int
    """Pixels of the patch, those that only fill it up included."""
    fitted: int
    """Those of them that are fitted."""
    margin: int
    """Of a grid's lines; 0 for single pixels."""
    most_blur: float
    """How far the blur may grow before the patch is too small for it."""


@uncounted
def gather(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    radius: float,
    settings: FitSettings,
    blur: float,
    detail: int,
    patch: Patch,
) -> Gathered:
    """Fill a patch with the pixels round a candidate whose blur is about `blur`.

    No pixels where the candidate sees no floor. `detail`: see `detect.discs.fit_kernels.fit_disc`.
    """
    ratio = settings.blur_ratio
    shape, along_u, along_v, area = view_of(floor_xy, u0, v0, radius, blur, ratio)
    if area == 0.0:
        return Gathered(LIST, 0, 0, 0, MOST_BLUR)
    beyond_u = max(settings.reach_px, settings.reach_blurs * blur)
    beyond_v = max(settings.reach_px, settings.reach_blurs * blur * ratio)
    room = 1.08 * settings.reach_radii
    half_u = int(max(room * along_u, 1.08 * along_u + beyond_u)) + 1
    half_v = int(max(room * along_v, 1.08 * along_v + beyond_v)) + 1
    half_u = min(half_u, image.shape[1])
    half_v = min(half_v, image.shape[0])
    window = (2 * half_u + 1) * (2 * half_v + 1)
    if detail == LOOK:
        every = max(1, window // _LOOK_PIXELS)
        count = gather_sparse(
            image, floor_xy, u0, v0, radius, settings, half_u, half_v, every, shape, patch
        )
        return Gathered(shape, padded(count), count, 0, MOST_BLUR)
    if shape != LIST:
        across = 1.0 if shape != COLUMNS else ratio
        margin = min(int(3.0 * 1.3 * blur * across) + 3, 30)
        length = 2 * (half_u if shape != COLUMNS else half_v) + 1 + 2 * margin
        lines = 2 * (half_v if shape != COLUMNS else half_u) + 1
        if length * (lines + 2) <= CAPACITY:
            n, count = gather_grid(
                image, floor_xy, u0, v0, radius, blur, settings, half_u, half_v, margin,
                shape == COLUMNS, patch,
            )  # fmt: skip
            most_blur = min((margin - 1.0) / (2.5 * across), MOST_BLUR)
            return Gathered(shape, n, count, margin, most_blur)
    # All of them at the edge, and some of the others: those tell no more than grey levels.
    every = 1 + window // _DENSE_WINDOW
    count = gather_list(
        image, floor_xy, u0, v0, radius, blur, settings, half_u, half_v, every, patch
    )
    return Gathered(LIST, padded(count), count, 0, MOST_BLUR)
