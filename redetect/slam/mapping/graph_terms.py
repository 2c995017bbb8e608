"""Whitened errors of odometry, discs and lines at an estimate, with their Jacobians."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.bounds import Bounded, Positive
from redetect.landmarks import wrap_angle
from redetect.least_squares import LossKind
from redetect.least_squares.solver import Block, Linear, Loss, robust_cost, stack
from redetect.plane import between, pose_differences
from redetect.slam import models
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import Estimate, Graph
from redetect.slam.mounting import rows_as_recorded, rows_through_mounting
from redetect.slam.settings import RowErrors

#: Rotation about robot x, y, z, and position in robot x, y, z.
MOUNTING = 6

#: Sigma of the prior of the camera's horizontal position (m), for runs with too little rotation.
PLACE_PRIOR_M = 0.1

#: Standard deviation of lines' priors, if there are any (m).
LINE_PRIOR_M = 3.0


@dataclass(frozen=True)
class Weighting(Bounded, error=SlamError):
    """The cost function and the unknowns."""

    loss: LossKind = "none"  # robust loss of landmark rows; odometry always has full weight
    loss_scale: Positive = 3.0  # scale of the loss, standard deviations
    calibrate: bool = False  # whether the camera's mounting is unknown, with discs only
    # Whether that includes its horizontal position (x, y), which discs determine when the robot
    # turns, or only rotation and height.
    place: bool = True
    # How rows and discs are compared if the mounting is unknown. `corrected`: the row's pixel is
    # projected to the floor by the camera as mounted, with the row's own covariance. `recorded`:
    # the row that the calibrated camera would have written is compared with the actual one, to
    # which that covariance belongs.
    row_errors: RowErrors = "recorded"

    @classmethod
    def of(cls, flags: object) -> Weighting:
        """As flags of the same names state it."""
        return cls(**{each.name: getattr(flags, each.name) for each in fields(cls)})

    @property
    def unknown_mounting(self) -> list[int]:
        """Indices of the unknown numbers of the mounting."""
        if not self.calibrate:
            return []
        return list(range(MOUNTING)) if self.place else [0, 1, 2, 5]


@dataclass(frozen=True, eq=False)
class Errors:
    """Whitened errors by kind, not robustified."""

    odometry: FloatArray  # (N, 3)
    discs: FloatArray  # (n, 2): NaN if the camera could not see a disc
    lines: FloatArray  # (q,)
    prior: FloatArray  # (K, 2) or (0, 2): lines minus their priors
    place: FloatArray  # (1, 2) or (0, 2): the camera's position minus the calibrated one


def errors(graph: Graph, estimate: Estimate, weighting: Weighting) -> Errors:
    """Whitened errors at an estimate: predicted minus measured, in standard deviations."""
    step = pose_differences(between(estimate.poses[:-1], estimate.poses[1:]), graph.steps)
    near, place = graph.line_prior, np.zeros((0, 2))
    if estimate.mounting is not None and graph.camera is not None:
        place = (estimate.mounting[None, :2, 3] - graph.camera.centre[:2]) / PLACE_PRIOR_M
    return Errors(
        odometry=_apply(graph.step_whitening, step),
        discs=_apply(graph.disc_whitening, _disc_rows(graph, estimate, weighting)[0]),
        lines=_bearing_errors(graph, estimate),
        prior=np.zeros((0, 2)) if near is None else (estimate.line_xy - near) / LINE_PRIOR_M,
        place=place,
    )


def cost(graph: Graph, estimate: Estimate, weighting: Weighting) -> float:
    """The function to minimise; infinite if the camera could not see a disc."""
    error = errors(graph, estimate, weighting)
    plain, loss = Loss(), Loss(weighting.loss, weighting.loss_scale)
    parts = (error.odometry, error.discs, error.lines[:, None], error.prior, error.place)
    return robust_cost(zip(parts, (plain, loss, loss, plain, plain)))


def linearise(
    graph: Graph, estimate: Estimate, weighting: Weighting, *, by_tilt: bool = False
) -> Linear:
    """The problem linearised at an estimate; poses, discs and lines are in the order of
    `Graph.unknowns`, the mounting is shared.

    The unknown numbers of the mounting change by a rotation vector in the robot frame, applied from
    the left, and a translation; with `by_tilt` pitch and roll of all frames take their place.
    """
    error = errors(graph, estimate, weighting)
    loss = Loss(weighting.loss, weighting.loss_scale)
    by_first, by_second = models.between_jacobians(estimate.poses[:-1], estimate.poses[1:])
    step = 3 * np.arange(len(graph.steps), dtype=np.int64)
    _, *derivatives = _disc_rows(graph, estimate, weighting)
    by_pose, by_disc, by_mounting = (graph.disc_whitening @ by for by in derivatives)
    unknown = weighting.unknown_mounting
    by_shared = by_mounting[:, :, unknown] if unknown else None
    if by_tilt:
        by_shared = graph.disc_whitening @ models.common_tilt_jacobian(graph.disc_xy)
    of_pose = 3 * (graph.disc_pose - 1)  # below 0 for the first, which is not unknown
    seen = [(of_pose, by_pose), (graph.first_disc + 2 * graph.disc_index, by_disc)]
    whiten = graph.step_whitening
    blocks = [
        Block(error.odometry, [(step - 3, whiten @ by_first), (step, whiten @ by_second)]),
        Block(error.discs, seen, by_shared, loss),
        *_line_blocks(graph, estimate, error.lines, loss),
    ]
    if len(error.prior):
        of_line = graph.first_line + 2 * np.arange(len(error.prior), dtype=np.int64)
        near = np.tile(np.eye(2) / LINE_PRIOR_M, (len(error.prior), 1, 1))
        blocks.append(Block(error.prior, [(of_line, near)]))
    if len(error.place) and unknown:
        by_place = np.eye(MOUNTING)[None, 3:5, unknown] / PLACE_PRIOR_M
        blocks.append(Block(error.place, [], by_place))
    return stack(blocks, graph.unknowns, 2 if by_tilt else len(unknown))


def _apply(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("nij,nj->ni", matrices, vectors))


def _disc_rows(
    graph: Graph, estimate: Estimate, weighting: Weighting
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Predicted minus measured discs (n, 2) (m); Jacobians (n, 2, k) of pose, disc, mounting."""
    pose, disc = estimate.poses[graph.disc_pose], estimate.disc_xy[graph.disc_index]
    seen, (by_pose, by_disc) = models.disc_in_robot(pose, disc), models.disc_jacobians(pose, disc)
    if estimate.mounting is None:
        return seen - graph.disc_xy, by_pose, by_disc, np.zeros((len(seen), 2, 0))
    assert graph.camera is not None
    if weighting.row_errors == "corrected":
        rows, moves = rows_through_mounting(graph.camera, graph.disc_xy, estimate.mounting)
        return seen - rows, by_pose, by_disc, -moves
    rows, by_floor, by_mounting = rows_as_recorded(graph.camera, seen, estimate.mounting)
    return rows - graph.disc_xy, by_floor @ by_pose, by_floor @ by_disc, by_mounting


