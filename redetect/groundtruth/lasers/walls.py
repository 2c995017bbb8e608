"""Scans of an area at rest, and the pose of scanners from the walls of the building.

Drawings differ from buildings by centimetres. Single scanners fit such a map too well: they see a
few walls only, and readings of the others look like those of objects. So if the walls are off the
map, all scanners are aligned with it as one body, whose shape is that of their mutual alignment.
All readings of a wall share its error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from redetect.array_types import FloatArray, IntArray
from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.lasers.scanners import Scanner
from redetect.groundtruth.lasers.tracking_kernels import NewReadings, OutlineFit, refine_outline
from redetect.plane import apply, compose, invert, rotation

#: Least joint standard deviation of readings, wall and map (m).
FLOOR_M = 0.001
_LONE_STEPS = 30
# Walls are compared with the map by readings this near them, this number on each at least.
_NEAR_WALL_M = 0.15
_LEAST_ON_WALL = 4
_MOST_READINGS = 0.8
# A map is not exact if, with each scanner fitted to it by itself, not even most readings are on
# walls that are less off than this.
_EXACT_MAP_M = 0.001
# Least share of readings near walls if a scanner cannot be fitted by itself.
_LEAST_NEAR = 0.6
# A fit rejects what is this many of the walls' deviations off, divided by three.
_WALL_SIGMAS = 1.5


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


def first_walls(
    origin: FloatArray, directions: FloatArray, walls: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """The walls (S, 4) that rays from a point meet first: distances (N,), infinite if there is
    none, indices (N,), and cosines (N,) of the angles of incidence.

    `directions`: (N, 2) unit vectors.
    """
    start, along = walls[:, :2] - origin, walls[:, 2:] - walls[:, :2]
    across = directions[:, :1] * along[:, 1] - directions[:, 1:] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / across
        part = (start[:, 0] * directions[:, 1:] - start[:, 1] * directions[:, :1]) / across
    far = np.where((far > 0.0) & (part >= 0.0) & (part <= 1.0), far, np.inf)
    rows, first = np.arange(len(directions)), np.argmin(far, axis=1)
    cosines = np.abs(across[rows, first]) / np.hypot(*along[first].T)
    return far[rows, first], first, cosines


class WallOffsets(NamedTuple):
    """By how much walls are off the map, according to the readings that they reflect."""

    # What the offsets do not exceed for most readings, and their root mean square (m); 0 if no wall
    # is seen well.
    most_m: float
    rms_m: float
    near: float  # Share of the readings that are near walls
    readings_per_wall: float  # Mean number of readings on the wall of a reading


def wall_offsets(scans: Sequence[StillScan], poses: FloatArray, walls: FloatArray) -> WallOffsets:
    """Compare the map with readings of scanners at poses (scanners, 3) on it.

    `walls` (S, 4). A reading belongs to the wall that its beam meets first; readings far off are of
    other things.
    """
    wall, off = [], []
    for scan, pose in zip(scans, poses):
        far, first, cosines = first_walls(pose[:2], scan.direction @ rotation(pose[2]).T, walls)
        wall.append(first)
        off.append((scan.range_m - far) * cosines)
    walls_met, offs = np.concatenate(wall), np.concatenate(off)
    near = np.abs(offs) < _NEAR_WALL_M
    walls_met, offs = walls_met[near], offs[near]
    counts = np.bincount(walls_met)
    seen = np.flatnonzero(counts >= _LEAST_ON_WALL)
    if not len(seen):
        return WallOffsets(0.0, 0.0, 0.0, 1.0)
    medians = np.array([abs(float(np.median(offs[walls_met == k]))) for k in seen])
    order = np.argsort(medians)
    weights = counts[seen][order].astype(np.float64)
    weights = np.cumsum(weights / weights.sum())
    most = medians[order][np.searchsorted(weights, _MOST_READINGS)]
    return WallOffsets(
        float(most),
        float(np.sqrt(np.average(medians**2, weights=counts[seen]))),
        float(np.mean(near)),
        float(np.sum(counts**2) / np.sum(counts)),
    )


class BodyOnMap(NamedTuple):
    """All scanners on a map that is not exact."""

    map_sigma_m: float  # Standard deviation of the walls' offsets from the map
    poses: FloatArray  # (scanners, 3)
    covariance: FloatArray  # (3 scanners, 3 scanners): of their poses, jointly
    fit: WallFit  # Of the body


def body_on_inexact_map(
    scans: Sequence[StillScan],
    alone: Sequence[WallFit | None],
    whole: FloatArray,
    walls: FloatArray,
    narrowing_m: Sequence[float],
    gate_m: float,
    weak_sigma_m: float,
) -> BodyOnMap | None:
    """The scanners' poses as one body, if the walls are off the map; None if the map is exact.

    `alone`: each scanner fitted to the map by itself; None if that failed. `whole` (scanners, 3):
    poses of their mutual alignment, after an alignment with the map as one body. The others as for
    `fit_to_walls`.
    """
    offsets = wall_offsets(scans, whole, walls)
    sigma = offsets.rms_m
    fitted = [fit for fit in alone if fit is not None]
    if len(fitted) == len(scans):
        by_itself = wall_offsets(scans, np.stack([fit.pose for fit in fitted]), walls)
        if by_itself.most_m < _EXACT_MAP_M:
            return None
        sigma = max(sigma, by_itself.rms_m)
    elif offsets.near < _LEAST_NEAR or sigma < _EXACT_MAP_M:
        # Then the measured poses are wrong, and not the map.
        return None
    wide = [one for one in narrowing_m if one > _WALL_SIGMAS * sigma]
    fit = fit_to_walls(
        scans, whole, walls, np.zeros(3), gate_m, (*wide, _WALL_SIGMAS * sigma), weak_sigma_m
    )
    poses = compose(np.broadcast_to(fit.pose, whole.shape), whole)
    arms = poses[:, :2] - fit.pose[:2]
    derivatives = np.tile(np.eye(3), (len(scans), 1, 1))
    derivatives[:, 0, 2], derivatives[:, 1, 2] = -arms[:, 1], arms[:, 0]
    stacked = derivatives.reshape(-1, 3)
    common = stacked @ (offsets.readings_per_wall * fit.covariance) @ stacked.T
    own = [np.zeros((3, 3)) if one is None else one.covariance for one in alone]
    return BodyOnMap(sigma, poses, common + block_diag(*own), fit)
