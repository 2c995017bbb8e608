"""Phase 3, last part: the whole marker fitted to the grey values.

The four edges of a small marker give little information, but its cells have edges, too. Given a
candidate pattern, the whole marker is fitted at once (`detect.markers.pattern_fit_kernels`):
corners, light, blur. Each cell by itself then confirms or refutes the pattern.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.interrupts import interrupts_deferred_in
from detect.markers.homography_kernels import square_homography
from detect.markers.lens import Lens
from detect.markers.pattern_fit_kernels import PatternStart, fit_pattern
from detect.markers.pattern_model_kernels import Pattern, corner_signs
from detect.markers.pattern_pixel_kernels import Seam, select_pixels
from detect.markers.robust_kernels import LEAST_NOISE
from detect.markers.templates import Templates

FloatArray = NDArray[np.float64]

#: Pixels and steps of a fit, and of a first look.
_MOST_PIXELS = 3000
_MOST_STEPS = 12
_FIRST_LOOK_PIXELS = 450
_FIRST_LOOK_STEPS = 5
#: Width of the seam round the marker that is fitted: blurs and pixels, at most a cell's size.
_SEAM_BLURS = 2.5
_SEAM_PX = 0.5
_LEAST_SEAM_PX = 1.2
#: How far a corner may move from where the edges meet, pixels or cells, the greater.
_REACH_PX = 1.5
_REACH_CELLS = 0.75


@dataclass(frozen=True)
class PatternFit:
    """A marker fitted to the grey values.

    Attributes
    ----------
    corners : (4, 2) float64
        Straight pixels, in the order of the corners given.
    covariance : (8, 8) float64
        Of u0 v0 u1 ... v3, pixels squared.
    cells : (G * G,) float64
        Whiteness of each cell of the grid, as the grey values have it.
    cell_sigma : (G * G,) float64
        Its standard deviation due to noise.
    border : (B,) float64
        Whiteness of the other cells of the square.
    rest : float
        Standard deviation of what is left over, grey levels, but for outliers.
    misfit : float
        Standard deviation of what is left over beyond the image's noise, in contrasts.
    explained : float
        Explained share of the grey values' variance, noise aside.
    agree : float
        Share of the pixels that are no outliers.
    contrast : float
        White less black, grey levels.
    blur_px : float
        Mean standard deviation of the blur.
    blur_cells : float
        Standard deviation of the blur along the marker's axes, the greater, in cells.
    inflation : float
        By how much the covariance was increased for rests alike at neighbouring pixels.
    """

    corners: FloatArray
    covariance: FloatArray
    cells: FloatArray
    cell_sigma: FloatArray
    border: FloatArray
    rest: float
    misfit: float
    explained: float
    agree: float
    contrast: float
    blur_px: float
    blur_cells: float
    inflation: float


def fit_marker(
    image: NDArray[np.uint8],
    lens: Lens,
    corners: FloatArray,
    templates: Templates,
    template: int,
    *,
    dark: float,
    light: float,
    blur_px: float,
    noise: float,
    first_look: bool = False,
) -> PatternFit | None:
    """Fit a marker of a known pattern.

    Parameters
    ----------
    image : (H, W) uint8
        The image.
    lens : Lens
        Its lens.
    corners : (4, 2) float64
        Corners to begin with, straight pixels, clockwise as seen in the image.
    templates : Templates
        The dictionary.
    template : int
        Which of them.
    dark, light, blur_px : float
        Grey levels and blur to begin with.
    noise : float
        Standard deviation of the image's noise, grey levels.
    first_look : bool
        Use few pixels and few steps: enough to see whether it may be that marker.

    Returns
    -------
    PatternFit or None
        None if there is no fit near the given corners.
    """
    cell_px = templates.dictionary.cell * _least_side(corners)
    seam = min(_SEAM_BLURS * blur_px + _SEAM_PX, max(_LEAST_SEAM_PX, cell_px))
    box = _pixel_box(image, lens, corners, seam)
    if box is None:
        return None
    near = _SEAM_BLURS * blur_px + _SEAM_PX
    seam_pixels = Seam(seam, near, _FIRST_LOOK_PIXELS if first_look else _MOST_PIXELS)
    black = templates.blackness(template)
    pattern = Pattern(templates.lines, black, corner_signs(black))
    steps = _FIRST_LOOK_STEPS if first_look else _MOST_STEPS
    reach_px = max(_REACH_PX, _REACH_CELLS * cell_px)
    start = PatternStart(corners, dark, light, blur_px, noise, steps, reach_px)
    with interrupts_deferred_in(fit_pattern):
        samples = select_pixels(
            image, lens.grid, lens.step, corners, box, templates.lines, seam_pixels
        )
        found = fit_pattern(samples, pattern, start)
    if not found.found:
        return None
    contrast = max(found.contrast, 1e-3)
    outside = np.ones(black.shape, dtype=bool)
    side = templates.dictionary.patterns.shape[-1]
    outside[templates.first : templates.first + side, templates.first : templates.first + side] = 0
    return PatternFit(
        corners=found.corners,
        covariance=found.covariance,
        cells=templates.grid_of(found.cells),
        cell_sigma=templates.grid_of(found.cell_sigma),
        border=found.cells[outside],
        rest=found.rest,
        misfit=math.sqrt(max(0.0, found.rest**2 - max(noise, LEAST_NOISE) ** 2)) / contrast,
        explained=found.explained,
        agree=found.agree,
        contrast=found.contrast,
        blur_px=math.sqrt(0.5 * (found.blur[0] + found.blur[2])),
        blur_cells=_blur_along_axes(found.corners, found.blur) / templates.dictionary.cell,
        inflation=found.inflation,
    )


def _blur_along_axes(corners: FloatArray, covariance: FloatArray) -> float:
    """Standard deviation of the blur in the marker's middle, along its axes, in its widths."""
    h = square_homography(corners)
    w = 0.5 * (h[2, 0] + h[2, 1]) + 1.0
    middle = (0.5 * (h[:2, 0] + h[:2, 1]) + h[:2, 2]) / w
    px_per_width = (h[:2, :2] - np.outer(middle, h[2, :2])) / w
    widths_per_px = np.linalg.inv(px_per_width)
    uu, uv, vv = covariance
    blur = widths_per_px @ np.array([[uu, uv], [uv, vv]]) @ widths_per_px.T
    return float(np.sqrt(np.diag(blur).max()))


