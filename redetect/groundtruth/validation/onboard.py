"""The scanners on board against the building's walls: errors of ranges, and where they are mounted.

Both use what the scanners saw while the robot stood still at its reference poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.lasers.icp import nearest_on_segments
from redetect.groundtruth.validation.reference_poses_scans import ReferencePose
from redetect.landmarks import wrap_angle
from redetect.least_squares.solver import whitening
from redetect.plane import apply, compose, rotation

#: Readings farther from the wall that their beam meets are of something else (m).
_OF_A_WALL_M = 0.2
#: Ends of the bins of incidence (deg).
INCIDENCES_DEG = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0)
# Gates of the rounds in which mounts are refined, and the least deviation of a point from a wall.
_GATES_M = (0.2, 0.1, 0.05, 0.05, 0.05, 0.05)
_LEAST_SIGMA_M = 1e-3


class RangeErrors(NamedTuple):
    """Errors of N readings that are on walls."""

    incidence_rad: FloatArray  # (N,): between the beam and the wall's normal, 0 to pi/2
    error_m: FloatArray  # (N,): reading minus the wall's distance along the beam


class RefinedMounts(NamedTuple):
    """Where M scanners are on the robot."""

    poses: FloatArray  # (M, 3): in the robot's frame
    covariance: FloatArray  # (3 M, 3 M)


def first_walls(
    origin: FloatArray, directions: FloatArray, segments: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distances (N,) of the walls that rays from a point meet first, infinite where none, and the
    angles of incidence (N,).

    `directions` (N, 2) are of unit length, `segments` (S, 4).
    """
    start, along = segments[:, :2] - origin, segments[:, 2:] - segments[:, :2]
    across = directions[:, :1] * along[:, 1] - directions[:, 1:] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / across
        part = (start[:, 0] * directions[:, 1:] - start[:, 1] * directions[:, :1]) / across
    far = np.where((far > 0.0) & (part >= 0.0) & (part <= 1.0), far, np.inf)
    first = np.argmin(far, axis=1)
    rows = np.arange(len(directions))
    cosine = np.abs(across[rows, first]) / np.hypot(along[first, 0], along[first, 1])
    return far[rows, first], np.arccos(np.minimum(cosine, 1.0))


def range_errors(references: Sequence[ReferencePose], segments: FloatArray) -> RangeErrors:
    """Errors of the averaged readings at reference poses that scans refined."""
    angles, errors = [np.zeros(0)], [np.zeros(0)]
    for reference in references:
        if reference.still is None or reference.scans != "used":
            continue
        for scanner, points in zip(reference.still.scanners, reference.still.scanner_points):
            pose = compose(reference.pose, scanner.pose)
            reading = np.hypot(points[:, 0], points[:, 1])
            directions = points @ rotation(pose[2]).T / reading[:, None]
            far, incidence = first_walls(pose[:2], directions, segments)
            of_a_wall = np.abs(reading - far) < _OF_A_WALL_M
            angles.append(incidence[of_a_wall])
            errors.append((reading - far)[of_a_wall])
    return RangeErrors(np.concatenate(angles), np.concatenate(errors))


def refine_mounts(
    references: Sequence[ReferencePose], segments: FloatArray
) -> RefinedMounts | None:
    """Mounts of the scanners on board that lay their readings on the walls at all reference poses.

    Least squares over the mounts and all poses. What ties the mounts to the robot's frame are the
    poses by distances alone, with their covariances; how the mounts were measured does not count.
    None where fewer than three poses have both.
    """
    # Mounts that are wrong make scans disagree with distances.
    used = [
        r for r in references if r.scans in ("used", "disagrees") and r.distances.status == "ok"
    ]
    stills = [r.still for r in used if r.still is not None]
    if len(stills) < 3:
        return None
    priors = np.stack([r.distances.candidates[0] for r in used])
    roots = whitening(np.stack([r.distances.covariances[0] for r in used]))
    mounts = np.stack([scanner.pose for scanner in stills[0].scanners])
    poses, count = np.stack([r.pose for r in used]), len(mounts)
    along = segments[:, 2:] - segments[:, :2]
    normals = np.column_stack([-along[:, 1], along[:, 0]])
    normals /= np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-12)[:, None]
    for gate in _GATES_M:
        rows, errors = [], []
        for r, still in enumerate(stills):
            for m, cloud in enumerate(still.scanner_points):
                world = apply(compose(poses[r], mounts[m]), cloud)
                target, index, squared = nearest_on_segments(world, segments)
                near = squared <= gate * gate
                normal, world = normals[index[near]], world[near]
                row = np.zeros((len(world), count + len(used), 3))
                by_mount = world - apply(poses[r], mounts[m, :2])
                row[:, m, :2] = normal @ rotation(poses[r, 2])
                row[:, m, 2] = _moment(by_mount, normal)
                row[:, count + r, :2] = normal
                row[:, count + r, 2] = _moment(world - poses[r, :2], normal)
                rows.append(row)
                errors.append(np.sum(normal * (world - target[near]), axis=1))
        error = np.concatenate(errors)
        sigma = max(float(np.sqrt(np.mean(error**2))), _LEAST_SIGMA_M)
        of_prior = np.zeros((len(used), 3, count + len(used), 3))
        of_prior[range(len(used)), :, range(count, count + len(used))] = roots
        missing = poses - priors
        missing[:, 2] = wrap_angle(missing[:, 2])
        unknowns = 3 * (count + len(used))
        of_walls = np.concatenate(rows).reshape(-1, unknowns) / sigma
        jacobian = np.concatenate([of_walls, of_prior.reshape(-1, unknowns)])
        residual = np.concatenate([error / sigma, (roots @ missing[..., None]).ravel()])
        covariance = np.linalg.inv(jacobian.T @ jacobian)
        step = -(covariance @ (jacobian.T @ residual)).reshape(-1, 3)
        mounts, poses = mounts + step[:count], poses + step[count:]
    return RefinedMounts(mounts, covariance[: 3 * count, : 3 * count])


def _moment(arms: FloatArray, normals: FloatArray) -> FloatArray:
    """(N,) how far points move along the normals when their arms turn by one radian."""
    return np.asarray(arms[:, 0] * normals[:, 1] - arms[:, 1] * normals[:, 0])
