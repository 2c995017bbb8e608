"""Compares detected lines with reference rows of the same run."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from detect.comparison.figures import normalised_error, quantile
from detect.comparison.matching import frames_by_image, match_runs, numbers
from detect.comparison.result import CompareOptions, LineComparison, LinePairs
from landmarks import Frame, wrap_angle

FloatArray = NDArray[np.float64]

# Files hold six digits: a smaller sigma is no statement about a bearing.
_LEAST_SIGMA_RAD = 1e-12


def compare_line_frames(
    reference: Iterable[Frame],
    detected: Iterable[Frame],
    options: CompareOptions | None = None,
    *,
    names: tuple[str, str] = ("reference", "detected"),
) -> LineComparison:
    """Compare the lines of two sets of frames, called `names` in messages.

    Errors as of `detect.comparison.circles.compare_runs`.
    """
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