def _least_side(corners: FloatArray) -> float:
    """Least distance of opposite edges' middles, pixels."""
    middles = 0.5 * (corners + np.roll(corners, -1, axis=0))
    return float(min(np.hypot(*(middles[0] - middles[2])), np.hypot(*(middles[1] - middles[3]))))


def _pixel_box(
    image: NDArray[np.uint8], lens: Lens, corners: FloatArray, seam: float
) -> NDArray[np.int64] | None:
    """First and last column and row of a marker with its seam; None if it leaves the image."""
    homography = square_homography(corners)
    along = np.linspace(0.0, 1.0, 5)
    zero, one = np.zeros(5), np.ones(5)
    outline = np.concatenate(
        [
            np.stack(side, axis=-1)
            for side in ((along, zero), (one, along), (along, one), (zero, along))
        ]
    )
    straight = outline @ homography[:2, :2].T + homography[:2, 2]
    straight /= (outline @ homography[2, :2] + 1.0)[:, None]
    guess = lens.bend(corners.mean(axis=0)[None], corners.mean(axis=0))[0]
    pixels = lens.bend(straight, guess)
    if not np.all(np.isfinite(pixels)):
        return None
    height, width = image.shape
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    if low.min() < 0.0 or high[0] > width - 1.0 or high[1] > height - 1.0:
        return None
    reach = 1.5 * seam + 2.0
    return np.array(
        [
            max(0, int(low[0] - reach)),
            min(width - 1, int(high[0] + reach)),
            max(0, int(low[1] - reach)),
            min(height - 1, int(high[1] + reach)),
        ],
        dtype=np.int64,
    )
