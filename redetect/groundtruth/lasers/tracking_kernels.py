"""Kernels of laser tracking: new readings in a set of scans, and their fit to the robot.

A set of scans is a row of `ranges` per scanner (-1: none). Poses are (x, y, theta) of the robot in
the world; its faces (k, 4) run counter-clockwise in its own frame, so that outward normals are to
their right. Tables per scanner are padded to the longest scan.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.compiled import kernel

#: A reading within this of where a beam should meet the robot agrees (m).
AGREES_M = 0.05
#: A fit to the outline uses readings up to this many standard deviations off.
GATE_SIGMA = 3.5
# Standard deviation of a reading's distance from the outline in addition to the scanner's noise, as
# the outline is drawn to millimetres.
_FLOOR_M = 0.001
# Lower bound of the cosine between beam and normal: readings along a face are close to it whatever
# the pose.
_LEAST_SLOPE = 0.35
# A direction is undetermined if the pose's standard deviation along it is larger (a turn is
# measured at the farthest corner).
_WEAK_SIGMA_M = 0.03
_MOST_STEPS = 8


class ScanSet(NamedTuple):
    """Scans that belong together, one of each scanner."""

    ranges_mm: NDArray[np.uint16]  # (scans, readings): all scans of all sets
    rows: IntArray  # (scanners,): each scanner's scan of this set; -1 where it has none
    ages_s: FloatArray  # (scanners,): the set's time minus the scan's


class FixedScanners(NamedTuple):
    """Scanners as arrays, padded to the longest scan."""

    near_mm: FloatArray  # (scanners, readings): below this a reading is new; 0 for padding
    direction: FloatArray  # (scanners, readings, 2): of the beams in the world
    origins: FloatArray  # (scanners, 2): in the world (m)
    sigmas_m: FloatArray  # (scanners,): standard deviations of readings, rounding included
    covariance: FloatArray  # (3 scanners, 3 scanners): of the scanners' poses, jointly
    beam_times_s: FloatArray  # (scanners, readings): of the beams, after their scan's time


class Body(NamedTuple):
    """The robot's outline in the scanners' plane."""

    faces: FloatArray  # (k, 4): counter-clockwise
    normals: FloatArray  # (k, 2): their outward normals
    middle: FloatArray  # (2,): of its bounding box, in its frame
    radius_m: float  # Distance of its farthest corner from there
    symmetries: FloatArray  # (s, 3): motions that change its outline not at all, or not clearly


class NewReadings(NamedTuple):
    """New readings of a set of scans."""

    points: FloatArray  # (n, 2): in the world (m)
    scanner: IntArray  # (n,)
    direction: FloatArray  # (n, 2): of the beams
    range_m: FloatArray  # (n,)

    def where(self, chosen: BoolArray) -> NewReadings:
        """Those chosen."""
        return NewReadings._make(each[chosen] for each in self)


class OutlinePose(NamedTuple):
    """The most likely pose of an outline near a start."""

    pose: FloatArray
    covariance: FloatArray  # (3, 3): from the readings; along undetermined directions the prior's
    by_scanner: FloatArray  # (3, 3 scanners): derivatives of the pose by the scanners' poses
    used: int  # Number of readings used
    chi2: float  # Their squared normalised residuals
    undetermined_directions: int
    rms_m: float  # Of their distances from the outline
    weakest: FloatArray  # (3,): least determined direction of x, y, theta times the body's radius
    information: FloatArray  # (scanners, 3, 3): correction of each scanner's own pose
    gradient: FloatArray  # (scanners, 3): the same


class BeamCounts(NamedTuple):
    """Numbers of a set's beams, compared with a pose."""

    expected: int  # Beams that should see the robot in front of the background; of these:
    agree: int  # readings as expected
    through: int  # readings that are farther
    hidden: int  # readings that are nearer
    none: int  # without a reading
    beside: int  # New readings in the outline's circle, but outside the robot


