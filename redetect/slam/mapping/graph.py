"""All measurements of a run as one least-squares problem, and a value for each of its unknowns.

One map can represent a run only if all its parts are connected, which is checked here, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from camera import Camera
from redetect.array_types import FloatArray, IntArray
from redetect.least_squares.solver import whitening
from redetect.plane import apply
from redetect.slam.errors import SlamError
from redetect.slam.models import chain_steps
from redetect.slam.recording import LineRows, Recording


@dataclass(frozen=True, eq=False)
class Graph:
    """The measurements of a run, each with a root of its information.

    A whitening W of a covariance C has W C W^T = I. Pose 0 is the start, pose k + 1 that after
    step k.

    Attributes
    ----------
    steps : (N, 3) float64
        Odometry (m, m, rad).
    step_whitening : (N, 3, 3) float64
    disc_ids : (M,) int64
        Ascending.
    disc_pose, disc_index : (n,) int64
        From which pose each row saw which disc (index into `disc_ids`).
    disc_xy : (n, 2) float64
        Where, in the robot frame (m).
    disc_whitening : (n, 2, 2) float64
    line_ids : (K,) int64
        Vertical lines, ascending.
    line_pose : (q,) int64
        From which pose each row saw its lines.
    bearing_rad, bearing_sigma_rad : (q,) float64
        The rows' bearings and their standard deviations.
    member_row, member_line : (e,) int64
        Which rows show which lines (index into `line_ids`); a row may show several.
    camera_xy : (2,) float64
        Where in the robot frame bearings are taken from (m).
    camera : Camera or None
        As calibrated; it is needed where the mounting or a tilt is estimated.
    line_prior : (K, 2) float64 or None
        Where lines are believed to be (m): it bounds those that bearings leave open.
    """

    steps: FloatArray
    step_whitening: FloatArray
    disc_ids: IntArray
    disc_pose: IntArray
    disc_index: IntArray
    disc_xy: FloatArray
    disc_whitening: FloatArray
    line_ids: IntArray
    line_pose: IntArray
    bearing_rad: FloatArray
    bearing_sigma_rad: FloatArray
    member_row: IntArray
    member_line: IntArray
    camera_xy: FloatArray
    camera: Camera | None = None
    line_prior: FloatArray | None = None

    @property
    def disc_row_counts(self) -> IntArray:
        """(M,) how many rows show each disc."""
        return np.bincount(self.disc_index, minlength=len(self.disc_ids)).astype(np.int64)

    @property
    def line_row_counts(self) -> IntArray:
        """(K,) how many rows show each line."""
        return np.bincount(self.member_line, minlength=len(self.line_ids)).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Estimate:
    """A value for each unknown.

    Attributes
    ----------
    poses : (N + 1, 3) float64
        x, y (m), theta (rad) in the map; the first is given, not estimated.
    disc_xy : (M, 2) float64
        Discs in the map (m).
    line_xy : (K, 2) float64
        Vertical lines in the map (m).
    mounting : (3, 4) float64 or None
        robot_from_camera as mounted; None: as calibrated, and discs are taken as the rows say.
    tilt : (N + 1, 2) float64 or None
        Pitch and roll per pose (rad): x and y of a rotation vector in the robot frame; None: the
        robot is upright.
    """

    poses: FloatArray
    disc_xy: FloatArray
    line_xy: FloatArray
    mounting: FloatArray | None = None
    tilt: FloatArray | None = None


def graph_of_recording(recording: Recording, camera: Camera | None = None) -> Graph:
    """The problem that a run's odometry and discs pose; lines come in by `with_lines`.

    Parameters
    ----------
    recording : Recording
        The run. Rows without an identifier are left out.
    camera : Camera, optional
        As calibrated.

    Returns
    -------
    Graph
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
    )


def with_lines(graph: Graph, rows: LineRows, line_ids: IntArray) -> Graph:
    """The problem with the bearings of some lines.

    Takes `line_ids` (K,).
    """
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


def first_sight(graph: Graph, start: ArrayLike = (0.0, 0.0, 0.0)) -> Estimate:
    """Poses as odometry chains them, discs where they were first seen, no lines.

    Parameters
    ----------
    graph : Graph
        Its lines are not placed: `line_xy` is NaN.
    start : (3,) array_like
        The first pose.

    Returns
    -------
    Estimate
    """
    poses = chain_steps(graph.steps, start)
    _, first = np.unique(graph.disc_index, return_index=True)
    return Estimate(
        poses=poses,
        disc_xy=apply(poses[graph.disc_pose[first]], graph.disc_xy[first]),
        line_xy=np.full((len(graph.line_ids), 2), np.nan),
    )


#: Beyond these standard deviations a step gives no information about the robot's motion.
MOST_STEP_SIGMA_M = 100.0
MOST_STEP_SIGMA_RAD = float(np.pi)
#: Parts of a run are connected if they share this many landmarks; one leaves a rotation free.
FEWEST_SHARED = 2


def lost_steps(step_covariance: FloatArray) -> IntArray:
    """Steps whose odometry gives no information.

    Takes `step_covariance` (N, 3, 3); returns (L,).
    """
    way = np.linalg.eigvalsh(step_covariance[:, :2, :2])[:, -1]
    lost = (way > MOST_STEP_SIGMA_M**2) | (step_covariance[:, 2, 2] > MOST_STEP_SIGMA_RAD**2)
    return np.flatnonzero(lost)


def check_connected(recording: Recording, name: str) -> None:
    """See that landmarks join the parts between which odometry is lost."""
    lost = lost_steps(recording.step_covariance)
    if len(lost) == 0:
        return
    seen: list[set[tuple[str, int]]] = [set() for _ in range(len(lost) + 1)]
    circles, lines = recording.circles, recording.lines
    for part, number in zip(np.searchsorted(lost, circles.frame, side="right"), circles.ids):
        if number >= 0:
            seen[part].add(("disc", int(number)))
    for part, ids in zip(np.searchsorted(lost, lines.frame, side="right"), lines.ids):
        seen[part].update(("line", i) for i in ids)
    # Parts grow together as long as any two share enough.
    joined = [({k}, landmarks) for k, landmarks in enumerate(seen)]
    grown = True
    while grown:
        grown = False
        for a in range(len(joined)):
            for b in range(len(joined) - 1, a, -1):
                if len(joined[a][1] & joined[b][1]) >= FEWEST_SHARED:
                    parts, landmarks = joined.pop(b)
                    joined[a] = (joined[a][0] | parts, joined[a][1] | landmarks)
                    grown = True
    if len(joined) == 1:
        return
    # Name the first step with parts on both sides that nothing joins.
    group = {part: k for k, (parts, _) in enumerate(joined) for part in parts}
    broken = next(k for k in range(len(lost)) if group[k] != group[k + 1])
    step = int(lost[broken])
    covariance = recording.step_covariance[step]
    shared = len(joined[group[broken]][1] & joined[group[broken + 1]][1])
    sigma = np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    raise SlamError(
        f"{name}: disconnected at step {step + 1} ({recording.prefixes[step]}): its odometry is "
        f"lost (standard deviations {sigma:.3g} m, {np.sqrt(covariance[2, 2]):.3g} rad), and the "
        f"parts before and after share {shared} landmarks: expected at least {FEWEST_SHARED}"
    )
