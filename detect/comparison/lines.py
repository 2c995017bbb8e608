"""Compares detected lines with reference rows of the same run.

Frames are matched by the names of their images; in each, detected rows are paired with reference
rows one to one by bearing. A detected row can represent several lines that were joined; unpaired
reference rows within its sigma count as found, too. The remaining rows on either side are missed or
extra.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from itertools import accumulate
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from detect.comparison.figures import fraction, normalised_error, quantile
from detect.comparison.pairing import FrameMatch, match_rows, pair_frames
from detect.comparison.result import LineCompareOptions, LineComparison, LineFrameScore
from landmarks import Association, Frame, LineLandmark, associate, read_frames, wrap_angle

FloatArray = NDArray[np.float64]
LineMatch = FrameMatch[LineLandmark]

# Files hold six digits: a smaller sigma is no statement about a bearing.
_LEAST_SIGMA_RAD = 1e-12


def compare_line_runs(
    run: str | os.PathLike[str],
    *,
    reference: str | os.PathLike[str] | None = None,
    detected: str | os.PathLike[str] | None = None,
    options: LineCompareOptions | None = None,
) -> LineComparison:
    """Compare a run's detected lines with its reference rows.

    Parameters
    ----------
    run : path
        The run's folder.
    reference, detected : path, optional
        By default ``map.lines`` and ``detected.lines`` in that folder.
    options : LineCompareOptions, optional
        What counts as the same line, and which rows count.

    Returns
    -------
    LineComparison
        The figures.

    Raises
    ------
    landmarks.LandmarkFileError
        If a file cannot be read.
    CompareError
        If an image has two frames in a file.
    """
    reference = Path(run) / "map.lines" if reference is None else reference
    detected = Path(run) / "detected.lines" if detected is None else detected
    return compare_line_frames(
        read_frames(reference),
        read_frames(detected),
        options or LineCompareOptions(),
        reference_name=os.fspath(reference),
        detected_name=os.fspath(detected),
    )


def compare_line_frames(
    reference: Iterable[Frame],
    detected: Iterable[Frame],
    options: LineCompareOptions,
    *,
    reference_name: str = "reference",
    detected_name: str = "detected",
) -> LineComparison:
    """Compare the lines of two sets of frames; errors and reports use their names.

    See `compare_line_runs`.
    """
    paired = pair_frames(
        reference,
        detected,
        lambda frame: frame.lines,
        all_frames=options.all_frames,
        reference_name=reference_name,
        detected_name=detected_name,
    )
    matches = [
        match_rows(
            name,
            _in_fixed_order(wanted),
            _in_fixed_order(found),
            lambda some, others: pair_lines(some, others, options),
            only_identified=options.only_identified,
        )
        for name, wanted, found in paired.frames
    ]
    joined = [_count_joined(match, options) for match in matches]
    first = [match.reference[i] for match in matches for i in match.pairs.first]
    second = [match.detected[i] for match in matches for i in match.pairs.second]
    error_rad = wrap_angle(_numbers(second, "alpha") - _numbers(first, "alpha"))
    error_deg = np.degrees(np.abs(error_rad))
    sigma_rad = _numbers(second, "sigma")
    stated = sigma_rad >= _LEAST_SIGMA_RAD
    wanted_count = sum(len(match.reference) for match in matches)
    found_count = sum(len(match.detected) for match in matches)
    return LineComparison(
        reference_name=reference_name,
        detected_name=detected_name,
        options=options,
        reference=wanted_count,
        detected=found_count,
        matched=len(first),
        joined=sum(joined),
        set_aside=sum(match.set_aside for match in matches),
        recall=fraction(len(first) + sum(joined), wanted_count),
        precision=fraction(len(second), found_count),
        bearing_median_deg=quantile(error_deg, 0.5),
        bearing_95_deg=quantile(error_deg, 0.95),
        normalised_error=normalised_error(
            (error_rad[stated] / sigma_rad[stated]) ** 2,
            dof_per_row=1,
            left_out=int((~stated).sum()),
        ),
        ends_median=quantile(_end_distances(first, second), 0.5),
        beta_median_deg=quantile(
            np.degrees(np.abs(_numbers(second, "beta") - _numbers(first, "beta"))), 0.5
        ),
        frames=_frame_scores(matches, joined, error_deg),
        frames_only_in_reference=paired.only_in_reference,
        frames_only_in_detected=paired.only_in_detected,
    )


def pair_lines(
    reference: Sequence[LineLandmark],
    detected: Sequence[LineLandmark],
    options: LineCompareOptions,
) -> Association:
    """Pair lines one to one by bearing.

    Parameters
    ----------
    reference, detected : sequence of LineLandmark
        Rows of one frame.
    options : LineCompareOptions
        The gate: the larger of the tolerance and a multiple of the detected row's sigma.

    Returns
    -------
    Association
        As many pairs of reference (first) and detected rows (second) as possible, and of those with
        the least sum of squared differences in bearing.
    """
    difference = _differences(reference, detected)
    reach = _numbers(detected, "sigma") * options.sigmas
    gate = np.maximum(np.radians(options.tolerance_deg), reach)
    return associate(difference**2, np.abs(difference) <= gate)


def _in_fixed_order(rows: Sequence[LineLandmark]) -> list[LineLandmark]:
    """Sort rows, so that equally good pairs do not depend on the file's order."""
    return sorted(
        rows,
        key=lambda r: (r.alpha, r.sigma, r.beta, r.xtop, r.ytop, r.xbottom, r.ybottom, r.ids),
    )


