"""Is it a disc, and where exactly: the fit of a disc through the camera to the grey values.

Around each candidate a blurred disc on an unevenly lit background is fitted: pixels are gathered
(`detect.discs.patch`), the descent goes to the least squares (`detect.discs.descent`), and the
residuals say how far the fit can be trusted (`detect.discs.least_squares`). It gives the position
with its covariance, and the evidence that there is a disc at all.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.discs.descent import (
    MOST_BLUR,
    PATIENT,
    WORK,
    Descent,
    Hope,
    blur_of,
    descend,
    moved,
    solve_step,
)
from detect.discs.evidence_kernels import evidence_of
from detect.discs.least_squares import (
    BACKGROUND,
    UNKNOWNS,
    blur_width,
    correlated_area,
    factor_rows,
    outline_statistics,
    residuals,
    solution,
)
from detect.discs.model import BY_BLUR, BY_X, BY_Y, SHARE, Disc
from detect.discs.patch import EDGE, FULL, LOOK, Candidate, Effort, FitSettings, Gathered, gather
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

#: Result of a fit (the meaning: `DiscFits`), and the names of its fields. The centre and its
#: covariance in metres; a blur of `blur_bound` is the most that the patch allowed.
RESULT = np.dtype(
    [
        (name, np.float64)
        for name in (
            "x", "y", "radius", "blur", "contrast", "explained", "cov_xx", "cov_xy", "cov_yy",
            "sectors_good", "outline_deviation", "middle_step", "relative_blur", "blur_bound",
        )
    ]
)  # fmt: skip
X, Y, RADIUS, BLUR, CONTRAST, EXPLAINED = "x", "y", "radius", "blur", "contrast", "explained"
COV_XX, COV_XY, COV_YY = "cov_xx", "cov_xy", "cov_yy"
SECTORS_GOOD, OUTLINE_DEVIATION, MIDDLE_STEP = "sectors_good", "outline_deviation", "middle_step"
RELATIVE_BLUR, BLUR_BOUND = "relative_blur", "blur_bound"


@kernel()
def fit_disc(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    candidate: Candidate,
    settings: FitSettings,
    start: Disc,
    effort: Effort,
    hope: Hope,
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
    effort : Effort
    hope : Hope
        When to give up.
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
    gathered = gather(image, floor_xy, candidate, settings, start, effort.look, patch)
    most_blur = MOST_BLUR
    if gathered.shape != EDGE:
        most_blur = min(_MOST_GROWTH * candidate.blur + _MOST_GROWTH_PX, MOST_BLUR)
    result.blur_bound = most_blur
    if gathered.fitted - UNKNOWNS < 4:
        return False
    descent = descend(gathered, start, settings, most_blur, effort.evaluations, hope, work)
    if not descent.arrived or not _solve_last_step(descent, settings, most_blur, work):
        return False
    # The last step is taken as the linear model has it, and so are its residuals.
    disc = moved(descent.best, descent.contrast, math.log(most_blur), work)
    residual, near, near_total = residuals(patch, gathered.n, work.values, work.bare)
    blur = blur_of(gathered.shape, disc, settings.blur_ratio)
    result.x = floor_xy[candidate.v, candidate.u, 0] + disc.x * radius
    result.y = floor_xy[candidate.v, candidate.u, 1] + disc.y * radius
    result.radius = disc.radius * radius
    result.blur = math.exp(disc.log_blur)
    result.contrast = work.values[SHARE]
    result.explained = 1.0 - min(near / max(near_total, 1e-12), 1.0)
    result.relative_blur = blur_width(patch, gathered.n, disc, blur) / disc.radius
    result.sectors_good = 1.0
    result.middle_step = 1.0
    if not effort.look:
        variance = max(residual / (gathered.fitted - UNKNOWNS), settings.noise**2)
        _judge(gathered, disc, radius, variance, work, result)
    return True


@kernel(forceinline=True)
def _clear(result: Any) -> None:
    result.x = result.y = result.radius = result.blur = result.contrast = result.explained = 0.0
    result.cov_xx = result.cov_xy = result.cov_yy = result.sectors_good = 0.0
    result.outline_deviation = result.middle_step = result.relative_blur = 0.0


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
def _judge(
    gathered: Gathered, disc: Disc, radius: float, variance: float, work: Any, result: Any
) -> None:
    """Covariance and outline of a fit, from the factor and the residuals in the working space.

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
    outline = outline_statistics(patch, gathered.n, disc, contrast, work.sector_sums)
    result.sectors_good = outline.good
    result.outline_deviation = outline.deviation
    result.middle_step = outline.middle


@kernel()
def fit_all(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    pixels: NDArray[np.int64],
    radius: float,
    blur_guess: FloatArray,
    settings: FitSettings,
    effort: Effort,
) -> tuple[Any, NDArray[np.bool_]]:
    """(N,) results of `fit_disc` from each pixel, and whether there is one."""
    n = len(pixels)
    results = np.zeros(n, RESULT)
    fitted = np.zeros(n, np.bool_)
    work = np.zeros(1, WORK)
    for i in range(n):
        candidate = Candidate(pixels[i, 0], pixels[i, 1], radius, blur_guess[i], 0)
        start = Disc(0.0, 0.0, 1.0, math.log(blur_guess[i]))
        fitted[i] = fit_disc(
            image, floor_xy, candidate, settings, start, effort, PATIENT, work[0], results[i]
        )
    return results, fitted


