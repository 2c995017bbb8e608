"""Background of a fixed scanner, learned from scans of the empty area."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Background:
    """A scanner's static background, beam by beam.

    Attributes
    ----------
    range_m : (readings,) float64
        Median of the beam's readings; NaN where it has none.
    sigma_m : (readings,) float64
        Their standard deviation by the median of deviations, at least `least_sigma_m`; NaN where
        the beam has none.
    near_m : (readings,) float64
        A reading below this is something that was not there; infinite where the beam sees nothing.
    drop_out : (readings,) float64
        Share of the scans without a reading.
    quantum_m : float
        All readings are whole multiples of this; 0 if there are none.
    scans : int
        Scans that it was learned from.
    """

    range_m: FloatArray
    sigma_m: FloatArray
    near_m: FloatArray
    drop_out: FloatArray
    quantum_m: float
    scans: int


def learn_background(
    ranges_mm: NDArray[np.uint16],
    max_range_m: float,
    *,
    least_sigma_m: float = 0.005,
    margin_sigma: float = 5.0,
    passing: float = 0.02,
) -> Background:
    """Learn the background of the beams from scans of the empty area.

    Parameters
    ----------
    ranges_mm : (N, readings) uint16
        The scans; 0 or `max_range_m` and more where nothing came back.
    max_range_m : float
        The scanner's.
    least_sigma_m : float
        Standard deviation that a beam has at least (m).
    margin_sigma : float
        A reading is new if it is this many standard deviations nearer than the nearest object that
        the beam saw.
    passing : float
        The nearest object is at this quantile of the beam's readings: beams along an edge see near
        and far in turn, and nearer readings than that are treated as passing objects.

    Returns
    -------
    Background

    Raises
    ------
    GroundTruthError
        If there are no scans.
    """
    if ranges_mm.ndim != 2 or len(ranges_mm) == 0:
        raise GroundTruthError(f"empty scans of shape {ranges_mm.shape}: expected (N, readings)")
    metres = ranges_mm * 1e-3
    hit = (ranges_mm > 0) & (metres < max_range_m)
    ordered = np.sort(np.where(hit, metres, np.inf), axis=0)
    count = hit.sum(axis=0)
    beams = np.arange(ranges_mm.shape[1])

    def quantile(values: FloatArray, share: float) -> FloatArray:
        row = np.minimum((share * count).astype(np.int64), np.maximum(count - 1, 0))
        return np.asarray(values[row, beams])

    median = quantile(ordered, 0.5)
    # Two readings in a hundred scans say nothing about the background.
    seen = count >= max(1, round(0.02 * len(ranges_mm)))
    deviation = np.full_like(metres, np.inf)
    np.subtract(metres, median, out=deviation, where=hit)
    deviation = np.sort(np.abs(deviation), axis=0)
    sigma = np.maximum(1.4826 * quantile(deviation, 0.5), least_sigma_m)
    near = np.where(seen, quantile(ordered, passing), 0.0)
    near -= margin_sigma * np.where(seen, sigma, 0.0)
    return Background(
        np.where(seen, median, np.nan),
        np.where(seen, sigma, np.nan),
        np.where(seen, np.maximum(near, 0.0), np.inf),
        1.0 - count / len(ranges_mm),
        1e-3 * float(np.gcd.reduce(ranges_mm, axis=None)),
        len(ranges_mm),
    )
