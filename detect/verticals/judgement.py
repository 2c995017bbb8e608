"""Selects the tracks that can be verticals, by themselves and by the tilt on which most agree.

A track's evidence is its response summed over its length in pixel widths, weakened by the square of
its sharpness: soft edges are shadows and glare more often than the building's. A line at an angle b
to the vertical is accepted if b^2 is at most the sum of the squares of the largest lean, of a
number of standard deviations of its noise, and of some pixels over its length
(`detect.line_settings.LineSettings`).

An edge that crosses the band round the horizon has a maximum of the response on each of its rows.
Such maxima, one below the other, are a *chain*: a short track that costs nothing to follow
(`tilt_of_chains`).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.verticals.refinement import (
    LineFits,
    StepFilters,
    fit_eigenlines,
    fit_lines,
    regression_covariance,
)
from detect.verticals.response import Strip
from detect.verticals.starts import Maxima
from detect.verticals.tilt import (
    ConsensusSettings,
    TiltEstimate,
    Verticals,
    agreed_tilt,
)
from detect.verticals.tilt_error import descending
from detect.verticals.tracking import LineTracks, sum_of

FloatArray = NDArray[np.float64]

# Places in `FATES`.
ACCEPTED = 0
JOINED = 1
SHORT = 2
NO_MAXIMUM = 3
LITTLE_EVIDENCE = 4
OFF_THE_TRACK = 5
NOT_STRAIGHT = 6
OFF_THE_HORIZON = 7
UNCERTAIN = 8
SOFT = 9
NOT_VERTICAL = 10
SAME_EDGE = 11
BESIDE_A_STRONGER_EDGE = 12

#: Fates of a track: accepted as a line, joined to a stronger one, or the reason for its rejection.
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

#: Maxima of a chain on neighbouring rows of the band are closer than this, columns.
_CHAIN_APART = 1.5
#: Least number of maxima of a chain; noise alone gives few as long.
_CHAIN_LEAST = 6
#: Largest root-mean-square distance of them from a straight line, pixels.
_CHAIN_SCATTER_PX = 0.3
#: How far a chain may lean from the vertical over its length, pixels (see
#: `detect.line_settings.LineSettings.largest_lean_px`).
_CHAIN_LEAN_PX = 0.5
#: Standard deviation of its lean over its length due to causes other than noise, pixels: more than
#: that of lines, which are refined on the grey values.
_CHAIN_BEND_PX = 0.125


class Leaning(NamedTuple):
    """How far verticals lean; see `detect.line_settings.LineSettings`."""

    building_variance: float
    bend_px: float
    lean_noise: float
    largest_lean_rad: float
    largest_lean_sigmas: float
    largest_lean_px: float


class JudgementLimits(NamedTuple):
    """Limits for the selection of tracks; see `detect.line_settings.LineSettings`.

    `least_score` is the least evidence in responses, not in pixel widths.
    """

    least_points: int
    least_score: float
    least_evidence: float
    largest_shift_px: float
    largest_scatter_px: float
    largest_horizon_gap_px: float
    largest_noise_px: float
    least_sharpness: float
    soft_evidence: float
    weight_limit: float
    same_edge_px: float
    leaning: Leaning
    consensus: ConsensusSettings


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
    tilt : TiltEstimate
        That most lines agree with; NaN where too few do.
    """

    fits: LineFits
    evidence: FloatArray
    fate: NDArray[np.int8]
    tilt: TiltEstimate


