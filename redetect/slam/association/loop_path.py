"""The path and the landmarks that a run's rows and labels say: sparse least squares.

For loop closing between two rounds: Gauss-Newton steps, damped where they fail, from the
last round's solution, with weights that let rows count less which contradict all others. The map
for its own sake, with marginal covariances and calibration, is `slam map`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, eye_array
from scipy.sparse.linalg import splu

from redetect.landmarks import wrap_angle
from redetect.slam.models.measurement import (
    bearing_jacobians,
    bearing_of_vertical,
    disc_in_map,
    disc_in_robot,
    disc_jacobians,
)
from redetect.slam.models.motion import chain_steps, relative_pose, relative_pose_jacobians
from redetect.slam.recording import Recording

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Beyond this many standard deviations a row pulls with constant force (Huber).
_HUBER_SIGMA = 3.0
_WORST_DAMPING = 1e8
# A line keeps near its start with this standard deviation: sights without parallax leave it free.
_LINE_PRIOR_M = 3.0


@dataclass(frozen=True, eq=False)
class Solution:
    """Path and landmarks.

    Attributes
    ----------
    path : (N + 1, 3) float64
        Start and pose after each step; theta is not wrapped.
    circle_xy : (M, 2) float64
        Discs by label (m).
    line_xy : (L, 2) float64
        Lines by label (m); NaN where nothing is known.
    cost : float
        The minimum: sum of Huber's function of the squared normalised residuals.
    """

    path: FloatArray
    circle_xy: FloatArray
    line_xy: FloatArray
    cost: float


@dataclass(frozen=True, eq=False)
class _System:
    """Constants of all steps: rows, labels and roots of the information."""

    recording: Recording
    circle_label: IntArray
    line_label: IntArray
    line_rows: IntArray  # rows of lines that have a place
    camera_xy: tuple[float, float]
    step_root: FloatArray
    circle_root: FloatArray
    line_root: FloatArray
    line_start: FloatArray


def first_sight(
    recording: Recording, path: FloatArray, labels: IntArray, count: int | None = None
) -> FloatArray:
    """Places of discs from the rows that saw them, as means over all rows.

    Parameters
    ----------
    recording : Recording
        The run.
    path : (N + 1, 3) float64
        Its poses.
    labels : (n,) int64
        Label of each disc row, from 0.
    count : int, optional
        Number of labels; by default the largest and one.

    Returns
    -------
    (count, 2) float64
        NaN for labels without rows.
    """
    size = int(labels.max(initial=-1)) + 1 if count is None else count
    seen = disc_in_map(path[recording.circles.frame + 1], recording.circles.xy)
    number = np.bincount(labels, minlength=size)
    with np.errstate(invalid="ignore"):
        return np.stack(
            [np.bincount(labels, seen[:, a], minlength=size) / number for a in (0, 1)], axis=-1
        )


def intersect_bearings(
    recording: Recording,
    path: FloatArray,
    labels: IntArray,
    *,
    camera_xy: tuple[float, float] = (0.0, 0.0),
) -> FloatArray:
    """Places of lines from the bearings of all rows that saw them, the path being known.

    Parameters
    ----------
    recording : Recording
        The run.
    path : (N + 1, 3) float64
        Its poses.
    labels : (n,) int64
        Label of each line row, from 0.
    camera_xy : (2,)
        The camera's centre in the robot frame (m).

    Returns
    -------
    (L, 2) float64
        NaN where the place is less certain than 0.5 m, or behind the camera.
    """
    lines = recording.lines
    count = int(labels.max(initial=-1)) + 1
    pose = path[lines.frame + 1]
    centre = disc_in_map(pose, np.broadcast_to(np.asarray(camera_xy), (len(pose), 2)))
    angle = lines.bearing_rad + pose[:, 2]
    along = np.stack([np.sin(angle), -np.cos(angle)], axis=-1)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    offset = np.sum(normal * centre, axis=1)
    distance = np.full(len(pose), 3.0)
    places = np.full((count, 2), np.nan)
    for _ in range(4):  # the farther a line, the less its bearing says
        weight = 1.0 / (lines.sigma_rad * np.maximum(distance, 0.3)) ** 2
        information = np.zeros((count, 2, 2))
        np.add.at(information, labels, weight[:, None, None] * normal[:, :, None] * normal[:, None])
        vector = np.zeros((count, 2))
        np.add.at(vector, labels, (weight * offset)[:, None] * normal)
        smallest = np.linalg.eigvalsh(information)[:, 0]
        certain = smallest > 1.0 / 0.5**2
        places[:] = np.nan
        places[certain] = np.linalg.solve(information[certain], vector[certain][..., None])[..., 0]
        ahead = np.sum(along * (places[labels] - centre), axis=1)
        distance = np.where(np.isfinite(ahead), np.abs(ahead), distance)
    behind = np.bincount(labels, ahead < 0.0, minlength=count) > 0
    places[behind] = np.nan
    return places


def solve_path(
    recording: Recording,
    circle_labels: IntArray,
    line_labels: IntArray,
    path: FloatArray | None = None,
    line_xy: FloatArray | None = None,
    *,
    camera_xy: tuple[float, float] = (0.0, 0.0),
    sigma_scale: float = 1.0,
    most_steps: int = 12,
    tolerance: float = 1e-4,
) -> Solution:
    """Least squares over all poses and landmarks.

    Parameters
    ----------
    recording : Recording
        The run.
    circle_labels, line_labels : (n,) int64
        Landmark of each row, from 0 without gaps.
    path : (N + 1, 3) float64, optional
        Where to start from; by default odometry.
    line_xy : (L, 2) float64, optional
        Initial positions of the lines (m); rows of lines with NaN are ignored. Without it, all
        lines are ignored.
    camera_xy : (2,)
        The camera's centre in the robot frame (m).
    sigma_scale : float
        Factor on the discs' standard deviations.
    most_steps : int
        Bound of the steps.
    tolerance : float
        A step that lowers the cost by less than this share is the last.

    Returns
    -------
    Solution
    """
    poses = chain_steps(recording.steps) if path is None else path.copy()
    discs = first_sight(recording, poses, circle_labels)
    lines = np.full((int(line_labels.max(initial=-1)) + 1, 2), np.nan)
    if line_xy is not None:
        lines[:] = line_xy
    known = np.isfinite(lines[:, 0])
    system = _System(
        recording=recording,
        circle_label=circle_labels,
        line_label=line_labels,
        line_rows=np.flatnonzero(known[line_labels]),
        camera_xy=camera_xy,
        step_root=_information_root(recording.step_covariance),
        circle_root=_information_root(sigma_scale**2 * recording.circles.covariance),
        line_root=1.0 / recording.lines.sigma_rad,
        line_start=lines.copy(),
    )
    known_lines = np.flatnonzero(known)
    residuals = _residuals(system, poses, discs, lines)
    cost = _cost(residuals)
    damping = 1e-6
    for _ in range(most_steps):
        accepted = False
        while damping < _WORST_DAMPING:
            change = _step(system, poses, discs, lines, residuals, damping)
            n, m = 3 * len(recording), 2 * len(discs)
            new_poses, new_discs, new_lines = poses.copy(), discs.copy(), lines.copy()
            new_poses[1:] += change[:n].reshape(-1, 3)
            new_discs += change[n : n + m].reshape(-1, 2)
            new_lines[known_lines] += change[n + m :].reshape(-1, 2)
            new_residuals = _residuals(system, new_poses, new_discs, new_lines)
            new_cost = _cost(new_residuals)
            if new_cost <= cost:
                accepted = True
                break
            damping = max(damping, 1e-6) * 100.0
        if not accepted:
            break
        gained = cost - new_cost
        poses, discs, lines, residuals = new_poses, new_discs, new_lines, new_residuals
        cost = new_cost
        damping *= 0.1
        if gained <= tolerance * cost:
            break
    return Solution(poses, discs, lines, cost)


_Residuals = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def _residuals(
    system: _System, poses: FloatArray, discs: FloatArray, lines: FloatArray
) -> _Residuals:
    """Normalised residuals of steps (N, 3), discs (n, 2), bearings and the lines' prior."""
    recording = system.recording
    step = relative_pose(poses[:-1], poses[1:]) - recording.steps
    step[:, 2] = wrap_angle(step[:, 2])
    circles = recording.circles
    disc = disc_in_robot(poses[circles.frame + 1], discs[system.circle_label]) - circles.xy
    rows = system.line_rows
    bearing = wrap_angle(
        bearing_of_vertical(
            poses[recording.lines.frame[rows] + 1],
            lines[system.line_label[rows]],
            np.asarray(system.camera_xy),
        )
        - recording.lines.bearing_rad[rows]
    )
    moved = lines - system.line_start
    return (
        np.einsum("nij,nj->ni", system.step_root, step),
        np.einsum("nij,nj->ni", system.circle_root, disc),
        bearing * system.line_root[rows],
        moved[np.isfinite(moved[:, 0])] / _LINE_PRIOR_M,
    )


