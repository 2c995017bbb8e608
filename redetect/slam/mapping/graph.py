"""The measurements of a run as one least-squares problem, and first estimates of its unknowns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from camera import Camera
from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.least_squares.solver import whitening
from redetect.plane import apply, chain_steps
from redetect.slam.models import bearing_jacobians, disc_in_robot
from redetect.slam.recording import LineRows, Recording

#: Largest distance of a ray from the intersection it agrees with, in standard deviations.
MOST_MISS = 10.0
#: Lines with a less certain position, given the poses, are dropped.
MOST_SIGMA_M = 0.5
# Odometry is good enough for a first triangulation over about this many metres of path.
_LOCAL_PATH_M = 15.0
# No robot's camera is closer to an edge than this.
_NEAREST_M = 0.1


@dataclass(frozen=True, eq=False)
class Graph:
    """The measurements of a run, each with a root of its information.

    A whitening W of a covariance C has W C W^T = I. Pose 0 is the start, pose k + 1 after step k.
    """

    steps: FloatArray  # (N, 3): odometry (m, m, rad)
    step_whitening: FloatArray  # (N, 3, 3)
    disc_ids: IntArray  # (M,): ascending
    disc_pose: IntArray  # (n,): pose of each row
    disc_index: IntArray  # (n,): its disc, as an index of `disc_ids`
    disc_xy: FloatArray  # (n, 2): measured position in the robot frame (m)
    disc_whitening: FloatArray  # (n, 2, 2)
    line_ids: IntArray  # (K,): of vertical lines, ascending
    line_pose: IntArray  # (q,): pose of each row of lines
    bearing_rad: FloatArray  # (q,)
    bearing_sigma_rad: FloatArray  # (q,)
    # (e,): pairs of row and line (an index of `line_ids`); a row may show several lines.
    member_row: IntArray
    member_line: IntArray
    camera_xy: FloatArray  # (2,): origin of bearings in the robot frame (m)
    camera: Camera | None = None  # as calibrated; needed if the mounting is estimated
    line_prior: FloatArray | None = None  # (K, 2): priors of lines (m), if bearings are too few
    common_tilt_variance: float = 0.0  # of pitch and roll common to all frames (rad^2)

    @property
    def first_disc(self) -> int:
        """Index of the discs in the vector of unknowns, after all poses but the first."""
        return 3 * len(self.steps)

    @property
    def first_line(self) -> int:
        """Index of the lines in the vector of unknowns."""
        return self.first_disc + 2 * len(self.disc_ids)

    @property
    def unknowns(self) -> int:
        """Number of unknowns: poses, then discs, then lines."""
        return self.first_line + 2 * len(self.line_ids)

    @property
    def disc_row_counts(self) -> IntArray:
        """(M,) number of rows of each disc."""
        return np.bincount(self.disc_index, minlength=len(self.disc_ids)).astype(np.int64)

    @property
    def line_row_counts(self) -> IntArray:
        """(K,) number of rows of each line."""
        return np.bincount(self.member_line, minlength=len(self.line_ids)).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Estimate:
    """A value for each unknown."""

    poses: FloatArray  # (N + 1, 3): x, y (m), theta (rad); the first is given, not estimated
    disc_xy: FloatArray  # (M, 2): discs in the map (m)
    line_xy: FloatArray  # (K, 2): vertical lines in the map (m)
    # (3, 4): robot_from_camera as mounted; None: as calibrated, and rows of discs are used as is.
    mounting: FloatArray | None = None


def graph_of_recording(recording: Recording, camera: Camera | None = None) -> Graph:
    """The problem of odometry and identified discs; `with_lines` adds lines."""
    circles = recording.circles
    known = circles.identified
    ids, index = np.unique(circles.ids[known], return_inverse=True)
    none = np.zeros(0, dtype=np.int64)
    return Graph(
        steps=recording.steps,
        step_whitening=whitening(recording.step_covariance),
        disc_ids=ids,
        disc_pose=circles.frame[known] + 1,
        disc_index=index.astype(np.int64),
        disc_xy=circles.xy[known],
        disc_whitening=whitening(circles.covariance[known]),
        line_ids=none,
        line_pose=none,
        bearing_rad=np.zeros(0),
        bearing_sigma_rad=np.zeros(0),
        member_row=none,
        member_line=none,
        camera_xy=np.zeros(2) if camera is None else np.array(camera.centre[:2]),
        camera=camera,
        common_tilt_variance=recording.common_tilt_variance,
    )


def with_lines(graph: Graph, rows: LineRows, line_ids: IntArray) -> Graph:
    """The problem with the bearings of some lines, `line_ids` (K,)."""
    place = {int(number): k for k, number in enumerate(line_ids)}
    usable = [k for k, ids in enumerate(rows.ids) if ids and all(i in place for i in ids)]
    members = [(r, place[i]) for r, k in enumerate(usable) for i in rows.ids[k]]
    table = np.array(members, dtype=np.int64).reshape(-1, 2)
    return replace(
        graph,
        line_ids=np.asarray(line_ids, dtype=np.int64),
        line_pose=rows.frame[usable] + 1,
        bearing_rad=rows.bearing_rad[usable],
        bearing_sigma_rad=rows.sigma_rad[usable],
        member_row=table[:, 0].copy(),
        member_line=table[:, 1].copy(),
    )


def first_sight(
    graph: Graph, start: ArrayLike = (0.0, 0.0, 0.0), poses: FloatArray | None = None
) -> Estimate:
    """Poses chained by odometry from the first (3,), discs where they were first seen.

    Other poses (N + 1, 3) may be given. Lines have no initial position: `line_xy` is NaN.
    """
    poses = chain_steps(graph.steps, start) if poses is None else poses
    _, first = np.unique(graph.disc_index, return_index=True)
    return Estimate(
        poses=poses,
        disc_xy=apply(poses[graph.disc_pose[first]], graph.disc_xy[first]),
        line_xy=np.full((len(graph.line_ids), 2), np.nan),
    )


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
    lengths = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    driven = np.concatenate([[0.0], np.cumsum(lengths)])
    every = np.array(sorted({i for ids in rows.ids for i in ids}), dtype=np.int64)
    seen = np.flatnonzero([len(ids) == 1 for ids in rows.ids])
    label = np.searchsorted(every, [rows.ids[k][0] for k in seen])
    pose = rows.frame[seen] + 1
    _, first, view = np.unique(label, return_index=True, return_inverse=True)
    near = driven[pose] - driven[pose[first[view]]] <= _LOCAL_PATH_M
    xy = np.full((len(every), 2), np.nan)
    for some in (near, np.ones(len(seen), dtype=bool)):
        use = some & np.isnan(xy[label, 0])
        own = rows.only(seen[use])
        views = (poses[pose[use]], own.bearing_rad, own.sigma_rad, label[use], len(every))
        met = triangulate(*views, camera_xy)
        agrees = (met.ahead_m > 0.0) & (met.miss_sigmas <= MOST_MISS)
        count, right = (np.bincount(label[use], w, len(every)) for w in (None, agrees))
        xy = np.where((right > 0.5 * count)[:, None], met.xy, xy)
    placed = np.isfinite(xy[:, 0])
    return InitialLines(every[placed], xy[placed], every[~placed])


def well_placed(graph: Graph, estimate: Estimate) -> BoolArray:
    """(K,) mask of the lines of an estimate whose position the bearings determine.

    Rows of different lines with one identifier may agree best on a point at a camera: from there
    every bearing is possible, and its information is without bound.
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
    at_camera = np.bincount(line, np.hypot(*to_line.T) < _NEAREST_M, len(information))
    return np.asarray(certain & (share > 0.5) & (at_camera == 0))


