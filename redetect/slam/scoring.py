"""Distances of paths and maps from references of the same run."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from redetect.landmarks import squared_mahalanobis
from redetect.landmarks.map_file import LandmarkMap, Path2D
from redetect.plane import pose_differences
from redetect.slam.errors import SlamError


def path_distance(path: Path2D, reference: ArrayLike, name: str = "") -> dict[str, float]:
    """Distance of a path from another one of the same run in the same map, `reference` (N, 3).

    Rms, median and largest distance of positions (m) and headings (rad), and those of the last
    pose. Raises `SlamError`, beginning with `name`, if their numbers of poses differ.
    """
    other = np.asarray(reference, dtype=np.float64)
    if len(other) != len(path.poses):
        raise SlamError(f"{name}{len(other)} poses: expected {len(path.poses)}, as in this run")
    x, y, turn = pose_differences(path.poses, other).T
    position, heading = np.hypot(x, y), np.abs(turn)
    return {
        f"{name}_{figure}_{unit}": float(value)
        for name, unit, distance in (("position", "m", position), ("heading", "rad", heading))
        for figure, value in (
            ("rms", math.sqrt(float(np.mean(distance**2)))),
            ("median", np.median(distance)),
            ("max", np.max(distance)),
            ("last", distance[-1]),
        )
    }


def map_distance(landmark_map: LandmarkMap, reference: LandmarkMap) -> dict[str, float]:
    """Distance of landmarks from those of another map with the same identifiers."""
    offsets, covariances = [], []
    kinds = (landmark_map.discs, reference.discs), (landmark_map.lines, reference.lines)
    for some, others in kinds:
        _, own, other = np.intersect1d(some.ids, others.ids, return_indices=True)
        offsets.append(some.xy[own] - others.xy[other])
        covariances.append(some.covariance[own])
    offset, covariance = np.concatenate(offsets), np.concatenate(covariances)
    if not len(offset):
        raise SlamError("no landmark is in both maps: expected some of the same identifiers")
    distance = np.hypot(*offset.T)
    return {
        "landmarks": float(len(distance)),
        "rms_m": math.sqrt(float(np.mean(distance**2))),
        "median_m": float(np.median(distance)),
        "max_m": float(np.max(distance)),
        "normalised": float(np.mean(squared_mahalanobis(offset, covariance))) / 2.0,
    }
