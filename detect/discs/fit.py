"""Where a disc is exactly: the fit of a disc through the camera to the grey values.

A blurred disc on an unevenly lit background is fitted: pixels are gathered
(`detect.discs.patch`), the descent goes to the least squares (`detect.discs.descent`), and the
residuals say how far the fit can be trusted (`detect.discs.least_squares`). It gives the position
with its covariance, and the share of the grey values that the disc explains.
"""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.discs.descent import (
    MOST_BLUR,
    WORK,
    Descent,
    descend,
    moved,
    solve_step,
)
from detect.discs.least_squares import (
    BACKGROUND,
    UNKNOWNS,
    correlated_area,
    factor_rows,
    residuals,
    solution,
)
from detect.discs.model import BY_BLUR, BY_X, BY_Y, SHARE, Disc
from detect.discs.patch import EDGE, Candidate, FitSettings, Gathered, gather
from redetect.compiled import kernel

FloatArray = NDArray[np.float64]

#: Pixels within this many radii of the centre are fitted, and those this near to the edge, in
#: pixels or in standard deviations of the blur.
_REACH_RADII = 1.7
_REACH_PX = 3.0
_REACH_BLURS = 2.0
#: Standard deviation of the radius about the nominal one (relative), of the log of the blur; and
#: the blur in pixels about which it lies.
_RADIUS_SIGMA = 0.08
_BLUR_SIGMA = 0.7
_BLUR_PX = 0.6
#: Grey values are rounded: noise is never below this.
_LEAST_NOISE = 0.3
#: A flat disc's blur may grow from the one its pixels were gathered for by this factor, and pixels.
_MOST_GROWTH, _MOST_GROWTH_PX = 1.5, 1.0

#: Result of a fit. The centre, its covariance and the radius are in metres; the blur is a standard
#: deviation, in pixels; the contrast is the grey level inside minus outside. `explained` is the
#: share of the variance about the background that the disc explains. A blur of `blur_bound` is the
#: most that the patch allowed.
RESULT = np.dtype(
    [
        (name, np.float64)
        for name in (
            "x", "y", "radius", "blur", "contrast", "explained", "cov_xx", "cov_xy", "cov_yy",
            "blur_bound",
        )
    ]
)  # fmt: skip


@kernel()
def fit_disc(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    candidate: Candidate,
    settings: FitSettings,
    start: Disc,
    work: Any,
    result: Any,
) -> bool:
    """Fit one candidate.

    Parameters
    ----------
    image : (H, W) uint8
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    candidate : Candidate
    settings : FitSettings
    start : Disc
        Where to start.
    work : WORK
        Working space.
    result : RESULT
        The result.

    Returns
    -------
    bool
        Whether the fit came to a result.
    """
    patch, radius = work.patch, candidate.radius
    _clear(result)
    gathered = gather(image, floor_xy, candidate, settings, start, patch)
    most_blur = MOST_BLUR
    if gathered.shape != EDGE:
        most_blur = min(_MOST_GROWTH * candidate.blur + _MOST_GROWTH_PX, MOST_BLUR)
    result.blur_bound = most_blur
    if gathered.fitted - UNKNOWNS < 4:
        return False
    descent = descend(gathered, start, settings, most_blur, work)
    if not descent.arrived or not _solve_last_step(descent, settings, most_blur, work):
        return False
    # The last step is taken as the linear model has it, and so are its residuals.
    disc = moved(descent.best, descent.contrast, math.log(most_blur), work)
    residual, near, near_total = residuals(patch, gathered.n, work.values, work.bare)
    result.x = floor_xy[candidate.v, candidate.u, 0] + disc.x * radius
    result.y = floor_xy[candidate.v, candidate.u, 1] + disc.y * radius
    result.radius = disc.radius * radius
    result.blur = math.exp(disc.log_blur)
    result.contrast = work.values[SHARE]
    result.explained = 1.0 - min(near / max(near_total, 1e-12), 1.0)
    variance = max(residual / (gathered.fitted - UNKNOWNS), settings.noise**2)
    _find_covariance(gathered, radius, variance, work, result)
    return True


@kernel(forceinline=True)
def _clear(result: Any) -> None:
    result.x = result.y = result.radius = result.blur = result.contrast = result.explained = 0.0
    result.cov_xx = result.cov_xy = result.cov_yy = 0.0


@kernel(forceinline=True)
def _solve_last_step(descent: Descent, settings: FitSettings, most_blur: float, work: Any) -> bool:
    """All unknowns of the undamped step into `work.values`, the background alone into `bare`."""
    factor = work.factor
    if not factor_rows(work.best, 0, BY_BLUR, factor):
        return False
    solution(factor, 0, BACKGROUND, work.bare)
    if not solve_step(
        descent.best, descent.contrast, descent.variance, 0.0, settings, math.log(most_blur), work
    ):
        return False
    solution(factor, 0, UNKNOWNS, work.values)
    return True


@kernel(forceinline=True)
def _find_covariance(
    gathered: Gathered, radius: float, variance: float, work: Any, result: Any
) -> None:
    """Covariance of a fit, from the factor and the residuals in the working space.

    `variance` is that of the residuals. x and y are the last unknowns: their covariance is the
    inverse of the factor's last two rows.
    """
    patch, factor = work.patch, work.factor
    contrast = work.values[SHARE]
    scale = variance * correlated_area(patch, gathered.n) * (radius / contrast) ** 2
    per_xx, per_yy, xy = factor[BY_X, BY_X], factor[BY_Y, BY_Y], factor[BY_Y, BY_X]
    result.cov_xx = scale * per_xx * per_xx * (1.0 + (xy * per_yy) ** 2)
    result.cov_xy = -scale * per_xx * per_yy * per_yy * xy
    result.cov_yy = scale * per_yy * per_yy


def fit_settings(noise: float, blur_ratio: float) -> FitSettings:
    """Settings of an image's fits: its noise (grey levels) and `blur_ratio_of` the camera."""
    return FitSettings(
        noise=max(noise, _LEAST_NOISE),
        reach_radii=_REACH_RADII,
        reach_px=_REACH_PX,
        reach_blurs=_REACH_BLURS,
        radius_sigma=_RADIUS_SIGMA,
        blur_px=_BLUR_PX,
        blur_sigma=_BLUR_SIGMA,
        blur_ratio=blur_ratio,
    )


#: Memory that is new for every image has to be fetched first.
_kept = threading.local()


def working_space() -> NDArray[Any]:
    """(1,) `detect.discs.descent.WORK`: what the calling thread's fits work in."""
    space: NDArray[Any] | None = getattr(_kept, "space", None)
    if space is None:
        space = np.zeros(1, WORK)
        _kept.space = space
    return space


def fitted_positions(results: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
    """(N, 2) centres, metres, and their (N, 2, 2) covariances from (N,) `RESULT`."""
    covariance = np.empty((len(results), 2, 2))
    covariance[:, 0, 0] = results["cov_xx"]
    covariance[:, 0, 1] = covariance[:, 1, 0] = results["cov_xy"]
    covariance[:, 1, 1] = results["cov_yy"]
    return np.stack([results["x"], results["y"]], axis=-1), covariance


def blur_ratio_of(camera: Camera) -> float:
    """Blur along v over blur along u, in pixels.

    Optics blur equally in all directions. Where the scales differ, as in single fields of
    interlaced frames, a pixel is not square, and the same blur is fewer pixels along v.
    """
    return camera.scale_y / camera.scale_x