class Triangulation(NamedTuple):
    """The points in which the rays of K lines meet, and how well."""

    xy: FloatArray  # (K, 2) metres; NaN if the rays do not determine it
    ahead_m: FloatArray  # (n,) distance of the point along each ray
    miss_sigmas: FloatArray  # (n,) distance from each ray, standard deviations


def triangulate(
    poses: FloatArray,
    bearing_rad: FloatArray,
    sigma_rad: FloatArray,
    labels: IntArray,
    count: int,
    camera_xy: ArrayLike,
) -> Triangulation:
    """Triangulate `count` lines: the points nearest to the rays of each, by angular distance.

    Takes `poses` (n, 3), `bearing_rad, sigma_rad, labels` (n,), `camera_xy` (2,). A point is
    determined if its standard deviation is below `MOST_SIGMA_M` in every direction.
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
        certain = np.linalg.eigvalsh(information)[:, 0] > MOST_SIGMA_M**-2
        places = np.full((count, 2), np.nan)
        places[certain] = np.linalg.solve(information[certain], vector[certain][..., None])[..., 0]
        ahead = np.sum(along * (places[labels] - centre), axis=1)
        distance = np.where(np.isfinite(ahead), np.abs(ahead), distance)
    miss = np.abs(np.sum((places[labels] - centre) * normal, axis=1)) * np.sqrt(weight)
    return Triangulation(places, ahead, miss)
