"""Localisation in a known map: an extended Kalman filter of the pose alone.

The map has errors of its own. They are the same each time a landmark is seen, so that adding its
covariance to each measurement's would let the filter average them away, which it can't. By default
the filter *considers* them: it carries the correlation of the pose with each landmark's error along
without estimating the landmarks anew (Schmidt-Kalman filter).

Landmarks of a map made by driving share most of their error with their neighbours. The joint
covariance describes this (`LandmarkMap.joint_covariance`); without it landmarks are
assumed to be independent of each other.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from redetect.landmarks.map_file import LandmarkMap
from redetect.slam.filters.frames import NO_CAMERA, POSE_SIZE, Filter, FrameRows, innovation_of
from redetect.slam.recording import UNKNOWN_ID

MapErrors = Literal["considered", "ignored"]


class Localizer(Filter):
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
        `considered`: see above; `ignored`: the map is exact.
    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        start: ArrayLike = (0.0, 0.0, 0.0),
        start_covariance: ArrayLike | None = None,
        camera_xy: ArrayLike = NO_CAMERA,
        *,
        map_errors: MapErrors = "considered",
    ) -> None:
        # From prediction to prediction, as with first estimates in EKF-SLAM: else corrections would
        # look like knowledge of how the map as a whole is turned.
        considered = map_errors == "considered"
        super().__init__(start, start_covariance, camera_xy, first_estimates=considered)
        discs, lines = landmark_map.discs, landmark_map.lines
        self.disc_slots = {int(i): POSE_SIZE + 2 * k for k, i in enumerate(discs.ids)}
        first = POSE_SIZE + 2 * len(discs)
        self.line_slots = {int(i): first + 2 * k for k, i in enumerate(lines.ids)}
        places = np.concatenate([discs.xy, lines.xy]).ravel()
        self._grow(len(places))
        self.size = len(self._state)
        self._state[POSE_SIZE:] = self._linearised[POSE_SIZE:] = places
        if considered and len(places):
            joint = landmark_map.joint_covariance
            if joint is None:
                joint = block_diag(*discs.covariance, *lines.covariance)
            self._covariance[POSE_SIZE:, POSE_SIZE:] = joint

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
        innovation = innovation_of(rows.only(discs, lines), self, self._linearised)
        factor, last = self._whitened(innovation)
        # The pose alone is corrected.
        self._state[:POSE_SIZE] += factor[:POSE_SIZE] @ last
        corrected = self._covariance[:POSE_SIZE] - factor[:POSE_SIZE] @ factor.T
        self._covariance[:POSE_SIZE], self._covariance[:, :POSE_SIZE] = corrected, corrected.T
