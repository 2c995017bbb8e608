"""Odometry with the data set's kind of covariance, and errors that match it.

The shipped steps' covariances are those of a robot whose position and heading walk randomly along
the way: in every metre the position gains a variance of `POSITION_VARIANCE_PER_M` in x and y, the
heading one of `HEADING_VARIANCE_PER_M`, and turning counts as further way. Heading errors move the
rest of the step: for a straight step of length L, cxx = q_xy L + q_phi L^3 / 3, cyy = q_xy L,
cxphi = q_phi L^2 / 2. All 3297 shipped rows follow this within a few percent.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from redetect.landmarks import Step
from tools.simulator.poses import relative_pose
from tools.simulator.scene import FloatArray

#: Fitted to the shipped steps.
HEADING_VARIANCE_PER_M = 1.4955e-3
HEADING_VARIANCE_PER_RAD = 3.74e-4
#: Shipped steps: the ratio of the variances of heading and position is the same everywhere.
HEADING_OVER_POSITION = 18.637

_GAUSS_NODES = 4


def step_covariance(steps: ArrayLike) -> FloatArray:
    """Covariance of steps as the data set has it.

    Parameters
    ----------
    steps : (..., 3) array
        dx, dy (m), dphi (rad): the pose after each step in the frame before it.

    Returns
    -------
    (..., 3, 3) array
        Covariance of (dx, dy, dphi).
    """
    step = np.asarray(steps, dtype=np.float64)
    way = np.hypot(step[..., 0], step[..., 1])
    heading = HEADING_VARIANCE_PER_M * way + HEADING_VARIANCE_PER_RAD * np.abs(step[..., 2])
    position = heading / HEADING_OVER_POSITION
    covariance = np.zeros((*step.shape[:-1], 3, 3))
    covariance[..., 0, 0] = covariance[..., 1, 1] = position
    nodes, weights = np.polynomial.legendre.leggauss(_GAUSS_NODES)
    for node, weight in zip(0.5 * (nodes + 1.0), 0.5 * weights):
        # A heading error at this share of the way turns what is left of the step.
        rest_x, rest_y = _rest_of_arc(step, float(node))
        lever = np.stack([-rest_y, rest_x, np.ones_like(rest_x)], axis=-1)
        outer = lever[..., :, None] * lever[..., None, :]
        covariance += weight * heading[..., None, None] * outer
    return covariance


def _rest_of_arc(step: FloatArray, share: float) -> tuple[FloatArray, FloatArray]:
    """What is left of steps after a share of their way (an arc), in the frame before them."""
    dphi = step[..., 2]
    # Chord of the first `share` of an arc: its direction turns back by half of what is missing.
    small = np.abs(dphi) < 1e-9
    safe = np.where(small, 1.0, dphi)
    ratio = np.where(small, share, np.sin(0.5 * share * safe) / np.sin(0.5 * safe))
    back = 0.5 * (share - 1.0) * dphi
    c, s = np.cos(back), np.sin(back)
    x = ratio * (c * step[..., 0] - s * step[..., 1])
    y = ratio * (s * step[..., 0] + c * step[..., 1])
    return step[..., 0] - x, step[..., 1] - y


def measured_steps(
    poses: ArrayLike, rng: np.random.Generator, wrong: ArrayLike | None = None
) -> FloatArray:
    """Steps as odometry measures them.

    Parameters
    ----------
    poses : (N + 1, 3) array
        True poses x, y (m), heading (rad).
    rng : numpy Generator
        Source of the errors: Gaussian, of the covariance that `step_covariance` gives.
    wrong : (N,) bool array, optional
        Steps on which odometry is simply wrong (wheels slipping on a rough yard): it overestimates
        the way by a tenth and drifts in heading, far beyond its covariance.

    Returns
    -------
    (N, 3) array
        dx, dy (m), dphi (rad).
    """
    pose = np.asarray(poses, dtype=np.float64)
    true = relative_pose(pose[:-1], pose[1:])
    root = np.linalg.cholesky(step_covariance(true) + 1e-18 * np.eye(3))
    noise = rng.standard_normal(true.shape)
    measured = true + np.einsum("nij,nj->ni", root, noise)
    if wrong is not None:
        slip = np.asarray(wrong, dtype=bool)
        measured[slip, :2] *= 1.1
        measured[slip, 2] += 0.012
    return np.asarray(measured)


def step_record(prefix: str, step: FloatArray) -> Step:
    """Row of a measured step; its covariance is that of the measured movement."""
    c = step_covariance(step)
    dx, dy, dphi = (float(x) for x in step)
    return Step(
        prefix, dx, dy, dphi, float(c[0, 0]), float(c[0, 1]), float(c[1, 1]), float(c[0, 2]),
        float(c[1, 2]), float(c[2, 2]),
    )  # fmt: skip


def joined_steps(steps: list[Step], kept: list[int]) -> list[Step]:
    """Odometry of a run of which only some frames are kept.

    Parameters
    ----------
    steps : list of Step
        All steps.
    kept : list of int
        Indices of the kept frames, ascending.

    Returns
    -------
    list of Step
        For each kept frame the movement since the one before it, covariances propagated to first
        order, under the kept frame's prefix.
    """
    joined: list[Step] = []
    first = 0
    for last in kept:
        pose, covariance = np.zeros(3), np.zeros((3, 3))
        for step in steps[first : last + 1]:
            move = np.array([step.dx, step.dy, step.dphi])
            c, s = np.cos(pose[2]), np.sin(pose[2])
            turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            lever = np.eye(3)
            lever[:2, 2] = [-s * move[0] - c * move[1], c * move[0] - s * move[1]]
            own = np.array(
                [
                    [step.cxx, step.cxy, step.cxphi],
                    [step.cxy, step.cyy, step.cyphi],
                    [step.cxphi, step.cyphi, step.cphiphi],
                ]
            )
            covariance = lever @ covariance @ lever.T + turn @ own @ turn.T
            pose = pose + turn @ move
        a = covariance
        joined.append(
            Step(
                steps[last].prefix, float(pose[0]), float(pose[1]), float(pose[2]),
                float(a[0, 0]), float(a[0, 1]), float(a[1, 1]), float(a[0, 2]), float(a[1, 2]),
                float(a[2, 2]),
            )
        )  # fmt: skip
        first = last + 1
    return joined
