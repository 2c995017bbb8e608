"""What follows tracking, in one call each: fits and their judgement, and the lines in the end.

A call from Python costs as much as the work on a line or two, and the arrays that it takes and
returns cost more.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.verticals.bearing import ends_of_lines, turned_bearings
from detect.verticals.fit import FIT_NUMBERS
from detect.verticals.fit_kernels import fit_eigenlines, refine_lines
from detect.verticals.judgement_kernels import (
    NOT_VERTICAL,
    group_tracks,
    join_tracks,
    judge_tracks,
    share_edges,
    weigh_verticals,
)
from detect.verticals.tilt import TILT_NUMBERS
from detect.verticals.tilt_kernels import agree_on_tilt, level_matrix

#: Columns from one to the next at which the lean is predicted.
_LEAN_SPACING = 16


@njit(cache=True, error_model="numpy")
def regression_covariance(
    covariance: NDArray[np.float64],
    scatter_px: NDArray[np.float64],
    pixel: NDArray[np.float64],
    bounds: NDArray[np.int64],
    middle: NDArray[np.float64],
    spread: NDArray[np.float64],
) -> None:
    """Covariance of a, b of regressions on points with independent errors."""
    for t in range(len(pixel)):
        points = bounds[t + 1] - bounds[t]
        of_mean = (scatter_px[t] * pixel[t]) ** 2 / max(points - 2, 1)
        of_lean = of_mean / spread[t]
        covariance[t, 0, 0] = of_mean + middle[t] * middle[t] * of_lean
        covariance[t, 0, 1] = -middle[t] * of_lean
        covariance[t, 1, 0] = covariance[t, 0, 1]
        covariance[t, 1, 1] = of_lean


@njit(cache=True, error_model="numpy")
def _largest_lean_deviation(bearing: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    """Standard deviation of the lean of a vertical due to that of the tilt, where it is largest."""
    largest = 0.0
    for c in range(0, len(bearing), _LEAN_SPACING):
        if math.isfinite(bearing[c]):
            sine = math.sin(bearing[c])
            cosine = math.cos(bearing[c])
            variance = (
                sine * sine * covariance[0, 0]
                - 2.0 * sine * cosine * covariance[0, 1]
                + cosine * cosine * covariance[1, 1]
            )
            largest = max(largest, variance)
    return math.sqrt(largest)


@njit(cache=True, error_model="numpy")
def largest_lean(bearing: NDArray[np.float64], pitch: float, roll: float) -> float:
    """How far a vertical leans in a camera of some tilt, where that is most (rad)."""
    largest = 0.0
    for c in range(0, len(bearing), _LEAN_SPACING):
        if math.isfinite(bearing[c]):
            lean = pitch * math.sin(bearing[c]) - roll * math.cos(bearing[c])
            largest = max(largest, abs(lean))
    return largest


@njit(cache=True, error_model="numpy")
def agreed_tilt(
    bearing: NDArray[np.float64],
    normal: NDArray[np.float64],
    inclination: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    weight: NDArray[np.float64],
    edge: NDArray[np.int64],
    stray_share: float,
    limits: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The tilt that most lines agree with, if they are enough.

    Parameters
    ----------
    bearing
        The table.
    normal, inclination, tolerance, weight
        The lines (see `weigh_verticals`).
    edge : (N,) int64
        The first line of the edge that each belongs to.
    stray_share
        See `detect.verticals.tilt.ConsensusSettings`.
    limits
        See `detect.verticals.judgement.limits_of`.

    Returns
    -------
    tilt : (`TILT_NUMBERS`,) float64
        See there; NaN where too few lines agree.
    agrees : (N,) bool
        Lines that agree with the best tilt, that of too few lines included.
    """
    pitch, roll, covariance, agrees = agree_on_tilt(
        normal, inclination, tolerance, weight, edge, int(limits[15]), limits[16], limits[17],
        limits[18], int(limits[19]), stray_share, limits[23],
    )  # fmt: skip
    lines = 0
    votes = 0.0
    total = 0.0
    for k in range(len(weight)):
        total += weight[k]
        if agrees[k]:
            lines += 1
            votes += weight[k]
    tilt = np.full(TILT_NUMBERS, np.nan)
    if lines >= limits[20] and abs(pitch) <= limits[16] and abs(roll) <= limits[16]:
        tilt[0] = pitch
        tilt[1] = roll
        tilt[2:6] = covariance.reshape(-1)
        tilt[6] = lines
        tilt[7] = votes / total
        tilt[8] = _largest_lean_deviation(bearing, covariance)
    return tilt, agrees


