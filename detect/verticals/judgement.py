"""Selects the tracks that can be verticals, individually and by the tilt consensus.

A track's evidence is its response summed over its length in pixel widths, times the square of its
sharpness: soft edges are more often shadows and glare than edges of the building. A line at an
angle b to the vertical is accepted if b^2 is at most the sum of the squares of the largest lean, a
number of standard deviations of its noise, and some pixels over its length (`LineSettings`).
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineNumbers
from detect.verticals.refinement import LineFits, StepFilters, fit_lines
from detect.verticals.response import Strip
from detect.verticals.tilt import (
    TiltEstimate,
    Verticals,
    agree_on_tilt,
    group_around_strongest,
    strongest_first,
)
from detect.verticals.tracking import LineTracks
from redetect.array_types import BoolArray, FloatArray, GreyImage, IntArray
from redetect.compiled import kernel


class Outcome(IntEnum):
    """Outcome of a track: a line of its own, joined to another one, or the reason for rejection."""

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


#: The outcomes in words.
OUTCOMES = tuple(outcome.name.lower().replace("_", " ") for outcome in Outcome)

#: Soft and faint edges are kept if they have at least this evidence.
_SOFT_EVIDENCE = 40.0
#: Votes of a line in the consensus increase with its evidence, up to this number.
_MOST_VOTES = 3.0
_LEAN_SIGMAS = 8.0  #: Largest lean of a line in standard deviations due to noise.

#: Tracks with these outcomes might be lines if tracked again,
_DOUBTFUL = (
    Outcome.NO_MAXIMUM,
    Outcome.OFF_THE_TRACK,
    Outcome.NOT_STRAIGHT,
    Outcome.UNCERTAIN,
    Outcome.SOFT,
)
#: and those with at least this share of the evidence threshold might exceed it.
_NEARLY = 0.7


class JudgedTracks(NamedTuple):
    """Lines through tracks, and their outcomes."""

    fits: LineFits  # a line for each track, unless that is too short or too faint
    #: (T,) response summed over the length in pixel widths, times the square of the sharpness
    evidence: FloatArray
    #: (T,) indices of `OUTCOMES`; lines that disagree with the tilt are "not vertical"
    outcome: NDArray[np.int8]
    #: (T,) rejected tracks that may have continued beyond the edge's end, or lost it early
    doubtful: BoolArray
    #: Consensus tilt; None if too few lines agree. Its covariance is that of least squares.
    tilt: TiltEstimate | None
    verticals: Verticals  # constraints of the tilt by lines that may individually be verticals
    edge: IntArray  # (N,) for each of these, the first one on the same edge


def fit_and_judge(
    image: GreyImage,
    strip: Strip,
    tracks: LineTracks,
    filters: StepFilters,
    numbers: LineNumbers,
    before: JudgedTracks | None = None,
) -> JudgedTracks:
    """Fit lines to tracks, select them individually, and estimate the consensus tilt.

    If only the doubtful tracks of an earlier pass were tracked again, only these are fitted.
    """
    least = numbers.least_points, numbers.least_evidence / strip.row_aspect
    if before is None:
        fits = fit_lines(image, strip, tracks, filters, least, 0)
    else:
        kept = np.flatnonzero(~before.doubtful)
        new = fit_lines(image, strip, tracks, filters, least, len(kept))
        fits = LineFits(*map(np.concatenate, zip((old[kept] for old in before.fits), new)))
    evidence, outcome, doubtful, accepted, lines, edge = _judge(strip, tracks, fits, numbers)
    tilt, agrees = agree_on_tilt(lines, numbers)
    outcome[accepted[~agrees]] = Outcome.NOT_VERTICAL
    consensus = tilt if tilt.lines > 0 else None
    return JudgedTracks(fits, evidence, outcome, doubtful, consensus, lines, edge)


# Kernels that are launched one after the other compile faster than nested ones.


@kernel()
def _judge(
    strip: Strip, tracks: LineTracks, fits: LineFits, numbers: LineNumbers
) -> tuple[FloatArray, NDArray[np.int8], BoolArray, IntArray, Verticals, IntArray]:
    """Evidence and individual outcomes of tracks, which are doubtful; planes and edges of lines."""
    count = len(tracks.polarity)
    evidence, outcome, doubtful = (
        np.empty(count),
        np.empty(count, np.int8),
        np.empty(count, np.bool_),
    )
    _judge_each(strip, tracks, fits, numbers, evidence, outcome)
    _reject_soft(fits, evidence, accepted_tracks(outcome), numbers, outcome)
    for t in range(count):
        nearly = evidence[t] >= _NEARLY * numbers.least_evidence
        doubtful[t] = outcome[t] in _DOUBTFUL or (outcome[t] == Outcome.LITTLE_EVIDENCE and nearly)
    accepted = accepted_tracks(outcome)
    count = len(accepted)
    votes, place, near = np.empty(count), np.empty(count), np.empty(count)
    own_evidence, polarity = np.empty(count), np.empty(count)
    for k in range(count):
        t = accepted[k]
        votes[k] = min(0.1 * evidence[t], _MOST_VOTES)
        place[k] = fits.reference_rad[t] + math.atan(fits.line[t, 0])
        near[k] = numbers.same_edge_px * fits.pixel_rad[t]
        own_evidence[k], polarity[k] = evidence[t], tracks.polarity[t]
    lines = _weigh(fits, accepted, votes, numbers)
    edge = group_around_strongest(place, near, own_evidence, polarity)
    share_edges(lines, edge)
    return evidence, outcome, doubtful, accepted, lines, edge


@kernel()
def _judge_each(
    strip: Strip, tracks: LineTracks, fits: LineFits, numbers: LineNumbers,
    evidence: FloatArray, outcome: NDArray[np.int8],
) -> None:  # fmt: skip
    """Evidence of each track, and whether it can individually be a vertical."""
    score = tracks.score
    for t in range(len(outcome)):
        begin, end = tracks.bounds[t], tracks.bounds[t + 1]
        total = 0.0
        for i in range(begin, end):
            total += score[i]
        evidence[t] = total * strip.row_aspect * fits.sharpness[t] ** 2
        horizon = strip.anchor_row[min(int(np.rint(tracks.column[begin])), len(strip.bearing) - 1)]
        gap = max(horizon - tracks.row[end - 1], tracks.row[begin] - horizon) * strip.row_aspect
        noise_px = math.sqrt(fits.covariance[t, 0, 0]) / fits.pixel_rad[t]
        if end - begin < numbers.least_points:
            outcome[t] = Outcome.SHORT
        elif not evidence[t] >= numbers.least_evidence:
            outcome[t] = Outcome.LITTLE_EVIDENCE
        elif not math.isfinite(fits.line[t, 0]):
            outcome[t] = Outcome.NO_MAXIMUM
        elif not fits.shift_px[t] <= numbers.largest_shift_px:
            outcome[t] = Outcome.OFF_THE_TRACK
        elif not fits.scatter_px[t] <= numbers.largest_scatter_px:
            outcome[t] = Outcome.NOT_STRAIGHT
        elif not gap <= numbers.largest_horizon_gap_px:
            outcome[t] = Outcome.OFF_THE_HORIZON
        elif not noise_px <= numbers.largest_noise_px:
            outcome[t] = Outcome.UNCERTAIN
        else:
            outcome[t] = Outcome.ACCEPTED


@kernel()
def accepted_tracks(outcome: NDArray[np.int8]) -> IntArray:
    """(N,) indices of the tracks accepted so far."""
    accepted, count = np.empty(len(outcome), np.int64), 0
    for t in range(len(outcome)):
        if outcome[t] == Outcome.ACCEPTED:
            accepted[count] = t
            count += 1
    return accepted[:count]


@kernel()
def _reject_soft(
    fits: LineFits, evidence: FloatArray, accepted: IntArray, numbers: LineNumbers,
    outcome: NDArray[np.int8],
) -> None:  # fmt: skip
    """Reject lines that are soft and faint compared to the other accepted ones."""
    if len(accepted) == 0:
        return
    # How sharp an edge can be depends on the image's focus and motion.
    least_sharpness = numbers.least_sharpness * _quantile(fits.sharpness, accepted, 0.25)
    faint = _quantile(fits.contrast, accepted, 0.5)
    for t in accepted:
        soft = fits.sharpness[t] < least_sharpness and fits.contrast[t] < faint
        if soft and evidence[t] < _SOFT_EVIDENCE:
            outcome[t] = Outcome.SOFT


@kernel()
def _quantile(values: FloatArray, chosen: IntArray, share: float) -> float:
    """Quantile of some values, interpolated linearly."""
    own = np.empty(len(chosen))
    for k in range(len(chosen)):
        own[k] = values[chosen[k]]
    order = strongest_first(own)
    place = (1.0 - share) * (len(own) - 1)
    upper = int(place)
    high, low = own[order[upper]], own[order[min(upper + 1, len(own) - 1)]]
    return float(high - (place - upper) * (high - low))


@kernel()
def _weigh(
    fits: LineFits, accepted: IntArray, votes: FloatArray, numbers: LineNumbers
) -> Verticals:
    """The tilt's constraints by accepted lines, with their votes."""
    count = len(accepted)
    normal, variance, tolerance = np.empty((count, 3)), np.empty(count), np.empty(count)
    for k in range(count):
        t = accepted[k]
        sine, cosine = math.sin(fits.reference_rad[t]), math.cos(fits.reference_rad[t])
        a, b = fits.line[t, 0], fits.line[t, 1]
        length = math.sqrt(1.0 + a * a + b * b)
        normal[k, 0] = (cosine - a * sine) / length
        normal[k, 1] = (sine + a * cosine) / length
        normal[k, 2] = -b / length
        # One pixel from end to end: 12 = (length / standard deviation of its points)^2.
        per_length = fits.pixel_rad[t] / math.sqrt(12.0 * fits.spread[t])
        noise = fits.covariance[t, 1, 1]
        variance[k] = (
            math.radians(numbers.building_deg) ** 2
            + numbers.lean_noise * noise
            + (numbers.bend_px * per_length) ** 2
        )
        tolerance[k] = math.sqrt(
            math.radians(numbers.largest_lean_deg) ** 2
            + _LEAN_SIGMAS**2 * noise
            + (numbers.largest_lean_px * per_length) ** 2
        )
    return Verticals(normal, variance, tolerance, votes)


@kernel()
def share_edges(lines: Verticals, edge: IntArray) -> None:
    """Give the lines on one edge together the votes and information of a single line."""
    members = np.zeros(len(edge), np.int64)
    for k in range(len(edge)):
        members[edge[k]] += 1
    for k in range(len(edge)):
        lines.variance[k] *= members[edge[k]]
        lines.weight[k] /= members[edge[k]]
