"""Errors of the building map, and the pose of all scanners on a map that has some.

Drawings differ from buildings by centimetres. Single scanners fit such a map too well: they see a
few walls only, and readings of the others look like those of objects. So if the walls are off the
map, all scanners are aligned with it as one body, whose shape is that of their mutual alignment.
All readings of a wall share its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from redetect.array_types import FloatArray
from redetect.groundtruth.lasers.walls import StillScan, WallFit, fit_to_walls
from redetect.plane import compose, rotation

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
        ray = scan.direction @ rotation(pose[2]).T
        along = walls[:, 2:] - walls[:, :2]
        to_wall = walls[:, :2] - pose[:2]
        with np.errstate(divide="ignore", invalid="ignore"):
            across = ray[:, :1] * along[:, 1] - ray[:, 1:] * along[:, 0]
            distance = (to_wall[:, 0] * along[:, 1] - to_wall[:, 1] * along[:, 0]) / across
            share = (to_wall[:, 0] * ray[:, 1:] - to_wall[:, 1] * ray[:, :1]) / across
        hit = (distance > 0.0) & (share >= 0.0) & (share <= 1.0)
        distance = np.where(hit, distance, np.inf)
        first = np.argmin(distance, axis=1)
        beams = np.arange(len(ray))
        slope = across[beams, first] / np.hypot(*along[first].T)
        wall.append(first)
        off.append((scan.range_m - distance[beams, first]) * np.abs(slope))
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

    Parameters
    ----------
    scans : sequence of StillScan
        One of each scanner.
    alone : sequence of WallFit
        Each scanner fitted to the map by itself; None if that failed.
    whole : (scanners, 3) float64
        Poses of their mutual alignment, after an alignment with the map as one body.
    walls, narrowing_m, gate_m, weak_sigma_m
        As for `fit_to_walls`.
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
