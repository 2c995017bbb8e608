"""Associates rows of verticals along a known path, by points where rays intersect.

A row of a vertical is a ray in the map. From frame to frame it is ambiguous: neighbouring edges are
closer together than the uncertainty of a bearing, and a new edge may be at any distance. Over many
frames the rays of one vertical intersect in one point, which becomes less likely by chance with
each frame. So for each intersection of rays of frames a few steps apart, the likelihood of the
surrounding frames with a vertical there is compared to that without. The best point is assigned its
rows, at most one per frame; then the next best point among the remaining rows. This is a greedy
solution of the problem that multiple hypothesis tracking solves with trees (D. B. Reid, "An
algorithm for tracking multiple targets", IEEE Transactions on Automatic Control 24(6), 1979).

The path comes from the discs; it gives the heading of a single frame less precisely than a bearing
is measured. So the verticals associated from frame to frame are added to the least-squares problem
of the path first, with a robust loss. The search then starts with wide gates; its result replaces
those verticals in the problem, and the search is repeated with narrower gates.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from redetect.angles import wrapped
from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.compiled import kernel
from redetect.landmarks import wrap_angle
from redetect.plane import apply
from redetect.slam.association.loop_closing import intersect_bearings, solve_path
from redetect.slam.models import bearing_of_vertical
from redetect.slam.recording import Recording

# Probability that a visible vertical gives a row, and standard deviations within which a ray may be
# that row.
_DETECTED, _GATE = 0.7, 3.0
# Number of frames before and after a crossing that are considered.
_WINDOW = 40
# Of a point: log likelihood ratio of the rows with it to without.
_LEAST_SCORE = 4.0
# Numbers of steps between frames whose rays are intersected.
_GAPS = np.array([2, 4, 7, 11])
# Least angle between two intersected rays, in standard deviations, and distances of a point.
_LEAST_PARALLAX_SIGMAS, _NEAREST_M, _FARTHEST_M = 4.0, 0.3, 14.0
# Points with fewer rows are none, and with fewer than the second do not correct the path.
_FEWEST_ROWS, _PATH_ROWS = 3, 6
_ROOT_TWO_PI = math.sqrt(2.0 * math.pi)
# Tolerance of bearings beyond the field of view.
_WIDER_RAD = 0.005
# Number of times that the frame-to-frame association corrects the path.
_FIRST_ROUNDS = 2
# Standard deviation of the path's heading in a single frame, for each round (degrees).
_HEADING_SIGMA_DEG = (0.2, 0.15, 0.1, 0.1)
# Factor on the rows' standard deviations, which do not include the detector's errors at edges that
# are close together; the same for rows that correct the path.
_SIGMA_SCALE, _PATH_SIGMA_SCALE = 1.5, 2.0


class Rays(NamedTuple):
    """Rows of verticals in the map, by frame and bearing."""

    row: IntArray  # (n,): index of each ray's row in the run
    centre: FloatArray  # (n, 2): the camera's position (m)
    angle: FloatArray  # (n,): its direction in the map (rad)
    bearing: FloatArray  # (n,): the same in the robot frame (rad)
    sigma: FloatArray  # (n,): of it (rad)
    frame: IntArray  # (n,): ascending from 0
    start: IntArray  # (F + 1,): rays start[f] to start[f + 1] are those of frame f
    heading: FloatArray  # (F, 2): cosine and sine of the robot's heading
    widest_rad: float  # half the field of view, below a right angle


@kernel()
def _crossings(rays: Rays) -> tuple[FloatArray, IntArray]:
    """Points (k, 2) where rays of frames some steps apart cross, ahead of both, and the frames."""
    centre, angle, sigma, frame, start = rays.centre, rays.angle, rays.sigma, rays.frame, rays.start
    points = []
    frames = []
    for i in range(len(angle)):
        ux, uy = math.sin(angle[i]), -math.cos(angle[i])
        for gap in _GAPS:
            other = frame[i] + gap
            if other >= len(start) - 1:
                continue
            for j in range(start[other], start[other + 1]):
                parallax = abs(wrapped(angle[j] - angle[i]))
                if parallax < _LEAST_PARALLAX_SIGMAS * math.hypot(sigma[i], sigma[j]):
                    continue
                vx, vy = math.sin(angle[j]), -math.cos(angle[j])
                determinant = vx * uy - ux * vy
                if abs(determinant) < 1e-9:
                    continue
                x, y = centre[j, 0] - centre[i, 0], centre[j, 1] - centre[i, 1]
                near, far = (vx * y - vy * x) / determinant, (ux * y - uy * x) / determinant
                if min(near, far) < _NEAREST_M or max(near, far) > _FARTHEST_M:
                    continue
                points.append(centre[i, 0] + near * ux)
                points.append(centre[i, 1] + near * uy)
                frames.append(frame[i])
    return np.array(points, dtype=np.float64).reshape(-1, 2), np.array(frames, dtype=np.int64)


@kernel()
def _best_stretch(
    point: FloatArray, frame: int, rays: Rays, free: BoolArray, worth: FloatArray, reach: float
) -> tuple[float, IntArray]:
    """The contiguous stretch of frames with the most evidence for a vertical at a point.

    A frame with a ray within the gate adds the log likelihood ratio of a ray from that point to one
    from anywhere (at most its `worth`); a frame without such a ray, if the point is in the field of
    view, adds the log probability of missing a vertical. Returns the sum over the stretch, and its
    rays.
    """
    start, bearing, sigma = rays.start, rays.bearing, rays.sigma
    first, last = max(0, frame - _WINDOW), min(len(start) - 1, frame + _WINDOW)
    rows = np.full(last - first, -1, dtype=np.int64)
    widest = math.tan(rays.widest_rad)
    missed = math.log(1.0 - _DETECTED)
    best, total = 0.0, 0.0
    best_first, best_last, began = first, first, first
    for f in range(first, last):
        if start[f] == start[f + 1]:
            continue
        x, y = point[0] - rays.centre[start[f], 0], point[1] - rays.centre[start[f], 1]
        if x * x + y * y < _NEAREST_M**2:
            continue
        cos, sin = rays.heading[f, 0], rays.heading[f, 1]
        left, ahead = cos * x + sin * y, sin * x - cos * y
        if abs(left) > widest * ahead:
            continue
        seen = math.atan2(left, ahead)
        gained = missed
        i = start[f] + np.searchsorted(bearing[start[f] : start[f + 1]], seen - reach)
        while i < start[f + 1] and bearing[i] <= seen + reach:
            off = (seen - bearing[i]) / sigma[i]
            if free[i] and abs(off) < _GATE and worth[i] - 0.5 * off * off > gained:
                gained, rows[f - first] = worth[i] - 0.5 * off * off, i
            i += 1
        if total <= 0.0:
            total, began = 0.0, f
        total += gained
        if total > best:
            best, best_first, best_last = total, began, f + 1
    used = rows[best_first - first : best_last - first]
    return best, used[used >= 0]


@kernel()
def _meeting_point(rays: Rays, used: IntArray, point: FloatArray) -> FloatArray:
    """The point that some rays pass closest to: robust least squares, from a point near it."""
    for _ in range(4):
        a, b, c, d, e = 1e-6, 0.0, 1e-6, 0.0, 0.0
        for i in used:
            x, y = point[0] - rays.centre[i, 0], point[1] - rays.centre[i, 1]
            off = wrapped(math.atan2(x, -y) - rays.angle[i])
            squared = x * x + y * y
            by_x, by_y = -y / squared, x / squared
            variance = rays.sigma[i] ** 2
            weight = 1.0 / (variance + 0.25 * off * off)
            a += weight * by_x * by_x
            b += weight * by_x * by_y
            c += weight * by_y * by_y
            d += weight * by_x * off
            e += weight * by_y * off
        determinant = a * c - b * b
        change = np.array([(c * d - b * e) / determinant, (a * e - b * d) / determinant])
        if not math.hypot(change[0], change[1]) <= 1.0:  # rays nearly parallel
            break
        point = point - change
    return point


@kernel()
def take_points(
    points: FloatArray, frames: IntArray, rays: Rays, reach: float
) -> tuple[IntArray, FloatArray]:
    """Select points (k, 2) greedily: the best one with its rays, then the best of the other rays.

    Takes their `frames` (k,), and the widest gate of a bearing (rad); returns `labels` (n,) of the
    rays, `found` (m, 2).
    """
    # Log likelihood ratio of a ray from a vertical to one from anywhere.
    clutter = len(rays.angle) / len(rays.heading) / (2.0 * rays.widest_rad)
    worth = np.log(_DETECTED / (rays.sigma * _ROOT_TWO_PI * clutter))
    free = np.ones(len(rays.angle), dtype=np.bool_)
    labels = np.full(len(free), -1, dtype=np.int64)
    found = np.empty((len(free), 2))
    count = 0
    # Scores only decrease as rows are assigned: a point still first when rescored is the best.
    waiting = [(0.0, 0) for _ in range(0)]
    for k in range(len(points)):
        score, _ = _best_stretch(points[k], frames[k], rays, free, worth, reach)
        if score >= _LEAST_SCORE:
            waiting.append((-score, k))
    heapq.heapify(waiting)
    while len(waiting) > 0:
        k = heapq.heappop(waiting)[1]
        point = points[k]
        score, used = _best_stretch(point, frames[k], rays, free, worth, reach)
        if score < _LEAST_SCORE:
            continue
        if len(waiting) > 0 and score < -waiting[0][0]:
            heapq.heappush(waiting, (-score, k))
            continue
        for _ in range(3):
            better = _meeting_point(rays, used, point)
            improved, others = _best_stretch(better, frames[k], rays, free, worth, reach)
            if improved <= score:
                break
            point, score, used = better, improved, others
        if len(used) >= _FEWEST_ROWS:
            labels[used] = count
            free[used] = False
            found[count] = point
            count += 1
    return labels, found[:count].copy()


def lines_by_points(
    recording: Recording,
    path: FloatArray,
    circle_labels: IntArray,
    line_labels: IntArray,
    *,
    camera_xy: ArrayLike = (0.0, 0.0),
    disc_sigma_scale: float = 1.0,
) -> tuple[IntArray, FloatArray]:
    """Labels (m,) of the rows of verticals, by the points in which their rays intersect, and the
    corrected path (N + 1, 3); from `circle_labels` (n,), `line_labels` (m,), `camera_xy` (2,).
    """
    sigma = _PATH_SIGMA_SCALE * recording.lines.sigma_rad
    scaled = replace(recording, lines=replace(recording.lines, sigma_rad=sigma))

    def corrected(path: FloatArray, labels: IntArray, points: FloatArray) -> FloatArray:
        """Least squares over poses, discs and points, repeated without outliers."""
        count = len(points)
        rows = np.bincount(labels + 1, minlength=count + 1)[labels + 1]
        used = (labels >= 0) & (rows >= _PATH_ROWS)
        for _ in range(3):
            solution = solve_path(
                scaled,
                circle_labels,
                np.where(used, labels, count),
                path,
                np.concatenate([points, [[np.nan, np.nan]]]),
                camera_xy=camera_xy,
                sigma_scale=disc_sigma_scale,
            )
            path = solution.path
            places = solution.line_xy[np.where(used, labels, 0)]
            bearing = bearing_of_vertical(path[recording.lines.frame + 1], places, camera_xy)
            used &= np.abs(wrap_angle(bearing - recording.lines.bearing_rad)) < 4.0 * sigma
        return path

    for _ in range(_FIRST_ROUNDS):
        places = intersect_bearings(recording, path, line_labels, camera_xy=camera_xy)
        known = np.isfinite(places[:, 0])
        if not np.any(known):
            break
        label_of = np.where(known, np.cumsum(known) - 1, -1)
        path = corrected(path, label_of[line_labels], places[known])
    labels = np.full(len(line_labels), -1, dtype=np.int64)
    for number, sigma_deg in enumerate(_HEADING_SIGMA_DEG):
        rays = rays_of(recording, path, camera_xy, _SIGMA_SCALE, np.radians(sigma_deg))
        labels, points = find_points(rays)
        if number < len(_HEADING_SIGMA_DEG) - 1 and len(points):
            path = corrected(path, labels, points)
    rest = labels < 0
    _, own = np.unique(line_labels[rest], return_inverse=True)
    labels[rest] = labels.max(initial=-1) + 1 + own
    return labels, path


def rays_of(
    recording: Recording,
    path: FloatArray,
    camera_xy: ArrayLike,
    sigma_scale: float,
    heading_sigma_rad: float,
) -> Rays:
    """The rows of verticals as rays in the map, by the `path` (N + 1, 3) and `camera_xy` (2,)."""
    lines = recording.lines
    row = np.lexsort((lines.bearing_rad, lines.frame))
    frame, bearing = lines.frame[row], lines.bearing_rad[row]
    poses = path[frame + 1]
    return Rays(
        row=row,
        centre=apply(poses, np.broadcast_to(np.asarray(camera_xy), (len(poses), 2))),
        angle=bearing + poses[:, 2],
        bearing=bearing,
        sigma=np.hypot(sigma_scale * lines.sigma_rad[row], heading_sigma_rad),
        frame=frame,
        start=np.searchsorted(frame, np.arange(len(recording) + 1)),
        heading=np.stack([np.cos(path[1:, 2]), np.sin(path[1:, 2])], axis=1),
        widest_rad=min(float(np.max(np.abs(bearing), initial=0.0)) + _WIDER_RAD, 1.57),
    )


def find_points(rays: Rays) -> tuple[IntArray, FloatArray]:
    """Labels (n,) of rows by the points in which their rays intersect, and these points (k, 2)."""
    points, frames = _crossings(rays)
    taken, found = take_points(points, frames, rays, _GATE * float(rays.sigma.max(initial=0.0)))
    labels = np.empty(len(taken), dtype=np.int64)
    labels[rays.row] = taken
    return labels, found
