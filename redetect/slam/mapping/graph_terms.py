"""Whitened errors of odometry, discs, lines and tilt at an estimate, with their Jacobians."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from redetect.landmarks import wrap_angle
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import Estimate, Graph
from redetect.slam.models.measurement import (
    bearing_jacobians,
    bearing_of_vertical,
    disc_in_robot,
    disc_jacobians,
)
from redetect.slam.models.motion import relative_pose, relative_pose_jacobians
from redetect.slam.models.mounting import (
    RecordedJacobians,
    directions_of_rows,
    nominal_mounting,
    rows_as_recorded,
    rows_through_mounting,
    turn_to_the_left,
)
from redetect.storage.bounds import ABOVE_0, Bounds, demand

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Loss = Literal["none", "huber", "cauchy", "geman-mcclure"]
RowErrors = Literal["corrected", "recorded"]

#: Rotation about robot x, y, z, and height.
MOUNTING_UNKNOWNS = 4


_SWAY_RAD = Bounds("from 0 to less than a right angle", 0.0, 0.5 * math.pi, below=True)


@dataclass(frozen=True)
class Weighting:
    """The cost function and the unknowns.

    Attributes
    ----------
    loss : str
        How much a landmark row counts; odometry always counts in full.
    loss_scale : float
        Standard deviations from which on rows pull less.
    calibrate : bool
        Whether the camera's rotation and height are unknowns.
    row_errors : "corrected" or "recorded"
        Where rows and discs are compared when the mounting is unknown. `corrected`: the row's pixel
        is put on the floor by the camera as mounted, under the row's own covariance. `recorded`:
        the row that the calibrated camera would have written is compared with the one it wrote,
        which is where that covariance belongs.
    tilt_sigma_rad : float
        Standard deviation of each pose's pitch and roll; 0: the robot is upright. With a tilt, rows
        are compared as recorded.
    """

    loss: Loss = "none"
    loss_scale: float = 3.0
    calibrate: bool = False
    row_errors: RowErrors = "corrected"
    tilt_sigma_rad: float = 0.0

    def __post_init__(self) -> None:
        demand(self, SlamError, loss_scale=ABOVE_0, tilt_sigma_rad=_SWAY_RAD)


@dataclass(frozen=True)
class Layout:
    """Layout of the vector of unknowns: poses except the first, tilt, discs, lines."""

    poses: int
    discs: int
    lines: int
    tilted: bool

    @property
    def first_tilt(self) -> int:
        return 3 * (self.poses - 1)

    @property
    def first_disc(self) -> int:
        return self.first_tilt + (2 * (self.poses - 1) if self.tilted else 0)

    @property
    def first_line(self) -> int:
        return self.first_disc + 2 * self.discs

    @property
    def size(self) -> int:
        return self.first_line + 2 * self.lines


def layout_of(graph: Graph, weighting: Weighting) -> Layout:
    """Layout of a problem's unknowns."""
    return Layout(
        poses=len(graph.steps) + 1,
        discs=len(graph.disc_ids),
        lines=len(graph.line_ids),
        tilted=weighting.tilt_sigma_rad > 0.0,
    )


@dataclass(frozen=True, eq=False)
class Errors:
    """Whitened errors by kind, not robustified.

    Attributes
    ----------
    odometry : (N, 3) float64
    discs : (n, 2) float64
        NaN where a disc would be out of the camera's sight.
    lines : (q,) float64
    tilt : (N, 2) or (0, 2) float64
    """

    odometry: FloatArray
    discs: FloatArray
    lines: FloatArray
    tilt: FloatArray


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Dense pieces (b, h, w) of a Jacobian at rows and columns (b,)."""

    row: IntArray
    column: IntArray
    values: FloatArray


def errors(graph: Graph, estimate: Estimate, weighting: Weighting) -> Errors:
    """Whitened errors at an estimate: predicted minus measured, in standard deviations."""
    step = relative_pose(estimate.poses[:-1], estimate.poses[1:]) - graph.steps
    step[:, 2] = wrap_angle(step[:, 2])
    tilt = np.zeros((0, 2))
    if estimate.tilt is not None and weighting.tilt_sigma_rad > 0.0:
        tilt = estimate.tilt[1:] / weighting.tilt_sigma_rad
    return Errors(
        odometry=_apply(graph.step_whitening, step),
        discs=_apply(graph.disc_whitening, _disc_errors(graph, estimate, weighting)),
        lines=_bearing_errors(graph, estimate),
        tilt=tilt,
    )


def robust(squared: FloatArray, weighting: Weighting) -> tuple[FloatArray, FloatArray]:
    """Costs of rows under the loss, and their weights in the equivalent least squares.

    Parameters
    ----------
    squared : (n,) float64
        Squared errors of rows in units of their variance.
    weighting : Weighting
        The loss: Huber, Cauchy (Lorentzian) or Geman-McClure; all are the square near 0.

    Returns
    -------
    cost, weight : (n,) float64
        The weight is the cost's derivative by the square.
    """
    c2 = weighting.loss_scale**2
    if weighting.loss == "huber":
        far = squared > c2
        root = np.sqrt(np.where(far, squared, c2))
        scale = weighting.loss_scale
        return np.where(far, 2.0 * scale * root - c2, squared), np.where(far, scale / root, 1.0)
    if weighting.loss == "cauchy":
        return c2 * np.log1p(squared / c2), 1.0 / (1.0 + squared / c2)
    if weighting.loss == "geman-mcclure":
        return squared * c2 / (c2 + squared), (c2 / (c2 + squared)) ** 2
    return squared, np.ones_like(squared)


def cost(graph: Graph, estimate: Estimate, weighting: Weighting) -> float:
    """The function to minimise; infinite if a disc would be out of the camera's sight."""
    error = errors(graph, estimate, weighting)
    discs, _ = robust(np.sum(error.discs**2, axis=1), weighting)
    lines, _ = robust(error.lines**2, weighting)
    total = float(np.sum(error.odometry**2) + np.sum(discs) + np.sum(lines) + np.sum(error.tilt**2))
    return total if np.isfinite(total) else float("inf")


