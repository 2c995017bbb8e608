"""Compares detected lines with reference rows of the same run."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from detect.comparison.figures import normalised_error, quantile
from detect.comparison.matching import (
    frames_by_image,
    match_runs,
    numbers,
)
from detect.comparison.result import CompareOptions, LineComparison, LinePairs
from landmarks import Frame, read_frames, wrap_angle

FloatArray = NDArray[np.float64]

# Files hold six digits: a smaller sigma is no statement about a bearing.
_LEAST_SIGMA_RAD = 1e-12


def compare_line_runs(
    run: str | os.PathLike[str],
    *,
    reference: str | os.PathLike[str] | None = None,
    detected: str | os.PathLike[str] | None = None,
    options: CompareOptions | None = None,
) -> LineComparison:
    """Compare a run's detected lines with its reference rows.

    As `detect.comparison.circles.compare_runs`, by default of ``map.lines`` and ``detected.lines``.
    """
    reference = Path(run) / "map.lines" if reference is None else reference
    detected = Path(run) / "detected.lines" if detected is None else detected
    return compare_line_frames(
        read_frames(reference),
        read_frames(detected),
        options,
        names=(os.fspath(reference), os.fspath(detected)),
    )


def compare_line_frames(
    reference: Iterable[Frame],
    detected: Iterable[Frame],
    options: CompareOptions | None = None,
    *,
    names: tuple[str, str] = ("reference", "detected"),
) -> LineComparison:
    """Compare the lines of two sets of frames; errors and reports use their names."""
    options = options or CompareOptions()
    sides = frames_by_image(reference, names[0]), frames_by_image(detected, names[1])
    common = match_runs("lines", *sides, options, names)
    first, second = ([row for m in common.frames for row in m.paired[side]] for side in (0, 1))

    def difference(name: str) -> FloatArray:
        return numbers(second, name) - numbers(first, name)

    bearing_rad, sigma_rad = numbers(first, "alpha"), numbers(second, "sigma")
    error_rad = wrap_angle(difference("alpha"))
    error_deg = np.degrees(np.abs(error_rad))
    variance = np.where(sigma_rad >= _LEAST_SIGMA_RAD, sigma_rad**2, 0.0)
    ends = [
        np.hypot(difference(x), difference(y))
        for x, y in (("xtop", "ytop"), ("xbottom", "ybottom"))
    ]
    return LineComparison(
        **vars(common),
        bearing_median_deg=quantile(error_deg),
        bearing_95_deg=quantile(error_deg, 0.95),
        normalised_error=normalised_error(error_rad[:, None], variance[:, None, None]),
        ends_median=quantile(np.concatenate(ends)),
        beta_median_deg=quantile(np.degrees(np.abs(difference("beta")))),
        pairs=LinePairs(bearing_rad, error_rad, sigma_rad),
    )