@kernel()
def new_points(
    scans: ScanSet, fixed: FixedScanners, centre: FloatArray, reach_m: float,
    velocity: FloatArray, about: FloatArray,
) -> NewReadings:  # fmt: skip
    """Points of a set that are nearer than the background and within reach of a position.

    `centre` (2,): points farther than `reach_m` from here are ignored. Points are propagated from
    their beam's time to the set's by the robot's `velocity` (3,) (m/s, m/s, rad/s), and turned
    `about` (2,), its position at the set's time.
    """
    ranges_mm, rows, ages_s = scans
    vx, vy, rate = velocity[0], velocity[1], velocity[2]
    most = rows.size * ranges_mm.shape[1]
    points = np.empty((most, 2))
    scanner = np.empty(most, dtype=np.int64)
    direction = np.empty((most, 2))
    range_m = np.empty(most)
    n = 0
    for s in range(rows.size):
        if rows[s] < 0:
            continue
        for i in range(ranges_mm.shape[1]):
            r = float(ranges_mm[rows[s], i])
            if r <= 0.0 or r >= fixed.near_mm[s, i]:
                continue
            x = fixed.origins[s, 0] + 1e-3 * r * fixed.direction[s, i, 0]
            y = fixed.origins[s, 1] + 1e-3 * r * fixed.direction[s, i, 1]
            dx, dy = x - centre[0], y - centre[1]
            if dx * dx + dy * dy > reach_m * reach_m:
                continue
            age = ages_s[s] - fixed.beam_times_s[s, i]
            c, sn = math.cos(rate * age), math.sin(rate * age)
            # From where the robot was at the beam's time, along an arc.
            ca, sa = math.cos(0.5 * rate * age), math.sin(0.5 * rate * age)
            dx = x - about[0] + (ca * vx + sa * vy) * age
            dy = y - about[1] + (ca * vy - sa * vx) * age
            points[n, 0] = about[0] + c * dx - sn * dy
            points[n, 1] = about[1] + sn * dx + c * dy
            bx, by = fixed.direction[s, i, 0], fixed.direction[s, i, 1]
            direction[n, 0], direction[n, 1] = c * bx - sn * by, sn * bx + c * by
            scanner[n] = s
            range_m[n] = 1e-3 * r
            n += 1
    return NewReadings(
        points[:n].copy(), scanner[:n].copy(), direction[:n].copy(), range_m[:n].copy()
    )


@kernel()
def _face_of(
    x: float, y: float, bx: float, by: float, range_m: float, body: Body, gate_m: float
) -> int:
    """The face of a reading at (x, y), -1 for none; (bx, by) is its beam's direction.

    Of faces turned to the scanner that which the beam meets first; without its range (below 0), the
    nearest one within the gate.
    """
    faces, normal = body.faces, body.normals
    best, face = np.inf, -1
    for k in range(faces.shape[0]):
        slope = normal[k, 0] * bx + normal[k, 1] * by
        if slope >= 0.0:
            continue
        x1, y1 = faces[k, 0], faces[k, 1]
        ex, ey = faces[k, 2] - x1, faces[k, 3] - y1
        length2 = ex * ex + ey * ey
        if range_m < 0.0:
            t = min(1.0, max(0.0, ((x - x1) * ex + (y - y1) * ey) / length2))
            d = math.sqrt((x - x1 - t * ex) ** 2 + (y - y1 - t * ey) ** 2)
            if d > gate_m:
                continue
        else:
            # From the reading along its beam to the face: the beam's point there.
            ahead = (normal[k, 0] * (x1 - x) + normal[k, 1] * (y1 - y)) / slope
            t = ((x + ahead * bx - x1) * ex + (y + ahead * by - y1) * ey) / length2
            d = range_m + ahead
            if t < 0.0 or t > 1.0 or d <= 0.0:
                continue
        if d < best:
            best, face = d, k
    return face


class _NormalEquations(NamedTuple):
    """Sums over the readings used; the pose's errors are in the outline's frame."""

    h: FloatArray  # (3, 3)
    g: FloatArray  # (3,)
    cross: FloatArray  # (3, 3 scanners): of the pose and the scanners' own poses
    information: FloatArray  # This and the next as in `OutlinePose`
    gradient: FloatArray
    used: int
    chi2: float
    squares: float  # Sum of squared distances from the outline (m^2)
    middle: FloatArray  # (2,): of the readings, in the outline's frame


