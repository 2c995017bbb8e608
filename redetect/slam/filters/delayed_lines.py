"""Position of a vertical line from bearings at several poses: delayed initialisation.

Until there is parallax, bearings wait, and the poses that they were seen from are kept.

A line joins the state of EKF-SLAM with all the bearings that were kept of it at once. Their
linearised equations, in standard deviations,

    r = X dx + L dl + n,    L = (Q1 Q2) (U; 0)

fall into two rows Q1^T that give dl from dx, and the others, Q2^T, in which dl does not appear:
these are an ordinary measurement of the poses. As Q1 and Q2 are orthogonal, both are independent,
and each bearing is used once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle
from redetect.plane import apply
from redetect.slam.models import bearing_jacobians, bearing_of_vertical

_MOST_ITERATIONS = 10
_CONVERGED_M = 1e-6
# Of the normal matrix of unit rays: about the square of the angle between them.
_LEAST_DETERMINANT = 1e-6
# Nearer to the camera than this a bearing says nothing (m).
_NEAREST_M = 0.05
# A line that was out of sight for this many frames is initialised again.
LONGEST_ABSENCE_FRAMES = 50
# Poses kept at most. If there are more, every other one is dropped: the span is what matters.
MOST_KEPT_POSES = 24
# Below this angle between its rays (rad) a line is not tried to be placed; and after it was, not
# before the angle has grown by this factor.
LEAST_PARALLAX_RAD, PARALLAX_GROWTH = 0.02, 1.05


@dataclass(frozen=True)
class View:
    """A bearing that waits."""

    frame: int  # its frame, whose pose is kept
    # The row.
    bearing_rad: float
    sigma_rad: float


class WaitingLines:
    """Views of lines that are not in the state yet.

    Attributes
    ----------
    slots : dict of int to int
        Where in the state the pose of a frame is kept.
    free_slots : list of int
        Where poses were kept that no view needs any more.
    """

    def __init__(self) -> None:
        self.slots: dict[int, int] = {}
        self.free_slots: list[int] = []
        self._views: dict[int, list[View]] = {}
        self._tried_rad: dict[int, float] = {}

    def worth_trying(self, number: int, parallax_rad: float) -> bool:
        """Whether the rays of a line differ more than when it was last tried to be placed."""
        if parallax_rad < self._tried_rad.get(number, LEAST_PARALLAX_RAD):
            return False
        self._tried_rad[number] = PARALLAX_GROWTH * parallax_rad
        return True

    def views(self, number: int) -> list[View]:
        """The stored views of a line, in the order of the frames."""
        return self._views.get(number, [])

    def keep(self, number: int, view: View) -> None:
        """Keep a row; the pose of its frame must be kept as well."""
        self._views.setdefault(number, []).append(view)

    def take(self, number: int) -> None:
        """Forget a line: it joined the state, or is given up."""
        self._views.pop(number, None)
        self._tried_rad.pop(number, None)

    def forget(self, frame: int | None = None) -> int:
        """Forget lines that are out of sight for long, or all; returns how many views they had."""
        absent = {
            number: len(views)
            for number, views in self._views.items()
            if frame is None or frame - views[-1].frame > LONGEST_ABSENCE_FRAMES
        }
        for number in absent:
            self.take(number)
        return sum(absent.values())

    def thin(self) -> int:
        """Drop every other pose if there are too many; returns how many views were dropped, too."""
        if len(self.slots) <= MOST_KEPT_POSES:
            return 0
        given_up = set(sorted(self.slots)[1:-1:2])
        before = sum(map(len, self._views.values()))
        kept = {
            number: [view for view in views if view.frame not in given_up]
            for number, views in self._views.items()
        }
        self._views = {number: views for number, views in kept.items() if views}
        return before - sum(map(len, self._views.values()))

    def release(self) -> None:
        """Let go of the poses that no view needs any more."""
        needed = {view.frame for views in self._views.values() for view in views}
        for frame in [frame for frame in self.slots if frame not in needed]:
            self.free_slots.append(self.slots.pop(frame))


@dataclass(frozen=True, eq=False)
class LineStart:
    """A line that joins the state, and what its bearings say of the poses."""

    # (2,): its most likely position in the map (m); the equations are linearised there.
    xy: FloatArray
    # (2,): what the place is off from where Q1's two equations alone have it (m): to be added to it
    # before the residual is used, which takes it back.
    correction: FloatArray
    by_poses: FloatArray  # (2, 3 k): its derivative by the k poses
    noise: FloatArray  # (2, 2): covariance that the bearings add (m^2)
    # (k - 2,): measured less predicted, in standard deviations, of what the bearings say of the
    # poses.
    residual: FloatArray
    residual_by_poses: FloatArray  # (k - 2, 3 k): Jacobian of that


def triangulate(
    poses: FloatArray,
    bearing_rad: FloatArray,
    sigma_rad: FloatArray,
    camera_xy: FloatArray,
    pose_covariance: FloatArray,
) -> FloatArray | None:
    """The most likely place of a line that bearings from several poses show.

    Takes `poses` (k, 3), `bearing_rad, sigma_rad` (k,), `camera_xy` (2,), `pose_covariance` (3 k, 3
    k); returns (2,).
    """
    origin = apply(poses, camera_xy)
    angle = poses[:, 2] + bearing_rad
    # A ray looks along (sin, -cos) of its angle; this is across it.
    across = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    normal = across.T @ across
    if np.linalg.det(normal) < _LEAST_DETERMINANT:
        return None
    xy: FloatArray = np.linalg.solve(normal, across.T @ np.sum(across * origin, axis=1))
    ahead = np.stack([np.sin(angle), -np.cos(angle)], axis=-1)
    noise = np.diag(sigma_rad**2)
    for _ in range(_MOST_ITERATIONS):
        if np.any(np.sum((xy - origin) * ahead, axis=1) < _NEAREST_M):
            return None
        by_pose, by_line = bearing_jacobians(poses, xy, camera_xy)
        by_poses = _by_all_poses(by_pose)
        error = wrap_angle(bearing_rad - bearing_of_vertical(poses, xy, camera_xy))
        weighted = np.linalg.solve(by_poses @ pose_covariance @ by_poses.T + noise, by_line)
        normal = weighted.T @ by_line
        if np.linalg.det(normal) <= 1e-12 * np.trace(normal) ** 2:
            return None
        change = np.linalg.solve(normal, weighted.T @ error)
        xy = xy + change
        if np.hypot(*change) < _CONVERGED_M:
            return xy
    return None


def _by_all_poses(by_pose: FloatArray) -> FloatArray:
    """Jacobians of k bearings by their own poses, (k, 3), as one by all of them: (k, 3 k)."""
    count = len(by_pose)
    by_poses = np.zeros((count, count, 3))
    by_poses[np.arange(count), np.arange(count)] = by_pose
    return by_poses.reshape(count, 3 * count)


def start_line(
    poses: FloatArray,
    poses_at: FloatArray,
    bearing_rad: FloatArray,
    sigma_rad: FloatArray,
    camera_xy: FloatArray,
    pose_covariance: FloatArray,
) -> LineStart | None:
    """Place a line by bearings from several poses.

    Takes `poses` (k, 3), and those at which derivatives by the headings are evaluated, `poses_at`
    (k, 3); `bearing_rad, sigma_rad` (k,), `camera_xy` (2,), `pose_covariance` (3 k, 3 k).
    """
    xy = triangulate(poses, bearing_rad, sigma_rad, camera_xy, pose_covariance)
    if xy is None:
        return None
    _, by_line = bearing_jacobians(poses, xy, camera_xy)
    offset = xy - poses_at[:, :2]
    by_heading = by_line[:, 0] * offset[:, 1] - by_line[:, 1] * offset[:, 0]
    by_poses = _by_all_poses(np.column_stack([-by_line, by_heading]) / sigma_rad[:, None])
    error = wrap_angle(bearing_rad - bearing_of_vertical(poses, xy, camera_xy)) / sigma_rad
    both, upper = np.linalg.qr(by_line / sigma_rad[:, None], mode="complete")
    inverse = np.linalg.inv(upper[:2])
    return LineStart(
        xy=xy,
        correction=inverse @ both[:, :2].T @ error,
        by_poses=-inverse @ both[:, :2].T @ by_poses,
        noise=inverse @ inverse.T,
        residual=both[:, 2:].T @ error,
        residual_by_poses=both[:, 2:].T @ by_poses,
    )


def relative_range_sigma(pose: FloatArray, line_xy: FloatArray, covariance: FloatArray) -> float:
    """Standard deviation of a line's distance from the robot, over that distance.

    Takes `pose, line_xy` (3,), (2,), `covariance` (5, 5).
    """
    offset = line_xy - pose[:2]
    distance = float(np.hypot(*offset))
    sight = offset / distance
    along = np.array([-sight[0], -sight[1], 0.0, sight[0], sight[1]])
    return float(np.sqrt(max(along @ covariance @ along, 0.0))) / distance
