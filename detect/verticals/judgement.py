"""Selects the tracks that can be verticals, by themselves and by the tilt on which most agree.

A track's evidence is its response summed over its length in pixel widths, weakened by the square of
its sharpness: soft edges are shadows and glare more often than the building's. A line at an angle b
to the vertical is accepted if b^2 is at most the sum of the squares of the largest lean, of a
number of standard deviations of its noise, and of some pixels over its length
(`detect.line_settings.LineSettings`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.verticals.refinement import LineFits, StepFilters, fit_lines
from detect.verticals.response import FloatArray, Strip
from detect.verticals.starts import Maxima, StartBand
from detect.verticals.tilt import TiltEstimate, Verticals, agreed_tilt, gather
from detect.verticals.tracking import LineTracks

#: Fates of tracks: a line of its own, joined to another one, or the reason for its rejection.
FATES = (
    "accepted",
    "joined",
    "short",
    "no maximum",
    "little evidence",
    "off the track",
    "not straight",
    "off the horizon",
    "uncertain",
    "soft",
    "not vertical",
    "same edge",
    "beside a stronger edge",
)
(
    ACCEPTED,
    JOINED,
    SHORT,
    NO_MAXIMUM,
    LITTLE_EVIDENCE,
    OFF_THE_TRACK,
    NOT_STRAIGHT,
    OFF_THE_HORIZON,
    UNCERTAIN,
    SOFT,
    NOT_VERTICAL,
    SAME_EDGE,
    BESIDE_A_STRONGER_EDGE,
) = range(len(FATES))

#: Least number of maxima of a chain; noise alone gives few as long.
_CHAIN_LEAST = 6
#: Largest root-mean-square distance of them from a straight line, pixels.
_CHAIN_SCATTER_PX = 0.3
#: How far a chain may lean from the vertical over its length, and the standard deviation of its
#: lean due to causes other than noise, pixels: more than that of lines, which are refined.
_CHAIN_LEAN_PX, _CHAIN_BEND_PX = 0.5, 0.125


class Judgement(NamedTuple):
    """Lines through tracks, and their fates.

    Attributes
    ----------
    fits : LineFits
        A line for each track; those too short or too faint to be lines have none.
    evidence : (T,) float64
        Response summed over the track's length in pixel widths, weakened by the square of its
        sharpness.
    fate : (T,) int8
        Places in `FATES`; lines that disagree with the tilt are "not vertical".
    tilt : TiltEstimate or None
        That most lines agree with; None where too few do. Its covariance is that of least squares.
    verticals : Verticals
        What the lines that may be verticals by themselves say about the tilt.
    edge : (N,) int64
        The first of these that is of the same edge, for each.
    """

    fits: LineFits
    evidence: FloatArray
    fate: NDArray[np.int8]
    tilt: TiltEstimate | None
    verticals: Verticals
    edge: NDArray[np.int64]


def fit_and_judge(
    image: NDArray[np.uint8], strip: Strip, tracks: LineTracks, filters: StepFilters,
    settings: LineSettings,
) -> Judgement:  # fmt: skip
    """Fit lines to tracks, select them one by one, and estimate the tilt on which most agree."""
    least_points = settings.least_points(strip.row_aspect)
    fits = fit_lines(
        image, strip, tracks, filters, least_points, settings.least_evidence / strip.row_aspect
    )
    evidence, fate = _judge_each(strip, tracks, fits, settings)
    accepted = np.flatnonzero(fate == ACCEPTED)
    votes = np.minimum(0.1 * evidence[accepted], settings.weight_limit)
    lines = weigh_verticals(fits, votes, accepted, Leaning.of(settings))
    place = fits.reference_rad[accepted] + np.arctan(fits.line[accepted, 0])
    near = settings.same_edge_px * fits.pixel_rad[accepted]
    edge = gather(place, near, evidence[accepted], tracks.polarity[accepted])
    lines = share_edges(lines, edge)
    tilt, agrees = agreed_tilt(lines, settings)
    fate[accepted[~agrees]] = NOT_VERTICAL
    return Judgement(fits, evidence, fate, tilt, lines, edge)


class _Limits(NamedTuple):
    """Limits for tracks by themselves; see `detect.line_settings.LineSettings`."""

    least_points: int
    least_evidence: float
    largest_shift_px: float
    largest_scatter_px: float
    largest_horizon_gap_px: float
    largest_noise_px: float


def _judge_each(
    strip: Strip, tracks: LineTracks, fits: LineFits, settings: LineSettings
) -> tuple[FloatArray, NDArray[np.int8]]:
    """Evidence of each track, and whether it can be a vertical, by itself."""
    limits = _Limits(
        settings.least_points(strip.row_aspect),
        float(settings.least_evidence),
        float(settings.largest_shift_px),
        float(settings.largest_scatter_px),
        float(settings.largest_horizon_gap_px),
        float(settings.largest_noise_px),
    )
    evidence, fate = np.empty(len(tracks.polarity)), np.empty(len(tracks.polarity), np.int8)
    _judge(strip, tracks, fits, limits, evidence, fate)
    accepted = np.flatnonzero(fate == ACCEPTED)
    if len(accepted) > 0:
        # How sharp an edge can be depends on the image's focus and motion.
        sharpness, contrast = fits.sharpness[accepted], fits.contrast[accepted]
        soft = sharpness < settings.least_sharpness * _quantile(sharpness, 0.25)
        soft &= contrast < _quantile(contrast, 0.5)
        soft &= evidence[accepted] < settings.soft_evidence
        fate[accepted[soft]] = SOFT
    return evidence, fate


@njit(cache=True, error_model="numpy")
def _judge(
    strip: Strip, tracks: LineTracks, fits: LineFits, limits: _Limits, evidence: FloatArray,
    fate: NDArray[np.int8],
) -> None:  # fmt: skip
    score = tracks.score
    for t in range(len(fate)):
        begin, end = tracks.bounds[t], tracks.bounds[t + 1]
        total = 0.0
        for i in range(begin, end):
            total += score[i]
        evidence[t] = total * strip.row_aspect * fits.sharpness[t] ** 2
        horizon = strip.anchor_row[min(int(np.rint(tracks.column[begin])), len(strip.bearing) - 1)]
        gap = max(horizon - tracks.row[end - 1], tracks.row[begin] - horizon) * strip.row_aspect
        noise_px = math.sqrt(fits.covariance[t, 0, 0]) / fits.pixel_rad[t]
        if end - begin < limits.least_points:
            fate[t] = SHORT
        elif not evidence[t] >= limits.least_evidence:
            fate[t] = LITTLE_EVIDENCE
        elif not math.isfinite(fits.line[t, 0]):
            fate[t] = NO_MAXIMUM
        elif not fits.shift_px[t] <= limits.largest_shift_px:
            fate[t] = OFF_THE_TRACK
        elif not fits.scatter_px[t] <= limits.largest_scatter_px:
            fate[t] = NOT_STRAIGHT
        elif not gap <= limits.largest_horizon_gap_px:
            fate[t] = OFF_THE_HORIZON
        elif not noise_px <= limits.largest_noise_px:
            fate[t] = UNCERTAIN
        else:
            fate[t] = ACCEPTED


def _quantile(values: FloatArray, share: float) -> float:
    """Quantile, interpolated linearly, without the overhead of `numpy.quantile`."""
    place = share * (len(values) - 1)
    below = int(place)
    ordered = np.sort(values)
    lower, upper = ordered[below], ordered[min(below + 1, len(values) - 1)]
    return float(lower + (place - below) * (upper - lower))


class Leaning(NamedTuple):
    """How far verticals lean; see `detect.line_settings.LineSettings`."""

    building_rad: float
    bend_px: float
    lean_noise: float
    largest_lean_rad: float
    largest_lean_sigmas: float
    largest_lean_px: float

    @classmethod
    def of(cls, settings: LineSettings) -> Leaning:
        """Those of some settings."""
        return cls(
            math.radians(settings.building_deg),
            float(settings.bend_px),
            float(settings.lean_noise),
            math.radians(settings.largest_lean_deg),
            float(settings.largest_lean_sigmas),
            float(settings.largest_lean_px),
        )


def weigh_verticals(
    fits: LineFits, weight: FloatArray, accepted: NDArray[np.intp], leaning: Leaning
) -> Verticals:
    """The tilt's constraints by accepted lines, with some votes each."""
    count = len(accepted)
    lines = Verticals(np.empty((count, 3)), np.empty(count), np.empty(count), weight)
    _weigh(fits, accepted, leaning, lines)
    return lines


