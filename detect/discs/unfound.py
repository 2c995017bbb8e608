"""Why discs are not found: the candidates of an image, with the stage and number that dropped each.

The candidates are those of the detector itself (`detect.discs.search.Looks`,
`detect.discs.second_look`), and besides them centres of the other polarity, of a lower contrast or
down to half of the least quality, which it doesn't look at. Suggestions are tried: each says what
would be found with it.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.circles import (
    CircleDetections,
    FirstLook,
    detect_circles,
    disc_shape,
    first_look,
    first_search,
    second_look,
)
from detect.discs.candidates import strong_and_alone
from detect.discs.evidence import LEAST_EXPLAINED, RADIUS_RANGE
from detect.discs.quality import Centres, Limits, centres_of
from detect.discs.radius import FACTOR, find_radius
from detect.discs.search import FATES, LEAST_STEPS, share_of_steps
from detect.settings import CircleSettings
from lut import DiscTable, build_disc_table, cached_disc_table

FloatArray = NDArray[np.float64]
Stage = Literal[
    "disc", "quality", "polarity", "contrast", "few steps", "first look", "evidence", "elsewhere",
    "beside a better disc", "of the rarer sign", "pale", "second look",
]  # fmt: skip

#: Centres of at least this share of the least quality are candidates: anywhere, or near a place.
_QUALITY_SHARE, _QUALITY_SHARE_NEAR = 0.9, 0.3
#: Radii that are tried at a place are as much smaller and larger.
_OTHER_RADII = 2.5
#: A place is as far as this from where it was pointed at, radii.
_NEAR = 1.5
#: Blurs that are this much wider than the stated one are worth a suggestion.
_BLURRED = 1.5
#: Radii of fits whose median differs by this share from the nominal one are, too.
_OTHER_RADIUS = 0.04
_FEWEST_FITS = 5


class Candidate(NamedTuple):
    """A candidate for a disc."""

    u: float  # pixel
    v: float
    x_m: float  # on the floor as the camera is calibrated, metres
    y_m: float
    quality: float  # Otsu's
    contrast: float  # grey levels inside minus outside
    stage: Stage  # what dropped it; "disc" if it was found
    value: float  # the number that decided,
    limit: float  # and what it should have been at least; NaN where there is none

    @property
    def is_disc(self) -> bool:
        """Whether it was found."""
        return self.stage == "disc"

    def reason(self) -> str:
        """In words, with the flag that decides."""
        value, limit = f"{self.value:.2f}", f"{self.limit:.2f}"
        return {
            "disc": f"found: evidence {value}, least {limit}",
            "quality": f"quality {value} is less than {limit} (--threshold)",
            "polarity": f"contrast {value} is of the other sign (--polarity any)",
            "contrast": f"contrast {value} is less than {limit}, by the noise (--noise-floor)",
            "few steps": f"grey values step on {value} of all sides, {limit} expected",
            "first look": "a quick fit finds no disc"
            if not math.isfinite(self.value)
            else f"a quick fit has evidence {value}, {limit} needed to go on (--evidence)",
            "evidence": "the fit is impossible for a disc: radius, outline or middle"
            if not math.isfinite(self.value)
            else f"evidence {value} is less than {limit} (--evidence)",
            "elsewhere": "the fit wandered to something else",
            "beside a better disc": f"{value} radii from a better disc (--separation {limit})",
            "pale": f"evidence {value}, and much less contrast than the other discs",
            "of the rarer sign": f"evidence {value}, and nearly all discs are of the other sign",
            "second look": f"log-odds {value} by its rim, {limit} expected",
        }[self.stage]


@dataclass(frozen=True)
class DiscExplanation:
    """What became of the candidates of an image."""

    candidates: tuple[Candidate, ...]  # those that were found first, then by falling quality
    place: str  # of the place that was pointed at; empty without one
    suggestions: tuple[str, ...]  # what to try, and what that would find

    def to_json(self) -> str:
        """All of it, the candidates numbered from 1; what is not finite is null."""
        records = [
            {
                "number": number,
                **{
                    name: None if isinstance(value, float) and not math.isfinite(value) else value
                    for name, value in row._asdict().items()
                },
                "reason": row.reason(),
            }
            for number, row in enumerate(self.candidates, start=1)
        ]
        content = {
            "place": self.place,
            "suggestions": list(self.suggestions),
            "candidates": records,
        }
        return json.dumps(content, indent=1, allow_nan=False)


def explain_discs(
    image: NDArray[np.uint8],
    camera: Camera,
    settings: CircleSettings,
    at: tuple[float, float] | None = None,
) -> DiscExplanation:
    """Explain what was found in an image, and what was not.

    Parameters
    ----------
    image : (H, W) uint8
    camera : Camera
    settings : CircleSettings
        With `verify` and `refine`: the plain detectors drop nothing after the quality.
    at : (float, float), optional
        Pixel (u, v) of something that should have been found: candidates near it alone.
    """
    scene = _Scene(image, camera, settings)
    share = _QUALITY_SHARE if at is None else _QUALITY_SHARE_NEAR
    candidates = list(_candidates(scene, share))
    place = ""
    if at is not None:
        place = _place(at, scene)
        x, y = camera.floor_from_pixel(at).tolist()
        near = _NEAR * settings.radius_m
        candidates = [c for c in candidates if math.hypot(c.x_m - x, c.y_m - y) < near]
    candidates.sort(key=lambda c: (not c.is_disc, -c.quality))
    return DiscExplanation(tuple(candidates), place, tuple(_suggestions(scene, at)))


def why_none(images: Sequence[NDArray[np.uint8]], camera: Camera, settings: CircleSettings) -> str:
    """A sentence on the candidates for discs in images (H, W) without any, and what they fail."""
    scenes = (_Scene(image, camera, settings) for image in images)
    stages: Counter[Stage] = Counter(c.stage for scene in scenes for c in _candidates(scene))
    del stages["disc"]
    if not stages:
        return (
            f"There is no candidate in {len(images)} of the images: no place has a quality of "
            f"{settings.threshold:g} (--threshold)."
        )
    other_sign, faint = stages.pop("polarity", 0), stages.pop("contrast", 0)
    left = sum(stages.values())
    fates = (
        (other_sign, f"are not {settings.polarity} (--polarity any)"),
        (faint, f"have a contrast of less than {settings.noise_floor:g} times the noise "
         "(--noise-floor)"),
        (left, "do not look like a disc when one is fitted (--evidence)"),
    )  # fmt: skip
    failed = ", ".join(f"{count} {test}" for count, test in fates if count)
    count = other_sign + faint + left
    return f"Of {count} candidates in {len(images)} of the images {failed}."


@dataclass(frozen=True)
class _Scene:
    """An image, and what is found in it."""

    image: NDArray[np.uint8]
    camera: Camera
    settings: CircleSettings

    @cached_property
    def table(self) -> DiscTable:
        return cached_disc_table(self.camera, disc_shape(self.settings))

    @cached_property
    def found(self) -> CircleDetections:
        return detect_circles(self.image, self.camera, self.table, self.settings)

    @cached_property
    def first(self) -> FirstLook:
        return first_look(self.image, self.camera, self.table, self.settings)

    def centres(self, least_quality: float) -> Centres:
        return centres_of(self.image, self.table, Limits(least_quality))

    def count(self, at: tuple[float, float] | None) -> int:
        """Discs that were found, near a pixel if one is given."""
        if at is None:
            return len(self.found)
        here = self.camera.floor_from_pixel(at)
        return int((np.hypot(*(self.found.floor_xy - here).T) < self.settings.radius_m).sum())


def _candidates(scene: _Scene, quality_share: float = 1.0) -> Iterator[Candidate]:
    """What was found, and the candidates that were rejected."""
    image, camera, settings = scene.image, scene.camera, scene.settings
    table, found = scene.table, scene.found
    pixels = camera.project_floor(found.floor_xy)
    every = scene.centres(0.0)
    for (u, v), (x, y), q, evidence in zip(
        pixels.tolist(), found.floor_xy.tolist(), found.quality.tolist(), found.evidence.tolist()
    ):
        # Not every pixel of a large disc is tested for its centre.
        nearest = np.argmin(np.hypot(*(every.pixels - np.array((u, v))).T))
        contrast = float(every.contrast[nearest])
        yield Candidate(u, v, x, y, q, contrast, "disc", evidence, settings.evidence)
    near = 0.5 * settings.separation_m
    taken = [found.floor_xy]
    weakest = settings.least_contrast
    if settings.verify or settings.refine:
        _, weakest, centres, by_fit, _ = scene.first
        looks, least = by_fit.looks, first_search(settings).least_evidence
        best = strong_and_alone(centres, table.floor_xy, weakest, near)
        at = looks.pixels
        floor = table.floor_xy[at[:, 1], at[:, 0]].astype(np.float64)
        for k, number in enumerate(looks.fate.tolist()):
            name = FATES[number]
            if name in ("disc", "in a clear disc", "same disc") or _near(
                found.floor_xy, floor[k], near
            ):
                continue
            quality, contrast = float(centres.quality[best[k]]), float(centres.contrast[best[k]])
            u, v = at[k].tolist()
            x, y = floor[k].tolist()
            value, limit = float(looks.log_odds[k]), least
            if name == "few steps":
                value = share_of_steps(
                    image, table.floor_xy, u, v, settings.inner_radius_m, settings.outer_radius_m,
                    contrast,
                )  # fmt: skip
                limit = LEAST_STEPS
            elif name == "beside a better disc":
                away = np.hypot(*(found.floor_xy - floor[k]).T).min(initial=math.inf)
                value, limit = float(away) / settings.radius_m, settings.separation
            stage: Stage = name  # type: ignore[assignment]
            yield Candidate(u, v, x, y, quality, contrast, stage, value, limit)
        taken.append(floor)
        more = second_look(image, camera, table, settings, scene.first)
        dropped = more.log_odds < 0.0
        for xy, q, odds in zip(
            more.floor_xy[dropped], more.quality[dropped], more.log_odds[dropped].tolist()
        ):
            if not _near(np.concatenate(taken), xy, near):
                (u, v), (x, y) = camera.project_floor(xy).tolist(), xy.tolist()
                yield Candidate(u, v, x, y, float(q), math.nan, "second look", odds, 0.0)
    wider = scene.centres(quality_share * settings.threshold)
    others = np.concatenate(taken)
    for k in strong_and_alone(wider, table.floor_xy, 0.0, settings.separation_m).tolist():
        u, v = wider.pixels[k].tolist()
        x, y = table.floor_xy[v, u].astype(np.float64).tolist()
        if _near(others, np.array([x, y]), settings.separation_m):
            continue
        q, contrast = float(wider.quality[k]), float(wider.contrast[k])
        sign = {"any": 0.0, "light": 1.0, "dark": -1.0}[settings.polarity]
        if q < settings.threshold:
            yield Candidate(u, v, x, y, q, contrast, "quality", q, settings.threshold)
        elif sign * contrast < 0.0:
            yield Candidate(u, v, x, y, q, contrast, "polarity", contrast, 0.0)
        elif abs(contrast) < weakest:
            yield Candidate(u, v, x, y, q, contrast, "contrast", abs(contrast), weakest)


def _near(places: FloatArray, xy: FloatArray, within_m: float) -> bool:
    return bool((np.hypot(*(places - xy).T) < within_m).any())


def _place(at: tuple[float, float], scene: _Scene) -> str:
    """What the detector sees at a pixel, in words."""
    camera, settings, (u, v) = scene.camera, scene.settings, at
    if not (0.0 <= u <= camera.width - 1 and 0.0 <= v <= camera.height - 1):
        return f"({u:g}, {v:g}) is outside the image, {camera.width}x{camera.height} px."
    x, y = camera.floor_from_pixel(at).tolist()
    if not math.isfinite(x):
        return f"({u:g}, {v:g}) does not see the floor: it is above the horizon of the calibration."
    words = f"({u:g}, {v:g}) sees the floor {-y:.2f} m in front and {x:.2f} m to the left"
    rows = np.abs(camera.floor_jacobian(at)[:, 1])
    per_row = float(np.hypot(*rows))
    if per_row > settings.far_limit_m_per_px:
        return (
            f"{words}, where the floor moves {per_row:.3f} m per image row: too far for discs of "
            f"{settings.radius_m:g} m, {settings.far_limit_m_per_px:.3f} m at most (--far-limit)."
        )
    centres = scene.centres(0.0)
    floor = scene.table.floor_xy[centres.pixels[:, 1], centres.pixels[:, 0]].astype(np.float64)
    away = np.hypot(floor[:, 0] - x, floor[:, 1] - y)
    near = np.flatnonzero(away < settings.radius_m)
    at_border = min(u, v, camera.width - 1 - u, camera.height - 1 - v) < settings.border_px
    if at_border or not len(near):
        return f"{words}: no centre of a disc is looked for there, it is too near to the border."
    best = near[np.argmax(centres.quality[near])]
    return (
        f"{words}: within a radius of it the best quality is {centres.quality[best]:.2f} (least "
        f"{settings.threshold:g}), with a contrast of {centres.contrast[best]:+.0f} grey levels."
    )


def _suggestions(scene: _Scene, at: tuple[float, float] | None) -> Iterator[str]:
    """What to change, where it finds more (at the place that was pointed at)."""
    settings, here = scene.settings, scene.count(at)
    if at is not None and here:
        return

    def gained(changed: CircleSettings) -> int:
        return replace(scene, settings=changed).count(at) - here

    where = "there" if at is not None else "more"
    if settings.polarity != "any" and (more := gained(replace(settings, polarity="any"))) > 0:
        yield f"--polarity any finds {more} {where}."
    radius_m = _radius_at(scene, at) if at is not None else None
    if at is None and not here:
        estimate = find_radius([scene.image], scene.camera, replace(settings, polarity="any"))
        radius_m = None if estimate is None else estimate.radius_m
    if radius_m is not None and abs(math.log(radius_m / settings.radius_m)) > math.log(FACTOR):
        yield f"--radius-m {radius_m:.3f} finds a disc {'there' if at is not None else 'here'}."
    if not settings.verify:
        return
    looks = scene.first.found.looks
    results = looks.results[looks.results["explained"] >= LEAST_EXPLAINED]
    if len(results):
        blur_px = round(float(np.median(results["blur"])), 1)
        if blur_px > _BLURRED * settings.blur_px:
            more = gained(replace(settings, blur_px=blur_px))
            if more > 0:
                yield f"--blur-px {blur_px:g}, as edges are blurred, finds {more} {where}."
    relative = results["radius"] / settings.radius_m
    relative = relative[(relative > RADIUS_RANGE[0]) & (relative < RADIUS_RANGE[1])]
    if len(relative) >= _FEWEST_FITS:
        off = float(np.median(relative)) - 1.0
        if abs(off) > _OTHER_RADIUS:
            yield (
                f"Discs look {100 * abs(off):.0f} % {'larger' if off > 0 else 'smaller'} than "
                f"{settings.radius_m:g} m: is that their radius, and the camera's height in the "
                "calibration right (`camera level`)?"
            )
    lower = replace(settings, evidence=settings.evidence - 2.0)
    if (more := gained(lower)) > 0:
        yield f"--evidence {lower.evidence:.1f} finds {more} {where}: look whether they are discs."


def _radius_at(scene: _Scene, at: tuple[float, float]) -> float | None:
    """The radius at which a disc of the highest evidence is found at a pixel."""
    camera, settings = scene.camera, scene.settings
    here = camera.floor_from_pixel(at)
    if not np.isfinite(here).all():
        return None
    count = round(math.log(_OTHER_RADII) / math.log(FACTOR))
    best, of_best = -math.inf, None
    for radius_m in (settings.radius_m * FACTOR ** np.arange(-count, count + 1)).tolist():
        tried = replace(settings, radius_m=radius_m, polarity="any")
        table = build_disc_table(camera, disc_shape(tried))
        found = detect_circles(scene.image, camera, table, tried)
        near = np.hypot(*(found.floor_xy - here).T) < radius_m
        if near.any() and found.evidence[near].max() > best:
            best, of_best = float(found.evidence[near].max()), radius_m
    return of_best
