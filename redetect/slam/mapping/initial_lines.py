"""Initial estimates of the positions of vertical lines, from bearings alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.plane import apply
from redetect.slam.mapping.graph import Estimate, Graph
from redetect.slam.models import bearing_jacobians, disc_in_robot
from redetect.slam.recording import LineRows

#: Largest distance of a ray from the intersection it agrees with, in standard deviations.
MOST_MISS = 10.0
#: Lines with a less certain position, given the poses, are dropped.
MOST_SIGMA_M = 0.5
# Odometry is good enough for a first triangulation over about this many metres of path.
_LOCAL_PATH_M = 15.0


@dataclass(frozen=True, eq=False)
class InitialLines:
    """Lines that can be triangulated, and the others."""

    ids: IntArray  # (K,): triangulated lines, ascending
    xy: FloatArray  # (K, 2): their positions in the map (m)
    unplaced: IntArray  # (U,): lines never seen, alone in a row, under enough parallax


def place_lines(poses: FloatArray, rows: LineRows, camera_xy: FloatArray) -> InitialLines:
    """Triangulate lines from sufficiently accurate poses.

    Only rows of a single line are used, since two lines that were always joined cannot be
    separated. A line is triangulated from its views along some metres of path after its first
    sight; if it stays uncertain, from all its views. Half of them have to agree with its position.

    Takes `poses` (N + 1, 3), `camera_xy` (2,).
    """
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))])
    every = np.array(sorted({i for ids in rows.ids for i in ids}), dtype=np.int64)
    seen = np.flatnonzero([len(ids) == 1 for ids in rows.ids])
    label = np.searchsorted(every, [rows.ids[k][0] for k in seen])
    pose = rows.frame[seen] + 1
    _, first, view = np.unique(label, return_index=True, return_inverse=True)
    near = way[pose] - way[pose[first[view]]] <= _LOCAL_PATH_M
    xy = np.full((len(every), 2), np.nan)
    for some in (near, np.ones(len(seen), dtype=bool)):
        use = some & np.isnan(xy[label, 0])
        own, bearing, sigma = seen[use], rows.bearing_rad, rows.sigma_rad
        found, ahead, miss = meeting_points(
            *(poses[pose[use]], bearing[own], sigma[own], label[use], len(every)),
            camera_xy,
            MOST_SIGMA_M**-2,
        )
        agrees = (ahead > 0.0) & (miss <= MOST_MISS)
        count, right = (np.bincount(label[use], w, len(every)) for w in (None, agrees))
        xy = np.where((right > 0.5 * count)[:, None], found, xy)
    placed = np.isfinite(xy[:, 0])
    return InitialLines(every[placed], xy[placed], every[~placed])


def well_placed(graph: Graph, estimate: Estimate) -> BoolArray:
    """(K,) mask of the lines of an estimate whose position the bearings determine."""
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


def meeting_points(
    poses: FloatArray,
    bearing_rad: FloatArray,
    sigma_rad: FloatArray,
    labels: IntArray,
    count: int,
    camera_xy: ArrayLike,
    least_information: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The points nearest to the rays of each line, by angular distance.

    Takes `poses` (n, 3), `bearing_rad, sigma_rad, labels` (n,), `camera_xy` (2,). Returns points
    (count, 2), NaN if the information (m^-2) is less in some direction; for each ray the distance
    of the point along it (n,) (m), and from it in standard deviations (n,).
    """
    centre = apply(poses, np.broadcast_to(np.asarray(camera_xy), (len(poses), 2)))
    # A bearing b in the robot frame is the direction (sin b, -cos b).
    angle = bearing_rad + poses[:, 2]
    along = np.stack([np.sin(angle), -np.cos(angle)], axis=-1)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    offset = np.sum(normal * centre, axis=1)
    distance = np.full(len(poses), 3.0)
    for _ in range(4):  # reweighting, since a bearing is less accurate in metres at a distance
        weight = 1.0 / (sigma_rad * np.maximum(distance, 0.3)) ** 2
        information = np.zeros((count, 2, 2))
        np.add.at(information, labels, weight[:, None, None] * normal[:, :, None] * normal[:, None])
        vector = np.zeros((count, 2))
        np.add.at(vector, labels, (weight * offset)[:, None] * normal)
        certain = np.linalg.eigvalsh(information)[:, 0] > least_information
        places = np.full((count, 2), np.nan)
        places[certain] = np.linalg.solve(information[certain], vector[certain][..., None])[..., 0]
        ahead = np.sum(along * (places[labels] - centre), axis=1)
        distance = np.where(np.isfinite(ahead), np.abs(ahead), distance)
    miss = np.abs(np.sum((places[labels] - centre) * normal, axis=1)) * np.sqrt(weight)
    return places, ahead, miss
