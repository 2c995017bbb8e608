"""Explains why discs are not found: the candidates of an image, and what rejected each.

The candidates are those of the detector itself (`detect.discs.judgement`) for discs of both
polarities, searched with the camera's lean (`detect.lean`) if the image shows one. Suggestions are
tried out: each states what would be found with it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from camera import Camera
from detect.circles import (
    SIGNS,
    CircleDetections,
    adjusted_log_odds,
    classify_candidates,
    detect_circles,
    searched_images,
    vote_shape,
    within_margins,
)
from detect.discs.judgement import LEAST_RIM, RIM_RADIUS, JudgedCandidates, Outcome
from detect.lean import detect_tilted, search_of
from detect.lines import detect_lines
from detect.projection import Tilt
from detect.radius import find_radius
from detect.settings import CircleSettings
from lut import VoteTable, build_vote_table, cached_vertical_table, cached_vote_table
from redetect.array_types import FloatArray, GreyImage
from redetect.json_text import json_text
from redetect.messages import counted
from redetect.tables import Table

Stage = Literal[
    "disc",
    "polarity",
    "steps",
    "prescreening",
    "rim",
    "evidence",
    "beside a better disc",
    "outside",
]

_STAGES: dict[Outcome, Stage] = {
    Outcome.FEW_STEPS: "steps",
    Outcome.PRESCREENING: "prescreening",
    Outcome.NO_RIM: "rim",
}
#: Radii from the nominal one divided by this to the nominal one times this are tried at a position.
_OTHER_RADII = 2.5
_FACTOR = 1.1  #: From one of these to the next.
_NEAR = 1.5  #: Largest distance of a candidate from the given position, radii.
#: Relative deviation of the rims' median radius from the expected one that causes a suggestion.
_OTHER_RADIUS = 0.04
_FEWEST_RIMS = 5


class Candidate(NamedTuple):
    """A candidate for a disc."""

    u: float  # pixel
    v: float
    x_m: float  # position on the floor, metres
    y_m: float
    votes: float  # of edges, relative to the mean at the same distance
    contrast: float  # grey levels inside minus outside; NaN if no rim was traced
    stage: Stage  # that rejected it; "disc" if it was found
    value: float  # the number that decided; NaN if there is none
    limit: float  # least value of it that passes; NaN if there is none

    @property
    def is_disc(self) -> bool:
        """Whether the candidate was found."""
        return self.stage == "disc"

    def reason(self) -> str:
        """The reason in words, with the flag that sets the limit."""
        value, limit = f"{self.value:.2f}", f"{self.limit:.2f}"
        return {
            "disc": f"found: evidence {value}, least {limit}",
            "polarity": "it is of the other polarity (--polarity any)",
            "steps": "the grey value steps on few sides, or too little for the noise "
            "(--noise-floor)",
            "prescreening": f"no disc by the prescreening: log-odds {value}",
            "rim": f"{value} of its rim lie on a circle of this radius, {limit} expected",
            "evidence": f"evidence {value} is less than {limit} (--evidence)",
            "beside a better disc": f"{value} radii from a better disc (--separation {limit})",
            "outside": "its centre is outside the image: too little of it is visible to locate it",
        }[self.stage]


@dataclass(frozen=True, eq=False, repr=False)
class DiscExplanation(Table):
    """Candidates of an image with the stage and the number that rejected them, and suggestions.

    Attributes
    ----------
    image : (H, W) uint8
    camera : Camera
        Leaning from its calibration as in the search; positions on the floor are level.
    settings : CircleSettings
    at : (float, float) or None
        The given pixel.
    candidates : tuple of detect.explanation.Candidate
        Accepted ones first, then in order of decreasing votes.
    place : str
        Description of the given pixel; empty without one.
    suggestions : tuple of str
        Flags or settings to try, with their results.
    lean : (float, float) or None
        Pitch and roll (rad) by which the camera leans from its calibration, if that finds more.
    """

    image: GreyImage
    camera: Camera
    settings: CircleSettings
    at: tuple[float, float] | None
    candidates: tuple[Candidate, ...]
    place: str
    suggestions: tuple[str, ...]
    lean: Tilt | None

    def columns(self) -> dict[str, Any]:
        """One row per candidate, numbered as in the picture."""
        rows = self.candidates
        return {
            "number": list(range(1, len(rows) + 1)),
            **{name: [getattr(row, name) for row in rows] for name in Candidate._fields},
            "reason": [row.reason() for row in rows],
        }

    def to_json(self) -> str:
        """The explanation as JSON, with candidates numbered from 1."""
        content = {"place": self.place, "suggestions": list(self.suggestions)}
        return json_text({**content, "candidates": self.records()})

    def __str__(self) -> str:
        lines = [self.place] if self.place else []
        lines += [
            f"{number:3d}  ({row.u:.0f}, {row.v:.0f})  {row.reason()}"
            for number, row in enumerate(self.candidates, start=1)
        ]
        return "\n".join([*lines, *self.suggestions])


def explain_discs(
    image: GreyImage, camera: Camera, settings: CircleSettings,
    at: tuple[float, float] | None = None,
) -> DiscExplanation:  # fmt: skip
    """Explain what was found in an image and what was not.

    Parameters
    ----------
    image : (H, W) uint8
    camera : Camera
    settings : CircleSettings
        `refine` is always on: the published detector rejects centres only for their low quality.
    at : (float, float), optional
        Pixel (u, v) of something that should have been found; only candidates near it are listed.
    """
    settings = replace(settings, refine=True)
    tilt = detect_lines(image, cached_vertical_table(camera)).tilt
    lean = None
    if tilt is not None:
        _, lean = detect_tilted(image, camera, settings, (tilt.pitch_rad, tilt.roll_rad))
    camera, _ = search_of(camera, settings, lean)
    scene = _Examined(image, camera, settings)
    candidates = list(_candidates(scene))
    place = ""
    if at is not None:
        place = _place(at, scene)
        x, y = camera.floor_from_pixel(at).tolist()
        near = _NEAR * settings.radius_m
        candidates = [c for c in candidates if math.hypot(c.x_m - x, c.y_m - y) < near]
    candidates.sort(key=lambda c: (not c.is_disc, -c.votes))
    suggestions = tuple(_suggestions(scene, at))
    return DiscExplanation(image, camera, settings, at, tuple(candidates), place, suggestions, lean)


def why_none(images: Sequence[GreyImage], camera: Camera, settings: CircleSettings) -> str:
    """A sentence on why the candidates in images (H, W) without discs were rejected."""
    settings = replace(settings, refine=True)
    scenes = (_Examined(image, camera, settings) for image in images)
    stages: Counter[Stage] = Counter(c.stage for scene in scenes for c in _candidates(scene))
    del stages["disc"]
    searched = counted(len(images), "image")
    if not stages:
        return f"There is no candidate in {searched}: no edges lie on a circle."
    outcomes = (
        (stages["outside"], "have their centre outside the image"),
        (stages["polarity"], f"are not {settings.polarity} (--polarity any)"),
        (stages["steps"], "have a contrast too faint for the noise (--noise-floor), or no rim"),
        (stages["prescreening"] + stages["rim"], "have no rim of this radius (--radius-m)"),
        (stages["evidence"], "do not look like a disc (--evidence)"),
        (stages["beside a better disc"], "are beside a better one"),
    )
    failed = ", ".join(f"{count} {test}" for count, test in outcomes if count)
    return f"Of {counted(stages.total(), 'candidate')} in {searched}, {failed}."


@dataclass(frozen=True)
class _Examined:
    """An image and the detections in it."""

    image: GreyImage
    camera: Camera
    settings: CircleSettings

    @cached_property
    def table(self) -> VoteTable:
        return cached_vote_table(self.camera, vote_shape(self.settings))

    @cached_property
    def found(self) -> CircleDetections:
        return detect_circles(self.image, self.camera, self.table, self.settings)

    @cached_property
    def judgement(self) -> tuple[FloatArray, JudgedCandidates]:
        """Votes for the candidates of both polarities, and their classification."""
        settings = replace(self.settings, polarity="any")
        image, camera, table, _ = within_margins(self.image, self.camera, self.table, settings)
        return classify_candidates(searched_images(image, camera, table, settings), settings)

    def count(self, at: tuple[float, float] | None) -> int:
        """Number of discs found, near a pixel if one is given."""
        if at is None:
            return len(self.found)
        here = self.camera.floor_from_pixel(at)
        return int((np.hypot(*(self.found.floor_xy - here).T) < self.settings.radius_m).sum())


def _candidates(scene: _Examined) -> Iterator[Candidate]:
    """The discs found, and the rejected candidates."""
    camera, settings, found = scene.camera, scene.settings, scene.found
    votes, judgement = scene.judgement
    evidence = adjusted_log_odds(judgement, settings)
    taken = np.zeros(len(votes), np.bool_)
    found_px = camera.project_floor(found.floor_xy).tolist()
    for k, ((x, y), (u, v)) in enumerate(zip(found.floor_xy.tolist(), found_px)):
        away = np.hypot(*(judgement.floor_xy - found.floor_xy[k]).T)
        taken |= away < 0.5 * settings.radius_m
        best = int(np.argmin(away - 1e-3 * (judgement.log_odds > 0.0)))
        row = float(votes[best]), float(judgement.step[best])
        yield Candidate(u, v, x, y, *row, "disc", float(found.evidence[k]), settings.evidence)
    sign = SIGNS[settings.polarity]
    pixels = camera.project_floor(judgement.floor_xy)
    for k in np.flatnonzero(~taken).tolist():
        outcome, value = Outcome(judgement.outcome[k]), float(judgement.value[k])
        if outcome is Outcome.SAME_RIM:
            continue
        contrast = float(judgement.step[k]) if outcome is Outcome.JUDGED else math.nan
        stage: Stage = "evidence"
        limit = settings.evidence
        if judgement.sign[k] * sign < 0.0:
            if outcome is not Outcome.JUDGED or value < 0.0:
                continue
            stage = "polarity"
        elif outcome is not Outcome.JUDGED:
            stage, limit = _STAGES[outcome], LEAST_RIM if outcome is Outcome.NO_RIM else math.nan
        elif evidence[k] < limit:
            value = float(evidence[k])
        else:
            away = np.hypot(*(found.floor_xy - judgement.floor_xy[k]).T).min(initial=math.inf)
            value, limit = float(away) / settings.radius_m, settings.separation
            stage = "beside a better disc"
            if value >= limit:
                stage, value, limit = "outside", math.nan, math.nan
        (u, v), (x, y) = pixels[k].tolist(), judgement.floor_xy[k].tolist()
        yield Candidate(u, v, x, y, float(votes[k]), contrast, stage, value, limit)


def _place(at: tuple[float, float], scene: _Examined) -> str:
    """What the detector sees at a pixel, in words."""
    camera, settings, (u, v) = scene.camera, scene.settings, at
    if not (0.0 <= u <= camera.width - 1 and 0.0 <= v <= camera.height - 1):
        return f"({u:g}, {v:g}) is outside the image, {camera.width}x{camera.height} px."
    x, y = camera.floor_from_pixel(at).tolist()
    if not math.isfinite(x):
        return f"({u:g}, {v:g}) does not see the floor: it is above the horizon of the calibration."
    side = "left" if x >= 0.0 else "right"
    words = f"({u:g}, {v:g}) sees the floor {-y:.2f} m in front and {abs(x):.2f} m to the {side}"
    per_row = float(np.hypot(*camera.floor_jacobian(at)[:, 1]))
    if per_row > settings.far_limit_m_per_px:
        return (
            f"{words}, where the floor moves {per_row:.3f} m per image row: too far for discs of "
            f"{settings.radius_m:g} m, {settings.far_limit_m_per_px:.3f} m at most (--far-limit)."
        )
    if min(u, v, camera.width - u, camera.height - v) < settings.border_px:
        return f"{words}: no centre of a disc is looked for there, it is too near to the border."
    votes, judgement = scene.judgement
    near = np.hypot(*(judgement.traced_from - [x, y]).T) < settings.radius_m
    if not near.any():
        return f"{words}: too few edges there vote for a disc of {settings.radius_m:g} m."
    return f"{words}: edges there have {votes[near].max():.1f} times the usual votes for a disc."


def _suggestions(scene: _Examined, at: tuple[float, float] | None) -> Iterator[str]:
    """Changes of settings that find more (at the given position)."""
    settings, here = scene.settings, scene.count(at)
    if at is not None and here:
        return

    def gained(changed: CircleSettings) -> int:
        return replace(scene, settings=changed).count(at) - here

    where = "there" if at is not None else "more"
    by_polarity = gained(replace(settings, polarity="any")) if settings.polarity != "any" else 0
    if by_polarity > 0:
        yield f"--polarity any finds {by_polarity} {where}."
    radius_m, gain = None, "a disc there"
    if at is not None and by_polarity <= 0:
        radius_m = _radius_at(scene, at)
    elif at is None and not here:
        estimate = find_radius([scene.image], scene.camera, replace(settings, polarity="any"))
        if estimate is not None:
            radius_m, gain = estimate.radius_m, counted(estimate.discs, "disc")
    if radius_m is not None and abs(math.log(radius_m / settings.radius_m)) > math.log(_FACTOR):
        yield f"--radius-m {radius_m:.3f} finds {gain}."
    rims = scene.judgement[1]
    discs = (rims.outcome == Outcome.JUDGED) & (rims.log_odds > settings.evidence)
    sizes = rims.radius[discs] / (RIM_RADIUS * settings.radius_m)
    if len(sizes) >= _FEWEST_RIMS:
        off = float(np.median(sizes)) - 1.0
        if abs(off) > _OTHER_RADIUS:
            yield (
                f"Discs look {100 * abs(off):.0f} % {'larger' if off > 0 else 'smaller'} than "
                f"{settings.radius_m:g} m: is that their radius, and the camera's height in the "
                "calibration right (`camera level`)?"
            )
    lower = replace(settings, evidence=settings.evidence - 2.0)
    if (more := gained(lower)) > 0:
        yield f"--evidence {lower.evidence:.1f} finds {more} {where}: look whether they are discs."


def _radius_at(scene: _Examined, at: tuple[float, float]) -> float | None:
    """The radius at which the disc with the highest evidence is found at a pixel."""
    camera, settings = scene.camera, scene.settings
    here = camera.floor_from_pixel(at)
    if not np.isfinite(here).all():
        return None
    count = round(math.log(_OTHER_RADII) / math.log(_FACTOR))
    best, of_best = -math.inf, None
    for radius_m in (settings.radius_m * _FACTOR ** np.arange(-count, count + 1)).tolist():
        tried = replace(settings, radius_m=radius_m, polarity="any")
        table = build_vote_table(camera, vote_shape(tried))
        found = detect_circles(scene.image, camera, table, tried)
        near = np.hypot(*(found.floor_xy - here).T) < radius_m
        if near.any() and found.evidence[near].max() > best:
            best, of_best = float(found.evidence[near].max()), radius_m
    return of_best
