"""Detected discs held against reference rows of the same run.

Frames are matched by the names of their images; in each, detected rows are paired with reference
rows one to one within a gate. What is left over on either side is missed or extra.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from math import inf, isfinite
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from detect.comparison.figures import fraction, normalised_error, quantile
from detect.comparison.pairing import FrameMatch, match_rows, pair_frames, shown_name
from detect.comparison.result import (
    CompareError,
    CompareOptions,
    Comparison,
    DistanceBin,
    ErrorCovariance,
    FrameScore,
    NormalisedError,
)
from detect.runs.image_names import image_name
from landmarks import (
    Association,
    CircleLandmark,
    Frame,
    associate_positions,
    associate_within_covariance,
    circle_arrays,
    is_positive_definite,
    read_frames,
    squared_mahalanobis,
)

__all__ = ["DISTANCE_EDGES_M", "compare_frames", "compare_runs", "image_name", "pair_discs"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# The forward distances for which the data set's own qualities are known.
DISTANCE_EDGES_M = (0.8, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)


def compare_runs(
    run: str | os.PathLike[str],
    *,
    reference: str | os.PathLike[str] | None = None,
    detected: str | os.PathLike[str] | None = None,
    options: CompareOptions | None = None,
) -> Comparison:
    """Compare a run's detected discs with its reference rows.

    Parameters
    ----------
    run : path
        The run's folder.
    reference, detected : path, optional
        By default ``map.circles`` and ``detected.circles`` in that folder.
    options : CompareOptions, optional
        What counts as the same disc, and which rows count.

    Returns
    -------
    Comparison
        The figures.

    Raises
    ------
    landmarks.LandmarkFileError
        If a file cannot be read.
    CompareError
        If a frame occurs twice in a file, or the gate needs a reference row's covariance and that
        is not positive definite.
    """
    reference = Path(run) / "map.circles" if reference is None else reference
    detected = Path(run) / "detected.circles" if detected is None else detected
    return compare_frames(
        read_frames(reference),
        read_frames(detected),
        options or CompareOptions(),
        reference_name=os.fspath(reference),
        detected_name=os.fspath(detected),
    )


def compare_frames(
    reference: Iterable[Frame],
    detected: Iterable[Frame],
    options: CompareOptions,
    *,
    reference_name: str = "reference",
    detected_name: str = "detected",
) -> Comparison:
    """Compare the discs of two sets of frames; the names stand for them in errors and reports.

    See `compare_runs`.
    """
    paired = pair_frames(
        reference,
        detected,
        lambda frame: frame.circles,
        all_frames=options.all_frames,
        reference_name=reference_name,
        detected_name=detected_name,
    )
    matches = [_match_frame(*frame, options) for frame in paired.frames]
    wanted = _pool([(match.reference, match.pairs.first) for match in matches])
    found = _pool([(match.detected, match.pairs.second) for match in matches])
    offset_xy = found.xy[found.paired] - wanted.xy[wanted.paired]
    error_m = np.asarray(np.linalg.norm(offset_xy, axis=1), dtype=np.float64)
    return Comparison(
        reference_name=reference_name,
        detected_name=detected_name,
        options=options,
        reference=len(wanted.xy),
        detected=len(found.xy),
        matched=len(error_m),
        set_aside=sum(match.set_aside for match in matches),
        recall=_mean(wanted.is_paired),
        precision=_mean(found.is_paired),
        error_median_m=quantile(error_m, 0.5),
        error_95_m=quantile(error_m, 0.95),
        normalised_error=_normalised_error(
            offset_xy, _error_covariance(wanted, found, options.error_covariance)
        ),
        reference_quality_matched=quantile(wanted.quality[wanted.is_paired], 0.5),
        reference_quality_missed=quantile(wanted.quality[~wanted.is_paired], 0.5),
        detected_quality_matched=quantile(found.quality[found.is_paired], 0.5),
        detected_quality_extra=quantile(found.quality[~found.is_paired], 0.5),
        bins=tuple(
            _distance_bin(from_m, to_m, wanted, found, error_m)
            for from_m, to_m in pairwise((-inf, *DISTANCE_EDGES_M, inf))
        ),
        frames=_frame_scores(matches, error_m),
        frames_only_in_reference=paired.only_in_reference,
        frames_only_in_detected=paired.only_in_detected,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Pool:
    """All rows of one side that count; `paired` are those in pairs, in the order of the pairs."""

    xy: FloatArray
    quality: FloatArray
    covariance: FloatArray
    paired: NDArray[np.intp]
    is_paired: BoolArray


def _match_frame(
    name: str,
    reference: Sequence[CircleLandmark],
    detected: Sequence[CircleLandmark],
    options: CompareOptions,
) -> FrameMatch[CircleLandmark]:
    measurable = is_positive_definite(circle_arrays(reference).covariance)
    if options.sigma is not None and not measurable.all():
        raise CompareError(
            f"frame {shown_name(name)}: a reference row's covariance is not positive definite: "
            "expected one to measure sigmas in; a gate in metres needs none"
        )
    return match_rows(
        name,
        reference,
        detected,
        lambda some, others: pair_discs(some, others, options),
        only_identified=options.only_identified,
    )


def pair_discs(
    reference: Sequence[CircleLandmark], detected: Sequence[CircleLandmark], options: CompareOptions
) -> Association:
    """Pair discs one to one.

    Parameters
    ----------
    reference, detected : sequence of CircleLandmark
        Rows of one frame.
    options : CompareOptions
        The gate.

    Returns
    -------
    Association
        As many pairs of reference (first) and detected rows (second) as possible, and of those with
        the least sum of squared distances.
    """
    first, second = circle_arrays(reference), circle_arrays(detected)
    if options.sigma is None:
        return associate_positions(first.xy, second.xy, gate_m=options.gate_m)
    return associate_within_covariance(
        first.xy, second.xy, first.covariance, gate_sigma=options.sigma
    )


def _pool(frames: Sequence[tuple[Sequence[CircleLandmark], NDArray[np.intp]]]) -> _Pool:
    arrays = circle_arrays([row for rows, _ in frames for row in rows])
    starts = accumulate((len(rows) for rows, _ in frames), initial=0)
    paired = np.array(
        [start + i for start, (_, indices) in zip(starts, frames) for i in indices], dtype=np.intp
    )
    is_paired = np.zeros(len(arrays.xy), dtype=np.bool_)
    is_paired[paired] = True
    return _Pool(arrays.xy, arrays.quality, arrays.covariance, paired, is_paired)


def _error_covariance(wanted: _Pool, found: _Pool, source: ErrorCovariance) -> FloatArray:
    if source == "detected":
        return found.covariance[found.paired]
    if source == "reference":
        return wanted.covariance[wanted.paired]
    return wanted.covariance[wanted.paired] + found.covariance[found.paired]


def _normalised_error(offset_xy: FloatArray, covariance: FloatArray) -> NormalisedError:
    usable = is_positive_definite(covariance)
    return normalised_error(
        squared_mahalanobis(offset_xy[usable], covariance[usable]),
        dof_per_row=2,
        left_out=int((~usable).sum()),
    )


def _distance_bin(
    from_m: float, to_m: float, wanted: _Pool, found: _Pool, error_m: FloatArray
) -> DistanceBin:
    wanted_here, found_here = (
        (from_m <= -pool.xy[:, 1]) & (-pool.xy[:, 1] < to_m) for pool in (wanted, found)
    )
    return DistanceBin(
        from_m=from_m if isfinite(from_m) else None,
        to_m=to_m if isfinite(to_m) else None,
        reference=int(wanted_here.sum()),
        missed=int((wanted_here & ~wanted.is_paired).sum()),
        detected=int(found_here.sum()),
        extra=int((found_here & ~found.is_paired).sum()),
        recall=_mean(wanted.is_paired[wanted_here]),
        precision=_mean(found.is_paired[found_here]),
        reference_quality_median=quantile(wanted.quality[wanted_here], 0.5),
        detected_quality_median=quantile(found.quality[found_here], 0.5),
        error_median_m=quantile(error_m[wanted_here[wanted.paired]], 0.5),
    )


def _frame_scores(
    matches: Sequence[FrameMatch[CircleLandmark]], error_m: FloatArray
) -> tuple[FrameScore, ...]:
    ends = list(accumulate(len(match.pairs.first) for match in matches))
    return tuple(
        FrameScore(
            name=match.name,
            matched=len(match.pairs.first),
            missed=len(match.pairs.first_alone),
            extra=len(match.pairs.second_alone),
            largest_error_m=quantile(error_m[end - len(match.pairs.first) : end], 1.0),
        )
        for match, end in zip(matches, ends)
    )


def _mean(mask: BoolArray) -> float | None:
    return fraction(int(mask.sum()), len(mask))
