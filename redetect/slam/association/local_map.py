"""A small map that travels with the robot: landmarks in the frame of the robot now.

Its state are the landmarks, with their joint covariance, and no pose: a movement transforms them
and adds odometry's error to all of them alike (J. A. Castellanos, R. Martinez-Cantin, J. D. Tardos,
J. Neira, "Robocentric map joining", Robotics and Autonomous Systems 55, 2007). A disc is kept as
(x, y); a vertical line as bearing and inverse distance from the camera (J. Civera, A. J. Davison,
J. M. M. Montiel, "Inverse depth parametrization for monocular SLAM", IEEE Transactions on Robotics
24(5), 2008).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.landmarks import wrap_angle
from redetect.slam.models.motion import rotation

# Up to this distance discs have to be equally certain.
_NEAR_M = 4.0
# Lines farther away than this have no place yet (1/m).
_LEAST_INVERSE_DISTANCE = 0.02


@dataclass(eq=False)
class LocalMap:
    """Landmarks in the frame of the robot."""

    # (m, 2): Discs: x, y (m). Lines: bearing (rad) and inverse distance (1/m) from the camera.
    mean: FloatArray
    covariance: FloatArray  # (2 m, 2 m)
    is_line: BoolArray  # (m,)
    number: IntArray  # (m,): number of the landmark; discs and lines are counted separately
    last_frame: IntArray  # (m,): when it was seen last

    @classmethod
    def empty(cls) -> LocalMap:
        """A map without landmarks."""
        whole = np.zeros(0, dtype=np.int64)
        return cls(np.zeros((0, 2)), np.zeros((0, 0)), np.zeros(0, dtype=np.bool_), whole, whole)


def moved(
    local: LocalMap, step: FloatArray, step_covariance: FloatArray, camera_xy: tuple[float, float]
) -> LocalMap:
    """The map in the frame of the robot after a step.

    Takes `step` (3,), `step_covariance` (3, 3), `camera_xy` (2,).
    """
    m = len(local.mean)
    if m == 0:
        return local
    turn = rotation(step[2])
    mean = np.empty((m, 2))
    by_landmark = np.empty((m, 2, 2))
    by_step = np.empty((m, 2, 3))

    discs = ~local.is_line
    now = (local.mean[discs] - step[:2]) @ turn
    mean[discs] = now
    by_landmark[discs] = turn.T
    by_step[discs, :, :2] = -turn.T
    by_step[discs, 0, 2], by_step[discs, 1, 2] = now[:, 1], -now[:, 0]

    if np.any(local.is_line):
        bearing, inverse = local.mean[local.is_line].T
        camera = np.asarray(camera_xy)
        shift = step[:2] + turn @ camera - camera
        sin, cos = np.sin(bearing), np.cos(bearing)
        # Where the line is from the camera's new place, times the inverse distance; old axes.
        seen = np.stack([sin, -cos], -1) - inverse[:, None] * shift
        squared = np.sum(seen**2, axis=-1)
        length = np.sqrt(squared)
        mean[local.is_line, 0] = wrap_angle(np.arctan2(seen[:, 0], -seen[:, 1]) - step[2])
        mean[local.is_line, 1] = inverse / length
        bearing_by_seen = np.stack([-seen[:, 1], seen[:, 0]], -1) / squared[:, None]
        inverse_by_seen = -(inverse / (squared * length))[:, None] * seen
        by_seen = np.stack([bearing_by_seen, inverse_by_seen], axis=1)
        seen_by_landmark = np.stack(
            [np.stack([cos, sin], -1), np.broadcast_to(-shift, seen.shape)], axis=-1
        )
        turned = turn @ camera
        seen_by_turn = -inverse[:, None] * np.array([-turned[1], turned[0]])
        jacobian = by_seen @ seen_by_landmark
        jacobian[:, 1, 1] += 1.0 / length
        by_landmark[local.is_line] = jacobian
        by_step[local.is_line, :, :2] = -inverse[:, None, None] * by_seen
        by_step[local.is_line, :, 2] = np.einsum("nab,nb->na", by_seen, seen_by_turn)
        by_step[local.is_line, 0, 2] -= 1.0

    blocks = local.covariance.reshape(m, 2, m, 2)
    blocks = np.einsum("iab,ibjc->iajc", by_landmark, blocks)
    covariance = np.einsum("iajb,jcb->iajc", blocks, by_landmark).reshape(2 * m, 2 * m)
    stacked = by_step.reshape(2 * m, 3)
    covariance = covariance + stacked @ step_covariance @ stacked.T
    return LocalMap(mean, covariance, local.is_line, local.number, local.last_frame)


def tilt_jacobian(disc_xy: FloatArray, height_m: float) -> FloatArray:
    """How a small tilt of the robot moves the places on the floor that a camera seems to see.

    Takes `disc_xy` (n, 2); returns (n, 2, 2).
    """
    x, y = disc_xy.T
    rows = (x * y / height_m, -height_m - x**2 / height_m)
    others = (height_m + y**2 / height_m, -x * y / height_m)
    return np.stack([np.stack(rows, -1), np.stack(others, -1)], axis=1)


def kept(
    local: LocalMap, frame: int, *, forget_frames: int, forget_sigma_m: float, most_landmarks: int
) -> LocalMap:
    """The map without landmarks that were not seen for long or have become too uncertain."""
    m = len(local.mean)
    if m == 0:
        return local
    variance = np.diagonal(local.covariance).reshape(m, 2).sum(axis=1)
    keep = frame - local.last_frame <= forget_frames
    farther = np.maximum(np.linalg.norm(local.mean, axis=1) / _NEAR_M, 1.0)
    keep &= local.is_line | (variance <= (farther * forget_sigma_m) ** 2)
    for kind in (False, True):
        some = np.flatnonzero(keep & (local.is_line == kind))
        if len(some) > most_landmarks:
            oldest_first = some[np.argsort(local.last_frame[some], kind="stable")]
            keep[oldest_first[:-most_landmarks]] = False
    if np.all(keep):
        return local
    index = np.flatnonzero(np.repeat(keep, 2))
    return LocalMap(
        local.mean[keep],
        local.covariance[np.ix_(index, index)],
        local.is_line[keep],
        local.number[keep],
        local.last_frame[keep],
    )


def line_places(
    local: LocalMap, frame: int, camera_xy: tuple[float, float]
) -> tuple[FloatArray, IntArray]:
    """Positions of the lines seen in a frame.

    Takes `camera_xy` (2,); returns `places` (n, 2), `numbers` (n,).
    """
    some = (
        local.is_line & (local.last_frame == frame) & (local.mean[:, 1] > _LEAST_INVERSE_DISTANCE)
    )
    bearing, inverse = local.mean[some].T
    direction = np.stack([np.sin(bearing), -np.cos(bearing)], axis=-1)
    return direction / inverse[:, None] + np.asarray(camera_xy), local.number[some]
