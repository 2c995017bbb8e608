"""The path of one image from grey values to lines, in one call.

Each array that a compiled function takes from Python or returns costs as much as the work on a line
or two.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.verticals.blur import median_sharpness
from detect.verticals.chain_kernels import tilt_of_chains
from detect.verticals.detections import COUNTS
from detect.verticals.follow_kernels import follow_edges
from detect.verticals.pass_kernels import fit_and_judge, largest_lean, lines_of_tracks
from detect.verticals.response_kernels import band_response
from detect.verticals.start_kernels import find_maxima, ordered_starts
from detect.verticals.tilt import TILT_NUMBERS


@njit(cache=True, error_model="numpy")
def find_lines(
    image: NDArray[np.uint8],
    pixels: NDArray[np.uint8],
    elevation_tan: NDArray[np.float32],
    bearing: NDArray[np.float64],
    anchor_row: NDArray[np.float64],
    first_row: NDArray[np.int32],
    last_row: NDArray[np.int32],
    robot_from_camera: NDArray[np.float64],
    strip: NDArray[np.float32],
    ends: NDArray[np.int32],
    rise: NDArray[np.float32],
    lean_by_pitch: NDArray[np.float64],
    lean_by_roll: NDArray[np.float64],
    band_row: NDArray[np.int32],
    band_pixel: NDArray[np.int32],
    band_runs: NDArray[np.int32],
    band_lengths: NDArray[np.uint8],
    band_odd: NDArray[np.int32],
    band_odd_bounds: NDArray[np.int32],
    band_part: NDArray[np.float32],
    band_scale: NDArray[np.float32],
    band_visible: NDArray[np.bool_],
    band_weights: NDArray[np.float32],
    weights: NDArray[np.float32],
    along: NDArray[np.float32],
    half: NDArray[np.int64],
    begin_of: NDArray[np.int64],
    height_weights: NDArray[np.float32],
    derivatives: NDArray[np.float32],
    farthest: NDArray[np.float64],
    few_half: NDArray[np.int64],
    few_begin_of: NDArray[np.int64],
    few_farthest: NDArray[np.float64],
    following: NDArray[np.float64],
    limits: NDArray[np.float64],
    doubt: NDArray[np.float64],
    grouping: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Find the building's verticals in an image.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    pixels : (N,) uint8
        See `detect.verticals.follow_kernels.follow_edges`.
    elevation_tan, bearing, anchor_row, first_row, last_row, robot_from_camera
        The table (see `lut.verticals.VerticalTable`).
    strip, ends, rise, lean_by_pitch, lean_by_roll
        See `detect.verticals.strip.Strip`.
    band_row, band_pixel, band_runs, band_lengths, band_odd, band_odd_bounds, band_part, band_scale,
    band_visible, band_weights
        See `detect.verticals.filter.StartBand`.
    weights, along
        See `detect.verticals.filter.LineFilter`.
    half, begin_of, height_weights, derivatives
        Filters of the refinement (see `detect.verticals.step_filters.StepFilters`).
    farthest
        How far its steps may go (see `fit_and_judge`).
    few_half, few_begin_of, few_farthest
        The same for the few edges that are followed first.
    following, limits, doubt, grouping : float64
        Settings as numbers (see `detect.verticals.judgement`); `doubt` is that about the tilt of a
        few edges, that about the tilt of the band (see `beyond_doubt`), and how far the lean of
        edges may come out different from that of the band before they are followed once more (rad).

    Returns
    -------
    (K,) float64
        See `detect.verticals.detections.LineDetections`.
    """
    response = np.empty(band_row.shape, np.float32)
    regulariser = np.float32(following[0])
    band_response(
        image, band_pixel, band_runs, band_lengths, band_odd, band_odd_bounds, band_part,
        band_scale, band_visible, int(following[1]), band_weights, along, regulariser, response,
    )  # fmt: skip
    threshold = following[2]
    level, start_column, start_sign = find_maxima(
        response, band_row, threshold, following[13] != 0.0
    )
    guided = following[9] != 0.0
    first_edges = int(following[10])
    tilt = np.full(TILT_NUMBERS, np.nan)
    # Of images full of maxima everywhere the band tells nothing.
    if guided and first_edges > 0 and following[14] != 0.0 and len(level) <= image.shape[1]:
        tilt = tilt_of_chains(
            response, band_row, level, start_column, start_sign, bearing, rise, limits
        )
    start_row, start_column, start_sign, _ = ordered_starts(
        response, band_row, level, start_column, start_sign
    )

    groups = len(ends)
    responses = np.empty(len(strip), np.float32)
    known = np.zeros((groups, 2), np.int32)
    half_width = int(following[3])
    max_gap = int(following[4])
    border = int(following[5])
    row_aspect = following[6]
    least_points = int(limits[0])
    least_score = limits[1]
    every = len(start_row) + 1
    enough = first_edges if guided and first_edges > 0 else every
    pitch, roll = 0.0, 0.0
    # All by the tilt of the band, if that leaves no doubt about it, and once more if they show
    # another one. Else a few edges, if they leave none; else all; then all by their tilt.
    by_tilt = beyond_doubt(tilt, doubt[3:])
    times = 0
    most = 2 if by_tilt else 1
    while True:
        pull, reach = 1.0, 1.0
        if by_tilt:
            pitch, roll = tilt[0], tilt[1]
            pull, reach = following[7], following[8]
            enough = every
            times += 1
        polarity, bounds, row, column, score, complete = follow_edges(
            pixels, strip, ends, lean_by_pitch, lean_by_roll, first_row, last_row, rise,
            weights, half_width, along, regulariser, responses, known, start_row, start_column,
            start_sign, pitch, roll, threshold, max_gap, border, pull, reach, enough, least_points,
            least_score,
        )  # fmt: skip
        few = not complete
        fits, evidence, fate, tilt = fit_and_judge(
            image, strip, rise, bearing, anchor_row, row_aspect, polarity, bounds, row, column,
            score, few_half if few else half, few_begin_of if few else begin_of, height_weights,
            derivatives, few_farthest if few else farthest, limits,
        )  # fmt: skip
        sharpness = median_sharpness(fits)
        if sharpness < following[15]:
            # All of it will be done again with wider filters.
            break
        enough = every
        if few and not beyond_doubt(tilt, doubt):
            continue
        if not guided or np.isnan(tilt[0]) or times == most:
            break
        if by_tilt and largest_lean(bearing, tilt[0] - pitch, tilt[1] - roll) <= doubt[6]:
            break
        by_tilt = True

    tilted = not np.isnan(tilt[0])
    members, member_bounds, lines = lines_of_tracks(
        bearing, elevation_tan, robot_from_camera, polarity, bounds, row, column, fits, evidence,
        fate, tilt[0] if tilted else 0.0, tilt[1] if tilted else 0.0, following[11],
        following[12] if tilted else np.inf, grouping,
    )  # fmt: skip
    return _together(
        polarity, bounds, row, column, score, fits, evidence, fate, tilt, members, member_bounds,
        lines, sharpness,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def beyond_doubt(tilt: NDArray[np.float64], doubt: NDArray[np.float64]) -> bool:
    """Whether a tilt that a few edges tell is good enough to follow all of them by.

    Parameters
    ----------
    tilt : (`TILT_NUMBERS`,) float64
        See `fit_and_judge`.
    doubt : (N,) float64
        Least lines that agree and least share of the votes; largest deviation of the lean (rad).
    """
    return bool(tilt[6] >= doubt[0] and tilt[7] >= doubt[1] and tilt[8] <= doubt[2])


@njit(cache=True, error_model="numpy")
def _put(numbers: NDArray[np.float64], at: int, values: NDArray[np.float64]) -> int:
    """Copy values to an index; return the one behind them."""
    for i in range(len(values)):
        numbers[at + i] = values[i]
    return at + len(values)


@njit(cache=True, error_model="numpy")
def _together(
    polarity: NDArray[np.float64],
    bounds: NDArray[np.int64],
    row: NDArray[np.int32],
    column: NDArray[np.float64],
    score: NDArray[np.float32],
    fits: NDArray[np.float64],
    evidence: NDArray[np.float64],
    fate: NDArray[np.int8],
    tilt: NDArray[np.float64],
    members: NDArray[np.int64],
    member_bounds: NDArray[np.int64],
    lines: NDArray[np.float64],
    sharpness: float,
) -> NDArray[np.float64]:
    tracks, points = len(polarity), len(row)
    total = (
        COUNTS + len(tilt) + 4 * tracks + 1 + len(fits) + 3 * points
        + len(members) + len(member_bounds) + lines.size + 1
    )  # fmt: skip
    numbers = np.empty(total)
    numbers[0] = tracks
    numbers[1] = points
    numbers[2] = lines.shape[1]
    numbers[3] = len(members)
    at = _put(numbers, COUNTS, tilt)
    at = _put(numbers, at, lines.reshape(-1))
    for n in range(len(members)):
        numbers[at + n] = members[n]
    at += len(members)
    for n in range(len(member_bounds)):
        numbers[at + n] = member_bounds[n]
    at += len(member_bounds)
    at = _put(numbers, at, evidence)
    for t in range(tracks):
        numbers[at + t] = fate[t]
    at += tracks
    at = _put(numbers, at, fits)
    at = _put(numbers, at, polarity)
    for t in range(tracks + 1):
        numbers[at + t] = bounds[t]
    at += tracks + 1
    for i in range(points):
        numbers[at + i] = row[i]
        numbers[at + points + i] = column[i]
        numbers[at + 2 * points + i] = score[i]
    numbers[total - 1] = sharpness
    return numbers
