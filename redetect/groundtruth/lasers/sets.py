"""Scans of several scanners as sets, and what the scanners see of the empty area."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from redetect.array_types import FloatArray, IntArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.scanners import (
    Robot,
    Scanner,
    Scans,
    find_scans,
    read_robot,
    read_scanners,
    read_scans,
)
from redetect.groundtruth.lasers.tracking_kernels import FixedScanners, ScanSet

# A beam's readings have at least this deviation (m); one is new if it is this many of them nearer
# than the nearest object that the beam saw, which is at this quantile of its readings.
_LEAST_SIGMA_M, _MARGIN_SIGMA, _PASSING = 0.005, 5.0, 0.02


class Background(NamedTuple):
    """A scanner's static background, beam by beam."""

    # (readings,): a reading below this is something that was not there; infinite where the beam
    # sees nothing
    near_m: FloatArray
    quantum_m: float  # All readings are whole multiples of this; 0 if there are none.


def learn_background(ranges_mm: NDArray[np.uint16], max_range_m: float) -> Background:
    """Learn the background of the beams from scans (N, readings) of the empty area.

    Readings are 0, or `max_range_m` and more, where nothing came back. The nearest object of a beam
    is at a low quantile of its readings: beams along an edge see near and far in turn, and nearer
    readings than that are treated as passing objects.
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
    sigma = np.maximum(1.4826 * quantile(deviation, 0.5), _LEAST_SIGMA_M)
    near = np.where(seen, quantile(ordered, _PASSING), 0.0)
    near -= _MARGIN_SIGMA * np.where(seen, sigma, 0.0)
    return Background(
        np.where(seen, np.maximum(near, 0.0), np.inf),
        1e-3 * float(np.gcd.reduce(ranges_mm, axis=None)),
    )


@dataclass(frozen=True, eq=False)
class ScanSets:
    """Scans that belong together."""

    times_s: FloatArray  # (sets,): mean time of the set's scans
    # (sets, scanners): row of `ranges_mm` per scanner; -1 where the scanner has none in the set.
    rows: IntArray
    ages_s: FloatArray  # (sets, scanners): the set's time minus the scan's
    ranges_mm: NDArray[np.uint16]  # (scans, readings): all scans of all scanners

    def __len__(self) -> int:
        return len(self.times_s)

    def __getitem__(self, index: int) -> ScanSet:
        return ScanSet(self.ranges_mm, self.rows[index], self.ages_s[index])


def fixed_scanners(scanners: Sequence[Scanner], empties: Sequence[Scans]) -> FixedScanners:
    """Arrange scanners, and the background in their scans of the empty area, for the kernels."""
    if not scanners:
        raise GroundTruthError("no scanners: expected some")
    backgrounds = [learn_background(e.ranges_mm, s.max_range_m) for s, e in zip(scanners, empties)]
    width = max(scanner.readings for scanner in scanners)
    near = np.zeros((len(scanners), width))
    direction = np.zeros((len(scanners), width, 2))
    for i, (scanner, background) in enumerate(zip(scanners, backgrounds)):
        reach = np.minimum(background.near_m, scanner.max_range_m)
        near[i, : scanner.readings] = 1e3 * reach
        angle = scanner.pose[2] + scanner.angles_rad
        direction[i, : scanner.readings] = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return FixedScanners(
        near,
        direction,
        np.stack([scanner.pose[:2] for scanner in scanners]),
        # Rounding to a quantum is an error more, evenly spread over it.
        np.sqrt([s.sigma_m**2 + b.quantum_m**2 / 12.0 for s, b in zip(scanners, backgrounds)]),
        block_diag(*(scanner.covariance for scanner in scanners)),
    )


def sets_of_scans(scans: Sequence[Scans], window_s: float | None = None) -> ScanSets:
    """Put the scans of scanners that run independently into sets.

    Going through all scans in the order of time, a set ends where a scanner would come a second
    time, or where its first scan is more than the window ago. So each scan is in one set, and
    scanners that run slightly faster than others occasionally have a set of their own.

    `scans`: per scanner. `window_s`: by default the median time between a scanner's scans.
    """
    total = sum(len(one) for one in scans)
    if total == 0:
        raise GroundTruthError("no scans of any scanner")
    width = max(one.ranges_mm.shape[1] for one in scans)
    ranges = np.zeros((total, width), dtype=np.uint16)
    first = np.cumsum([0, *(len(one) for one in scans)])
    for begin, one in zip(first, scans):
        ranges[begin : begin + len(one), : one.ranges_mm.shape[1]] = one.ranges_mm
    if window_s is None:
        steps = [float(np.median(np.diff(one.times_s))) for one in scans if len(one) > 1]
        window_s = min(steps) if steps else 0.0
    times = np.concatenate([one.times_s for one in scans])
    owner = np.concatenate([np.full(len(one), i) for i, one in enumerate(scans)])
    order = np.lexsort((owner, times))
    rows = _group(order, owner, times, len(scans), window_s)
    seen = rows >= 0
    at = np.where(seen, times[rows], 0.0)
    when = at.sum(axis=1) / seen.sum(axis=1)
    return ScanSets(when, rows, np.where(seen, when[:, None] - at, 0.0), ranges)


def _group(
    order: IntArray, owner: IntArray, times: FloatArray, scanners: int, window_s: float
) -> IntArray:
    rows: list[list[int]] = []
    begun = -np.inf
    for i, scanner, t in zip(order.tolist(), owner[order].tolist(), times[order].tolist()):
        if not rows or rows[-1][scanner] >= 0 or t - begun > window_s:
            rows.append([-1] * scanners)
            begun = t
        rows[-1][scanner] = i
    return np.array(rows, dtype=np.int64).reshape(-1, scanners)


def load_session(
    folder: Path, calibration: Path
) -> tuple[tuple[Scanner, ...], Robot, FixedScanners, ScanSets]:
    """Read fixed scanners, robot, scans, and learn the background.

    Raises
    ------
    GroundTruthError
        If a file is missing or does not fit the others.
    """
    scanners = read_scanners(calibration)
    robot = read_robot(folder / "robot.json")
    empties, scans = (
        [read_scans(find_scans(place, s.name), s.readings) for s in scanners]
        for place in (folder / "empty", folder)
    )
    return scanners, robot, fixed_scanners(scanners, empties), sets_of_scans(scans)