@dataclass(frozen=True, eq=False)
class Linearised:
    """A linear least-squares problem: the change x, m of the unknowns least in ``|J x + B m + r|``.

    Attributes
    ----------
    residual : (R,) float64
    jacobian : (R, K) sparse
        By all unknowns but the mounting, in the order of `Layout`.
    border : (R, 4) or (R, 0) float64
        By the mounting: a rotation vector in the robot frame, applied from the left, and height.
    """

    residual: FloatArray
    jacobian: sparse.csr_array
    border: FloatArray


def linearise(graph: Graph, estimate: Estimate, weighting: Weighting) -> Linearised:
    """The problem near an estimate; robust losses as reweighted least squares."""
    layout = layout_of(graph, weighting)
    error = errors(graph, estimate, weighting)
    disc_root = np.sqrt(robust(np.sum(error.discs**2, axis=1), weighting)[1])
    line_root = np.sqrt(robust(error.lines**2, weighting)[1])
    first_disc_row = 3 * len(graph.steps)
    first_line_row = first_disc_row + 2 * len(graph.disc_pose)
    first_tilt_row = first_line_row + len(graph.line_pose)
    rows = first_tilt_row + error.tilt.size

    by_pose, by_tilt, by_disc, by_mounting = _disc_blocks(graph, estimate, weighting)
    scale = disc_root[:, None, None]
    row = first_disc_row + 2 * np.arange(len(graph.disc_pose), dtype=np.int64)
    blocks = [
        *_odometry_blocks(graph, estimate),
        *_pose_blocks(row, graph.disc_pose, by_pose * scale),
        _Blocks(row, layout.first_disc + 2 * graph.disc_index, by_disc * scale),
        *_line_blocks(graph, estimate, layout, line_root, first_line_row),
    ]
    if layout.tilted:
        blocks.append(_Blocks(row, layout.first_tilt + 2 * (graph.disc_pose - 1), by_tilt * scale))
        every = np.arange(error.tilt.size, dtype=np.int64)
        level = np.full((len(every), 1, 1), 1.0 / weighting.tilt_sigma_rad)
        blocks.append(_Blocks(first_tilt_row + every, layout.first_tilt + every, level))
    border = np.zeros((rows, MOUNTING_UNKNOWNS if weighting.calibrate else 0))
    if weighting.calibrate:
        border[first_disc_row:first_line_row] = (by_mounting * scale).reshape(-1, 4)
        if estimate.mounting is not None and graph.camera is not None:
            # Rows' bearings were put into the robot frame as calibrated: a camera that is really
            # turned to the left sees landmarks further to the right than they are.
            _, by_turn = turn_to_the_left(graph.camera, estimate.mounting)
            lines = -(line_root / graph.bearing_sigma_rad)[:, None] * by_turn
            border[first_line_row:first_tilt_row] = lines
    return Linearised(
        residual=np.concatenate(
            [
                error.odometry.ravel(),
                (error.discs * disc_root[:, None]).ravel(),
                error.lines * line_root,
                error.tilt.ravel(),
            ]
        ),
        jacobian=_sparse(blocks, (rows, layout.size)),
        border=border,
    )


def _apply(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("nij,nj->ni", matrices, vectors))


def _disc_errors(graph: Graph, estimate: Estimate, weighting: Weighting) -> FloatArray:
    """(n, 2) discs as rows would have them, less the rows (m)."""
    if estimate.mounting is None and estimate.tilt is None:
        return _seen_discs(graph, estimate) - graph.disc_xy
    assert graph.camera is not None
    if estimate.mounting is not None and weighting.row_errors == "corrected":
        directions = directions_of_rows(graph.camera, graph.disc_xy)
        rows, _ = rows_through_mounting(graph.camera, directions, estimate.mounting)
        return _seen_discs(graph, estimate) - rows
    return _as_recorded(graph, estimate)[0] - graph.disc_xy