@kernel()
def _add_prior_where_undetermined(
    at: _NormalEquations, to_start: FloatArray, prior_m: float, scale: float
) -> tuple[int, FloatArray]:
    """Add the start as a prior of the directions that the readings do not determine, in place.

    Directions are evaluated about the middle of the readings; a radian is as much as `scale` (m).
    Returns how many these are, and the least determined one.
    """
    h, g, middle = at.h, at.g, at.middle
    # Turning about the middle: xi' = (t + theta x middle, theta * scale).
    back = np.array(
        [[1.0, 0.0, middle[1] / scale], [0.0, 1.0, -middle[0] / scale], [0.0, 0.0, 1.0 / scale]]
    )
    values, vectors = np.linalg.eigh(np.ascontiguousarray(back.T) @ h @ back)
    there = np.linalg.inv(back)
    p = 1.0 / (prior_m * prior_m)
    undetermined = 0
    for k in range(3):
        if values[k] < 1.0 / _WEAK_SIGMA_M**2:
            undetermined += 1
            row = np.ascontiguousarray(vectors[:, k]) @ there
            g -= p * row * (row @ to_start)
            for a in range(3):  # np.outer takes longer to compile
                h[a] += p * row[a] * row
    return undetermined, vectors[:, 0].copy()


@kernel()
def _normal_equations(
    seen: NewReadings, body: Body, pose: FloatArray, fixed: FixedScanners, gate_m: float,
    nearest: bool,
) -> _NormalEquations:  # fmt: skip
    """The normal equations at a pose; `nearest`: readings belong to the nearest faces."""
    points, scanner, direction, range_m = seen
    many = fixed.sigmas_m.size
    h = np.zeros((3, 3))
    g = np.zeros(3)
    cross = np.zeros((3, 3 * many))
    information = np.zeros((many, 3, 3))
    gradient = np.zeros((many, 3))
    c, s = math.cos(pose[2]), math.sin(pose[2])
    used, chi2, squares = 0, 0.0, 0.0
    sx = sy = 0.0
    for i in range(points.shape[0]):
        dx, dy = points[i, 0] - pose[0], points[i, 1] - pose[1]
        x, y = c * dx + s * dy, -s * dx + c * dy
        bx = c * direction[i, 0] + s * direction[i, 1]
        by = -s * direction[i, 0] + c * direction[i, 1]
        reach = -1.0 if nearest else range_m[i]
        face = _face_of(x, y, bx, by, reach, body, gate_m)
        if face < 0:
            continue
        q = scanner[i]
        nx, ny = body.normals[face, 0], body.normals[face, 1]
        e = nx * (x - body.faces[face, 0]) + ny * (y - body.faces[face, 1])
        across = min(nx * bx + ny * by, -_LEAST_SLOPE) * fixed.sigmas_m[q]
        variance = across * across + _FLOOR_M**2
        if e * e > GATE_SIGMA**2 * variance:
            continue
        w = 1.0 / variance
        used += 1
        chi2 += w * e * e
        squares += e * e
        sx += x
        sy += y
        by_robot = (-nx, -ny, nx * y - ny * x)
        # By the scanner's pose: the normal in the world, and turning about the scanner.
        wx, wy = c * nx - s * ny, s * nx + c * ny
        from_x, from_y = points[i, 0] - fixed.origins[q, 0], points[i, 1] - fixed.origins[q, 1]
        lever = wy * from_x - wx * from_y
        by_scanner = (wx, wy, lever)
        for a in range(3):
            g[a] += w * by_robot[a] * e
            gradient[q, a] += w * by_scanner[a] * e
            for b in range(3):
                h[a, b] += w * by_robot[a] * by_robot[b]
                cross[a, 3 * q + b] += w * by_robot[a] * by_scanner[b]
                information[q, a, b] += w * by_scanner[a] * by_scanner[b]
    middle = np.array([sx / max(used, 1), sy / max(used, 1)])
    return _NormalEquations(h, g, cross, information, gradient, used, chi2, squares, middle)


