"""The disc detector: one image in, discs on the floor out.

The entry point is `detect_circles`. The published detector (DLR Spatial Cognition data set report,
circle detection) needs only the quality of each centre: it accepts centres of sufficient quality
and contrast, keeps the best within a disc's width, and reports the pixel with a covariance of one
pixel and some centimetres. The default detector uses rims: edges vote for centres, the rims around
the best are traced and classified, and fits through the camera model give the positions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from camera import Camera
from camera.kernels import camera_numbers, project_floor_points
from detect.discs.candidates import best_apart, local_maxima, suppress_published
from detect.discs.evidence import SURE, paleness_penalty, sign_penalty
from detect.discs.fit import Scene, working_space
from detect.discs.hough import HoughCandidates, hough_candidates
from detect.discs.judgement import JudgedCandidates, Outcome, judge
from detect.discs.placing import place_discs
from detect.discs.positions import published_covariance, refined_covariance
from detect.discs.quality import Limits, centres_of
from detect.discs.rim_network import Networks, trained_networks
from detect.errors import DetectError
from detect.grey_values import blank_margins, estimate_noise, plain_image, steep_gradient
from detect.settings import CircleSettings, Polarity
from lut import (
    DiscShape,
    DiscTable,
    VoteShape,
    VoteTable,
    build_vote_table,
    cached_disc_table,
    cached_vote_table,
)
from lut.outlines import fingerprint, floor_positions
from lut.votes import largest_disc_px
from redetect.array_types import BoolArray, FloatArray, GreyImage, IntArray
from redetect.landmarks import CircleLandmark, circle_landmarks
from redetect.tables import ByContent

#: Lower bound of an image's noise in the noise floor: one grey level, its resolution.
_LEAST_NOISE = 1.0
#: The same in fits: that of rounded grey values.
_ROUNDING_NOISE = 0.3
SIGNS: dict[Polarity, int] = {"any": 0, "light": 1, "dark": -1}
_NOISE_ROWS = 16  #: Number of rows from which an image's noise is estimated.
#: Lowest gradient of an edge that votes, and in images full of edges, grey levels per pixel.
_FAINT_EDGE, _EDGE = 2.0, 4.0
_EDGE_NOISE = 0.4  #: The same in noise deviations, as a share of `noise_floor`.
_LEAST_STEP = 5.0  #: Lowest step at a rim, grey levels.
#: Factors by which images may be reduced, and the smallest side of such an image.
_FACTORS, _SMALLEST_SIDE_PX = (2, 4, 8, 16, 32), 16


#: A camera in the form that kernels take.
_numbers = lru_cache(maxsize=16)(camera_numbers)


@dataclass(frozen=True, eq=False)
class CircleDetections(ByContent):
    """The discs found in one image, in scan order of their pixels."""

    pixels: IntArray  #: (N, 2) pixels (u, v) of the centres; the published detector's maxima
    floor_xy: FloatArray  #: (N, 2) position in the robot frame, metres
    covariance: FloatArray  #: (N, 2, 2) of the position, square metres
    quality: FloatArray  #: (N,) Otsu's quality, 0 to 1: of the rim; the published one of the pixel
    evidence: FloatArray  #: (N,) log-odds that it is a disc; NaN where nothing was fitted
    #: Pitch and roll (rad) that turned the positions level, if any did
    levelled_by: tuple[float, float] | None = None

    def __len__(self) -> int:
        return len(self.quality)

    def landmarks(self) -> tuple[CircleLandmark, ...]:
        """Rows for a landmark file, without identifiers."""
        unknown = np.full(len(self), -1)
        return circle_landmarks(self.floor_xy, self.quality, self.covariance, unknown)

    def where(self, chosen: BoolArray) -> CircleDetections:
        """The discs that a boolean mask selects."""
        arrays = {name: each[chosen] for name, each in vars(self).items() if name != "levelled_by"}
        return replace(self, **arrays)


def detect_circles(
    image: GreyImage, camera: Camera, table: VoteTable | DiscTable, settings: CircleSettings
) -> CircleDetections:
    """Find the discs in one image.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image of the camera's size.
    camera : Camera
        The calibrated camera.
    table : VoteTable or DiscTable
        From `disc_table`.
    settings : CircleSettings
        What to look for.

    Returns
    -------
    CircleDetections

    Raises
    ------
    FrameError
        If the image is not an 8-bit grey image of the camera's size.
    DetectError
        If the table is for another detector, camera or shape of the discs.
    """
    kind, shape = (VoteTable, vote_shape) if settings.refine else (DiscTable, disc_shape)
    if not isinstance(table, kind) or not np.array_equal(
        table.made_for, fingerprint(camera, shape(settings))
    ):
        raise DetectError(
            f"the {type(table).__name__} is for another detector, camera or other settings, such "
            "as radius_m: expected disc_table(camera, settings)"
        )
    image = plain_image(image, (camera.height, camera.width))
    if isinstance(table, DiscTable):
        return _by_quality(image, camera, table, settings)
    return _by_rims(image, camera, table, settings)


def _by_rims(
    image: GreyImage, camera: Camera, table: VoteTable, settings: CircleSettings
) -> CircleDetections:
    """The default detector: finds discs by their rims and locates them by fits."""
    image, camera, table, left = within_margins(image, camera, table, settings)
    searched = searched_images(image, camera, table, settings)
    discs, log_odds = select_discs(searched, settings)
    scene = searched[0].scene
    floor_xy, fitted = place_discs(scene, discs, working_space()[0])
    centre_px = np.rint(project_floor_points(scene.camera_numbers, floor_xy))
    # If the centre is outside the image, too little of the disc is visible to locate it.
    inside = ((centre_px >= 0.0) & (centre_px < [camera.width, camera.height])).all(axis=1)
    order = np.flatnonzero(inside)
    order = order[np.lexsort((centre_px[order, 0], centre_px[order, 1]))]
    floor_xy = floor_xy[order]
    return CircleDetections(
        pixels=centre_px[order].astype(np.int64) + np.array([left, 0]),
        floor_xy=floor_xy,
        covariance=refined_covariance(
            camera, floor_xy, fitted[order], settings.systematic_px, settings.tilt_sigma_rad
        ),
        quality=discs.quality[order],
        evidence=log_odds[order],
    )


def within_margins(
    image: GreyImage, camera: Camera, table: VoteTable, settings: CircleSettings
) -> tuple[GreyImage, Camera, VoteTable, int]:
    """The image without blank columns at its sides, its camera and table; the columns at the left.

    Parameters as for `detect_circles`.
    """
    left, right = blank_margins(image)
    if left or right:
        camera, table = _cropped(camera, left, right, vote_shape(settings))
        image = np.ascontiguousarray(image[:, left : left + camera.width])
    return image, camera, table, left


@lru_cache(maxsize=8)
def _cropped(camera: Camera, left: int, right: int, shape: VoteShape) -> tuple[Camera, VoteTable]:
    """The camera of an image without its margins, and its table."""
    width, offset_x = camera.width - left - right, camera.offset_x - left
    camera = replace(camera, width=width, offset_x=offset_x)
    return camera, build_vote_table(camera, shape)  # not kept on disk: there may be one per image


class Searched(NamedTuple):
    """An image with the table of the discs that are searched in it."""

    scene: Scene
    table: VoteTable


def searched_images(
    image: GreyImage, camera: Camera, table: VoteTable, settings: CircleSettings
) -> list[Searched]:
    """The image, then reduced ones for large discs; parameters as for `detect_circles`."""
    searched = [Searched(scene_of(image, camera, table, settings), table)]
    for factor, smaller, own in _octaves(camera, vote_shape(settings)):
        # Means of squares of pixels.
        cut = image[: factor * smaller.height, : factor * smaller.width]
        size = smaller.width, smaller.height
        reduced = np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), np.uint8)
        searched.append(Searched(scene_of(reduced, smaller, own, settings), own))
    return searched


@lru_cache(maxsize=16)
def _octaves(camera: Camera, shape: VoteShape) -> tuple[tuple[int, Camera, VoteTable], ...]:
    """Factors by which images are reduced, with their camera and the table of their discs.

    In a large disc's surroundings, the grains of a carpet have as many edges as the disc, and vote
    for centres as it does; and the networks know no examples of such sizes. Halved until the disc
    has a radius of 10 to 20 pixels, an image shows the means of the grains.
    """
    too_large = largest_disc_px(camera, shape) / shape.largest_px
    most = min(2.0 * too_large, min(camera.width, camera.height) / _SMALLEST_SIDE_PX)
    octaves = []
    for factor in (factor for factor in _FACTORS if factor < most):
        smaller = replace(
            camera, width=camera.width // factor, height=camera.height // factor,
            scale_x=camera.scale_x / factor, scale_y=camera.scale_y / factor,
            offset_x=(camera.offset_x + 0.5) / factor - 0.5,
            offset_y=(camera.offset_y + 0.5) / factor - 0.5,
        )  # fmt: skip
        larger = replace(
            shape,
            border_px=shape.border_px // factor,
            far_limit_m_per_px=factor * shape.far_limit_m_per_px,
            smallest_px=0.5 * shape.largest_px,
        )
        octaves.append((factor, smaller, build_vote_table(smaller, larger)))
    return tuple(octaves)


def scene_of(image: GreyImage, camera: Camera, table: VoteTable, settings: CircleSettings) -> Scene:
    """An image with what all stages need; parameters as for `detect_circles`."""
    # Optics blur equally in all directions. Where pixels are not square, as in single fields of
    # interlaced frames, the same blur spans fewer pixels along v.
    ratio = camera.scale_y / camera.scale_x
    noise = max(estimate_noise(image, _NOISE_ROWS), _ROUNDING_NOISE)
    return Scene(image, table.floor_xy, settings.radius_m, noise, ratio, _numbers(camera))


def select_discs(
    searched: Sequence[Searched], settings: CircleSettings
) -> tuple[JudgedCandidates, FloatArray]:
    """The candidates that are discs, and their log-odds."""
    _, judgement = classify_candidates(searched, settings)
    log_odds = adjusted_log_odds(judgement, settings)
    best = best_apart(judgement.floor_xy, log_odds, settings.evidence, settings.separation_m)
    return judgement.where(best), log_odds[best]


def classify_candidates(
    searched: Sequence[Searched], settings: CircleSettings
) -> tuple[FloatArray, JudgedCandidates]:
    """(N,) scores of all candidates, and their classification."""
    candidates = [candidates_of(*each, settings) for each in searched]
    found = [classify(each.scene, settings, own) for each, own in zip(searched, candidates)]
    return (
        np.concatenate([each.score for each in candidates]),
        JudgedCandidates._make(map(np.concatenate, zip(*found))),
    )


def candidates_of(scene: Scene, table: VoteTable, settings: CircleSettings) -> HoughCandidates:
    """Centres for which edges vote."""
    usual = min(max(steep_gradient(scene.image, _NOISE_ROWS), _FAINT_EDGE), _EDGE)
    edge = max(usual, _EDGE_NOISE * settings.noise_floor * max(scene.noise, _LEAST_NOISE))
    return hough_candidates(scene.image, table, scene.radius, SIGNS[settings.polarity], edge)


def classify(
    scene: Scene,
    settings: CircleSettings,
    candidates: HoughCandidates,
    networks: Networks | None = None,
) -> JudgedCandidates:
    """Classify candidates (`detect.discs.judgement`), by default with the trained networks."""
    weakest = settings.noise_floor * max(scene.noise, _LEAST_NOISE)
    step, networks = max(weakest, _LEAST_STEP), networks or trained_networks()
    return judge(scene.image, candidates, scene.radius, step, scene.camera_numbers, networks)


def adjusted_log_odds(judgement: JudgedCandidates, settings: CircleSettings) -> FloatArray:
    """(N,) log-odds of candidates, compared with each other; minus infinity without a rim."""
    step, log_odds = judgement.step, judgement.log_odds
    sure = log_odds >= SURE
    penalty = paleness_penalty(step, judgement.floor_grey, sure)
    if settings.polarity == "any":
        penalty += sign_penalty(step, sure)
    return np.where(judgement.outcome == Outcome.JUDGED, log_odds - penalty, -np.inf)


def _by_quality(
    image: GreyImage, camera: Camera, table: DiscTable, settings: CircleSettings
) -> CircleDetections:
    """The published detector: selects centres of the table by quality and contrast alone."""
    weakest = settings.least_contrast
    if settings.noise_floor > 0.0:
        noise = estimate_noise(image, _NOISE_ROWS)
        weakest = max(weakest, settings.noise_floor * max(noise, _LEAST_NOISE))
    least = math.nextafter(settings.threshold, 1.0)
    limits = Limits(least, weakest, SIGNS[settings.polarity])
    pixels, quality, _ = centres_of(image, table, limits)
    if settings.stride == 0.0:
        qualities = np.zeros(image.shape)
        qualities[pixels[:, 1], pixels[:, 0]] = quality
        keep = local_maxima(qualities, settings.threshold)[pixels[:, 1], pixels[:, 0]]
        pixels, quality = pixels[keep], quality[keep]
    keep = suppress_published(pixels, quality, table.floor_xy, settings.separation_m)
    pixels, quality = pixels[keep], quality[keep]
    floor_xy = floor_positions(camera)[pixels[:, 1], pixels[:, 0]]
    covariance, no_evidence = published_covariance(camera, pixels), np.full(len(pixels), np.nan)
    return CircleDetections(pixels, floor_xy, covariance, quality, no_evidence)


def disc_table(camera: Camera, settings: CircleSettings) -> VoteTable | DiscTable:
    """The table that `detect_circles` needs, from the cache."""
    if settings.refine:
        return cached_vote_table(camera, vote_shape(settings))
    return cached_disc_table(camera, disc_shape(settings))


def vote_shape(settings: CircleSettings) -> VoteShape:
    """The settings on which the table of votes depends."""
    return VoteShape(settings.radius_m, settings.border_px, settings.far_limit_m_per_px)


def disc_shape(settings: CircleSettings) -> DiscShape:
    """The settings on which the table of outlines depends."""
    inner, outer = settings.inner_radius_m, settings.outer_radius_m
    return DiscShape(
        inner_radius_m=inner, outer_radius_m=outer, samples=settings.samples,
        border_px=settings.border_px, far_limit_m_per_px=settings.far_limit_m_per_px,
        least_pairs=settings.least_pairs, apart_px=settings.apart_px,
        stride_m=settings.stride * (outer - inner),
    )  # fmt: skip
