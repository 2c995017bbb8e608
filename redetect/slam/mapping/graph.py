"""The measurements of a run as one least-squares problem, and estimates of its unknowns."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from camera import Camera
from redetect.array_types import FloatArray, IntArray
from redetect.least_squares.solver import whitening
from redetect.plane import apply, chain_steps
from redetect.slam.recording import LineRows, Recording


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
    """The problem of a run's odometry and discs; `with_lines` adds lines.

    Rows without an identifier are ignored.
    """
    circles = recording.circles
    known = circles.ids >= 0
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
