"""Runs of robots that measure ranges and bearings of landmarks, as frames with positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from redetect.landmarks import CircleLandmark, Frame, Step
from redetect.slam.models.measurement import disc_of_range_and_bearing

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RangeBearing:
    """A run.

    Attributes
    ----------
    times : (N,) float64
        Of the frames (s), ascending.
    steps : (N, 3) float64
        Movements before each frame in the data set's axes: dx, dy (m), dphi (rad).
    frame : (n,) int64
        The frame of each measurement, ascending.
    range_m, bearing_rad : (n,) float64
        From the origin of the robot frame; 0 forward, positive to the left.
    ids : (n,) int64
        The landmark; -1 where it is not known.
    """

    times: FloatArray
    steps: FloatArray
    frame: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray
    ids: IntArray

    @property
    def prefixes(self) -> tuple[str, ...]:
        """Names of the frames: their times."""
        return tuple(f"{time:.3f}" for time in self.times)


def frames_of(run: RangeBearing, sigma_m: float, sigma_rad: float) -> list[Frame]:
    """The run as frames, whose steps state no covariance; landmarks as discs."""
    xy, covariance = disc_of_range_and_bearing(run.range_m, run.bearing_rad, sigma_m, sigma_rad)
    starts = np.searchsorted(run.frame, np.arange(len(run.times) + 1))
    frames = []
    for k, (prefix, step) in enumerate(zip(run.prefixes, run.steps.tolist())):
        rows = range(starts[k], starts[k + 1])
        seen = tuple(_disc(xy[row], covariance[row], int(run.ids[row])) for row in rows)
        frames.append(Frame(Step(prefix, *step, *([0.0] * 6)), seen))
    return frames


def _disc(xy: FloatArray, covariance: FloatArray, number: int) -> CircleLandmark:
    (x, y), (cxx, cxy, _, cyy) = xy.tolist(), covariance.ravel().tolist()
    return CircleLandmark(x, y, 1.0, cxx, cxy, cyy, (number,))
