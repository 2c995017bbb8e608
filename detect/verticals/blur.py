"""Estimates the blur of an image, and adapts the settings to it.

Rotation of the robot and soft optics blur all edges of an image alike. If the blur is wider than
the filter, the steepest point of an edge is not unique: motion blur turns a step into a ramp of
constant slope, in which tracks drift. A filter as wide as the blur finds the middle of the ramp.
"""

from __future__ import annotations

import dataclasses
import math
from functools import lru_cache

import numpy as np

from detect.line_settings import WIDEST_FILTER_PX, LineSettings
from detect.verticals.refinement import LineFits

_WIDE_ENOUGH = 0.68  #: Least width of the filter, as a share of the blur's width.
_WIDEST_STEP_PX = 19.0  #: Largest filter width of a refinement step, pixels.
_LEAST_EDGES = 3  #: Least number of edges from which the blur of an image is estimated.
#: Settings that scale with the width of the filter: pixels across an edge. They include a line's
#: standard deviation, since other edges within the blur displace it in proportion.
_ACROSS = (
    "sigma_across_px", "guided_reach_px", "fine_scale_px", "coarse_scale_px",
    "largest_scatter_px", "largest_shift_px", "largest_noise_px", "bend_px", "largest_lean_px",
    "same_edge_px", "join_px", "shoulder_px", "sigma_px",
)  # fmt: skip
_FILTERS = ("sigma_across_px", "fine_scale_px", "coarse_scale_px")


def blur_of_sharpness(sharpness: float, fine_px: float, coarse_px: float) -> float:
    """Standard deviation of the Gaussian blur of a step edge with a given sharpness, pixels.

    The derivative of a Gaussian of width s measures a step blurred by b with the contrast
    s / sqrt(s^2 + b^2); sharpness is the ratio of that for two widths. Infinite if the sharpness is
    below its limit for large blur, fine_px / coarse_px.
    """
    ratio = (sharpness * coarse_px / fine_px) ** 2
    if ratio <= 1.0:
        return math.inf
    return math.sqrt(max(coarse_px**2 - ratio * fine_px**2, 0.0) / (ratio - 1.0))


def width_for(sharpness: float, settings: LineSettings) -> float:
    """The smallest of `blurred_widths` that suits edges of a sharpness, or the largest."""
    blur_px = blur_of_sharpness(sharpness, settings.fine_scale_px, settings.coarse_scale_px)
    enough = [
        width
        for width in settings.blurred_widths
        if width * settings.sigma_across_px >= _WIDE_ENOUGH * blur_px
    ]
    return min(enough, default=max(settings.blurred_widths))


@lru_cache(maxsize=32)
def widened(settings: LineSettings, width: float) -> LineSettings:
    """The settings for edges `width` times as wide; only larger `blurred_widths` remain."""
    width = min(width, WIDEST_FILTER_PX / max(getattr(settings, name) for name in _FILTERS))
    across = {name: width * getattr(settings, name) for name in _ACROSS}
    steps = tuple(
        (min(width * scale, _WIDEST_STEP_PX), width * most)
        for scale, most in settings.refine_steps_px
    )
    wider = tuple(other / width for other in settings.blurred_widths if other > width)
    return dataclasses.replace(settings, refine_steps_px=steps, blurred_widths=wider, **across)


def median_sharpness(fits: LineFits) -> float:
    """The (lower) median sharpness of all refined edges, lines or not; 1 if there are too few."""
    sharpness = np.sort(fits.sharpness[~np.isnan(fits.contrast)])
    return 1.0 if len(sharpness) < _LEAST_EDGES else float(sharpness[(len(sharpness) - 1) // 2])
