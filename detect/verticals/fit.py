"""Straight lines through tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Numbers for each line.
FIT_NUMBERS = 13


@dataclass(frozen=True, slots=True, eq=False)
class LineFits:
    """Straight lines through tracks, each in the chart round a reference bearing.

    A direction at bearing `reference_rad` + d whose elevation has tangent e is X = tan(d),
    Z = e / cos(d) in the chart; the line is X = a + b Z.

    Attributes
    ----------
    numbers : (13 * T,) float64
        What the properties tell, in their order, as `detect.verticals.pass_kernels.fit_and_judge`
        has it.
    """

    numbers: FloatArray

    def __len__(self) -> int:
        return len(self.numbers) // FIT_NUMBERS

    def _part(self, begin: int, after: int) -> FloatArray:
        count = len(self)
        return self.numbers[begin * count : after * count]

    @property
    def reference_rad(self) -> FloatArray:
        """(T,) bearing of the chart's origin."""
        return self._part(0, 1)

    @property
    def pixel_rad(self) -> FloatArray:
        """(T,) width of a pixel's column at the horizon there."""
        return self._part(1, 2)

    @property
    def line(self) -> FloatArray:
        """(T, 2) a, b; NaN where there is no line."""
        return self._part(2, 4).reshape(-1, 2)

    @property
    def covariance(self) -> FloatArray:
        """(T, 2, 2) covariance of a, b, due to noise."""
        return self._part(4, 8).reshape(-1, 2, 2)

    @property
    def scatter_px(self) -> FloatArray:
        """(T,) root-mean-square distance of the tracked points from their straight line, pixels."""
        return self._part(8, 9)

    @property
    def shift_px(self) -> FloatArray:
        """(T,) how far the refinement took the line's middle, pixels."""
        return self._part(9, 10)

    @property
    def spread(self) -> FloatArray:
        """(T,) variance of the points' Z."""
        return self._part(10, 11)

    @property
    def contrast(self) -> FloatArray:
        """(T,) height of the step in grey values; NaN without refinement."""
        return self._part(11, 12)

    @property
    def sharpness(self) -> FloatArray:
        """(T,) contrast at the fine scale relative to the coarse one, at most 1.

        It is 1 without refinement.
        """
        return self._part(12, 13)
