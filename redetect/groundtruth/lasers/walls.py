"""Scans of an area at rest, and the pose of scanners from the walls of the building."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.lasers.scanners import Scanner
from redetect.groundtruth.lasers.tracking_kernels import NewReadings, OutlineFit, refine_outline
from redetect.plane import apply, invert, rotation

#: Least joint standard deviation of readings, wall and map (m).
FLOOR_M = 0.001
_LONE_STEPS = 30


class StillScan(NamedTuple):
    """Readings of a scanner while nothing moves, averaged beam by beam."""

    range_m: FloatArray  # (n,)
    direction: FloatArray  # (n, 2): of the beams, in the scanner's frame
    sigma_m: float  # Standard deviation of an averaged reading

    @property
    def points(self) -> FloatArray:
        """(n, 2) points in the scanner's frame, in the order of the beams (m)."""
        return self.range_m[:, None] * self.direction


def still_scan(scanner: Scanner, ranges_mm: NDArray[np.uint16]) -> StillScan:
    """Average scans (N, readings) in which nothing moves.

    Excluded are beams without a reading in half of the scans and those along an edge, which jump
    between near and far; also a beam's readings far from its median, of passing objects.
    """
    metres = ranges_mm * 1e-3
    hit = scanner.has_return(ranges_mm)
    masked = np.where(hit, metres, np.nan)
    usable = hit.sum(axis=0) >= max(1.0, 0.5 * len(ranges_mm))
    median = np.full(scanner.readings, np.nan)
    median[usable] = np.nanmedian(masked[:, usable], axis=0)
    close = np.abs(masked - median) < 4.0 * max(scanner.sigma_m, 0.005)
    count = close.sum(axis=0)
    usable &= count >= 0.8 * hit.sum(axis=0)
    mean = np.where(close, metres, 0.0).sum(axis=0)[usable] / count[usable]
    angle = scanner.angles_rad[usable]
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    readings = float(np.median(count[usable])) if usable.any() else 1.0
    return StillScan(mean, direction, max(scanner.sigma_m, 0.003) / math.sqrt(readings))


class WallFit(NamedTuple):
    """Pose of rigidly connected scanners, from the walls that they see."""

    pose: FloatArray  # (3,): of their common frame on the map
    covariance: FloatArray  # (3, 3): from the residuals' size and the geometry
    by_mounts: FloatArray  # (3, 3 scanners): derivative of the pose by theirs in the common frame
    used: int  # Number of readings used
    rms_m: float  # Of their distances from the walls
    open_directions: int  # Number of directions that the walls do not determine


def fit_to_walls(
    scans: Sequence[StillScan],
    mounts: FloatArray,
    walls: FloatArray,
    start: FloatArray,
    gate_m: float,
    narrowing_m: Sequence[float],
    weak_sigma_m: float,
) -> WallFit:
    """Most likely pose of scanners on the map, near a start.

    A reading belongs to the wall that its beam meets first. Readings of objects in front of a wall
    are far from the wall that the beam would hit, and are excluded as the fit narrows.

    Parameters
    ----------
    scans : sequence of StillScan
        One of each scanner.
    mounts : (scanners, 3) float64
        Poses of the scanners in their common frame.
    walls : (S, 4) float64
        Pieces of wall on the map, seen from both sides (m).
    start : (3,) float64
        Of the common frame on the map.
    gate_m : float
        Largest distance of a reading from its wall at first.
    narrowing_m : sequence of float
        Joint standard deviations of readings, wall and map as the fit narrows; readings farther
        away than three of them are rejected. In the last step the residuals determine it.
    weak_sigma_m : float
        Directions along which the standard deviation would be larger are undetermined, and are
        held at the start.

    Raises
    ------
    GeometryError
        If fewer than ten readings match walls.
    """
    # The kernel moves faces onto points: here the map into the scanners' frame.
    faces = np.vstack([walls, walls[:, [2, 3, 0, 1]]])
    seen = NewReadings(
        np.concatenate([apply(mount, scan.points) for mount, scan in zip(mounts, scans)]),
        np.repeat(np.arange(len(scans)), [len(scan.range_m) for scan in scans]),
        np.concatenate([s.direction @ rotation(m[2]).T for m, s in zip(mounts, scans)]),
        np.concatenate([scan.range_m for scan in scans]),
    )
    origins, sigmas = mounts[:, :2].copy(), np.array([scan.sigma_m for scan in scans])
    pose, ratio = invert(start), 1.0
    for floor in (*narrowing_m, None):
        floor = max(FLOOR_M, narrowing_m[-1] * math.sqrt(ratio)) if floor is None else floor
        fit = OutlineFit(floor, 0.25, 3.0, gate_m, 0.5, weak_sigma_m, 1.0, _LONE_STEPS)
        found = refine_outline(seen, faces, pose, origins, sigmas, fit)
        if found.used < 10:
            raise GeometryError(f"{found.used} readings lie on the map: expected 10 or more")
        pose, ratio = found.pose, found.chi2 / (found.used - 3.0)
    world = invert(pose)
    # The inverse's derivatives: x' = -R' t and theta' = -theta.
    c, s = math.cos(world[2]), math.sin(world[2])
    jacobian = np.array([[-c, s, world[1]], [-s, -c, -world[0]], [0.0, 0.0, -1.0]])
    covariance = max(ratio, 0.1) * jacobian @ found.covariance @ jacobian.T
    return WallFit(
        world,
        0.5 * (covariance + covariance.T),
        jacobian @ found.by_scanner,
        found.used,
        found.rms_m,
        found.open_directions,
    )