@njit(cache=True, error_model="numpy")
def _weigh(fits: LineFits, accepted: NDArray[np.int64], leaning: Leaning, lines: Verticals) -> None:
    for k in range(len(accepted)):
        t = accepted[k]
        sine, cosine = math.sin(fits.reference_rad[t]), math.cos(fits.reference_rad[t])
        a, b = fits.line[t, 0], fits.line[t, 1]
        length = math.sqrt(1.0 + a * a + b * b)
        lines.normal[k, 0] = (cosine - a * sine) / length
        lines.normal[k, 1] = (sine + a * cosine) / length
        lines.normal[k, 2] = -b / length
        # One pixel from end to end: 12 = (length / standard deviation of its points)^2.
        per_length = fits.pixel_rad[t] / math.sqrt(12.0 * fits.spread[t])
        noise = fits.covariance[t, 1, 1]
        lines.variance[k] = (
            leaning.building_rad**2
            + leaning.lean_noise * noise
            + (leaning.bend_px * per_length) ** 2
        )
        lines.tolerance[k] = math.sqrt(
            leaning.largest_lean_rad**2
            + leaning.largest_lean_sigmas**2 * noise
            + (leaning.largest_lean_px * per_length) ** 2
        )


def share_edges(lines: Verticals, edge: NDArray[np.int64]) -> Verticals:
    """Let the lines of one edge say together as much about the tilt as one."""
    members = np.bincount(edge)[edge]
    return lines._replace(variance=lines.variance * members, weight=lines.weight / members)