@njit(cache=True, error_model="numpy")
def fit_and_judge(
    image: NDArray[np.uint8],
    strip: NDArray[np.float32],
    elevation: NDArray[np.float32],
    bearing: NDArray[np.float64],
    anchor_row: NDArray[np.float64],
    row_aspect: float,
    polarity: NDArray[np.float64],
    bounds: NDArray[np.int64],
    row: NDArray[np.int32],
    column: NDArray[np.float64],
    score: NDArray[np.float32],
    half: NDArray[np.int64],
    begin_of: NDArray[np.int64],
    height_weights: NDArray[np.float32],
    derivatives: NDArray[np.float32],
    farthest: NDArray[np.float64],
    limits: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int8], NDArray[np.float64]]:
    """Fit lines to tracks, refine and judge them, and find the tilt that most of them agree with.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    strip, elevation
        See `detect.verticals.strip.Strip`: its columns and its rise.
    bearing, anchor_row, row_aspect
        The table (see `lut.verticals.VerticalTable`).
    polarity, bounds, row, column, score
        The tracks (see `detect.verticals.tracks.LineTracks`).
    half, begin_of, height_weights, derivatives
        Filters of the refinement (see `detect.verticals.fit_kernels.refine_lines`).
    farthest : (K,) float64
        How far its steps may go; of length 0 for none: the covariance is then that of independent
        points with the scatter that the track shows.
    limits : (25,) float64
        See `detect.verticals.judgement.limits_of`.

    Returns
    -------
    fits : (`FIT_NUMBERS` * T,) float64
        See `detect.verticals.fit.LineFits`.
    evidence : (T,) float64
        Of each track.
    fate : (T,) int8
        Of each track, that of lines that disagree with the others included.
    tilt : (`TILT_NUMBERS`,) float64
        See there; NaN where too few lines agree.
    """
    reference, pixel, line, scatter_px, middle, spread, rise, off = fit_eigenlines(
        bearing, elevation, bounds, row, column, score, int(limits[0]), limits[1]
    )
    count = len(reference)
    if len(farthest) > 0:
        line, covariance, shift_px, contrast, sharpness = refine_lines(
            image, strip, bearing, polarity, bounds, row, column, reference, pixel, middle,
            rise, off, half, begin_of, height_weights, derivatives, farthest,
            line,
        )  # fmt: skip
    else:
        covariance = np.empty((count, 2, 2))
        regression_covariance(covariance, scatter_px, pixel, bounds, middle, spread)
        shift_px = np.zeros(count)
        contrast = np.full(count, np.nan)
        sharpness = np.ones(count)
    evidence, fate = judge_tracks(
        bounds, row, column, score, anchor_row, row_aspect, pixel, line, covariance, scatter_px,
        shift_px, contrast, sharpness, int(limits[0]), limits[2], limits[3], limits[4], limits[5],
        limits[6], limits[7], limits[8],
    )  # fmt: skip
    accepted, normal, inclination, tolerance, weight = weigh_verticals(
        reference, pixel, line, covariance, spread, evidence, fate, limits[14], limits[9],
        limits[21], limits[10], limits[11], limits[12], limits[13],
    )  # fmt: skip
    edge = share_edges(
        reference, pixel, line, polarity, evidence, accepted, limits[24], inclination, weight
    )
    tilt, agrees = agreed_tilt(
        bearing, normal, inclination, tolerance, weight, edge, limits[22], limits
    )
    sure = not np.isnan(tilt[0])
    for k in range(len(accepted)):
        if not (agrees[k] if sure else abs(normal[k, 2]) <= tolerance[k]):
            fate[accepted[k]] = NOT_VERTICAL

    fits = np.empty(FIT_NUMBERS * count)
    fits[:count] = reference
    fits[count : 2 * count] = pixel
    fits[2 * count : 4 * count] = line.reshape(-1)
    fits[4 * count : 8 * count] = covariance.reshape(-1)
    fits[8 * count : 9 * count] = scatter_px
    fits[9 * count : 10 * count] = shift_px
    fits[10 * count : 11 * count] = spread
    fits[11 * count : 12 * count] = contrast
    fits[12 * count :] = sharpness
    return fits, evidence, fate, tilt


