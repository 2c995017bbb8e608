"""Headings over time as the synchronisation of clocks needs them: continuous, cut at gaps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.trajectories.streams import PlanarPoses

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def continuous_headings(poses: PlanarPoses) -> FloatArray:
    """Headings without jumps of whole turns.

    Parameters
    ----------
    poses : PlanarPoses
        Sampled so often that the robot turns less than half a turn between neighbours.

    Returns
    -------
    (N,) float64
        Headings (rad), beyond +-pi where the robot went on turning.
    """
    return np.asarray(np.unwrap(poses.poses[:, 2]))


def segments_between_gaps(times_s: FloatArray, largest_gap_s: float) -> list[slice]:
    """Cut times where a pause is longer than a limit.

    Parameters
    ----------
    times_s : (N,) array
        Ascending.
    largest_gap_s : float
        Longer pauses begin a new segment.

    Returns
    -------
    list of slice
        The segments' samples.
    """
    cuts = np.flatnonzero(np.diff(times_s) > largest_gap_s) + 1
    ends = [0, *cuts.tolist(), len(times_s)]
    return [slice(a, b) for a, b in pairwise(ends) if b > a]


def heading_noise(times_s: FloatArray, headings_rad: FloatArray) -> float:
    """How rough headings are: standard deviation of a sample beside its neighbours (rad).

    Third differences cancel whatever turns smoothly; their median does not mind single jumps.

    Parameters
    ----------
    times_s, headings_rad : (N,) arrays
        At least 5 samples, headings continuous.

    Returns
    -------
    float
    """
    if len(times_s) < 5:
        raise GroundTruthError(f"{len(times_s)} headings: expected 5 or more")
    third = np.diff(headings_rad, 3)
    # Variance of a third difference of white noise: 1 + 9 + 9 + 1.
    return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20.0))


def sampling_interval(times_s: FloatArray) -> float:
    """Median time between samples (s)."""
    return float(np.median(np.diff(times_s)))


@dataclass(frozen=True, eq=False)
class HeadingIntegral:
    """Headings as a function of time, straight between samples, of which exact means are taken.

    Attributes
    ----------
    times_s : (N,) float64
        Ascending.
    headings_rad : (N,) float64
        Continuous.
    """

    times_s: FloatArray
    headings_rad: FloatArray

    def means(self, from_s: FloatArray, to_s: FloatArray) -> FloatArray:
        """Mean headings between pairs of times.

        Parameters
        ----------
        from_s, to_s : (M,) arrays
            Ends of the windows, `to_s` later; outside the samples the first or last heading holds.

        Returns
        -------
        (M,) float64
        """
        return np.asarray((self._integral(to_s) - self._integral(from_s)) / (to_s - from_s))

    def covers(self, from_s: FloatArray, to_s: FloatArray, largest_gap_s: float) -> BoolArray:
        """Which of M spans of time are within the samples and overlap no longer gap."""
        covered = (from_s >= self.times_s[0]) & (to_s <= self.times_s[-1])
        for gap in np.flatnonzero(np.diff(self.times_s) > largest_gap_s):
            covered &= (to_s <= self.times_s[gap]) | (from_s >= self.times_s[gap + 1])
        return np.asarray(covered)

    @cached_property
    def _areas(self) -> FloatArray:
        between = 0.5 * (self.headings_rad[1:] + self.headings_rad[:-1]) * np.diff(self.times_s)
        return np.concatenate([[0.0], np.cumsum(between)])

    def _integral(self, times_s: FloatArray) -> FloatArray:
        """Integral of the heading from the first sample to each time."""
        inside = np.clip(times_s, self.times_s[0], self.times_s[-1])
        k = np.clip(
            np.searchsorted(self.times_s, inside, side="right") - 1, 0, len(self._areas) - 1
        )
        heading = np.interp(times_s, self.times_s, self.headings_rad)
        return np.asarray(
            self._areas[k]
            + 0.5 * (heading + self.headings_rad[k]) * (inside - self.times_s[k])
            + heading * (times_s - inside)
        )


def windowed_means(
    times_s: FloatArray, headings_rad: FloatArray, window_s: float
) -> tuple[FloatArray, FloatArray]:
    """Means of headings over windows side by side; windows with a gap in them are left out.

    Parameters
    ----------
    times_s, headings_rad : (N,) arrays
        Headings continuous.
    window_s : float
        Length of each window.

    Returns
    -------
    middles_s, means_rad : (M,) arrays
        Middles of the windows and the mean headings.
    """
    count = int((times_s[-1] - times_s[0]) / window_s)
    edges = times_s[0] + window_s * np.arange(count + 1)
    integral = HeadingIntegral(times_s, headings_rad)
    whole = integral.covers(edges[:-1], edges[1:], 0.5 * window_s)
    means = integral.means(edges[:-1], edges[1:])
    return (0.5 * (edges[1:] + edges[:-1]))[whole], means[whole]
