"""The disc detector: one image in, discs on the floor out.

The way of one image begins at `detect_circles`. The published detector (DLR Spatial
Cognition data set report, circle detection) needs no more than the quality of each centre: it
accepts those of a good quality and contrast, keeps the best within a disc's width, and reports the
pixel with a covariance of one pixel and some centimetres. The default goes on from the maxima of
the quality: it fits a disc through the camera at each, weighs the evidence, suppresses neighbours
in the floor plane and refines the position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import camera_numbers, published_camera_numbers
from detect.discs.candidates import alone_published, local_maxima, suppress_neighbours
from detect.discs.evidence import lost_by_paleness
from detect.discs.fit import blur_ratio_of, fit_settings, fitted_positions, working_space
from detect.discs.hough import HoughCandidates, hough_candidates
from detect.discs.placing import place_all
from detect.discs.positions import pixel_positions, refined_covariances
from detect.discs.quality import (
    Centres,
    Limits,
    centres_of,
    contrast_and_floor,
    least_part_quality,
)
from detect.discs.quality import quality_of_centres as quality_of_centres
from detect.discs.rim_network import Networks, trained_networks
from detect.discs.search import SURE_EVIDENCE, DiscSearch, FoundDiscs, Scene, search_discs
from detect.discs.second_look import NO_LOOKS, SecondLooks, Sought, second_looks
from detect.errors import FrameError
from detect.grey_values import blank_margins, estimate_noise
from detect.settings import CircleSettings, Polarity
from lut import DiscShape, DiscTable, cached_disc_table
from lut.outlines import floor_positions

FloatArray = NDArray[np.float64]

#: The published covariance: this deviation in every direction, and two pixels squared.
PUBLISHED_FLOOR_M = 0.04
PUBLISHED_PIXEL_VARIANCE = 2.0

#: For the noise floor an image's noise is never less than this: one grey level, its resolution.
_LEAST_NOISE = 1.0
_SIGNS: dict[Polarity, int] = {"any": 0, "light": 1, "dark": -1}
_LIGHT_AND_DARK: tuple[Polarity, Polarity] = ("light", "dark")
#: Rows of an image from which its noise is estimated.
_NOISE_ROWS = 16
#: Least gradient of an edge that votes, and least step of a rim, grey levels (per pixel).
_EDGE, _LEAST_STEP = 5.5, 8.0
#: Of the least quality, the samples that a group of centres shares must have this share.
_PART_QUALITY = 0.8
#: Discs of so little more than the least evidence are for the second look, where the polarity is
#: stated.
_DOUBTFUL = 1.0
#: Where it is not, it is each that two sure discs have; the second look then examines this number
#: of candidates, the best ones, which need these log-odds more.
_LEAST_SURE, _BEST, _UNSTATED = 2, 60, 0.75


@dataclass(frozen=True)
class CircleDetections:
    """The discs found in one image, in scan order of their pixels.

    Attributes
    ----------
    pixels : (N, 2) int64
        Pixel (u, v) of each local maximum of the quality.
    floor_xy : (N, 2) float64
        Position in the robot frame, metres.
    covariance : (N, 2, 2) float64
        Of the position, square metres.
    quality : (N,) float64
        Otsu's quality at the pixel, 0 to 1.
    evidence : (N,) float64
        Log-odds that it is a disc; NaN where nothing was fitted.
    levelled_by : (float, float) or None
        Pitch and roll (rad) that turned the positions level, if any did.
    """

    pixels: NDArray[np.int64]
    floor_xy: FloatArray
    covariance: FloatArray
    quality: FloatArray
    evidence: FloatArray
    levelled_by: tuple[float, float] | None = None

    def __len__(self) -> int:
        return len(self.quality)


def detect_circles(
    image: NDArray[np.uint8], camera: Camera, table: DiscTable, settings: CircleSettings
) -> CircleDetections:
    """Find the discs in one image.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image of the camera's size.
    camera : Camera
        The calibrated camera.
    table : DiscTable
        The camera's table for `disc_shape` of the settings (see `lut.cached_disc_table`).
    settings : CircleSettings
        What to look for.

    Returns
    -------
    CircleDetections

    Raises
    ------
    FrameError
        If the image has not the camera's size.
    """
    if image.shape != (camera.height, camera.width):
        raise FrameError(
            f"the image is {image.shape[1]}x{image.shape[0]} px: "
            f"the calibration is for {camera.width}x{camera.height}"
        )
    if not (settings.verify or settings.refine):
        return _without_fit(image, camera, table, settings)
    left, right = blank_margins(image)
    if not (left or right):
        return _with_fit(image, camera, table, settings)
    camera, table = _between_margins(camera, left, right, disc_shape(settings))
    image = np.ascontiguousarray(image[:, left : left + camera.width])
    found = _with_fit(image, camera, table, settings)
    return replace(found, pixels=found.pixels + np.array([left, 0]))


@lru_cache(maxsize=8)
def _between_margins(
    camera: Camera, left: int, right: int, shape: DiscShape
) -> tuple[Camera, DiscTable]:
    """The camera that sees an image without its margins, and its table."""
    width, offset_x = camera.width - left - right, camera.offset_x - left
    camera = replace(camera, width=width, offset_x=offset_x)
    return camera, cached_disc_table(camera, shape)


def _with_fit(
    image: NDArray[np.uint8], camera: Camera, table: DiscTable, settings: CircleSettings
) -> CircleDetections:
    """The default detector: discs that are fitted from the best centres."""
    first = first_look(image, camera, table, settings)
    centres, found = first.centres, first.found
    pixels, found_quality = centres.pixels[found.centre], centres.quality[found.centre]
    floor_xy, fitted, evidence = found.floor_xy, found.covariance, found.evidence
    more = second_look(image, camera, table, settings, first)
    discs = SecondLooks(*(values[more.log_odds >= 0.0] for values in more))
    if len(discs.step):
        more_xy, more_covariance = fitted_positions(
            place_all(first.scene, found.radius, discs, working_space())
        )
        seen_at = np.rint(camera.project_floor(more_xy))
        # Of a disc whose centre is out of sight too little is seen to say where it is.
        in_sight = ((seen_at >= 0.0) & (seen_at < [camera.width, camera.height])).all(axis=1)
        discs = SecondLooks(*(values[in_sight] for values in discs))
        more_xy, more_covariance = more_xy[in_sight], more_covariance[in_sight]
        pixels = np.concatenate([pixels, seen_at[in_sight].astype(np.int64)])
        order = np.argsort(pixels[:, 1] * image.shape[1] + pixels[:, 0], kind="stable")
        pixels = pixels[order]
        found_quality = np.concatenate([found_quality, discs.quality])[order]
        floor_xy = np.concatenate([floor_xy, more_xy])[order]
        fitted = np.concatenate([fitted, more_covariance])[order]
        evidence = np.concatenate([evidence, settings.evidence + discs.log_odds])[order]
    covariance = refined_covariance(camera, floor_xy, fitted, settings)
    if not settings.refine:
        floor_xy, covariance = published_positions(camera, pixels)
    return CircleDetections(
        pixels=pixels,
        floor_xy=floor_xy,
        covariance=covariance,
        quality=found_quality,
        evidence=evidence,
    )


class FirstLook(NamedTuple):
    """What the fits from the best centres find, and on what terms."""

    noise: float
    weakest: float  # least contrast, grey levels
    centres: Centres
    found: FoundDiscs
    scene: Scene


def first_look(
    image: NDArray[np.uint8], camera: Camera, table: DiscTable, settings: CircleSettings
) -> FirstLook:
    """Discs that are fitted from the best centres; parameters as of `detect_circles`."""
    noise = estimate_noise(image, _NOISE_ROWS)
    weakest = settings.noise_floor * max(noise, _LEAST_NOISE)
    least, sign = settings.threshold, _SIGNS[settings.polarity]
    centres = centres_of(image, table, Limits(least, _PART_QUALITY * least, sign=sign))
    scene = scene_of(image, camera, table, settings, noise)
    return FirstLook(noise, weakest, centres, search_discs(scene, centres, weakest), scene)


def scene_of(
    image: NDArray[np.uint8],
    camera: Camera,
    table: DiscTable,
    settings: CircleSettings,
    noise: float,
) -> Scene:
    """An image, and how it is searched; parameters as of `detect_circles`."""
    kernel = _kernel_camera(camera)
    fit = fit_settings(noise, kernel.blur_ratio)
    return Scene(image, table.floor_xy, first_search(settings), fit, kernel.numbers)


def second_look(
    image: NDArray[np.uint8], camera: Camera, table: DiscTable, settings: CircleSettings,
    first: FirstLook,
) -> SecondLooks:  # fmt: skip
    """Look again where the first look found no disc; other parameters as of `detect_circles`.

    Candidates by edges have a sign. Where none is stated, it is that of the sure discs, for discs
    of one place are mostly alike: of each sign that has enough of them, the best candidates are
    examined, and pale ones count for less.
    """
    if not (settings.verify and settings.refine):
        return NO_LOOKS
    found, centres = first.found, first.centres
    if settings.polarity != "any":
        candidates = candidates_at(image, camera, table, settings, first.noise)
        return second_looks_at(image, camera, settings, candidates, found.floor_xy, first.noise)
    contrast, floor_grey = contrast_and_floor(image, centres, found.centre)
    sure = found.evidence >= SURE_EVIDENCE
    looks = [NO_LOOKS]
    for polarity in _LIGHT_AND_DARK:
        if (np.sign(contrast[sure]) == _SIGNS[polarity]).sum() >= _LEAST_SURE:
            of_sign = replace(settings, polarity=polarity)
            candidates = candidates_at(image, camera, table, of_sign, first.noise)
            best = HoughCandidates(candidates.floor_xy[:_BEST], candidates.score[:_BEST])
            terms = found.floor_xy, first.noise, None, _UNSTATED
            looks.append(second_looks_at(image, camera, of_sign, best, *terms))
    more = SecondLooks(*(np.concatenate(values) for values in zip(*looks, strict=True)))
    lost = lost_by_paleness(
        np.concatenate([contrast, more.step]),
        np.concatenate([floor_grey, more.floor_grey]),
        np.concatenate([sure, np.zeros(len(more.step), np.bool_)]),
    )
    more = more._replace(log_odds=more.log_odds - lost[len(sure) :])
    alone = suppress_neighbours(more.floor_xy, more.log_odds, settings.separation_m)
    return SecondLooks(*(values[alone] for values in more))


def candidates_at(
    image: NDArray[np.uint8],
    camera: Camera,
    table: DiscTable,
    settings: CircleSettings,
    noise: float,
) -> HoughCandidates:
    """Candidates of the second look, as parameters of `second_looks_at`."""
    edge = max(_EDGE, 0.7 * settings.noise_floor * max(noise, _LEAST_NOISE))
    sign = float(_SIGNS[settings.polarity])
    return hough_candidates(image, camera, table, settings.radius_m, sign, edge)


def second_looks_at(
    image: NDArray[np.uint8],
    camera: Camera,
    settings: CircleSettings,
    candidates: HoughCandidates,
    found_xy: FloatArray,
    noise: float,
    networks: Networks | None = None,
    needed: float = 0.0,
) -> SecondLooks:
    """Look a second time where no disc was found (see `detect.discs.second_look`).

    Parameters
    ----------
    image, camera, settings
        As of `detect_circles`; the polarity is stated.
    candidates : HoughCandidates
        Of `candidates_at`, or some of them.
    found_xy : (N, 2) float64
        Discs found already, metres.
    noise : float
        Of the image, grey levels.
    networks : Networks, optional
        Others than the trained ones.
    needed : float
        Log-odds that a disc needs more than usual.
    """
    sign = float(_SIGNS[settings.polarity])
    weakest = settings.noise_floor * max(noise, _LEAST_NOISE)
    sought = Sought(
        settings.radius_m, settings.separation_m, sign, max(weakest, _LEAST_STEP), needed
    )
    return second_looks(
        image, candidates, np.ascontiguousarray(found_xy), sought, _kernel_camera(camera).numbers,
        networks or trained_networks(),
    )  # fmt: skip


def _without_fit(
    image: NDArray[np.uint8], camera: Camera, table: DiscTable, settings: CircleSettings
) -> CircleDetections:
    """The published detector: centres of the table by their quality and contrast alone."""
    weakest = settings.least_contrast
    if settings.noise_floor > 0.0:
        noise = estimate_noise(image, _NOISE_ROWS)
        weakest = max(weakest, settings.noise_floor * max(noise, _LEAST_NOISE))
    least_part = least_part_quality(settings.threshold, settings.samples)
    least = math.nextafter(settings.threshold, 1.0)
    limits = Limits(least, least_part, weakest, _SIGNS[settings.polarity])
    pixels, quality, _ = centres_of(image, table, limits)
    if settings.stride == 0.0:
        qualities = np.zeros(image.shape)
        qualities[pixels[:, 1], pixels[:, 0]] = quality
        keep = local_maxima(qualities, settings.threshold)[pixels[:, 1], pixels[:, 0]]
        pixels, quality = pixels[keep], quality[keep]
    keep = alone_published(pixels, quality, table.floor_xy, settings.separation_m)
    pixels, quality = pixels[keep], quality[keep]
    floor_xy, covariance = published_positions(camera, pixels)
    return CircleDetections(pixels, floor_xy, covariance, quality, np.full(len(pixels), np.nan))


@lru_cache(maxsize=4)
def _disc_search(settings: CircleSettings) -> DiscSearch:
    return DiscSearch(
        radius=settings.radius_m,
        inner=settings.inner_radius_m,
        outer=settings.outer_radius_m,
        separation=settings.separation_m,
        verify=settings.verify,
        refine=settings.refine,
        least_evidence=settings.evidence,
        optics_px=settings.blur_px,
    )


def first_search(settings: CircleSettings) -> DiscSearch:
    """What the first look goes by: where a second is certain, that decides on doubtful discs."""
    search = _disc_search(settings)
    if settings.polarity == "any" or not (settings.verify and settings.refine):
        return search
    return search._replace(least_evidence=search.least_evidence + _DOUBTFUL)


def disc_shape(settings: CircleSettings) -> DiscShape:
    """What the table needs to know of the settings."""
    inner, outer = settings.inner_radius_m, settings.outer_radius_m
    stride_m, rows_m = settings.stride * (outer - inner), 0.0
    if settings.verify and settings.refine:
        rows_m = settings.rows_apart * min(settings.radius_m - inner, outer - settings.radius_m)
        stride_m = max(stride_m, rows_m)
    return DiscShape(
        inner_radius_m=inner,
        outer_radius_m=outer,
        samples=settings.samples,
        border_px=settings.border_px,
        far_limit_m_per_px=settings.far_limit_m_per_px,
        least_pairs=settings.least_pairs,
        apart_px=settings.apart_px,
        stride_m=stride_m,
        rows_m=rows_m,
    )


def published_positions(camera: Camera, pixels: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """Positions on the floor that are pixels, as the data set has them.

    Parameters
    ----------
    camera : Camera
        The calibrated camera.
    pixels : (N, 2) int64
        Pixels (u, v).

    Returns
    -------
    floor_xy : (N, 2) float64
        Robot frame, metres; NaN where a pixel does not see the floor.
    covariance : (N, 2, 2) float64
        (0.04 m)^2 I + 2 px^2 J J^T, square metres. J is the Jacobian of the position
        (`Camera.floor_jacobian_published`).
    """
    numbers, floor_xy = _kernel_camera(camera).published, floor_positions(camera)
    return pixel_positions(
        numbers, floor_xy, pixels, PUBLISHED_FLOOR_M**2, PUBLISHED_PIXEL_VARIANCE
    )


class _KernelCamera(NamedTuple):
    """A camera in the forms that kernels take."""

    numbers: FloatArray
    published: FloatArray  # `published_camera_numbers`
    centre: FloatArray
    blur_ratio: float


@lru_cache(maxsize=4)
def _kernel_camera(camera: Camera) -> _KernelCamera:
    centre = np.array(camera.centre, np.float64)
    return _KernelCamera(
        camera_numbers(camera), published_camera_numbers(camera), centre, blur_ratio_of(camera)
    )


def refined_covariance(
    camera: Camera, floor_xy: FloatArray, fitted: FloatArray, settings: CircleSettings
) -> FloatArray:
    """Covariance of refined positions: the fit's, the systematic floor, the camera's tilt.

    Parameters
    ----------
    camera : Camera
        The calibrated camera.
    floor_xy : (N, 2) float64
        Refined positions, metres.
    fitted : (N, 2, 2) float64
        Covariances of the fits.
    settings : CircleSettings
        `systematic_px` and `tilt_sigma_deg`.

    Returns
    -------
    (N, 2, 2) float64
        Square metres.
    """
    kernel = _kernel_camera(camera)
    return np.asarray(
        refined_covariances(
            kernel.numbers,
            kernel.centre,
            np.ascontiguousarray(floor_xy, np.float64),
            np.ascontiguousarray(fitted, np.float64),
            settings.systematic_px**2,
            np.radians(settings.tilt_sigma_deg) ** 2,
        )
    )


def tilt_jacobian(camera: Camera, floor_xy: FloatArray) -> FloatArray:
    """How far positions seem to move when the robot tilts about the robot frame's X and Y axes.

    The robot tilts about its origin on the floor: a floor point then has the height
    x w_Y - y w_X in the robot's frame, and is seen where the ray through it meets the floor that
    the calibration believes in.

    Parameters
    ----------
    camera : Camera
        The calibrated camera.
    floor_xy : (N, 2) float64
        Positions, metres.

    Returns
    -------
    (N, 2, 2) float64
        d(X, Y) / d(rotation about X, about Y), metres per radian.
    """
    per_height = (floor_xy - camera.centre[:2]) / camera.centre[2]
    height_per_tilt = np.stack([-floor_xy[:, 1], floor_xy[:, 0]], axis=-1)
    return np.asarray(per_height[:, :, None] * height_per_tilt[:, None, :])
