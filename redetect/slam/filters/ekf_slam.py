"""EKF-SLAM: the pose and all landmarks with one joint covariance, updated frame by frame in place.

Landmarks join the state when they are first seen, with the correlations that follow from the pose
they were seen from (Smith, Self, Cheeseman: Estimating uncertain spatial relationships in robotics,
1990). All rows of a frame are one measurement, so that all of them are linearised at the pose the
odometry leads to.

A vertical line is seen by its bearing only. As long as its bearings have too little parallax,
copies of the poses they were seen from are kept in the state (stochastic cloning); then the line
joins the state by all of them at once (`redetect.slam.filters.delayed_lines`). Each row is used
once.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import count
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg.blas import dgemm

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks.map_file import LandmarkMap, Landmarks
from redetect.plane import rotation
from redetect.slam.errors import SlamError
from redetect.slam.filters.delayed_lines import View, WaitingLines, relative_range_sigma, start_line
from redetect.slam.filters.frames import (
    NO_CAMERA,
    POSE_SIZE,
    Associator,
    Filter,
    FilterRun,
    FrameRows,
    Innovation,
    innovation_of,
    run_filter,
)
from redetect.slam.recording import UNKNOWN_ID, Recording

JacobiansAt = Literal["first", "latest"]

#: A line joins the state when its distance is known to this share, so that bearings are nearly
#: linear in its place.
LARGEST_RANGE_SIGMA = 0.05

_POSE = np.arange(POSE_SIZE)
# By as many numbers the state grows; some too many cost less than moving its covariance often.
_CHUNK = 64


class EkfSlam(Filter):
    """The filter.

    Parameters
    ----------
    start : (3,) array_like
        Pose at the start (m, m, rad).
    start_covariance : (3, 3) array_like
        Its covariance; none by default, as the start defines the map.
    camera_xy : (2,) array_like
        The camera's centre in the robot frame (m); only lines need it.
    jacobians : str
        `first`: evaluate them at the first estimate of each landmark and at the poses as predicted
        (Huang, Mourikis, Roumeliotis: Observability-based rules for designing consistent EKF SLAM
        estimators, 2010), so that landmarks that the filter has initialised itself give it no
        spurious information about its heading. `latest`: at the latest estimates, as the textbook
        filter does.
    """

    def __init__(
        self,
        start: ArrayLike = (0.0, 0.0, 0.0),
        start_covariance: ArrayLike | None = None,
        camera_xy: ArrayLike = NO_CAMERA,
        *,
        jacobians: JacobiansAt = "first",
    ) -> None:
        super().__init__(start, start_covariance, camera_xy, first_estimates=jacobians == "first")
        self.disc_rows: Counter[int] = Counter()
        self.line_rows: Counter[int] = Counter()
        self.frame = -1
        self._waiting = WaitingLines()

    def predict(self, step: FloatArray, noise: FloatArray) -> None:
        """The robot moves by an odometry step (3,), of covariance (3, 3)."""
        super().predict(step, noise)
        self.frame += 1

    def measure(self, rows: FrameRows) -> None:
        """Update with the rows of the frame: known landmarks first, then new ones.

        Rows without ID are left out, and so are rows of several lines of which not all are in the
        map yet. A row of several lines measures the mean of their bearings.
        """
        discs, lines = [], []
        new_discs: dict[int, int] = {}
        again: list[int] = []
        single: list[int] = []
        for k, number in enumerate(rows.circles.ids.tolist()):
            if number == UNKNOWN_ID:
                self.count.left_out["disc without ID"] += 1
            elif number in self.disc_slots:
                discs.append(k)
            elif number in new_discs:
                again.append(k)
            else:
                new_discs[number] = k
        for k, numbers in enumerate(rows.lines.ids):
            if not numbers:
                self.count.left_out["line without ID"] += 1
            elif all(number in self.line_slots for number in numbers):
                lines.append(k)
            elif len(numbers) > 1:
                self.count.left_out["row of lines not in the map yet"] += 1
            else:
                single.append(k)
        if discs or lines:
            self._update(rows.only(discs, lines))
        for number, k in new_discs.items():
            self._add_disc(number, rows.circles.xy[k], rows.circles.covariance[k])
        if again:
            self._update(rows.only(again, []))
        if single or self._waiting.slots:
            self._view_lines(rows, single)

    def finish(self) -> None:
        """The run is over: lines that were not initialised are dropped."""
        self._give_up(self._waiting.forget())

    def landmark_map(self) -> LandmarkMap:
        """The landmarks that are in the state, with their covariances."""
        slots = np.array([*self.disc_slots.values(), *self.line_slots.values()], dtype=np.int64)
        return LandmarkMap(
            discs=self._landmarks(self.disc_slots, self.disc_rows),
            lines=self._landmarks(self.line_slots, self.line_rows),
            joint_covariance=self.block((slots[:, None] + np.arange(2)).ravel()),
        )

    def _update(self, rows: FrameRows) -> None:
        """Use rows whose landmarks are in the state."""
        self._apply(innovation_of(rows, self, self._linearised))
        self.count.discs += len(rows.circles)
        self.count.lines += len(rows.lines)
        self.disc_rows.update(rows.circles.ids.tolist())
        self.line_rows.update(number for numbers in rows.lines.ids for number in numbers)

    def _apply(self, innovation: Innovation) -> None:
        """Update the state."""
        factor, last = self._whitened(innovation)
        # P - K S K^T, in place.
        self._covariance = dgemm(
            -1.0, factor, factor, 1.0, self._covariance, trans_b=1, overwrite_c=1
        )
        self._state += factor @ last

    def _add_disc(self, number: int, seen_xy: FloatArray, noise: FloatArray) -> None:
        pose, at = self._state, self._linearised
        by_seen = rotation(pose[2])
        xy = pose[:2] + by_seen @ seen_xy
        by_pose = np.array([[1.0, 0.0, at[1] - xy[1]], [0.0, 1.0, xy[0] - at[0]]])
        self.disc_slots[number] = self._append(_POSE, by_pose, by_seen @ noise @ by_seen.T, xy, xy)
        self.disc_rows[number] = 1
        self.count.discs += 1

    def _view_lines(self, rows: FrameRows, single: list[int]) -> None:
        """Lines that are not in the state yet: they join it, or wait."""
        waiting, reasons = self._waiting, self.count.left_out
        given_up = waiting.forget(self.frame)
        kept = False
        for k in single:
            number = rows.lines.ids[k][0]
            view = View(
                self.frame, float(rows.lines.bearing_rad[k]), float(rows.lines.sigma_rad[k])
            )
            if number in self.line_slots or any(
                other.frame == self.frame for other in waiting.views(number)
            ):
                reasons["further row of a new line"] += 1
            elif not self._start_line(number, [*waiting.views(number), view]):
                waiting.keep(number, view)
                kept = True
        if kept:
            waiting.slots[self.frame] = self._keep_pose()
            given_up += waiting.thin()
        self._give_up(given_up)

    def _give_up(self, views: int) -> None:
        """Count views that are not used, and let go of the poses that none needs any more."""
        if views:
            self.count.left_out["line without parallax"] += views
        self._waiting.release()

    def _start_line(self, number: int, views: list[View]) -> bool:
        """Add a line by all its views, the last from the present pose, if that places it well."""
        if len(views) < 2:
            return False
        slots = [*(self._waiting.slots[view.frame] for view in views[:-1]), 0]
        index = (np.array(slots)[:, None] + _POSE).ravel()
        bearing = np.array([view.bearing_rad for view in views])
        sigma = np.array([view.sigma_rad for view in views])
        poses = self._state[index].reshape(-1, POSE_SIZE)
        if not self._waiting.worth_trying(number, float(np.ptp(np.unwrap(bearing + poses[:, 2])))):
            return False
        known = self.block(index)
        poses_at = self._linearised[index].reshape(-1, POSE_SIZE)
        start = start_line(poses, poses_at, bearing, sigma, self.camera_xy, known)
        if start is None:
            return False
        both = np.zeros((5, 5))
        both[:3, :3] = known[-3:, -3:]
        both[:3, 3:] = known[-3:] @ start.by_poses.T
        both[3:, :3] = both[:3, 3:].T
        both[3:, 3:] = start.by_poses @ known @ start.by_poses.T + start.noise
        if relative_range_sigma(poses[-1], start.xy, both) > LARGEST_RANGE_SIGMA:
            return False
        self.line_slots[number] = self._append(
            index, start.by_poses, start.noise, start.xy + start.correction, start.xy
        )
        if len(views) > 2:
            noise = np.eye(len(start.residual))
            self._apply(Innovation(start.residual, start.residual_by_poses, index, noise))
        self._waiting.take(number)
        self.line_rows[number] = len(views)
        self.count.lines += len(views)
        return True

    def _keep_pose(self) -> int:
        """Put a copy of the pose into the state; returns where."""
        copy, none = np.eye(POSE_SIZE), np.zeros((POSE_SIZE, POSE_SIZE))
        pose, at = self._state[_POSE], self._linearised[_POSE]
        if not self._waiting.free_slots:
            return self._append(_POSE, copy, none, pose, at)
        slot = self._waiting.free_slots.pop()
        self._put(slot, _POSE, copy, none, pose, at)
        return slot

    def _append(
        self,
        index: IntArray,
        jacobian: FloatArray,
        noise: FloatArray,
        value: FloatArray,
        linearised: FloatArray,
    ) -> int:
        """`_put` numbers at the end of the state; returns where they begin."""
        slot, self.size = self.size, self.size + len(value)
        if self.size > len(self._state):
            self._grow(_CHUNK)
        self._put(slot, index, jacobian, noise, value, linearised)
        return slot

    def _landmarks(self, slots: dict[int, int], rows: Counter[int]) -> Landmarks:
        places = np.array(list(slots.values()), dtype=np.int64)[:, None] + np.arange(2)
        return Landmarks(
            ids=np.array(list(slots), dtype=np.int64),
            xy=self._state[places],
            covariance=self._covariance[places[:, :, None], places[:, None, :]],
            rows=np.array([rows[number] for number in slots], dtype=np.int64),
        )


def run_ekf(recording: Recording, ekf: EkfSlam, associator: Associator | None = None) -> FilterRun:
    """`run_filter` with EKF-SLAM, which holds the map afterwards.

    If identities are found out, discs that are far from all others are new ones, numbered from 1 in
    the order of their first sight; lines have no place before there is parallax, so that they can't
    be found again by it: their rows must be known, else `SlamError` is raised.
    """
    pairing = associator or Associator()
    if pairing.method != "known" and len(recording.lines):
        raise SlamError(
            f"association {pairing.method} with lines: EKF-SLAM finds out the identity of discs "
            "only; expected known association, or a run without lines"
        )
    filtered = run_filter(recording, ekf, replace(pairing, new_id=count(1).__next__))
    ekf.finish()
    return filtered