def _count_joined(match: LineMatch, options: LineCompareOptions) -> int:
    """Count the unpaired reference rows within the sigmas of a paired detected row."""
    left = [match.reference[i] for i in match.pairs.first_alone]
    paired = [match.detected[i] for i in match.pairs.second]
    return int(joined_lines(left, paired, options).sum())


def joined_lines(
    left: Sequence[LineLandmark], paired: Sequence[LineLandmark], options: LineCompareOptions
) -> NDArray[np.bool_]:
    """Which reference rows count as found through another row's match.

    Parameters
    ----------
    left : sequence of LineLandmark
        Reference rows of a frame without a pair.
    paired : sequence of LineLandmark
        Its detected rows that are in pairs.
    options : LineCompareOptions
        Within how many of their sigmas.

    Returns
    -------
    (N,) bool
        For each of `left`.
    """
    reach = _numbers(paired, "sigma") * options.sigmas
    return np.asarray((np.abs(_differences(left, paired)) <= reach).any(axis=1))


def _differences(reference: Sequence[LineLandmark], detected: Sequence[LineLandmark]) -> FloatArray:
    """(N, M) bearings of detected rows less those of reference rows (rad)."""
    return wrap_angle(_numbers(detected, "alpha") - _numbers(reference, "alpha")[:, np.newaxis])


def _end_distances(first: Sequence[LineLandmark], second: Sequence[LineLandmark]) -> FloatArray:
    """(2 M,) distances between the top ends of M pairs of rows, then the bottom ends."""
    return np.concatenate(
        [
            np.hypot(
                _numbers(second, x) - _numbers(first, x), _numbers(second, y) - _numbers(first, y)
            )
            for x, y in (("xtop", "ytop"), ("xbottom", "ybottom"))
        ]
    )


def _frame_scores(
    matches: Sequence[LineMatch], joined: Sequence[int], error_deg: FloatArray
) -> tuple[LineFrameScore, ...]:
    ends = list(accumulate(len(match.pairs.first) for match in matches))
    return tuple(
        LineFrameScore(
            name=match.name,
            matched=len(match.pairs.first),
            joined=further,
            missed=len(match.pairs.first_alone) - further,
            extra=len(match.pairs.second_alone),
            largest_error_deg=quantile(error_deg[end - len(match.pairs.first) : end], 1.0),
        )
        for match, further, end in zip(matches, joined, ends)
    )


def _numbers(rows: Sequence[LineLandmark], name: str) -> FloatArray:
    """(N,) one number of each row."""
    return np.array([getattr(row, name) for row in rows], dtype=np.float64)