@dataclass(frozen=True)
class DiscFits:
    """Discs fitted at N candidates.

    Attributes
    ----------
    fitted : (N,) bool
        Whether the fit came to a result; the other arrays mean nothing where it did not.
    floor_xy : (N, 2) float64
        Centres on the floor (robot X, Y), metres.
    covariance : (N, 2, 2) float64
        Of the centres, from the fit: noise and, where the model does not fit, the correlated
        residuals.
    radius_m, blur_px, contrast : (N,) float64
        The disc's radius, the standard deviation of the blur, and grey level inside minus outside.
    explained : (N,) float64
        Share of the variance about the background that the disc explains.
    sectors_good : (N,) float64
        Share of 16 sectors whose step at the edge has the sign, and 0.4 of the size, of the disc's.
    middle_step : (N,) float64
        Step of the disc's middle from the background, relative to the contrast; 1 where the middle
        is less than two pixels.
    outline_deviation : (N,) float64
        Root mean square over the sectors of how far the edge is from the circle, in radii.
    relative_blur : (N,) float64
        Width of the blur across the edge, in radii.
    """

    fitted: NDArray[np.bool_]
    floor_xy: FloatArray
    covariance: FloatArray
    radius_m: FloatArray
    blur_px: FloatArray
    contrast: FloatArray
    explained: FloatArray
    sectors_good: FloatArray
    middle_step: FloatArray
    outline_deviation: FloatArray
    relative_blur: FloatArray


def fit_discs(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    pixels: NDArray[np.int64],
    radius_m: float,
    noise: float,
    *,
    blur_ratio: float = 1.0,
    blur_guess: FloatArray | None = None,
    first_look: bool = False,
) -> DiscFits:
    """Fit a disc at each candidate.

    Parameters
    ----------
    image : (H, W) uint8
        The image.
    floor_xy : (H, W, 2) float32
        Floor position of each pixel (`DiscTable.floor_xy`), metres.
    pixels : (N, 2) int64
        The candidates' pixels (u, v).
    radius_m : float
        Nominal radius, metres.
    noise : float
        Standard deviation of the image's noise, grey levels.
    blur_ratio : float
        Blur along v over blur along u, in pixels: `blur_ratio_of` the camera.
    blur_guess : (N,) float64, optional
        About how blurred each candidate is (along u), pixels.
    first_look : bool
        Use some of the pixels and few steps: several times faster, good enough to reject what is no
        disc. Covariance and outline are left out.

    Returns
    -------
    DiscFits
    """
    if blur_guess is None:
        blur_guess = np.full(len(pixels), _BLUR_PX)
    results, fitted = fit_all(
        image, floor_xy, np.ascontiguousarray(pixels), radius_m, blur_guess,
        fit_settings(noise, blur_ratio), LOOK if first_look else FULL,
    )  # fmt: skip
    centres, covariance = fitted_positions(results)
    return DiscFits(
        fitted=fitted,
        floor_xy=centres,
        covariance=covariance,
        radius_m=results[RADIUS],
        blur_px=results[BLUR],
        contrast=results[CONTRAST],
        explained=results[EXPLAINED],
        sectors_good=results[SECTORS_GOOD],
        middle_step=results[MIDDLE_STEP],
        outline_deviation=results[OUTLINE_DEVIATION],
        relative_blur=results[RELATIVE_BLUR],
    )


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
    covariance[:, 0, 0] = results[COV_XX]
    covariance[:, 0, 1] = covariance[:, 1, 0] = results[COV_XY]
    covariance[:, 1, 1] = results[COV_YY]
    return np.stack([results[X], results[Y]], axis=-1), covariance


def blur_ratio_of(camera: Camera) -> float:
    """Blur along v over blur along u, in pixels.

    Optics blur equally in all directions. Where the scales differ, as in single fields of
    interlaced frames, a pixel is not square, and the same blur is fewer pixels along v.
    """
    return camera.scale_y / camera.scale_x


def disc_evidence(fits: DiscFits, radius_m: float, blur_px: float = 1.0) -> FloatArray:
    """How much speaks for a disc: a log-odds score, minus infinity where it cannot be one.

    What speaks for a disc: that it explains the grey values, has the right radius, an even outline
    and a sharp edge. No single one must: glare or texture leave much unexplained about a sharp
    circle of the right size, defocus blurs the edge of a disc that explains everything. So they
    are weighed by a logistic regression. Its weights were fitted to some 18,000 discs, and to what
    else has a high quality, in photographs and renders: as they are, and with glare, shade,
    defocus, motion blur, noise and low contrast added. They are constants: that fitting is not
    part of the project.

    Parameters
    ----------
    fits : DiscFits
        The fits.
    radius_m : float
        Nominal radius, metres.
    blur_px : float
        Blur of the camera's optics (along u), pixels: as far as it goes beyond one pixel, it does
        not speak against a disc.

    Returns
    -------
    (N,) float64
    """
    evidence = np.full(len(fits.fitted), -np.inf)
    for k in np.flatnonzero(fits.fitted):
        evidence[k] = evidence_of(
            fits.explained[k], fits.radius_m[k] / radius_m, fits.outline_deviation[k],
            fits.sectors_good[k], fits.middle_step[k], fits.relative_blur[k], blur_px,
        )  # fmt: skip
    return evidence
