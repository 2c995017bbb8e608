"""Initial estimates of the positions of vertical lines, from bearings alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.plane import apply
from redetect.slam.mapping.graph import Estimate, Graph
from redetect.slam.models import bearing_jacobians, disc_in_robot
from redetect.slam.recording import LineRows

#: Rays to a line have to cross under at least this angle somewhere.
LEAST_PARALLAX_RAD = float(np.radians(5.0))
#: Largest median distance of rays from their intersection, in standard deviations.
MOST_MEDIAN_MISS = 10.0
#: Lines whose place is less certain, the poses being known, are left out.
MOST_SIGMA_M = 0.5
# Odometry is good enough for a first triangulation over about this many metres of path.
_LOCAL_PATH_M = 15.0


@dataclass(frozen=True, eq=False)
class InitialLines:
    """Lines that can be placed, and the others."""

    ids: IntArray  # (K,): lines that can be placed, ascending
    xy: FloatArray  # (K, 2): their positions in the map (m)
    unplaced: IntArray  # (U,): lines never seen, alone in a row, under enough parallax


def place_lines(
    poses: FloatArray,
    rows: LineRows,
    camera_xy: FloatArray,
    *,
    least_parallax_rad: float = LEAST_PARALLAX_RAD,
) -> InitialLines:
    """Triangulate lines from poses that are known well enough.

    Only rows of a single line are used: two lines that were always joined cannot be separated. A
    line is triangulated from its views along some metres of path from its first sight on; if they
    have too little parallax, from all of its views.

    Takes `poses` (N + 1, 3), `camera_xy` (2,).
    """
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))])
    views: dict[int, list[int]] = {}
    for k, ids in enumerate(rows.ids):
        if len(ids) == 1:
            views.setdefault(ids[0], []).append(k)
    every = sorted({i for ids in rows.ids for i in ids})
    placed: list[tuple[int, FloatArray]] = []
    for number in every:
        seen = np.array(views.get(number, []), dtype=np.int64)
        if len(seen) < 2:
            continue
        pose = rows.frame[seen] + 1
        near = way[pose] - way[pose[0]] <= _LOCAL_PATH_M
        for some in (near, np.ones(len(seen), dtype=bool)):
            xy = triangulate(
                poses[pose[some]],
                rows.bearing_rad[seen[some]],
                rows.sigma_rad[seen[some]],
                camera_xy,
                least_parallax_rad,
            )
            if xy is not None:
                placed.append((number, xy))
                break
    found = np.array([number for number, _ in placed], dtype=np.int64)
    return InitialLines(
        ids=found,
        xy=np.array([xy for _, xy in placed], dtype=np.float64).reshape(-1, 2),
        unplaced=np.setdiff1d(np.array(every, dtype=np.int64), found),
    )


def well_placed(graph: Graph, estimate: Estimate) -> BoolArray:
    """Which lines of an estimate the bearings of its poses place.

    Returns (K,).
    """
    line, row = graph.member_line, graph.member_row
    pose = estimate.poses[graph.line_pose[row]]
    to_line = disc_in_robot(pose, estimate.line_xy[line]) - graph.camera_xy
    _, by_line = bearing_jacobians(pose, estimate.line_xy[line], graph.camera_xy)
    by_line /= graph.bearing_sigma_rad[row][:, None]
    information = np.zeros((len(graph.line_ids), 2, 2))
    np.add.at(information, line, by_line[:, :, None] * by_line[:, None, :])
    bearing = graph.bearing_rad[row]
    ahead = to_line[:, 0] * np.sin(bearing) - to_line[:, 1] * np.cos(bearing) > 0.0
    share = np.bincount(line, ahead, len(information)) / graph.line_row_counts
    certain = np.linalg.eigvalsh(information)[:, 0] > MOST_SIGMA_M**-2
    return np.asarray(certain & (share > 0.5))


def triangulate(
    poses: FloatArray,
    bearing_rad: FloatArray,
    sigma_rad: FloatArray,
    camera_xy: FloatArray,
    least_parallax_rad: float,
) -> FloatArray | None:
    """The place nearest to rays.

    Takes `poses` (n, 3), `bearing_rad, sigma_rad` (n,), `camera_xy` (2,); returns (2,).
    """
    start = apply(poses, camera_xy)
    # Bearing b in the robot frame is the direction (sin b, -cos b).
    course = poses[:, 2] + bearing_rad
    ray = np.stack([np.sin(course), -np.cos(course)], axis=1)
    normal = np.stack([-ray[:, 1], ray[:, 0]], axis=1)
    if _widest_crossing(course) < least_parallax_rad:
        return None
    # Nearest point to all rays, then again with each ray's miss counted as an angle.
    distance = np.ones(len(ray))
    for _ in range(3):
        weight = 1.0 / (sigma_rad * distance)
        rows = normal * weight[:, None]
        xy, *_ = np.linalg.lstsq(rows, np.sum(rows * start, axis=1), rcond=None)
        distance = np.maximum(np.linalg.norm(xy - start, axis=1), 0.1)
    ahead = np.sum((xy - start) * ray, axis=1) > 0.0
    miss = np.abs(np.sum((xy - start) * normal, axis=1)) / (sigma_rad * distance)
    if np.mean(ahead) <= 0.5 or np.median(miss) > MOST_MEDIAN_MISS:
        return None
    return np.asarray(xy)


def _widest_crossing(course_rad: FloatArray) -> float:
    """The largest angle under which two of (n,) directions cross as lines, 0 to a right angle."""
    ordered = np.sort(course_rad % np.pi)
    # Of each line, the one nearest to its perpendicular: the next or the last one around it.
    after = np.searchsorted(ordered, (ordered + 0.5 * np.pi) % np.pi)
    widest = 0.0
    for place in (after, after - 1):
        apart = np.abs(ordered[place % len(ordered)] - ordered)
        widest = max(widest, float(np.max(np.minimum(apart, np.pi - apart))))
    return widest
