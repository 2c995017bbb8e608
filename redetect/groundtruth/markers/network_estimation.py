"""Poses of cameras, from a double checkerboard that two of them see at a time.

One camera sees a board that is fixed in the world. From it the others are chained: one camera sees
one face of the double board while another sees the other face. Then all are adjusted jointly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, product

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.markers import adjustment
from redetect.groundtruth.markers.boards import FIRST, SECOND, WORLD, BoardsFile, BoardView
from redetect.groundtruth.markers.pairs import chained_poses
from redetect.groundtruth.markers.poses import solve_camera
from redetect.groundtruth.settings import NetworkSettings
from redetect.groundtruth.trajectories import se3
from redetect.least_squares.solver import whitening

# Probability below which views disagree not by chance.
_BY_CHANCE = 1e-3
# Corners of a view this many times as far from where they are expected as most are wrong.
_WRONG_CORNER = 5.0
_PosedShots = Sequence[Sequence[tuple[BoardView, FloatArray]]]


@dataclass(frozen=True, eq=False)
class NetworkEstimate:
    """An estimated network, and the views used."""

    names: tuple[str, ...]  # The cameras
    world_from_camera: FloatArray  # (C, 4, 4)
    covariance: FloatArray  # (6 C, 6 C): joint, scaled by the residuals and by `disagreement`
    offset: FloatArray | None  # (4, 4): `first_from_second` of the double board, adjusted
    adjusted: adjustment.AdjustedBundle
    views: tuple[BoardView, ...]  # The bundle's views
    # Ratio of the squared differences between the boards' poses by single views and by the network
    # to those that the residuals imply; 1 if chance explains it
    disagreement: float
    connections: int  # Its degrees of freedom: 0 if nothing shows whether a board was moved


def estimate_network(
    setup: BoardsFile, shots: Sequence[Sequence[BoardView]], settings: NetworkSettings
) -> NetworkEstimate:
    """Estimate the poses of the cameras.

    Parameters
    ----------
    setup : BoardsFile
        The cameras, the boards and their poses; its images are not read.
    shots : sequence of sequences of BoardView
        Boards seen at one time.

    Raises
    ------
    GroundTruthError
        If a camera is not connected to the world, or the offset cannot be estimated.
    """
    names = tuple(sorted(setup.cameras))
    seen = [[(view, _camera_from_board(view, setup)) for view in shot] for shot in shots]
    parts = {WORLD: setup.world_from_board}
    if setup.double is not None:
        offset = setup.double.offset
        offset = _estimated_offset(seen) if offset is None else offset
        parts |= {FIRST: np.eye(4), SECOND: offset}
    poses, bodies = _chained(names, seen, parts)
    bundle, views = _bundle(setup, parts, seen, poses, bodies, settings.corner_sigma_px)
    bundle = bundle.only(_fitting_corners(setup, seen, settings.outlier_px))
    try:
        adjusted = adjustment.adjust_bundle(
            bundle, outlier_sigma=settings.outlier_sigma, outlier_px=settings.outlier_px
        )
    except GeometryError as error:
        raise GroundTruthError(f"the network cannot be adjusted: {error}") from None
    body_from_part = dict(zip(parts, adjusted.bundle.chain.body_from_part))
    disagreement, connections = _disagreement(adjusted)
    return NetworkEstimate(
        names,
        adjusted.bundle.chain.world_from_camera,
        adjusted.camera_covariance * adjusted.chi2_per_dof * disagreement,
        body_from_part.get(SECOND),
        adjusted,
        views,
        disagreement,
        connections,
    )


def _disagreement(adjusted: adjustment.AdjustedBundle) -> tuple[float, int]:
    """`NetworkEstimate.disagreement`, and its degrees of freedom.

    A moved board hardly changes the residuals of its many corners, but all of them by one motion,
    so the part of each view's residuals that another pose of its board would remove is compared
    with the rest.
    """
    part = adjusted.bundle.only(adjusted.used)
    by_pose = adjustment.project_chain_with_jacobians(part.chain, part.seen).by_camera
    white = whitening(part.seen.covariances)
    residuals = (white @ adjusted.residuals[adjusted.used][..., None])[..., 0]
    by_pose, rest, views = white @ by_pose, 0.0, np.unique(part.view)
    for view in views:
        own = residuals[part.view == view].ravel()
        q = np.linalg.qr(by_pose[part.view == view].reshape(-1, 6))[0]
        rest += float(own @ own - np.sum((q.T @ own) ** 2))
    dof = residuals.size - 6 * len(views)
    connections = adjusted.degrees_of_freedom - dof
    variance = rest / dof
    squared = (adjusted.cost - rest) / variance
    if connections < 1 or chdtrc(connections, squared) > _BY_CHANCE:
        return 1.0, connections
    return squared / connections * variance / adjusted.chi2_per_dof, connections


def _camera_from_board(view: BoardView, setup: BoardsFile) -> FloatArray:
    points = setup.boards[view.board].points
    try:
        return solve_camera(setup.cameras[view.camera], points, view.corners, "iterative")[0]
    except GeometryError as error:
        raise GroundTruthError(f"camera {view.camera}, board {view.board}: {error}") from None


def _estimated_offset(seen: _PosedShots) -> FloatArray:
    """`first_from_second`, from shots in which two cameras, or one, see both faces.

    With A_k the pose of the first face in one camera and B_k that of the second in another, the
    cameras fixed, (A_1^-1 A_k) X = X (B_1^-1 B_k): the hand-eye problem. Of several pairs of
    cameras, the one with the most shots is used.
    """
    together: dict[tuple[str, str], list[tuple[FloatArray, FloatArray]]] = {}
    for shot in seen:
        for (view_a, a), (view_b, b) in product(shot, repeat=2):
            if (view_a.board, view_b.board) == (FIRST, SECOND):
                if view_a.camera == view_b.camera:
                    return np.asarray(se3.inverse(a) @ b)
                together.setdefault((view_a.camera, view_b.camera), []).append((a, b))
    pairs = np.array(max(together.values(), key=len, default=[])).reshape(-1, 2, 4, 4)
    left, right = (se3.inverse(poses[:1]) @ poses[1:] for poses in pairs.swapaxes(0, 1))
    if len(left) < 2 or np.linalg.svd(se3.log(left)[:, 3:], compute_uv=False)[1] < 0.05:
        raise GroundTruthError(
            f"the offset of boards {FIRST} and {SECOND} cannot be estimated: "
            "expected 3 or more shots of two cameras with the boards turned about different axes"
        )
    return hand_eye(left, right)


def hand_eye(left: FloatArray, right: FloatArray) -> FloatArray:
    """(4, 4) least-squares solution X of left_k X = X right_k (Park & Martin 1994)."""
    rotation = Rotation.align_vectors(se3.log(left)[:, 3:], se3.log(right)[:, 3:])[0]
    matrix = np.concatenate(left[:, :3, :3] - np.eye(3))
    vector = np.concatenate(rotation.apply(right[:, :3, 3]) - left[:, :3, 3])
    translation = np.linalg.lstsq(matrix, vector, rcond=None)[0]
    return se3.transform(rotation.as_matrix(), translation)


def _chained(
    names: tuple[str, ...], seen: _PosedShots, parts: Mapping[str, FloatArray]
) -> tuple[FloatArray, dict[int, FloatArray]]:
    """Poses of cameras (C, 4, 4), and of the double board in each shot, chained from the world."""
    # Estimates of one frame in another: the world has index 0, the cameras follow.
    estimates: dict[tuple[int, int], list[FloatArray]] = {}
    held: dict[int, list[tuple[int, FloatArray]]] = {}  # By shot: `camera_from_body`
    for number, shot in enumerate(seen):
        for view, pose in shot:
            camera = 1 + names.index(view.camera)
            if view.board == WORLD:
                estimates.setdefault((0, camera), []).append(parts[WORLD] @ se3.inverse(pose))
            else:
                here = held.setdefault(number, [])
                here.append((camera, pose @ se3.inverse(parts[view.board])))
                for other, other_from_body in here[:-1]:
                    pair = ((camera, here[-1][1]), (other, other_from_body))
                    (a, a_from_body), (b, b_from_body) = sorted(pair, key=lambda one: one[0])
                    if a != b:
                        a_from_b = a_from_body @ se3.inverse(b_from_body)
                        estimates.setdefault((a, b), []).append(a_from_b)
    support = {pair: len(poses) for pair, poses in estimates.items()}
    central = {pair: _most_central(poses) for pair, poses in estimates.items()}
    poses = chained_poses(central, support, 1 + len(names), 0)
    lost = np.flatnonzero(np.isnan(poses[1:, 0, 0]))
    if lost.size:
        raise GroundTruthError(
            f"camera {names[lost[0]]} is not connected to the world: expected shots "
            "in which it sees the board of the world, or the double board together with a "
            "connected camera"
        )
    return poses[1:], {number: poses[here[0][0]] @ here[0][1] for number, here in held.items()}


def _most_central(poses: Sequence[FloatArray]) -> FloatArray:
    """The pose with the least sum of distances (m, rad) to the others."""
    stack = np.stack(poses)
    apart = np.linalg.norm(se3.log(se3.inverse(stack)[:, None] @ stack), axis=-1)
    return np.asarray(stack[int(np.argmin(np.minimum(apart, 1.0).sum(axis=1)))])


def _bundle(
    setup: BoardsFile,
    parts: Mapping[str, FloatArray],
    seen: _PosedShots,
    poses: FloatArray,
    bodies: Mapping[int, FloatArray],
    corner_sigma_px: float,
) -> tuple[adjustment.Bundle, tuple[BoardView, ...]]:
    """Bundle of all views; its first body is the world, the others are the double boards."""
    names, order = sorted(setup.cameras), list(parts)
    body_index = {number: body for body, number in enumerate(bodies, 1)}
    views = [view for shot in seen for view, _ in shot]
    rows = [
        (names.index(v.camera), 0 if v.board == WORLD else body_index[i], order.index(v.board))
        for i, shot in enumerate(seen)
        for v, _ in shot
    ]
    counts = [len(view.corners) for view in views]
    camera, body, part = np.repeat(np.array(rows).reshape(-1, 3), counts, axis=0).astype(np.int64).T
    points = adjustment.ChainPoints(
        camera,
        body,
        part,
        np.concatenate([setup.boards[view.board].points for view in views]),
        np.concatenate([view.corners for view in views]),
        np.tile(corner_sigma_px**2 * np.eye(2), (sum(counts), 1, 1)),
    )
    free = np.ones(len(names) + len(order) + 1 + len(bodies), dtype=np.bool_)
    free[len(names) : len(names) + len(order) + 1] = False
    priors: tuple[adjustment.PosePrior, ...] = ()
    double = setup.double
    if double is not None and any(view.board == SECOND for view in views):
        second = len(names) + order.index(SECOND)
        free[second] = double.offset is None or bool(np.any(double.covariance))
        if free[second] and double.offset is not None:
            # Exactly known poses among uncertain ones get a prior of a micrometre.
            covariance = double.covariance + 1e-12 * np.eye(6)
            priors = (adjustment.PosePrior(second, double.offset, covariance),)
    bundle = adjustment.Bundle(
        tuple(setup.cameras[name] for name in names),
        len(order),
        np.stack([*poses, *parts.values(), np.eye(4), *bodies.values()]),
        free,
        points,
        np.repeat(np.arange(len(views)), counts),
        priors,
    )
    return bundle, tuple(views)


def _fitting_corners(setup: BoardsFile, seen: _PosedShots, outlier_px: float) -> BoolArray:
    """(N,) whether corners fit their board's pose by its own picture; hidden ones do not."""
    fitting = []
    for view, pose in chain.from_iterable(seen):
        points = se3.apply(pose, setup.boards[view.board].points)
        off = np.linalg.norm(view.corners - setup.cameras[view.camera].project(points), axis=1)
        fitting.append(off <= max(outlier_px, _WRONG_CORNER * float(np.median(off))))
    return np.concatenate(fitting)