@njit(cache=True, error_model="numpy")
def lines_of_tracks(
    bearing: NDArray[np.float64],
    elevation_tan: NDArray[np.float32],
    robot_from_camera: NDArray[np.float64],
    polarity: NDArray[np.float64],
    bounds: NDArray[np.int64],
    row: NDArray[np.int32],
    column: NDArray[np.float64],
    fits: NDArray[np.float64],
    evidence: NDArray[np.float64],
    fate: NDArray[np.int8],
    pitch: float,
    roll: float,
    turn: float,
    building: float,
    grouping: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Lines of accepted tracks: one for each edge, close ones joined.

    Parameters
    ----------
    bearing, elevation_tan, robot_from_camera
        The table (see `lut.verticals.VerticalTable`).
    polarity, bounds, row, column
        The tracks (see `detect.verticals.tracks.LineTracks`).
    fits, evidence, fate
        See `fit_and_judge`; the fate of tracks that are left out or joined is changed.
    pitch, roll : float
        The tilt under which lines are seen (rad); 0 for none.
    turn : float
        1 to undo the tilt, -1 to apply it once more.
    building
        See `turned_bearings`.
    grouping : (7,) float64
        See `detect.verticals.judgement.grouping_of`.

    Returns
    -------
    members : (M,) int64
        Tracks, line by line from the left; the strongest of each line first.
    member_bounds : (N + 1,) int64
        Line n's members are ``member_bounds[n] : member_bounds[n + 1]``.
    lines : (8, N) float64
        Ends (see `ends_of_lines`), bearings, inclinations, standard deviations of the bearings and
        the part of them due to noise, each in a row.
    """
    count = len(evidence)
    reference = fits[:count]
    pixel = fits[count : 2 * count]
    line = fits[2 * count : 4 * count].reshape((count, 2))
    covariance = fits[4 * count : 8 * count].reshape((count, 2, 2))
    contrast = fits[11 * count : 12 * count]
    rotation = level_matrix(turn * pitch, turn * roll)
    alpha, noise = turned_bearings(reference, line, covariance, rotation, pitch, roll, building)
    members, member_bounds = group_tracks(
        alpha, pixel, contrast, polarity, evidence, fate, grouping[0], grouping[1], grouping[2],
        grouping[3], grouping[4],
    )  # fmt: skip
    equal = grouping[6] != 0.0
    weight = np.ones(count) if equal else evidence
    joined, sigma = join_tracks(alpha, noise, pixel, weight, members, member_bounds, grouping[5])
    strongest = members[member_bounds[:-1]]
    ends, beta = ends_of_lines(
        bearing, elevation_tan, robot_from_camera, bounds, row, column, reference, line, members
    )
    for n in range(len(strongest)):
        # The first member of a line is its strongest.
        first, last = member_bounds[n], member_bounds[n + 1]
        last = last if equal else first + 1
        for k in range(4):
            ends[n, k] = ends[first:last, k].mean()
        beta[n] = beta[first:last].mean()
    lines = np.empty((8, len(strongest)))
    for n in range(len(strongest)):
        for k in range(4):
            lines[k, n] = ends[n, k]
        lines[4, n] = joined[n]
        lines[5, n] = beta[n]
        lines[6, n] = sigma[n]
        lines[7, n] = noise[strongest[n]]
    return members, member_bounds, lines