def _members(graph: Graph) -> tuple[IntArray, FloatArray]:
    """(e,) pose of each member of a row, and its share of the row."""
    count = np.bincount(graph.member_row, minlength=len(graph.line_pose))
    return graph.line_pose[graph.member_row], 1.0 / count[graph.member_row]


def _bearing_errors(graph: Graph, estimate: Estimate) -> FloatArray:
    """(q,) whitened; a row of several lines measures the mean of their bearings."""
    if len(graph.line_pose) == 0:
        return np.zeros(0)
    pose, share = _members(graph)
    line_xy = estimate.line_xy[graph.member_line]
    bearing = models.bearing_of_vertical(estimate.poses[pose], line_xy, graph.camera_xy)
    off = wrap_angle(bearing - graph.bearing_rad[graph.member_row])
    mean = np.bincount(graph.member_row, share * off, minlength=len(graph.line_pose))
    return np.asarray(mean / graph.bearing_sigma_rad)


def _line_blocks(graph: Graph, estimate: Estimate, error: FloatArray, loss: Loss) -> list[Block]:
    """A row's derivatives are those of all its lines."""
    if len(graph.line_pose) == 0:
        return []
    pose, share = _members(graph)
    line_xy = estimate.line_xy[graph.member_line]
    by_pose, by_line = models.bearing_jacobians(estimate.poses[pose], line_xy, graph.camera_xy)
    scale = (share / graph.bearing_sigma_rad[graph.member_row])[:, None]
    by_pose, by_line = by_pose * scale, by_line * scale
    # The k-th line of each row; rows with fewer lines have none there.
    order = np.argsort(graph.member_row, kind="stable")
    count = np.bincount(graph.member_row, minlength=len(graph.line_pose))
    start = np.cumsum(count) - count
    of_row = np.zeros((len(count), 3))
    np.add.at(of_row, graph.member_row, by_pose)
    by = [(3 * (graph.line_pose - 1), of_row[:, None, :])]
    for k in range(int(count.max())):
        member = order[start + np.minimum(k, count - 1)]
        first = graph.first_line + 2 * graph.member_line[member]
        by.append((np.where(k < count, first, -1), by_line[member][:, None, :]))
    return [Block(error[:, None], by, loss=loss)]