def _cost(residuals: _Residuals) -> float:
    step, disc, bearing, prior = residuals
    total = float(np.sum(step**2) + np.sum(prior**2))
    for squared in (np.sum(disc**2, axis=1), bearing**2):
        length = np.sqrt(squared)
        beyond = 2.0 * _HUBER_SIGMA * length - _HUBER_SIGMA**2
        total += float(np.sum(np.where(length > _HUBER_SIGMA, beyond, squared)))
    return total


def _root_weights(squared: FloatArray) -> FloatArray:
    return np.sqrt(_HUBER_SIGMA / np.maximum(np.sqrt(squared), _HUBER_SIGMA))


def _step(
    system: _System,
    poses: FloatArray,
    discs: FloatArray,
    lines: FloatArray,
    residuals: _Residuals,
    damping: float,
) -> FloatArray:
    """Change of all unknowns: poses but the first, discs, lines with a place."""
    recording = system.recording
    count = len(recording)
    first_disc = 3 * count
    first_line = first_disc + 2 * len(discs)
    known = np.flatnonzero(np.isfinite(lines[:, 0]))
    line_column = np.full(len(lines), -1, dtype=np.int64)
    line_column[known] = first_line + 2 * np.arange(len(known))
    blocks: list[tuple[FloatArray, IntArray]] = []  # (n, d, k) values, (n, k) columns

    by_first, by_second = relative_pose_jacobians(poses[:-1], poses[1:])
    columns = 3 * (np.arange(count)[:, None] - 1) + np.arange(6)
    values = system.step_root @ np.concatenate([by_first, by_second], axis=2)
    blocks.append((values, columns))

    circles = recording.circles
    weight = _root_weights(np.sum(residuals[1] ** 2, axis=1))
    by_pose, by_disc = disc_jacobians(poses[circles.frame + 1], discs[system.circle_label])
    columns = np.concatenate(
        [
            3 * circles.frame[:, None] + np.arange(3),
            first_disc + 2 * system.circle_label[:, None] + np.arange(2),
        ],
        axis=1,
    )
    values = system.circle_root @ np.concatenate([by_pose, by_disc], axis=2)
    blocks.append((weight[:, None, None] * values, columns))
    weighted = [residuals[0].reshape(-1), (weight[:, None] * residuals[1]).reshape(-1)]

    rows = system.line_rows
    label, frame = system.line_label[rows], recording.lines.frame[rows]
    weight = _root_weights(residuals[2] ** 2)
    by_pose, by_line = bearing_jacobians(
        poses[frame + 1], lines[label], np.asarray(system.camera_xy)
    )
    columns = np.concatenate(
        [3 * frame[:, None] + np.arange(3), line_column[label][:, None] + np.arange(2)], axis=1
    )
    values = np.concatenate([by_pose, by_line], axis=1) * (weight * system.line_root[rows])[:, None]
    blocks.append((values[:, None], columns))
    weighted.append(weight * residuals[2])

    columns = line_column[known][:, None] + np.arange(2)
    blocks.append((np.tile(np.eye(2) / _LINE_PRIOR_M, (len(known), 1, 1)), columns))
    weighted.append(residuals[3].reshape(-1))

    all_values, all_rows, all_columns, start = [], [], [], 0
    for block, column in blocks:
        n, d, k = block.shape
        row = start + (d * np.arange(n)[:, None] + np.arange(d))[:, :, None]
        all_values.append(block.reshape(-1))
        all_rows.append(np.broadcast_to(row, (n, d, k)).reshape(-1))
        all_columns.append(np.broadcast_to(column[:, None], (n, d, k)).reshape(-1))
        start += n * d
    column, value = np.concatenate(all_columns), np.concatenate(all_values)
    free = column >= 0  # the first pose is fixed
    size = first_line + 2 * len(known)
    jacobian = csc_array(
        (value[free], (np.concatenate(all_rows)[free], column[free])), shape=(start, size)
    )
    normal = (jacobian.T @ jacobian).tocsc()
    # In units of each unknown's own information, so that metres and radians are treated alike.
    scale = np.sqrt(normal.diagonal())
    scale[scale == 0.0] = 1.0
    scaled = csc_array(normal.multiply(1.0 / scale[:, None]).multiply(1.0 / scale[None, :]))
    scaled = (scaled + damping * eye_array(size, format="csc")).tocsc()
    solver = splu(scaled, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    gradient = jacobian.T @ np.concatenate(weighted)
    return np.asarray(-solver.solve(gradient / scale) / scale)


def _information_root(covariance: FloatArray) -> FloatArray:
    """Roots W with W^T W = covariance^-1, of (n, d, d)."""
    return np.linalg.inv(np.linalg.cholesky(covariance))
