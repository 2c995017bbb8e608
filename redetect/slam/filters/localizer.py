"""Localisation in a known map: an extended Kalman filter of the pose alone.

The map has errors of its own. They are the same each time a landmark is seen, so that adding its
covariance to each measurement's would let the filter average them away, which it can't. By default
the filter *considers* them: it carries the correlation of the pose with each landmark's error along
without estimating the landmarks anew (Schmidt-Kalman filter).

Landmarks of a map made by driving share most of their error with their neighbours. The joint
covariance describes this (`redetect.landmarks.map_file`); without it landmarks are
assumed to be independent of each other.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks.map_file import LandmarkMap
from redetect.slam.filters.frames import (
    NO_CAMERA,
    FrameRows,
    RowCount,
    innovation_of,
    innovation_root,
)
from redetect.slam.models import move, move_jacobians
from redetect.slam.recording import UNKNOWN_ID

MapErrors = Literal["considered", "white", "ignored"]

_POSE_SIZE = 3


class Localizer:
    """The filter.

    Parameters
    ----------
    landmark_map : LandmarkMap
        Where the landmarks are.
    start : (3,) array_like
        Pose at the start, in the map (m, m, rad).
    start_covariance : (3, 3) array_like
        Its covariance; none by default, as the start of a run defines its map.
    camera_xy : (2,) array_like
        The camera's centre in the robot frame (m); only lines need it.
    map_errors : str
        `considered`: see above; `white`: each landmark's covariance is added to that of each of
        its rows, as if its error were another one each time; `ignored`: the map is exact.
    joint_covariance : (2 M, 2 M) array, optional
        Of all discs and then lines (m^2), for errors that are considered; by default landmarks are
        independent.
    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        start: ArrayLike = (0.0, 0.0, 0.0),
        start_covariance: ArrayLike | None = None,
        camera_xy: ArrayLike = NO_CAMERA,
        *,
        map_errors: MapErrors = "considered",
        joint_covariance: FloatArray | None = None,
    ) -> None:
        discs, lines = landmark_map.discs, landmark_map.lines
        self.camera_xy = np.asarray(camera_xy, dtype=np.float64)
        self.disc_slots = {int(i): _POSE_SIZE + 2 * k for k, i in enumerate(discs.ids)}
        first = _POSE_SIZE + 2 * len(discs)
        self.line_slots = {int(i): first + 2 * k for k, i in enumerate(lines.ids)}
        self.count = RowCount()
        self.pose_covariance = np.zeros((3, 3))
        if start_covariance is not None:
            self.pose_covariance += np.asarray(start_covariance, dtype=np.float64)
        self.state = np.concatenate(
            [np.asarray(start, dtype=np.float64), discs.xy.ravel(), lines.xy.ravel()]
        )
        self._map_errors = map_errors
        self._predicted = np.array(start, dtype=np.float64)
        numbers = len(self.state) - _POSE_SIZE
        self._map_covariance = np.zeros((numbers, numbers))
        if map_errors == "considered" and joint_covariance is not None:
            self._map_covariance += joint_covariance
        elif map_errors != "ignored":
            for k, block in enumerate(np.concatenate([discs.covariance, lines.covariance])):
                own = slice(2 * k, 2 * k + 2)
                self._map_covariance[own, own] = block
        # Of the pose with the landmarks' errors.
        self._cross = np.zeros((_POSE_SIZE, len(self.state) - _POSE_SIZE))

    def block(self, index: IntArray) -> FloatArray:
        """Rows and columns of the joint covariance of pose and map.

        Takes `index` (3 + 2 k,); returns (3 + 2 k, 3 + 2 k).
        """
        landmarks = index[_POSE_SIZE:] - _POSE_SIZE
        cross = self._cross[:, landmarks]
        own = self._map_covariance[landmarks[:, None], landmarks]
        return np.block([[self.pose_covariance, cross], [cross.T, own]])

    def predict(self, step: FloatArray, noise: FloatArray) -> None:
        """The robot moves by an odometry step (3,), of covariance (3, 3)."""
        by_pose, by_step = move_jacobians(self.state[:3], step)
        self.state[:_POSE_SIZE] = move(self.state[:3], step)
        if self._map_errors == "considered":
            # From prediction to prediction, as with first estimates in EKF-SLAM: else corrections
            # would look like knowledge of how the map as a whole is turned.
            by_pose[0, 2] = self._predicted[1] - self.state[1]
            by_pose[1, 2] = self.state[0] - self._predicted[0]
            self._predicted = self.state[:3].copy()
        moved = by_pose @ self.pose_covariance @ by_pose.T + by_step @ noise @ by_step.T
        self.pose_covariance = 0.5 * (moved + moved.T)
        self._cross = by_pose @ self._cross

    def measure(self, rows: FrameRows) -> None:
        """Use the rows of a frame whose landmarks are in the map; the others are left out.

        A row of several lines measures the mean of their bearings.
        """
        discs, lines, left_out = [], [], self.count.left_out
        for k, number in enumerate(rows.circles.ids.tolist()):
            if number in self.disc_slots:
                discs.append(k)
            else:
                left_out["disc without ID" if number == UNKNOWN_ID else "disc not in the map"] += 1
        for k, numbers in enumerate(rows.lines.ids):
            if numbers and all(number in self.line_slots for number in numbers):
                lines.append(k)
            else:
                left_out["line not in the map" if numbers else "line without ID"] += 1
        self.count.discs += len(discs)
        self.count.lines += len(lines)
        if not discs and not lines:
            return
        error, jacobian, index, noise = innovation_of(rows.only(discs, lines), self, self.state)
        block = self.block(index)
        root = innovation_root(jacobian @ block @ jacobian.T + noise)
        whitened = np.linalg.solve(root, error)
        # The pose's part of P H^T, over the root of S.
        factor = np.linalg.solve(root, jacobian @ block[:, :_POSE_SIZE]).T
        self.state[:_POSE_SIZE] += factor @ whitened
        if self._map_errors == "considered":
            # Of the measurement with the landmarks' errors: H P[index, landmarks].
            by_map = jacobian[:, :_POSE_SIZE] @ self._cross
            by_map += (
                jacobian[:, _POSE_SIZE:] @ self._map_covariance[index[_POSE_SIZE:] - _POSE_SIZE]
            )
            self._cross -= factor @ np.linalg.solve(root, by_map)
        self.pose_covariance = self.pose_covariance - factor @ factor.T
        self.count.innovation_squared += float(whitened @ whitened)
        self.count.innovation_numbers += len(error)
