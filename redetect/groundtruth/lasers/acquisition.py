"""The robot's outline, and finding it anywhere: every heap of new readings, every heading."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.icp import fit_outline, moved, nearest_on_segments
from redetect.groundtruth.lasers.tracking_kernels import (
    Body,
    FixedScanners,
    OutlineFit,
    OutlinePose,
    ScanSet,
    Seen,
    explain_set,
    new_points,
    refine_outline,
)
from redetect.groundtruth.settings import LaserSettings
from redetect.landmarks import wrap_angle
from redetect.plane import compose, invert, rotation


def outline_faces(outline: ArrayLike) -> FloatArray:
    """Faces (k, 4) of a closed outline, counter-clockwise: their outward normal is to the right.

    Of corners (k, 2) in order, either way round (m).

    Raises
    ------
    GroundTruthError
        If two corners that follow each other are one, faces cross, or the outline encloses nothing.
    """
    corners = np.asarray(outline, dtype=np.float64)
    following = np.roll(corners, -1, axis=0)
    if np.any(np.hypot(*(following - corners).T) < 1e-6):
        raise GroundTruthError("outline: two corners that follow each other are the same")
    area = 0.5 * float(np.sum(corners[:, 0] * following[:, 1] - following[:, 0] * corners[:, 1]))
    if abs(area) < 1e-6:
        raise GroundTruthError(f"outline: encloses {abs(area):g} m2")
    if area < 0.0:
        corners = corners[::-1]
    faces = np.hstack([corners, np.roll(corners, -1, axis=0)])
    for i in range(len(faces)):
        for j in range(i + 2, len(faces) - (i == 0)):
            if _cross(faces[i], faces[j]):
                raise GroundTruthError(f"outline: faces {i + 1} and {j + 1} cross")
    return faces


def outline_radius_m(faces: FloatArray) -> tuple[FloatArray, float]:
    """Middle (2,) of the outline's bounding box, and its farthest corner's distance from it (m)."""
    corners = faces[:, :2]
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    return middle, float(np.max(np.hypot(*(corners - middle).T)))


def outline_symmetries(faces: FloatArray, tolerance_m: float = 0.015) -> FloatArray:
    """Motions (s, 3) other than none that map the outline onto itself, by rising theta from -pi on.

    A robot of which only the outline is seen may be at `pose` or at `compose(pose, symmetry)`. s is
    0 for an outline that shows where the front is, 1 for a box, 3 for a square. No point of the
    turned outline is farther from the outline than the tolerance.
    """
    along = np.linspace(0.0, 1.0, 40, endpoint=False)[None, :, None]
    points = (faces[:, None, :2] + along * (faces[:, None, 2:] - faces[:, None, :2])).reshape(-1, 2)
    points = np.ascontiguousarray(points)
    # A symmetry keeps the centre of the area where it is.
    x1, y1, x2, y2 = faces.T
    twice = x1 * y2 - x2 * y1
    centre = np.array([np.sum((x1 + x2) * twice), np.sum((y1 + y2) * twice)]) / 3.0 / twice.sum()
    poses, errors = [], []
    for degrees in range(-180, 180, 3):
        angle = math.radians(degrees)
        pose = np.array([*(centre - rotation(angle) @ centre), angle])
        poses.append(pose)
        errors.append(_farthest_m(points, faces, pose))
    found: list[FloatArray] = []
    for i, error in enumerate(errors):
        if poses[i][2] == 0.0 or error > min(errors[i - 1], errors[(i + 1) % len(errors)]):
            continue
        # Where an ICP of the whole outline to itself ends.
        pose, _, _ = fit_outline(points, faces, invert(poses[i]), np.inf, 1.0, 0.0, 200)
        pose = invert(pose)
        pose[2] = _turn(pose[2])
        far = all(abs(_turn(pose[2] - k[2])) > 0.2 for k in [np.zeros(3), *found])
        if far and _farthest_m(points, faces, pose) <= tolerance_m:
            found.append(pose)
    return np.array(sorted(found, key=lambda p: p[2])).reshape(-1, 3)


def _farthest_m(points: FloatArray, faces: FloatArray, pose: FloatArray) -> float:
    _, _, squared = nearest_on_segments(moved(points, pose), faces)
    return math.sqrt(float(squared.max()))


def _turn(angle: float) -> float:
    """An angle taken to [-pi, pi), -pi also where rounding made it just less than pi."""
    return (angle + math.pi + 1e-9) % (2.0 * math.pi) - math.pi - 1e-9


def _cross(a: FloatArray, b: FloatArray) -> bool:
    def side(face: FloatArray, x: float, y: float) -> float:
        return float((face[2] - face[0]) * (y - face[1]) - (face[3] - face[1]) * (x - face[0]))

    return (
        side(a, b[0], b[1]) * side(a, b[2], b[3]) < 0.0
        and side(b, a[0], a[1]) * side(b, a[2], a[3]) < 0.0
    )


#: Steps of the refinement.
_STEPS = 8

_EVERYWHERE_M = 1e6
_LARGEST_CHI2 = 4.0


def refine(
    seen: Seen,
    start: FloatArray,
    fixed: FixedScanners,
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
    return refine_outline(seen, body.faces, start, fixed.origins, fixed.sigmas_m, fit)


def robot_body(outline: ArrayLike, symmetry_m: float = LaserSettings().symmetry_m) -> Body:
    """Prepare an outline (k, 2); raises `GroundTruthError` if it is none."""
    faces = outline_faces(outline)
    middle, radius = outline_radius_m(faces)
    return Body(faces, middle, radius, outline_symmetries(faces, symmetry_m))


def acquire(
    scans: ScanSet, fixed: FixedScanners, body: Body, settings: LaserSettings
) -> FloatArray | None:
    """Find the robot in one set of scans: x, y (m), theta (rad), or None.

    New readings that are close to each other are heaps; at each heap the ICP is begun from every
    heading. A pose counts only if the beams that should see the robot see it: neither background
    through it nor much that hides it. Where the two best poses differ by more than one of the
    outline's symmetries and explain the scans about as well, none is returned; with a symmetric
    outline it is one of the equivalent poses.
    """
    seen = new_points(scans, fixed, np.zeros(2), _EVERYWHERE_M, np.zeros(5))
    if len(seen.points) < settings.acquire_readings:
        return None
    found: list[tuple[float, FloatArray]] = []
    for place in _places(seen.points, body, settings):
        near = np.hypot(*(seen.points - place).T) <= 2.0 * body.radius_m + settings.gate_m
        if int(near.sum()) < settings.acquire_readings:
            continue
        found += _search(place, seen.where(near), scans, fixed, body, settings)
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
    scans: ScanSet,
    fixed: FixedScanners,
    body: Body,
    settings: LaserSettings,
) -> list[tuple[float, FloatArray]]:
    """Poses that explain the beams, with how many more beams agree than disagree."""
    found: list[tuple[float, FloatArray]] = []
    tried: list[FloatArray] = []
    for k in range(settings.headings):
        theta = 2.0 * math.pi * k / settings.headings
        start = np.array([*(place - rotation(theta) @ body.middle), theta])
        pose, _, count = fit_outline(seen.points, body.faces, start, 0.5, 0.9, 1e-3, 15)
        pose, _, count = fit_outline(
            seen.points, body.faces, pose, settings.gate_m, settings.keep, 1e-4, settings.most_steps
        )
        if count < settings.acquire_readings or any(_close(pose, t, 0.02, 2.0) for t in tried):
            continue
        tried.append(pose)
        refined = refine(seen, pose, fixed, body, settings, 0.1)
        if refined.used < settings.acquire_readings or refined.open_directions:
            continue
        if refined.chi2 > _LARGEST_CHI2 * (refined.used - 3.0):
            continue
        _, agree, through, hidden, _, beside = explain_set(scans, fixed, body, refined.pose)
        if agree < settings.least_agreement * (agree + through + hidden + beside):
            continue
        found.append((agree - 2.0 * (through + beside) - hidden, refined.pose))
    return found


def _close(a: FloatArray, b: FloatArray, metres: float, degrees: float) -> bool:
    near = math.hypot(a[0] - b[0], a[1] - b[1]) < metres
    return near and abs(float(wrap_angle(a[2] - b[2]))) < math.radians(degrees)


def _same(a: FloatArray, b: FloatArray, body: Body) -> bool:
    """Whether two poses are equal up to noise and the outline's symmetries."""
    others = (b, *(compose(b, symmetry) for symmetry in body.symmetries))
    return any(_close(a, other, 0.1, 8.0) for other in others)
