"""From tracks with fitted lines to verticals: judged by themselves, by each other, and joined."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from detect.line_fit import LineFits
from detect.line_settings import LineSettings
from detect.line_tracks import LineTracks
from detect.tilt import TiltEstimate, consensus, level_rotation
from lut.verticals import VerticalTable

FloatArray = NDArray[np.float64]
FateArray = NDArray[np.int8]

ACCEPTED = "accepted"
JOINED = "joined"

#: What can become of a track, in the order of the numbers in `detect.line_judgement_kernels`:
#: a line of its own, joined to a stronger one, or the reason why it is none.
FATES = (
    ACCEPTED,
    JOINED,
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
_NOT_VERTICAL = FATES.index("not vertical")


def judge_lines(
    tracks: LineTracks, fits: LineFits, table: VerticalTable, settings: LineSettings
) -> tuple[FloatArray, FateArray]:
    """Tell for each track what speaks for it, and whether it can be a vertical, by itself.

    Returns
    -------
    evidence : (T,) float64
        Response summed over the track's length in pixel widths, weakened by the square of its
        sharpness: soft edges are shadows and glare more often than the building's.
    fate : (T,) int8
        Places in `FATES`.
    """
    from detect.line_judgement_kernels import judge_tracks

    evidence, fate = judge_tracks(
        tracks.bounds, tracks.row, tracks.column, tracks.score, table.horizon_row,
        table.row_aspect, fits.pixel_rad, fits.line, fits.covariance, fits.scatter_px,
        fits.shift_px, fits.contrast, fits.sharpness, settings.least_points(table.row_aspect),
        settings.least_evidence, settings.largest_shift_px, settings.largest_scatter_px,
        settings.largest_horizon_gap_px, settings.largest_noise_px, settings.least_sharpness,
        settings.soft_evidence,
    )  # fmt: skip
    return evidence, fate


def agree_on_tilt(
    fits: LineFits, evidence: FloatArray, fate: FateArray, settings: LineSettings
) -> TiltEstimate | None:
    """Estimate the tilt from the accepted lines; those that disagree are marked "not vertical"."""
    from detect.line_judgement_kernels import weigh_verticals

    accepted, normal, variance, tolerance, weight = weigh_verticals(
        fits.reference_rad, fits.pixel_rad, fits.line, fits.covariance, fits.spread, evidence, fate,
        settings.bend_px, math.radians(settings.largest_lean_deg), settings.largest_lean_sigmas,
        settings.largest_lean_px, settings.weight_limit,
    )  # fmt: skip
    tilt, consistent = consensus(normal, variance, tolerance, weight, settings.consensus)
    fate[accepted[~consistent]] = _NOT_VERTICAL
    return tilt


def line_bearings(
    fits: LineFits, tilt: TiltEstimate | None, settings: LineSettings
) -> tuple[FloatArray, FloatArray]:
    """(T,) bearings of lines in the settings' convention, and their noise (rad).

    Level bearings take into account that verticals lean as the tilt says.
    """
    from detect.line_bearing_kernels import turned_bearings

    pitch, roll = (tilt.pitch_rad, tilt.roll_rad) if tilt is not None else (0.0, 0.0)
    level = settings.alpha == "level"
    rotation = level_rotation(pitch, roll) if level else level_rotation(-pitch, -roll)
    building = settings.consensus.building_rad if tilt is not None and level else math.inf
    alpha, noise = turned_bearings(
        fits.reference_rad, fits.line, fits.covariance, rotation, pitch, roll, building
    )
    return alpha, noise


def group_lines(
    alpha: FloatArray,
    tracks: LineTracks,
    fits: LineFits,
    evidence: FloatArray,
    fate: FateArray,
    settings: LineSettings,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Gather tracks to lines: one for each edge, close ones together.

    Tracks that are left out or joined are marked so in `fate`.

    Returns
    -------
    members : (M,) int64
        Tracks, line by line from the left, the strongest of each line first.
    bounds : (N + 1,) int64
        Line n's members are ``bounds[n] : bounds[n + 1]``.
    """
    from detect.line_judgement_kernels import group_tracks

    members, bounds = group_tracks(
        alpha, fits.pixel_rad, fits.contrast, tracks.polarity, evidence, fate,
        settings.same_edge_px, settings.join_px, settings.join_share, settings.shoulder_px,
        settings.shoulder_share,
    )  # fmt: skip
    return members, bounds