@lru_cache(maxsize=16)
def limits_of(settings: LineSettings, row_aspect: float) -> JudgementLimits:
    """Limits for the selection of tracks."""
    return JudgementLimits(
        least_points=settings.least_points(row_aspect),
        least_score=float(settings.least_evidence / row_aspect),
        least_evidence=float(settings.least_evidence),
        largest_shift_px=float(settings.largest_shift_px),
        largest_scatter_px=float(settings.largest_scatter_px),
        largest_horizon_gap_px=float(settings.largest_horizon_gap_px),
        largest_noise_px=float(settings.largest_noise_px),
        least_sharpness=float(settings.least_sharpness),
        soft_evidence=float(settings.soft_evidence),
        weight_limit=float(settings.weight_limit),
        same_edge_px=float(settings.same_edge_px),
        leaning=Leaning(
            building_variance=math.radians(settings.building_deg) ** 2,
            bend_px=float(settings.bend_px),
            lean_noise=float(settings.lean_noise),
            largest_lean_rad=math.radians(settings.largest_lean_deg),
            largest_lean_sigmas=float(settings.largest_lean_sigmas),
            largest_lean_px=float(settings.largest_lean_px),
        ),
        consensus=settings.consensus,
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def fit_and_judge(
    image: NDArray[np.uint8], strip: Strip, tracks: LineTracks, filters: StepFilters,
    limits: JudgementLimits,
) -> tuple[Judgement, Verticals, NDArray[np.int64]]:  # fmt: skip
    """Fit lines to tracks, select them one by one, and estimate the tilt on which most agree.

    The tilt's covariance is that of least squares. Also returned is what
    `detect.verticals.tilt.with_error` needs for another one: what the accepted tracks say about
    the tilt, and one of them for each, the same for all of an edge.
    """
    fits = fit_lines(image, strip, tracks, filters, limits.least_points, limits.least_score)
    evidence, fate = judge_each(strip, tracks, fits, limits)
    accepted = _chosen(fate)
    lines = weigh_verticals(fits, evidence, accepted, limits.leaning, limits.weight_limit)
    edge = share_edges(fits, tracks.polarity, evidence, accepted, limits.same_edge_px, lines)
    tilt, agrees = agreed_tilt(lines, strip.bearing, limits.consensus)
    for k in range(len(accepted)):
        if not agrees[k]:
            fate[accepted[k]] = NOT_VERTICAL
    return Judgement(fits, evidence, fate, tilt), lines, edge


@njit(cache=True, error_model="numpy")
def _chosen(fate: NDArray[np.int8]) -> NDArray[np.int64]:
    """Accepted tracks."""
    tracks = np.empty(len(fate), np.int64)
    n = 0
    for t in range(len(fate)):
        if fate[t] == ACCEPTED:
            tracks[n] = t
            n += 1
    return tracks[:n]


@njit(cache=True, error_model="numpy")
def _quantile(values: NDArray[np.float64], share: float) -> float:
    """Quantile of at least one value, interpolated linearly."""
    order = descending(values)
    last = len(values) - 1
    place = share * last
    below = int(place)
    lower = values[order[last - below]]
    upper = values[order[max(last - below - 1, 0)]]
    return float(lower + (place - below) * (upper - lower))


@njit(cache=True, error_model="numpy")
def judge_each(
    strip: Strip, tracks: LineTracks, fits: LineFits, limits: JudgementLimits
) -> tuple[FloatArray, NDArray[np.int8]]:
    """Evidence of each track, and whether it can be a vertical, by itself.

    Returns
    -------
    evidence : (T,) float64
        See `Judgement`.
    fate : (T,) int8
        Accepted, or the first reason why not.
    """
    anchor_row, row_aspect = strip.anchor_row, strip.row_aspect
    bounds, row, column, score = tracks.bounds, tracks.row, tracks.column, tracks.score
    sharpness, contrast = fits.sharpness, fits.contrast
    width = len(anchor_row)
    count = len(bounds) - 1
    evidence = np.empty(count)
    fate = np.empty(count, np.int8)
    for t in range(count):
        begin, end = bounds[t], bounds[t + 1]
        total = sum_of(score[begin:end])
        evidence[t] = total * row_aspect * sharpness[t] * sharpness[t]
        near = min(max(int(np.rint(column[begin])), 0), width - 1)
        gap = max(anchor_row[near] - row[end - 1], row[begin] - anchor_row[near]) * row_aspect
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
    accepted = _chosen(fate)
    if len(accepted) == 0:
        return evidence, fate
    # How sharp an edge can be depends on the image's focus and motion.
    sharp = limits.least_sharpness * _quantile(sharpness[accepted], 0.25)
    clear = _quantile(contrast[accepted], 0.5)
    for t in accepted:
        if sharpness[t] < sharp and contrast[t] < clear and evidence[t] < limits.soft_evidence:
            fate[t] = SOFT
    return evidence, fate


@njit(cache=True, error_model="numpy")
def weigh_verticals(
    fits: LineFits, evidence: FloatArray, accepted: NDArray[np.int64], leaning: Leaning,
    weight_limit: float,
) -> Verticals:  # fmt: skip
    """The tilt's constraints by accepted lines."""
    count = len(accepted)
    normal = np.empty((count, 3))
    variance = np.empty(count)
    tolerance = np.empty(count)
    weight = np.empty(count)
    for k in range(count):
        t = accepted[k]
        sine = math.sin(fits.reference_rad[t])
        cosine = math.cos(fits.reference_rad[t])
        a = fits.line[t, 0]
        b = fits.line[t, 1]
        length = math.sqrt(1.0 + a * a + b * b)
        normal[k, 0] = (cosine - a * sine) / length
        normal[k, 1] = (sine + a * cosine) / length
        normal[k, 2] = -b / length
        # One pixel from end to end: 12 = (length / standard deviation of its points)^2.
        per_length = fits.pixel_rad[t] / math.sqrt(12.0 * fits.spread[t])
        noise = fits.covariance[t, 1, 1]
        variance[k] = (
            leaning.building_variance
            + leaning.lean_noise * noise
            + (leaning.bend_px * per_length) ** 2
        )
        tolerance[k] = math.sqrt(
            leaning.largest_lean_rad**2
            + leaning.largest_lean_sigmas**2 * noise
            + (leaning.largest_lean_px * per_length) ** 2
        )
        weight[k] = min(0.1 * evidence[t], weight_limit)
    return Verticals(normal, variance, tolerance, weight)


@njit(cache=True, error_model="numpy")
def share_edges(
    fits: LineFits, polarity: FloatArray, evidence: FloatArray, accepted: NDArray[np.int64],
    same_edge_px: float, lines: Verticals,
) -> NDArray[np.int64]:  # fmt: skip
    """Let the lines of one edge say together as much about the tilt as one.

    Parameters
    ----------
    fits, polarity, evidence
        Of each track.
    accepted : (N,) int64
        Tracks that may be verticals.
    same_edge_px : float
        See `detect.line_settings.LineSettings`.
    lines : Verticals
        The accepted tracks; variances and weights change where an edge has several.

    Returns
    -------
    (N,) int64
        The first of the accepted tracks that are of the same edge.
    """
    variance, weight = lines.variance, lines.weight
    count = len(accepted)
    place = np.empty(count)
    for k in range(count):
        t = accepted[k]
        place[k] = fits.reference_rad[t] + math.atan(fits.line[t, 0])
    edge = np.full(count, -1, np.int64)
    members = np.zeros(count, np.int64)
    # From the strongest on, as `detect.verticals.joining.group_tracks` does.
    for strongest in descending(evidence[accepted]):
        if edge[strongest] >= 0:
            continue
        near = same_edge_px * fits.pixel_rad[accepted[strongest]]
        sign = polarity[accepted[strongest]]
        first = -1
        for k in range(count):
            if (
                edge[k] < 0
                and polarity[accepted[k]] == sign
                and abs(place[k] - place[strongest]) < near
            ):
                if first < 0:
                    first = k
                edge[k] = first
                members[first] += 1
    for k in range(count):
        variance[k] *= members[edge[k]]
        weight[k] /= members[edge[k]]
    return edge


@njit(cache=True, error_model="numpy")
def chain_maxima(
    response: NDArray[np.float32], maxima: Maxima
) -> tuple[FloatArray, NDArray[np.int32]]:
    """Places of maxima between columns, and of each the one below that continues its edge.

    Parameters
    ----------
    response : (K, W) float32
        On the rows of the band.
    maxima
        Its maxima.

    Returns
    -------
    place : (N,) float64
        Top of the parabola through the maximum and its neighbours.
    below : (N,) int32
        Maximum of the same sign on the next row of the band; -1 for none. No two have the same.
    """
    level, column, sign = maxima
    count = len(level)
    place = np.empty(count)
    below = np.full(count, -1, np.int32)
    first = 0
    for i in range(count):
        k = level[i]
        c = column[i]
        left = float(response[k, c - 1])
        centre = float(response[k, c])
        right = float(response[k, c + 1])
        place[i] = c + 0.5 * (left - right) / (left - 2.0 * centre + right)
        passed = place[i] - 2.0 * _CHAIN_APART
        while first < i and (level[first] < k - 1 or (level[first] < k and place[first] <= passed)):
            first += 1
        nearest = _CHAIN_APART
        above = -1
        other = first
        while other < i and level[other] < k and place[other] < place[i] + _CHAIN_APART:
            apart = abs(place[other] - place[i])
            if sign[other] == sign[i] and below[other] < 0 and apart < nearest:
                nearest = apart
                above = other
            other += 1
        if above >= 0:
            below[above] = i
    return place, below


@njit(cache=True, error_model="numpy")
def tilt_of_chains(
    response: NDArray[np.float32], band_row: NDArray[np.int32], maxima: Maxima, strip: Strip,
    limits: JudgementLimits,
) -> TiltEstimate:  # fmt: skip
    """The tilt that most chains agree with; NaN where too few do.

    `response` and `band_row` are those of the maxima (`detect.verticals.tracking.find_maxima`).
    """
    level, column, _ = maxima
    place, below = chain_maxima(response, maxima)
    count = len(level)
    length = np.ones(count, np.int32)
    for i in range(count - 1, -1, -1):
        if below[i] >= 0:
            length[i] += length[below[i]]
    bounds = np.zeros(count + 1, np.int64)
    row_of = np.empty(count, np.int32)
    place_of = np.empty(count)
    score_of = np.empty(count, np.float32)
    chains = 0
    n = 0
    for i in range(count):
        if length[i] < _CHAIN_LEAST:
            continue
        at = i
        while at >= 0:
            # Not to begin with this one again.
            length[at] = 0
            row_of[n] = band_row[level[at], column[at]]
            place_of[n] = place[at]
            score_of[n] = abs(response[level[at], column[at]])
            n += 1
            at = below[at]
        chains += 1
        bounds[chains] = n
    bounds = bounds[: chains + 1]
    tracks = LineTracks(np.ones(chains), bounds, row_of[:n], place_of[:n], score_of[:n], True)
    of_track = fit_eigenlines(strip, tracks, _CHAIN_LEAST, 0.0)
    fits = LineFits(
        of_track.reference, of_track.pixel, of_track.line,
        regression_covariance(of_track, bounds), of_track.scatter_px, np.zeros(chains),
        of_track.spread, np.ones(chains), np.ones(chains),
    )  # fmt: skip
    straight = np.flatnonzero(of_track.scatter_px <= _CHAIN_SCATTER_PX)
    own = limits.leaning
    leaning = Leaning(
        own.building_variance, _CHAIN_BEND_PX, 1.0, own.largest_lean_rad, own.largest_lean_sigmas,
        _CHAIN_LEAN_PX,
    )  # fmt: skip
    evidence = np.full(chains, 10.0 * limits.weight_limit)
    lines = weigh_verticals(fits, evidence, straight, leaning, limits.weight_limit)
    tilt, _ = agreed_tilt(lines, strip.bearing, limits.consensus)
    return tilt
