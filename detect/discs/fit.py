"""Is it a disc, and where exactly: the fit of a disc through the camera to the grey values.

Around each candidate a blurred disc on an unevenly lit background is fitted (Levenberg-Marquardt,
through the camera's exact geometry). The fit gives the position with its covariance, and the
evidence that there is a disc at all.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.discs import fit_kernels as kernels
from detect.discs.descent_kernels import WORK_INDICES, WORK_MEMORY
from detect.discs.evidence_kernels import evidence_of_all
from detect.discs.model_kernels import CAPACITY
from detect.discs.patch_kernels import FitSettings

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
        Use some of the pixels and few steps: several times faster, good enough to tell what is no
        disc. Covariance and outline are left out.

    Returns
    -------
    DiscFits
    """
    settings = fit_settings(noise, blur_ratio)
    if blur_guess is None:
        blur_guess = np.full(len(pixels), _BLUR_PX)
    results, fitted = kernels.fit_discs(
        image,
        floor_xy,
        np.ascontiguousarray(pixels[:, 0]),
        np.ascontiguousarray(pixels[:, 1]),
        radius_m,
        settings,
        blur_guess,
        kernels.LOOK if first_look else kernels.ALL,
    )
    centres, covariance = fitted_positions(results)
    return DiscFits(
        fitted=fitted,
        floor_xy=centres,
        covariance=covariance,
        radius_m=results[:, kernels.RADIUS],
        blur_px=results[:, kernels.BLUR],
        contrast=results[:, kernels.CONTRAST],
        explained=results[:, kernels.EXPLAINED],
        sectors_good=results[:, kernels.SECTORS_GOOD],
        middle_step=results[:, kernels.MIDDLE_STEP],
        outline_deviation=results[:, kernels.OUTLINE_DEVIATION],
        relative_blur=results[:, kernels.RELATIVE_BLUR],
    )


def fit_settings(noise: float, blur_ratio: float) -> FitSettings:
    """What an image's fits are told: its noise (grey levels) and `blur_ratio_of` the camera."""
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


def working_space() -> tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.uint8]]:
    """What the calling thread's fits work in (see `detect.discs.descent_kernels.work_in`)."""
    space: tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.uint8]] | None
    space = getattr(_kept, "space", None)
    if space is None:
        space = (
            np.zeros(WORK_MEMORY, np.float32),
            np.zeros(WORK_INDICES, np.uint32),
            np.zeros(CAPACITY, np.uint8),
        )
        _kept.space = space
    return space


def fitted_positions(results: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N, 2) centres, metres, and their (N, 2, 2) covariances from (N, RESULT_SIZE) results."""
    covariance = np.empty((len(results), 2, 2))
    covariance[:, 0] = results[:, kernels.COV_XX : kernels.COV_XY + 1]
    covariance[:, 1] = results[:, kernels.COV_XY : kernels.COV_YY + 1]
    return results[:, kernels.X : kernels.Y + 1].copy(), covariance


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
    return np.asarray(
        evidence_of_all(
            fits.fitted,
            fits.explained,
            fits.radius_m / radius_m,
            fits.outline_deviation,
            fits.sectors_good,
            fits.middle_step,
            fits.relative_blur,
            blur_px,
        )
    )