def tilt_of_chains(
    image: NDArray[np.uint8], strip: Strip, maxima: Maxima, band: StartBand,
    settings: LineSettings, no_steps: StepFilters,
) -> TiltEstimate | None:  # fmt: skip
    """The tilt that most chains of the band's maxima agree with; None where too few do."""
    members = np.flatnonzero(np.bincount(maxima.chain)[maxima.chain] >= _CHAIN_LEAST)
    if len(members) == 0:
        return None
    # Stable: from the top row of each chain to its bottom row.
    members = members[np.argsort(maxima.chain[members], kind="stable")]
    chain = maxima.chain[members]
    bounds = np.flatnonzero(np.concatenate([[True], chain[1:] != chain[:-1], [True]]))
    tracks = LineTracks(
        np.ones(len(bounds) - 1),
        bounds,
        band.row[maxima.level[members], maxima.column[members]],
        maxima.place[members],
        np.abs(maxima.value[members]),
    )
    fits = fit_lines(image, strip, tracks, no_steps, _CHAIN_LEAST, 0.0)
    straight = np.flatnonzero(fits.scatter_px <= _CHAIN_SCATTER_PX)
    leaning = Leaning.of(settings)._replace(
        bend_px=_CHAIN_BEND_PX, lean_noise=1.0, largest_lean_px=_CHAIN_LEAN_PX
    )
    # All chains count the same.
    votes = np.full(len(straight), float(settings.weight_limit))
    return agreed_tilt(weigh_verticals(fits, votes, straight, leaning), settings)[0]
