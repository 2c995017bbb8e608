"""Scans of several scanners as sets, and the tables by which the kernels work on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.background import Background
from redetect.groundtruth.lasers.scanners import Scanner
from redetect.groundtruth.lasers.scans import Scans
from redetect.groundtruth.lasers.tracking_kernels import Beams

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ScannerTables:
    """Fixed scanners as arrays, padded to the longest scan.

    Attributes
    ----------
    names : tuple of str
    poses : (scanners, 3) float64
        In the world.
    covariance : (3 scanners, 3 scanners) float64
        Of the poses, jointly.
    near_mm : (scanners, readings) float64
        A reading below this is new; 0 for the padding.
    beams : (scanners, readings, 2) float64
        The beams' directions in the world.
    sigmas_m : (scanners,) float64
        Standard deviations of readings, rounding included.
    """

    names: tuple[str, ...]
    poses: FloatArray
    covariance: FloatArray
    near_mm: FloatArray
    beams: FloatArray
    sigmas_m: FloatArray

    @property
    def origins(self) -> FloatArray:
        """(scanners, 2) places of the scanners (m)."""
        return np.ascontiguousarray(self.poses[:, :2])

    def as_beams(self) -> Beams:
        """As the kernels take them."""
        return Beams(self.near_mm, self.beams, self.origins)


@dataclass(frozen=True, eq=False)
class ScanSets:
    """Scans that belong together.

    Attributes
    ----------
    times_s : (sets,) float64
        Mean time of the set's scans.
    rows : (sets, scanners) int64
        Row of `ranges_mm` per scanner; -1 where the scanner has none in the set.
    ages_s : (sets, scanners) float64
        The set's time minus the scan's.
    ranges_mm : (scans, readings) uint16
        All scans of all scanners.
    """

    times_s: FloatArray
    rows: IntArray
    ages_s: FloatArray
    ranges_mm: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.times_s)


def scanner_tables(
    scanners: Sequence[Scanner],
    backgrounds: Sequence[Background],
    joint_covariance: FloatArray | None = None,
) -> ScannerTables:
    """Arrange scanners and their backgrounds for the kernels.

    Parameters
    ----------
    scanners, backgrounds : sequences of the same length
    joint_covariance : (3 scanners, 3 scanners) array, optional
        Of their poses; by default that of each one by itself.

    Raises
    ------
    GroundTruthError
        If there are no scanners, or a background is not of its scanner's size.
    """
    if not scanners or len(scanners) != len(backgrounds):
        raise GroundTruthError(
            f"{len(scanners)} scanners, {len(backgrounds)} backgrounds: expected as many, some"
        )
    width = max(scanner.readings for scanner in scanners)
    near = np.zeros((len(scanners), width))
    beams = np.zeros((len(scanners), width, 2))
    covariance = np.zeros((3 * len(scanners), 3 * len(scanners)))
    for i, (scanner, background) in enumerate(zip(scanners, backgrounds)):
        if background.near_m.shape != (scanner.readings,):
            raise GroundTruthError(
                f"scanner {scanner.name}: background of {len(background.near_m)} beams: "
                f"expected {scanner.readings}"
            )
        reach = np.minimum(background.near_m, scanner.max_range_m)
        near[i, : scanner.readings] = 1e3 * reach
        angle = scanner.pose[2] + scanner.angles_rad
        beams[i, : scanner.readings] = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = scanner.covariance
    if joint_covariance is not None:
        if joint_covariance.shape != covariance.shape:
            raise GroundTruthError(
                f"joint covariance of shape {joint_covariance.shape}: expected {covariance.shape}"
            )
        covariance = np.array(joint_covariance, dtype=np.float64)
    return ScannerTables(
        tuple(scanner.name for scanner in scanners),
        np.stack([scanner.pose for scanner in scanners]),
        covariance,
        near,
        beams,
        # Rounding to a quantum is an error more, evenly spread over it.
        np.sqrt([s.sigma_m**2 + b.quantum_m**2 / 12.0 for s, b in zip(scanners, backgrounds)]),
    )


def sets_of_scans(scans: Sequence[Scans], window_s: float | None = None) -> ScanSets:
    """Put the scans of scanners that run independently into sets.

    Going through all scans in the order of time, a set ends where a scanner would come a second
    time, or where its first scan is more than the window ago. So each scan is in one set, and
    scanners that run slightly faster than others occasionally have a set of their own.

    Parameters
    ----------
    scans : sequence of Scans
        Per scanner.
    window_s : float, optional
        By default the median time between a scanner's scans.

    Raises
    ------
    GroundTruthError
        If there are no scans at all.
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
    current = [-1] * scanners
    begun = -np.inf
    for i, scanner, t in zip(order.tolist(), owner[order].tolist(), times[order].tolist()):
        if rows and current[scanner] < 0 and t - begun <= window_s:
            current[scanner] = i
            continue
        current = [-1] * scanners
        current[scanner] = i
        begun = t
        rows.append(current)
    return np.array(rows, dtype=np.int64).reshape(-1, scanners)