@kernel()
def refine_outline(
    seen: NewReadings, body: Body, start: FloatArray, fixed: FixedScanners, gate_m: float,
    prior_m: float,
) -> OutlinePose:  # fmt: skip
    """Maximum likelihood pose of the outline near a start, by Gauss-Newton.

    A reading is uncertain along its beam: its distance from a face has the standard deviation
    sigma |n . beam|, and a floor for model errors of the outline and the scanner. A reading belongs
    to the face that its beam meets first, whatever its noise; at first, while the pose may be off,
    to the nearest one facing the scanner, within `gate_m`. Readings beyond the gate are ignored.
    Undetermined directions are held at the start, with the standard deviation `prior_m`.
    """
    pose = start.copy()
    covariance = np.full((3, 3), np.nan)
    calibration = np.zeros((3, 3 * fixed.sigmas_m.size))
    rms, undetermined = 0.0, 0
    weakest = np.zeros(3)
    local_covariance: FloatArray = np.zeros((3, 3))
    for step in range(_MOST_STEPS):
        # While the pose may be off, the nearest faces.
        at = _normal_equations(seen, body, pose, fixed, gate_m, step == 0)
        if at.used < 3:
            break
        rms = math.sqrt(at.squares / at.used)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        dx, dy = start[0] - pose[0], start[1] - pose[1]
        to_start = np.array([c * dx + s * dy, -s * dx + c * dy, start[2] - pose[2]])
        undetermined, v = _add_prior_where_undetermined(at, to_start, prior_m, body.radius_m)
        weakest[0], weakest[1], weakest[2] = c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]
        local_covariance = np.ascontiguousarray(np.linalg.inv(at.h))
        delta = -local_covariance @ at.g
        if step == _MOST_STEPS - 1 or (
            step > 0 and math.sqrt(delta[0] ** 2 + delta[1] ** 2) + abs(delta[2]) < 1e-6
        ):
            break
        pose[0] += c * delta[0] - s * delta[1]
        pose[1] += s * delta[0] + c * delta[1]
        pose[2] += delta[2]
    if at.used >= 3:
        c, s = math.cos(pose[2]), math.sin(pose[2])
        turn_world = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        turned = turn_world @ local_covariance
        covariance = turned @ np.ascontiguousarray(turn_world.T)
        calibration = -turned @ at.cross
    return OutlinePose(
        pose, covariance, calibration, at.used, at.chi2, undetermined, rms, weakest,
        at.information, at.gradient,
    )  # fmt: skip


@kernel()
def explain_set(scans: ScanSet, fixed: FixedScanners, body: Body, pose: FloatArray) -> BeamCounts:
    """Compare a set's beams with a pose, by casting each of them at the outline."""
    ranges_mm, rows, _ = scans
    faces, middle, radius_m = body.faces, body.middle, body.radius_m
    expected = agree = through = hidden = none = beside = 0
    c, s = math.cos(pose[2]), math.sin(pose[2])
    centre_x = pose[0] + c * middle[0] - s * middle[1]
    centre_y = pose[1] + s * middle[0] + c * middle[1]
    for q in range(rows.size):
        if rows[q] < 0:
            continue
        to_x, to_y = centre_x - fixed.origins[q, 0], centre_y - fixed.origins[q, 1]
        ox = -c * (pose[0] - fixed.origins[q, 0]) - s * (pose[1] - fixed.origins[q, 1])
        oy = s * (pose[0] - fixed.origins[q, 0]) - c * (pose[1] - fixed.origins[q, 1])
        for i in range(ranges_mm.shape[1]):
            bx, by = fixed.direction[q, i, 0], fixed.direction[q, i, 1]
            if fixed.near_mm[q, i] <= 0.0:
                continue
            off = to_x * by - to_y * bx
            ahead = to_x * bx + to_y * by
            if abs(off) > radius_m or ahead < -radius_m:
                continue
            rx, ry = c * bx + s * by, -s * bx + c * by
            best = np.inf
            for k in range(faces.shape[0]):
                ex, ey = faces[k, 2] - faces[k, 0], faces[k, 3] - faces[k, 1]
                cross = rx * ey - ry * ex
                if cross == 0.0:
                    continue
                ax, ay = faces[k, 0] - ox, faces[k, 1] - oy
                r = (ax * ey - ay * ex) / cross
                t = (ax * ry - ay * rx) / cross
                if r > 0.0 and 0.0 <= t <= 1.0 and r < best:
                    best = r
            reading = 1e-3 * ranges_mm[rows[q], i]
            if best < 1e-3 * fixed.near_mm[q, i]:
                expected += 1
                if reading <= 0.0:
                    none += 1
                elif reading > best + AGREES_M:
                    through += 1
                elif reading < best - AGREES_M:
                    hidden += 1
                else:
                    agree += 1
            elif 0.0 < reading < 1e-3 * fixed.near_mm[q, i] and abs(reading - ahead) < radius_m:
                beside += 1
    return BeamCounts(expected, agree, through, hidden, none, beside)
