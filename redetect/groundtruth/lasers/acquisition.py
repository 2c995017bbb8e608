"""Finding the robot anywhere in the covered area: every heap of new readings, every heading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from redetect.array_types import FloatArray
from redetect.groundtruth.lasers.icp import fit_outline
from redetect.groundtruth.lasers.outline import (
    LaserSettings,
    outline_faces,
    outline_radius_m,
    outline_symmetries,
)
from redetect.groundtruth.lasers.sets import ScannerTables, ScanSets
from redetect.groundtruth.lasers.tracking_kernels import (
    BeamCounts,
    OutlineFit,
    OutlinePose,
    Seen,
    explain_set,
    new_points,
    refine_outline,
)
from redetect.groundtruth.trajectories.plane import compose
from redetect.landmarks import wrap_angle

#: A reading within this of where a beam should meet the robot agrees (m).
AGREES_M = 0.05
#: Steps of the refinement.
_STEPS = 8

_EVERYWHERE_M = 1e6
_LARGEST_CHI2 = 4.0


@dataclass(frozen=True, eq=False)
class Body:
    """The robot's data for the kernels."""

    faces: FloatArray  # (k, 4): counter-clockwise
    middle: FloatArray  # (2,): of its bounding box, in its frame
    radius_m: float  # Of its farthest corner from there
    symmetries: FloatArray  # (s, 3): motions that its outline does not show, or not clearly


def refine(
    seen: Seen,
    start: FloatArray,
    tables: ScannerTables,
    body: Body,
    settings: LaserSettings,
    prior_m: float,
) -> OutlinePose:
    """Most likely pose near a start; undetermined directions are held by a prior `prior_m`."""
    s = settings
    fit = OutlineFit(
        s.floor_m, s.least_slope, s.gate_sigma, s.gate_m, prior_m, s.weak_sigma_m, body.radius_m,
        _STEPS,
    )  # fmt: skip
    return refine_outline(seen, body.faces, start, tables.origins, tables.sigmas_m, fit)


def explain(
    sets: ScanSets, index: int, tables: ScannerTables, body: Body, pose: FloatArray
) -> BeamCounts:
    """How a pose explains the beams of a set."""
    return explain_set(
        sets.ranges_mm, sets.rows[index], tables.as_beams(), body.faces, body.middle,
        body.radius_m, pose, AGREES_M,
    )  # fmt: skip


def robot_body(outline: ArrayLike, symmetry_m: float = LaserSettings().symmetry_m) -> Body:
    """Prepare an outline (k, 2); raises `GroundTruthError` if it is none."""
    faces = outline_faces(outline)
    middle, radius = outline_radius_m(faces)
    return Body(faces, middle, radius, outline_symmetries(faces, symmetry_m))


def acquire(
    sets: ScanSets, index: int, tables: ScannerTables, body: Body, settings: LaserSettings
) -> FloatArray | None:
    """Find the robot in one set of scans: x, y (m), theta (rad), or None.

    New readings that are close to each other are heaps; at each heap the ICP is begun from every
    heading. A pose counts only if the beams that should see the robot see it: neither background
    through it nor much that hides it. Where the two best poses differ by more than one of the
    outline's symmetries and explain the scans about as well, none is returned; with a symmetric
    outline it is one of the equivalent poses.
    """
    seen = new_points(
        sets.ranges_mm, sets.rows[index], tables.as_beams(), np.zeros(2), _EVERYWHERE_M,
        np.zeros(5), sets.ages_s[index],
    )  # fmt: skip
    if len(seen.points) < settings.acquire_readings:
        return None
    found: list[tuple[float, FloatArray]] = []
    for place in _places(seen.points, body, settings):
        near = np.hypot(*(seen.points - place).T) <= 2.0 * body.radius_m + settings.gate_m
        if int(near.sum()) < settings.acquire_readings:
            continue
        found += _search(place, seen.where(near), sets, index, tables, body, settings)
    if not found:
        return None
    found.sort(key=lambda entry: -entry[0])
    best, pose = found[0]
    for score, other in found[1:]:
        if score > 0.85 * best and not _same(pose, other, body):
            return None
    return pose


def _places(points: FloatArray, body: Body, settings: LaserSettings) -> list[FloatArray]:
    """Where the robot's middle might be: the middles of heaps, those of parts of large ones."""
    pairs = cKDTree(points).query_pairs(settings.link_m, output_type="ndarray")
    # SciPy before 1.12 does not support graphs with 64-bit indices.
    ends = (pairs[:, 0].astype(np.int32), pairs[:, 1].astype(np.int32))
    graph = coo_array((np.ones(len(pairs), dtype=np.int8), ends), (len(points),) * 2)
    count, label = connected_components(graph, directed=False)
    places: list[FloatArray] = []
    for k in range(count):
        heap = points[label == k]
        if len(heap) < settings.least_readings:
            continue
        low, high = heap.min(axis=0), heap.max(axis=0)
        if math.hypot(*(high - low)) <= 2.2 * body.radius_m:
            places.append(0.5 * (low + high))
            continue
        cell = np.floor((heap - low) / body.radius_m).astype(np.int64)
        for corner in np.unique(cell, axis=0):
            part = heap[np.max(np.abs(cell - corner), axis=1) <= 1]
            if len(part) >= settings.least_readings:
                places.append(np.asarray(part.mean(axis=0)))
    return places


def _search(
    place: FloatArray,
    seen: Seen,
    sets: ScanSets,
    index: int,
    tables: ScannerTables,
    body: Body,
    settings: LaserSettings,
) -> list[tuple[float, FloatArray]]:
    """Poses that explain the beams, with how many more beams agree than disagree."""
    found: list[tuple[float, FloatArray]] = []
    tried: list[FloatArray] = []
    for k in range(settings.headings):
        theta = 2.0 * math.pi * k / settings.headings
        c, s = math.cos(theta), math.sin(theta)
        x, y = body.middle
        start = np.array([place[0] - c * x + s * y, place[1] - s * x - c * y, theta])
        pose, _, count = fit_outline(seen.points, body.faces, start, 0.5, 0.9, 1e-3, 15)
        pose, _, count = fit_outline(
            seen.points, body.faces, pose, settings.gate_m, settings.kept, 1e-4, settings.most_steps
        )
        if count < settings.acquire_readings or any(_close(pose, other) for other in tried):
            continue
        tried.append(pose)
        refined = refine(seen, pose, tables, body, settings, 0.1)
        if refined.used < settings.acquire_readings or refined.open_directions:
            continue
        if refined.chi2 > _LARGEST_CHI2 * (refined.used - 3.0):
            continue
        _, agree, through, hidden, _, beside = explain(sets, index, tables, body, refined.pose)
        if agree < settings.least_agreement * (agree + through + hidden + beside):
            continue
        found.append((agree - 2.0 * (through + beside) - hidden, refined.pose))
    return found


def _close(a: FloatArray, b: FloatArray) -> bool:
    near = math.hypot(a[0] - b[0], a[1] - b[1]) < 0.02
    return near and abs(float(wrap_angle(a[2] - b[2]))) < math.radians(2.0)


def _same(a: FloatArray, b: FloatArray, body: Body) -> bool:
    """Whether two poses are equal up to noise and the outline's symmetries."""
    for other in (b, *(compose(b, symmetry) for symmetry in body.symmetries)):
        near = math.hypot(a[0] - other[0], a[1] - other[1]) < 0.1
        if near and abs(float(wrap_angle(a[2] - other[2]))) < math.radians(8.0):
            return True
    return False
