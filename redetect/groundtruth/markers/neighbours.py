"""Resolves ambiguous poses of a frame with the frames before and after it.

A robot on the floor keeps its height, roll and pitch and its speed is limited; the mirror image of
a marker rarely moves like that. Among all sequences of candidates, in which frames may be left out
at a cost, the cheapest through each candidate is found (min-sum, forwards and backwards). The
difference of cost between a frame's candidates is the certainty of the decision.

The candidates' own odds count for their own frame only: errors of frames of a standing robot go
together, and many weak reasons are not a strong one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from redetect.groundtruth.markers.poses import PoseEstimate
from redetect.groundtruth.markers.settings import PoseSettings

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Status = Literal["clear", "resolved", "unresolved", "rejected"]

# In units of negative log-likelihood: leaving a frame out is cheaper than two jumps round it, and a
# robot that was carried elsewhere costs one jump.
_JUMP_COST = 20.0
_REJECT_COST = 15.0
_MOST_LEFT_OUT = 3


@dataclass(frozen=True)
class Choice:
    """Which candidate of a frame is the robot's pose.

    Attributes
    ----------
    candidate : int or None
        None where the frame fits its neighbours with no candidate.
    status : str
        `clear` (there was only one), `resolved` by the neighbours, `unresolved` (the named
        candidate is the likeliest but not likely enough), or `rejected`.
    margin : float
        Natural logarithm of the odds against the next candidate; infinite without one.
    """

    candidate: int | None
    status: Status
    margin: float


def choose_candidates(
    times_s: Sequence[float], estimates: Sequence[PoseEstimate], settings: PoseSettings
) -> list[Choice]:
    """Decide between the candidates of each frame by its neighbours.

    Parameters
    ----------
    times_s : N floats
        Seconds, ascending.
    estimates : N estimates
    settings : PoseSettings
        Its odds, and what the robot can do.

    Returns
    -------
    list of N Choice
    """
    through, without = _cheapest_paths(times_s, estimates, settings)
    choices = []
    for estimate, costs, left_out in zip(estimates, through, without):
        if left_out < costs.min():
            choices.append(Choice(None, "rejected", float(costs.min() - left_out)))
            continue
        total = costs + np.array(estimate.log_odds)
        order = np.argsort(total, kind="stable")
        if len(order) == 1:
            choices.append(Choice(0, "clear", float("inf")))
            continue
        margin = float(total[order[1]] - total[order[0]])
        decided = margin >= np.log(settings.ambiguity_odds)
        choices.append(Choice(int(order[0]), "resolved" if decided else "unresolved", margin))
    return choices


def _cheapest_paths(
    times_s: Sequence[float], estimates: Sequence[PoseEstimate], settings: PoseSettings
) -> tuple[list[FloatArray], FloatArray]:
    """Cost of the cheapest sequence through each candidate, and of that without each frame."""
    count = len(estimates)
    sizes = [len(estimate.candidates) for estimate in estimates]
    steps = {
        skipped: _step_costs(times_s, estimates, skipped + 1, settings)
        for skipped in range(_MOST_LEFT_OUT + 1)
    }
    ahead = [np.full(size, _REJECT_COST * i) for i, size in enumerate(sizes)]
    for i in range(count):
        for skipped, costs in steps.items():
            j = i - skipped - 1
            if j >= 0:
                came = ahead[j][:, None] + costs[j] + _REJECT_COST * skipped
                ahead[i] = np.minimum(ahead[i], came.min(axis=0))
    back = [np.full(size, _REJECT_COST * (count - 1 - i)) for i, size in enumerate(sizes)]
    for i in reversed(range(count)):
        for skipped, costs in steps.items():
            j = i + skipped + 1
            if j < count:
                goes = costs[i] + back[j][None, :] + _REJECT_COST * skipped
                back[i] = np.minimum(back[i], goes.min(axis=1))
    through = [a + b for a, b in zip(ahead, back)]
    without = np.full(count, _REJECT_COST * count)
    for i in range(count):
        if i > 0:  # the sequence ends before this frame
            without[i] = min(without[i], float(ahead[i - 1].min()) + _REJECT_COST * (count - i))
        if i < count - 1:  # or begins after it
            without[i] = min(without[i], float(back[i + 1].min()) + _REJECT_COST * (i + 1))
    for skipped, costs in steps.items():
        for j in range(count - skipped - 1):
            if skipped:
                over = ahead[j][:, None] + costs[j] + back[j + skipped + 1][None, :]
                cost = float(over.min()) + _REJECT_COST * skipped
                inside = slice(j + 1, j + skipped + 1)
                without[inside] = np.minimum(without[inside], cost)
    return through, without


def _step_costs(
    times_s: Sequence[float],
    estimates: Sequence[PoseEstimate],
    distance: int,
    settings: PoseSettings,
) -> list[FloatArray]:
    """For each frame i, the costs (K_i, K_j) of moving to the candidates of frame i + distance."""
    first: list[int] = []
    second: list[int] = []
    seconds: list[float] = []
    shapes: list[tuple[int, int]] = []
    sizes = [len(estimate.candidates) for estimate in estimates]
    start = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    for i in range(len(estimates) - distance):
        j = i + distance
        shapes.append((sizes[i], sizes[j]))
        for a in range(sizes[i]):
            for b in range(sizes[j]):
                first.append(int(start[i]) + a)
                second.append(int(start[j]) + b)
                seconds.append(times_s[j] - times_s[i])
    if not first:
        return []
    poses = np.stack([c.world_from_robot for e in estimates for c in e.candidates])
    covariances = np.stack([c.covariance for e in estimates for c in e.candidates])
    costs = _motion_costs(
        poses, covariances, np.array(first), np.array(second), np.array(seconds), settings
    )
    split = np.cumsum([a * b for a, b in shapes])[:-1]
    return [part.reshape(shape) for part, shape in zip(np.split(costs, split), shapes)]


def _motion_costs(
    poses: FloatArray,
    covariances: FloatArray,
    first: IntArray,
    second: IntArray,
    seconds: FloatArray,
    settings: PoseSettings,
) -> FloatArray:
    """Half the squared Mahalanobis length of movements, in the world's axes, limited to a jump."""
    a, b = poses[first], poses[second]
    rotation_a, rotation_b = a[:, :3, :3], b[:, :3, :3]
    turned = Rotation.from_matrix(rotation_b @ rotation_a.transpose(0, 2, 1)).as_rotvec()
    moved = np.concatenate([b[:, :3, 3] - a[:, :3, 3], turned], axis=1)
    spread = np.zeros((len(moved), 6, 6))
    for pose_rotation, covariance in (
        (rotation_a, covariances[first]),
        (rotation_b, covariances[second]),
    ):
        axes = np.zeros((len(moved), 6, 6))
        axes[:, :3, :3] = pose_rotation
        axes[:, 3:, 3:] = rotation_b
        spread += axes @ covariance @ axes.transpose(0, 2, 1)
    heave, wobble = settings.heave_m, np.radians(settings.wobble_deg)
    reach = settings.speed_m_s * seconds
    turn = np.radians(settings.turn_deg_s) * seconds
    for axis, sigma in enumerate((reach, reach, heave, wobble, wobble, turn)):
        spread[:, axis, axis] += np.square(sigma)
    weighted = np.linalg.solve(spread, moved[..., None])[..., 0]
    return np.asarray(np.minimum(0.5 * np.sum(moved * weighted, axis=1), _JUMP_COST))
