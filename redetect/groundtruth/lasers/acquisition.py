"""Sets of scans, the scanners' static background, and global localisation of the robot in a set.

Readings nearer than the background are new and are clustered; at each cluster the outline is fitted
from every heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fclusterdata
from scipy.linalg import block_diag

from redetect.array_types import FloatArray, IntArray
from redetect.groundtruth.files import JsonObject
from redetect.groundtruth.lasers.icp import fit_outline
from redetect.groundtruth.lasers.scanners import (
    Robot,
    Scanner,
    Scans,
    find_scans,
    read_robot,
    read_scans,
    scanners_in,
    with_measured_noise,
)
from redetect.groundtruth.lasers.tracking_kernels import (
    Body,
    FixedScanners,
    NewReadings,
    ScanSet,
    explain_set,
    new_points,
    refine_outline,
)
from redetect.groundtruth.settings import LaserSettings
from redetect.landmarks import wrap_angle
from redetect.plane import compose, rotation

# Least standard deviation of a beam's readings (m); a reading is new if it is this many of them
# nearer than the beam's nearest object, which is at this quantile of its readings.
_LEAST_SIGMA_M, _MARGIN_SIGMA, _PASSING = 0.005, 5.0, 0.02
#: Least number of readings for a pose.
LEAST_READINGS = 8
#: The ICP ends after this number of steps.
MOST_STEPS = 60
# Least number of readings for finding the robot, and largest chi2 per degree of freedom then.
_ACQUIRED_READINGS, _LARGEST_CHI2 = 16, 4.0
# Number of headings from which the search begins.
_HEADINGS = 24
# New readings closer together than this may belong to one object.
_LINK_M = 0.3
# Least share of agreeing beams among those that should see the robot, or see something beside.
_LEAST_AGREEMENT = 0.75


def learn_background(scanner: Scanner, ranges_mm: NDArray[np.uint16]) -> tuple[FloatArray, float]:
    """The background of a scanner's beams, from scans (N, readings) of the empty area.

    Returns the range below which a reading of each beam is new (readings,), infinite without any,
    and of what all readings are whole multiples, 0 without any (m). The nearest object of a beam is
    at a low quantile of its readings: beams along an edge jump, and nearer ones are of passing
    objects.
    """
    metres = scanner.metres(ranges_mm)
    hit = np.isfinite(metres)
    ordered = np.sort(np.where(hit, metres, np.inf), axis=0)
    count = hit.sum(axis=0)
    beams = np.arange(ranges_mm.shape[1])

    def quantile(values: FloatArray, share: float) -> FloatArray:
        row = np.minimum((share * count).astype(np.int64), np.maximum(count - 1, 0))
        return np.asarray(values[row, beams])

    # Fewer than two readings in a hundred scans are no evidence of a background.
    seen = count >= max(1, round(0.02 * len(ranges_mm)))
    deviation = np.full_like(metres, np.inf)
    np.subtract(metres, quantile(ordered, 0.5), out=deviation, where=hit)
    deviation = np.sort(np.abs(deviation), axis=0)
    sigma = np.maximum(1.4826 * quantile(deviation, 0.5), _LEAST_SIGMA_M)
    near = np.where(seen, quantile(ordered, _PASSING), 0.0)
    near -= _MARGIN_SIGMA * np.where(seen, sigma, 0.0)
    quantum_m = 1e-3 * float(np.gcd.reduce(ranges_mm[hit]))
    return np.where(seen, np.maximum(near, 0.0), np.inf), quantum_m


@dataclass(frozen=True, eq=False)
class ScanSets:
    """Sets of scans, at most one per scanner, taken at about the same time."""

    times_s: FloatArray  # (sets,): mean time of the set's scans
    rows: IntArray  # (sets, scanners): rows of `ranges_mm`; -1 if a scanner has none in the set
    ages_s: FloatArray  # (sets, scanners): the set's time minus the scan's
    ranges_mm: NDArray[np.uint16]  # (scans, readings): all scans of all scanners

    def __len__(self) -> int:
        return len(self.times_s)

    def __getitem__(self, index: int) -> ScanSet:
        return ScanSet(self.ranges_mm, self.rows[index], self.ages_s[index])


def fixed_scanners(
    scanners: Sequence[Scanner], empties: Sequence[Scans], covariance: FloatArray | None = None
) -> FixedScanners:
    """Arrange scanners, and the background from their scans of the empty area, for the kernels.

    `covariance` (3 scanners, 3 scanners): of their poses, jointly; by default they are independent.
    """
    if covariance is None:
        covariance = block_diag(*(scanner.covariance for scanner in scanners))
    backgrounds = [learn_background(s, e.ranges_mm) for s, e in zip(scanners, empties)]
    width = max(scanner.readings for scanner in scanners)
    near = np.zeros((len(scanners), width))
    direction, beam_times = np.zeros((len(scanners), width, 2)), np.zeros((len(scanners), width))
    for i, (scanner, (near_m, _)) in enumerate(zip(scanners, backgrounds)):
        near[i, : scanner.readings] = 1e3 * np.minimum(near_m, scanner.max_range_m)
        beam_times[i, : scanner.readings] = scanner.beam_times_s
        angle = scanner.pose[2] + scanner.angles_rad
        direction[i, : scanner.readings] = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return FixedScanners(
        near,
        direction,
        np.stack([scanner.pose[:2] for scanner in scanners]),
        # Rounding adds an error that is uniform over a quantum.
        np.sqrt([s.sigma_m**2 + m**2 / 12.0 for s, (_, m) in zip(scanners, backgrounds)]),
        covariance,
        beam_times,
    )


def sets_of_scans(scans: Sequence[Scans]) -> ScanSets:
    """Group the scans of scanners that run independently into sets.

    `scans` has an entry per scanner. In the order of time, a new set begins if it would contain a
    scanner twice, or if its first scan is older than the median time between a scanner's scans: so
    scanners that run slightly faster than others occasionally have a set of their own.
    """
    total = sum(len(one) for one in scans)
    ranges = np.zeros((total, max(one.ranges_mm.shape[1] for one in scans)), dtype=np.uint16)
    first = np.cumsum([0, *(len(one) for one in scans)])
    for begin, one in zip(first, scans):
        ranges[begin : begin + len(one), : one.ranges_mm.shape[1]] = one.ranges_mm
    steps = [float(np.median(np.diff(one.times_s))) for one in scans if len(one) > 1]
    window_s = min(steps, default=0.0)
    times = np.concatenate([one.times_s for one in scans])
    owner = np.concatenate([np.full(len(one), i) for i, one in enumerate(scans)])
    order = np.lexsort((owner, times))
    sets: list[list[int]] = []
    begun = -np.inf
    for i, scanner, t in zip(order.tolist(), owner[order].tolist(), times[order].tolist()):
        if not sets or sets[-1][scanner] >= 0 or t - begun > window_s:
            sets.append([-1] * len(scans))
            begun = t
        sets[-1][scanner] = i
    rows = np.array(sets, dtype=np.int64)
    seen = rows >= 0
    at = np.where(seen, times[rows], 0.0)
    when = at.sum(axis=1) / seen.sum(axis=1)
    return ScanSets(when, rows, np.where(seen, when[:, None] - at, 0.0), ranges)


def load_session(
    folder: Path, calibration: Path
) -> tuple[tuple[Scanner, ...], Robot, FixedScanners, ScanSets, list[str]]:
    """Read fixed scanners, robot and scans, and learn the background.

    Scanners whose readings of the empty area scatter far more than stated get that noise; the last
    result is what to say about these. Raises `GroundTruthError` if a file is missing or does not
    fit the others.
    """
    content = JsonObject.read(calibration)
    scanners, joint = scanners_in(content), None
    if "covariance" in content:
        joint = content.joint_covariance("scanners", [s.name for s in scanners], 3)
    robot = read_robot(folder / "robot.json")
    empties, scans = (
        [read_scans(find_scans(place, s.name), s.readings) for s in scanners]
        for place in (folder / "empty", folder)
    )
    scanners, texts = with_measured_noise(scanners, empties, calibration)
    return scanners, robot, fixed_scanners(scanners, empties, joint), sets_of_scans(scans), texts


def acquire(
    scans: ScanSet, fixed: FixedScanners, body: Body, settings: LaserSettings
) -> FloatArray | None:
    """Find the robot in one set of scans: x, y (m), theta (rad), or None.

    New readings are clustered; at each cluster an ICP is started from every heading. A pose is
    accepted only if the beams that should hit the robot do, neither passing through it nor, mostly,
    being blocked before it. If another pose explains the scans about as well as the best, and they
    differ by more than a symmetry of the outline, None is returned; with a symmetric outline it is
    one of the equivalent poses.
    """
    seen = new_points(scans, fixed, np.zeros(2), math.inf, np.zeros(3), np.zeros(2))
    if len(seen.points) < _ACQUIRED_READINGS:
        return None
    found: list[tuple[float, FloatArray]] = []
    for place in _places(seen.points, body.radius_m):
        near = np.hypot(*(seen.points - place).T) <= 2.0 * body.radius_m + settings.gate_m
        if np.count_nonzero(near) >= _ACQUIRED_READINGS:
            found += _search(place, seen.where(near), scans, fixed, body, settings)
    if not found:
        return None
    best, pose = max(found, key=lambda entry: entry[0])
    if any(score > 0.85 * best and not _same(pose, other, body) for score, other in found):
        return None
    return pose


def _places(points: FloatArray, radius_m: float) -> list[FloatArray]:
    """Possible centres of the robot: the centres of clusters, and of parts of large clusters."""
    label = fclusterdata(points, _LINK_M, criterion="distance", method="single")
    places: list[FloatArray] = []
    for k in np.unique(label):
        cluster = points[label == k]
        if len(cluster) < LEAST_READINGS:
            continue
        low, high = cluster.min(axis=0), cluster.max(axis=0)
        if math.hypot(*(high - low)) <= 2.2 * radius_m:
            places.append(0.5 * (low + high))
            continue
        cell = np.floor((cluster - low) / radius_m).astype(np.int64)
        for corner in np.unique(cell, axis=0):
            part = cluster[np.max(np.abs(cell - corner), axis=1) <= 1]
            if len(part) >= LEAST_READINGS:
                places.append(np.asarray(part.mean(axis=0)))
    return places


def _search(
    place: FloatArray, seen: NewReadings, scans: ScanSet, fixed: FixedScanners, body: Body,
    settings: LaserSettings,
) -> list[tuple[float, FloatArray]]:  # fmt: skip
    """Poses that explain the beams, with a score: beams that agree less those that disagree."""
    found: list[tuple[float, FloatArray]] = []
    tried: list[FloatArray] = []
    for k in range(_HEADINGS):
        theta = 2.0 * math.pi * k / _HEADINGS
        start = np.array([*(place - rotation(theta) @ body.middle), theta])
        pose, _, count = fit_outline(seen.points, body.faces, start, 0.5, 0.9, 1e-3, 15)
        pose, _, count = fit_outline(
            seen.points, body.faces, pose, settings.gate_m, settings.keep, 1e-4, MOST_STEPS
        )
        if count < _ACQUIRED_READINGS or any(_close(pose, t, 0.02, 2.0) for t in tried):
            continue
        tried.append(pose)
        refined = refine_outline(seen, body, pose, fixed, settings.gate_m, 0.1)
        if refined.used < _ACQUIRED_READINGS or refined.undetermined_directions:
            continue
        if refined.chi2 > _LARGEST_CHI2 * (refined.used - 3.0):
            continue
        _, agree, through, hidden, _, beside = explain_set(scans, fixed, body, refined.pose)
        if agree >= _LEAST_AGREEMENT * (agree + through + hidden + beside):
            found.append((agree - 2.0 * (through + beside) - hidden, refined.pose))
    return found


def _close(a: FloatArray, b: FloatArray, metres: float, degrees: float) -> bool:
    near = math.hypot(a[0] - b[0], a[1] - b[1]) < metres
    return near and abs(float(wrap_angle(a[2] - b[2]))) < math.radians(degrees)


def _same(a: FloatArray, b: FloatArray, body: Body) -> bool:
    """Whether two poses are equal up to noise and the outline's symmetries."""
    others = (b, *(compose(b, symmetry) for symmetry in body.symmetries))
    return any(_close(a, other, 0.1, 8.0) for other in others)
