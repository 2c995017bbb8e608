"""From tracks with fitted lines to verticals: judged by themselves, by each other, and joined."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.verticals.fit import LineFits
from detect.verticals.step_filters import StepFilters, step_filters
from detect.verticals.strip import strip_of
from detect.verticals.tilt import REFINEMENTS, SOFTENING, STRAY_RAD, TiltEstimate, tilt_of_numbers
from detect.verticals.tracks import LineTracks
from lut.verticals import VerticalTable

FloatArray = NDArray[np.float64]
FateArray = NDArray[np.int8]

ACCEPTED = "accepted"
JOINED = "joined"

#: What can become of a track, in the order of the numbers in `detect.verticals.judgement_kernels`:
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


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """Lines through tracks, and what they are.

    Attributes
    ----------
    fits : LineFits
        A line for each track; those too short or too faint to be lines have none.
    evidence : (T,) float64
        Response summed over the track's length in pixel widths, weakened by the square of its
        sharpness: soft edges are shadows and glare more often than the building's.
    fate : (T,) int8
        Places in `FATES`.
    tilt : TiltEstimate or None
        That most lines agree with; None where too few do.
    votes : float
        Part of all votes that is for that tilt; NaN for none.
    lean_deviation_rad : float
        Standard deviation, due to that of the tilt, of the lean that verticals should show, where
        in the image it is largest; NaN for none.
    """

    fits: LineFits
    evidence: FloatArray
    fate: FateArray
    tilt: TiltEstimate | None
    votes: float
    lean_deviation_rad: float


def judge_tracks(
    image: NDArray[np.uint8],
    tracks: LineTracks,
    table: VerticalTable,
    settings: LineSettings,
    *,
    steps: int | None = None,
) -> Judgement:
    """Fit lines to tracks, judge them one by one, and let them agree on a tilt.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values, in scan order.
    tracks : LineTracks
        The tracks.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        See there.
    steps : int, optional
        Only so many of the settings' steps refine lines on the grey values.

    Returns
    -------
    Judgement
        Lines that disagree with the tilt are "not vertical".
    """
    from detect.verticals.pass_kernels import fit_and_judge

    filters, farthest = refinement_of(settings, steps)
    strip = strip_of(table)
    fits, evidence, fate, tilt = fit_and_judge(
        image, strip.column, strip.rise, table.bearing_rad, table.anchor_row,
        table.row_aspect, tracks.polarity, tracks.bounds, tracks.row, tracks.column, tracks.score,
        filters.half, filters.begin, filters.height, filters.derivatives, farthest,
        limits_of(settings, table.row_aspect),
    )  # fmt: skip
    votes, deviation = tilt[-2:].tolist()
    return Judgement(LineFits(fits), evidence, fate, tilt_of_numbers(tilt), votes, deviation)


@lru_cache(maxsize=16)
def refinement_of(
    settings: LineSettings, steps: int | None = None
) -> tuple[StepFilters, FloatArray]:
    """Filters of the refinement's first steps and of the two contrasts; how far a step may go."""
    scales = [scale for scale, _ in settings.refine_steps_px[:steps]]
    farthest = [distance for _, distance in settings.refine_steps_px[:steps]]
    filters = step_filters((*scales, settings.fine_scale_px, settings.coarse_scale_px))
    return filters, np.array(farthest, np.float64)


@lru_cache(maxsize=16)
def limits_of(settings: LineSettings, row_aspect: float) -> FloatArray:
    """What tracks are judged by, as numbers in the order in which compiled code takes them."""
    consensus = settings.consensus
    return np.array(
        [
            settings.least_points(row_aspect),
            settings.least_evidence / row_aspect,
            settings.least_evidence,
            settings.largest_shift_px,
            settings.largest_scatter_px,
            settings.largest_horizon_gap_px,
            settings.largest_noise_px,
            settings.least_sharpness,
            settings.soft_evidence,
            settings.bend_px,
            math.radians(settings.largest_lean_deg),
            settings.largest_lean_sigmas,
            settings.largest_lean_px,
            settings.weight_limit,
            consensus.building_rad**2,
            consensus.proposers,
            consensus.largest_rad,
            consensus.prior_rad,
            SOFTENING,
            REFINEMENTS,
            consensus.least_lines,
            settings.lean_noise,
            consensus.stray_share,
            STRAY_RAD,
            settings.same_edge_px,
        ],
        np.float64,
    )


@lru_cache(maxsize=16)
def grouping_of(settings: LineSettings) -> FloatArray:
    """What lines are gathered by, as `limits_of`."""
    return np.array(
        [
            settings.same_edge_px,
            settings.join_px,
            settings.join_share,
            settings.shoulder_px,
            settings.shoulder_share,
            settings.sigma_px,
            1.0 if settings.joined == "equal" else 0.0,
        ],
        np.float64,
    )
