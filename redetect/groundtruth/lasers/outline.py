"""The robot's outline in the scanners' plane: its faces, and the motions that do not change it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.icp import face_normals, fit_outline, moved, nearest_on_segments
from redetect.groundtruth.lasers.tracking_kernels import Body
from redetect.plane import invert, rotation

# Tolerance of the outline's symmetry under rotation.
_SYMMETRY_M = 0.12
# Faces fold back if 1 plus the cosine between their normals is smaller.
_FOLDED = 1e-6


def robot_body(outline: ArrayLike, outward_m: float = 0.0) -> Body:
    """Prepare an outline (k, 2), moved outward; raises `GroundTruthError` if it is not valid."""
    faces = outline_faces(outline, outward_m)
    corners = faces[:, :2]
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    radius = float(np.max(np.hypot(*(corners - middle).T)))
    return Body(faces, face_normals(faces), middle, radius, outline_symmetries(faces, _SYMMETRY_M))


def outline_faces(outline: ArrayLike, outward_m: float = 0.0) -> FloatArray:
    """Faces (k, 4) of a closed outline, counter-clockwise: their outward normal is to the right.

    `outline`: corners (k, 2) in order, in either direction (m); `outward_m`: by how much all faces
    are moved. Raises `GroundTruthError` if corners coincide, faces cross or fold back, or there is
    no area.
    """
    corners = np.asarray(outline, dtype=np.float64)
    following = np.roll(corners, -1, axis=0)
    if np.any(np.hypot(*(following - corners).T) < 1e-6):
        raise GroundTruthError("outline: two consecutive corners are the same")
    area = 0.5 * float(np.sum(corners[:, 0] * following[:, 1] - following[:, 0] * corners[:, 1]))
    if abs(area) < 1e-6:
        raise GroundTruthError(f"outline: encloses {abs(area):g} m2")
    if area < 0.0:
        corners = corners[::-1]
    normals = face_normals(np.hstack([corners, np.roll(corners, -1, axis=0)]))
    before = np.roll(normals, 1, axis=0)
    shared = 1.0 + np.sum(normals * before, axis=1, keepdims=True)
    if np.any(back := shared[:, 0] < _FOLDED):
        raise GroundTruthError(f"outline: folds back at {corners[int(np.argmax(back))].tolist()}")
    corners = corners + outward_m * (normals + before) / shared
    faces = np.hstack([corners, np.roll(corners, -1, axis=0)])
    for i in range(len(faces)):
        for j in range(i + 2, len(faces) - (i == 0)):
            if _divides(faces[i], faces[j]) and _divides(faces[j], faces[i]):
                raise GroundTruthError(f"outline: faces {i + 1} and {j + 1} cross")
    return faces


def outline_symmetries(faces: FloatArray, tolerance_m: float = 0.015) -> FloatArray:
    """Motions (s, 3) but the identity that map the outline onto itself, in order of theta from -pi.

    A robot of which only the outline is seen may be at `pose` or at `compose(pose, symmetry)`. s is
    0 for an outline without symmetries, 1 for a box, 3 for a square. No point of the turned outline
    is farther from the outline than the tolerance.
    """
    along = np.linspace(0.0, 1.0, 40, endpoint=False)[None, :, None]
    points = (faces[:, None, :2] + along * (faces[:, None, 2:] - faces[:, None, :2])).reshape(-1, 2)
    points = np.ascontiguousarray(points)
    # A symmetry keeps the centroid in place.
    x1, y1, x2, y2 = faces.T
    twice = x1 * y2 - x2 * y1
    centre = np.array([np.sum((x1 + x2) * twice), np.sum((y1 + y2) * twice)]) / 3.0 / twice.sum()
    angles = [math.radians(degrees) for degrees in range(-180, 180, 3)]
    poses = [np.array([*(centre - rotation(angle) @ centre), angle]) for angle in angles]
    errors = [_farthest_m(points, faces, pose) for pose in poses]
    found: list[FloatArray] = []
    for i, error in enumerate(errors):
        if poses[i][2] == 0.0 or error > min(errors[i - 1], errors[(i + 1) % len(errors)]):
            continue
        # Refined by an ICP of the whole outline to itself.
        pose = invert(fit_outline(points, faces, invert(poses[i]), np.inf, 1.0, 0.0, 200)[0])
        pose[2] = _turn(pose[2])
        far = all(abs(_turn(pose[2] - k[2])) > 0.2 for k in [np.zeros(3), *found])
        if far and _farthest_m(points, faces, pose) <= tolerance_m:
            found.append(pose)
    return np.array(sorted(found, key=lambda p: p[2])).reshape(-1, 3)


def _farthest_m(points: FloatArray, faces: FloatArray, pose: FloatArray) -> float:
    _, _, squared = nearest_on_segments(moved(points, pose), faces)
    return math.sqrt(float(squared.max()))


def _turn(angle: float) -> float:
    """An angle wrapped to [-pi, pi); -pi also if rounding made it slightly less than pi."""
    return (angle + math.pi + 1e-9) % (2.0 * math.pi) - math.pi - 1e-9


def _divides(face: FloatArray, other: FloatArray) -> bool:
    """Whether the ends of another face are on both sides of the line through a face."""
    (x, y), (ex, ey) = face[:2], face[2:] - face[:2]
    sides = ex * (other[1::2] - y) - ey * (other[::2] - x)
    return bool(sides[0] * sides[1] < 0.0)