def _as_recorded(graph: Graph, estimate: Estimate) -> tuple[FloatArray, RecordedJacobians]:
    assert graph.camera is not None
    tilt = np.zeros((len(estimate.poses), 2)) if estimate.tilt is None else estimate.tilt
    mounting = estimate.mounting
    if mounting is None:
        mounting = nominal_mounting(graph.camera)
    return rows_as_recorded(
        graph.camera, _seen_discs(graph, estimate), mounting, tilt[graph.disc_pose]
    )


def _seen_discs(graph: Graph, estimate: Estimate) -> FloatArray:
    return disc_in_robot(estimate.poses[graph.disc_pose], estimate.disc_xy[graph.disc_index])


def _disc_blocks(
    graph: Graph, estimate: Estimate, weighting: Weighting
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Derivatives of whitened disc errors by pose, tilt, disc and mounting."""
    whiten = graph.disc_whitening
    by_pose, by_disc = disc_jacobians(
        estimate.poses[graph.disc_pose], estimate.disc_xy[graph.disc_index]
    )
    none = np.zeros((len(whiten), 2, 0))
    if estimate.mounting is None and estimate.tilt is None:
        return whiten @ by_pose, none, whiten @ by_disc, none
    assert graph.camera is not None
    if estimate.mounting is not None and weighting.row_errors == "corrected":
        directions = directions_of_rows(graph.camera, graph.disc_xy)
        _, moves = rows_through_mounting(graph.camera, directions, estimate.mounting)
        return whiten @ by_pose, none, whiten @ by_disc, -whiten @ moves
    _, by = _as_recorded(graph, estimate)
    by_floor = whiten @ by.floor
    return by_floor @ by_pose, whiten @ by.tilt, by_floor @ by_disc, whiten @ by.mounting


def _members(graph: Graph) -> tuple[IntArray, FloatArray]:
    """(e,) pose of each member of a row, and its share of the row."""
    count = np.bincount(graph.member_row, minlength=len(graph.line_pose))
    return graph.line_pose[graph.member_row], 1.0 / count[graph.member_row]


def _bearing_errors(graph: Graph, estimate: Estimate) -> FloatArray:
    """(q,) whitened; a row of several lines measures the mean of their bearings."""
    if len(graph.line_pose) == 0:
        return np.zeros(0)
    pose, share = _members(graph)
    bearing = bearing_of_vertical(
        estimate.poses[pose], estimate.line_xy[graph.member_line], graph.camera_xy
    )
    turn = 0.0
    if estimate.mounting is not None and graph.camera is not None:
        turn, _ = turn_to_the_left(graph.camera, estimate.mounting)
    off = wrap_angle(bearing - turn - graph.bearing_rad[graph.member_row])
    mean = np.bincount(graph.member_row, share * off, minlength=len(graph.line_pose))
    return np.asarray(mean / graph.bearing_sigma_rad)


def _line_blocks(
    graph: Graph, estimate: Estimate, layout: Layout, root: FloatArray, first_row: int
) -> Iterator[_Blocks]:
    if len(graph.line_pose) == 0:
        return
    pose, share = _members(graph)
    by_pose, by_line = bearing_jacobians(
        estimate.poses[pose], estimate.line_xy[graph.member_line], graph.camera_xy
    )
    scale = share * (root / graph.bearing_sigma_rad)[graph.member_row]
    row = first_row + graph.member_row
    yield from _pose_blocks(row, pose, by_pose[:, None, :] * scale[:, None, None])
    yield _Blocks(
        row, layout.first_line + 2 * graph.member_line, by_line[:, None, :] * scale[:, None, None]
    )


def _odometry_blocks(graph: Graph, estimate: Estimate) -> Iterator[_Blocks]:
    by_first, by_second = relative_pose_jacobians(estimate.poses[:-1], estimate.poses[1:])
    step = np.arange(len(graph.steps), dtype=np.int64)
    yield from _pose_blocks(3 * step, step, graph.step_whitening @ by_first)
    yield from _pose_blocks(3 * step, step + 1, graph.step_whitening @ by_second)


def _pose_blocks(row: IntArray, pose: IntArray, values: FloatArray) -> Iterator[_Blocks]:
    """Derivatives by poses; the first pose is no unknown."""
    free = pose > 0
    yield _Blocks(row[free], 3 * (pose[free] - 1), values[free])


def _sparse(blocks: list[_Blocks], shape: tuple[int, int]) -> sparse.csr_array:
    values, rows, columns = [], [], []
    for block in blocks:
        _, height, width = block.values.shape
        row = block.row[:, None, None] + np.arange(height, dtype=np.int64)[:, None]
        column = block.column[:, None, None] + np.arange(width, dtype=np.int64)
        values.append(block.values.ravel())
        rows.append(np.broadcast_to(row, block.values.shape).ravel())
        columns.append(np.broadcast_to(column, block.values.shape).ravel())
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_array(entries, shape=shape)
