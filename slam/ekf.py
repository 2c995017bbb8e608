"""EKF-SLAM: the pose and all landmarks with one joint covariance, updated frame by frame in place.

Landmarks join the state when they are first seen, with the correlations that follow from the pose
they were seen from (Smith, Self, Cheeseman: Estimating uncertain spatial relationships in robotics,
1990). All rows of a frame are one measurement, so that all of them are linearised at the pose the
odometry leads to.

A vertical line is seen by its bearing only. When it is first seen, a copy of the pose joins the
state instead (stochastic cloning), and the bearing waits. As soon as another bearing has enough
parallax to it the line joins the state, computed from both poses, the kept and the present one,
and both bearings. Each row is used once; rows of the line between those two are not used.
"""

from __future__ import annotations

from collections import Counter
from itertools import count

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam.ekf_covariance import POSE_SIZE, JointCovariance
from slam.ekf_lines import FirstView, intersect, intersection_jacobians
from slam.errors import SlamError
from slam.filter_association import Associator
from slam.filter_frames import NO_CAMERA, FilterRun, FrameRows, RowCount, frames_of, unknown
from slam.filter_kernels import frame_innovation
from slam.map_file import LandmarkMap, Landmarks, Path2D
from slam.recording import Recording

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Two bearings make a line when the parallax between them is so many times its standard deviation:
# then the distance is known to about a tenth, and the intersection is linear enough.
PARALLAX_SIGMAS = 10.0
# A first view is given up for a later one after so many frames without parallax.
LONGEST_WAIT_FRAMES = 300

_POSE = np.arange(POSE_SIZE)


class EkfSlam:
    """The filter.

    Parameters
    ----------
    start : (3,) array_like
        Pose at the start (m, m, rad).
    start_covariance : (3, 3) array_like
        Its covariance; none by default, as the start defines the map.
    camera_xy : (2,) array_like
        The camera's centre in the robot frame (m); only lines need it.
    first_estimates : bool
        Evaluate Jacobians at the first estimate of each landmark and at the poses as predicted
        (Huang, Mourikis, Roumeliotis: Observability-based rules for designing consistent EKF SLAM
        estimators, 2010), so that the filter does not believe to learn its heading from
        landmarks it has placed itself.
    """

    def __init__(
        self,
        start: ArrayLike = (0.0, 0.0, 0.0),
        start_covariance: ArrayLike | None = None,
        camera_xy: ArrayLike = NO_CAMERA,
        *,
        first_estimates: bool = False,
    ) -> None:
        spread = np.zeros((3, 3)) if start_covariance is None else np.asarray(start_covariance)
        self.covariance = JointCovariance(spread)
        self.camera_xy = np.asarray(camera_xy, dtype=np.float64)
        self.disc_slots: dict[int, int] = {}
        self.line_slots: dict[int, int] = {}
        self.disc_rows: Counter[int] = Counter()
        self.line_rows: Counter[int] = Counter()
        self.count = RowCount()
        self.frame = -1
        self._state = np.array(start, dtype=np.float64)
        # The same array unless Jacobians are evaluated elsewhere.
        self._linearised = self._state.copy() if first_estimates else self._state
        self._first_views: dict[int, FirstView] = {}
        self._free_slots: list[int] = []

    @property
    def state(self) -> FloatArray:
        """The pose, then landmarks and kept poses, as the slots say: (n,)."""
        return self._state[: self.covariance.size]

    def block(self, index: IntArray) -> FloatArray:
        """Rows and columns `index` of the state's covariance."""
        return self.covariance.block(index)

    def predict(self, step: FloatArray, noise: FloatArray) -> None:
        """The robot moves by an odometry step.

        Parameters
        ----------
        step : (3,) array
            dx, dy (m), dphi (rad).
        noise : (3, 3) array
            Its covariance.
        """
        state, at = self._state, self._linearised
        cos, sin = np.cos(state[2]), np.sin(state[2])
        x = state[0] + cos * step[0] - sin * step[1]
        y = state[1] + sin * step[0] + cos * step[1]
        by_pose = np.array([[1.0, 0.0, at[1] - y], [0.0, 1.0, x - at[0]], [0.0, 0.0, 1.0]])
        by_step = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        self.covariance.move_pose(by_pose, by_step @ noise @ by_step.T)
        state[0], state[1], state[2] = x, y, state[2] + step[2]
        at[:POSE_SIZE] = state[:POSE_SIZE]
        self.frame += 1

    def measure(self, rows: FrameRows) -> None:
        """Use the rows of the frame: what is known first, then new landmarks.

        Rows without ID are left out, and so are rows of several lines of which not all are in the
        map yet. A row of several lines measures the mean of their bearings.

        Parameters
        ----------
        rows : FrameRows
        """
        discs, lines = [], []
        new_discs: dict[int, int] = {}
        again: list[int] = []
        single: list[int] = []
        for k, number in enumerate(rows.disc_ids):
            if unknown(number):
                self.count.left_out["disc without ID"] += 1
            elif number in self.disc_slots:
                discs.append(k)
            elif number in new_discs:
                again.append(k)
            else:
                new_discs[number] = k
        for k, numbers in enumerate(rows.line_ids):
            if not numbers:
                self.count.left_out["line without ID"] += 1
            elif all(number in self.line_slots for number in numbers):
                lines.append(k)
            elif len(numbers) > 1:
                self.count.left_out["row of lines not in the map yet"] += 1
            else:
                single.append(k)
        if discs or lines:
            self._update(rows, discs, lines)
        for number, k in new_discs.items():
            self._add_disc(number, rows.disc_xy[k], rows.disc_covariance[k])
        if again:
            self._update(rows, again, [])
        for k in single:
            self._view_line(rows.line_ids[k][0], rows.bearing_rad[k], rows.sigma_rad[k])

    def landmark_map(self) -> LandmarkMap:
        """The landmarks that are in the state, with their marginal covariances."""
        return LandmarkMap(
            discs=self._landmarks(self.disc_slots, self.disc_rows),
            lines=self._landmarks(self.line_slots, self.line_rows),
        )

    def _update(self, rows: FrameRows, discs: list[int], lines: list[int]) -> None:
        line_ids = [rows.line_ids[k] for k in lines]
        innovation, jacobian, noise, index = frame_innovation(
            self._state,
            self._linearised,
            np.array([self.disc_slots[rows.disc_ids[k]] for k in discs], dtype=np.int64),
            rows.disc_xy[discs],
            rows.disc_covariance[discs],
            np.array([self.line_slots[i] for ids in line_ids for i in ids], dtype=np.int64),
            np.cumsum([0, *map(len, line_ids)]),
            rows.bearing_rad[lines],
            rows.sigma_rad[lines],
            self.camera_xy,
        )
        projected = self.covariance.projected(index, jacobian)
        change, squared = self.covariance.measure(
            projected, jacobian @ projected[index] + noise, innovation
        )
        self._state[: len(change)] += change
        self.count.innovation_squared += squared
        self.count.innovation_numbers += len(innovation)
        self.count.discs += len(discs)
        self.count.lines += len(lines)
        self.disc_rows.update([rows.disc_ids[k] for k in discs])
        self.line_rows.update([i for ids in line_ids for i in ids])

    def _add_disc(self, number: int, seen_xy: FloatArray, noise: FloatArray) -> None:
        pose, at = self._state, self._linearised
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        by_seen = np.array([[cos, -sin], [sin, cos]])
        xy = pose[:2] + by_seen @ seen_xy
        by_pose = np.array([[1.0, 0.0, at[1] - xy[1]], [0.0, 1.0, xy[0] - at[0]]])
        self.disc_slots[number] = self._append(_POSE, by_pose, by_seen @ noise @ by_seen.T, xy, xy)
        self.disc_rows[number] = 1
        self.count.discs += 1

    def _view_line(self, number: int, bearing_rad: float, sigma_rad: float) -> None:
        """A line that is not in the state yet: it joins it, or its first view is kept."""
        first = self._first_views.get(number)
        if first is None:
            self._keep_view(number, bearing_rad, sigma_rad)
        elif not self._add_line(number, first, bearing_rad, sigma_rad):
            if self.frame - first.frame > LONGEST_WAIT_FRAMES:
                self._forget_view(number)
                self._keep_view(number, bearing_rad, sigma_rad)
            self.count.left_out["line without parallax yet"] += 1

    def _add_line(
        self, number: int, first: FirstView, bearing_rad: float, sigma_rad: float
    ) -> bool:
        """Add a line if its two bearings have enough parallax."""
        kept = np.arange(first.slot, first.slot + POSE_SIZE)
        found = intersect(
            self._state[kept], first.bearing_rad, self._state[:3], bearing_rad, self.camera_xy
        )
        if found is None:
            return False
        index = np.concatenate([kept, _POSE])
        headings = self.covariance.block(index[[2, 5]])
        variance = first.sigma_rad**2 + sigma_rad**2
        variance += headings[0, 0] + headings[1, 1] - 2.0 * headings[0, 1]
        if np.sin(found.parallax_rad) < PARALLAX_SIGMAS * np.sqrt(variance):
            return False
        at = self._linearised
        by_poses, by_bearings = intersection_jacobians(
            at[kept], at[:POSE_SIZE], found.xy, self.camera_xy
        )
        noise = by_bearings @ np.diag([first.sigma_rad**2, sigma_rad**2]) @ by_bearings.T
        self.line_slots[number] = self._append(index, by_poses, noise, found.xy, found.xy)
        self.line_rows[number] = 2
        self.count.lines += 2
        self._forget_view(number)
        return True

    def _keep_view(self, number: int, bearing_rad: float, sigma_rad: float) -> None:
        """Keep a bearing, and the pose it was seen from as part of the state."""
        shared = [v.slot for v in self._first_views.values() if v.frame == self.frame]
        if shared:
            slot = shared[0]
        else:
            copy, none = np.eye(POSE_SIZE), np.zeros((POSE_SIZE, POSE_SIZE))
            pose, at = self._state[:POSE_SIZE].copy(), self._linearised[:POSE_SIZE].copy()
            if self._free_slots:
                slot = self._free_slots.pop()
                self.covariance.replace(slot, _POSE, copy, none)
                self._linearised[slot : slot + POSE_SIZE] = at
                self._state[slot : slot + POSE_SIZE] = pose
            else:
                slot = self._append(_POSE, copy, none, pose, at)
        self._first_views[number] = FirstView(slot, self.frame, bearing_rad, sigma_rad)

    def _forget_view(self, number: int) -> None:
        slot = self._first_views.pop(number).slot
        if all(view.slot != slot for view in self._first_views.values()):
            self._free_slots.append(slot)

    def _append(
        self,
        index: IntArray,
        jacobian: FloatArray,
        noise: FloatArray,
        value: FloatArray,
        linearised: FloatArray,
    ) -> int:
        slot = self.covariance.append(index, jacobian, noise)
        if self.covariance.size > len(self._state):
            separate = self._linearised is not self._state
            self._state = np.resize(self._state, 2 * self.covariance.size)
            self._linearised = (
                np.resize(self._linearised, len(self._state)) if separate else self._state
            )
        self._linearised[slot : slot + len(value)] = linearised
        self._state[slot : slot + len(value)] = value
        return slot

    def _landmarks(self, slots: dict[int, int], rows: Counter[int]) -> Landmarks:
        place = np.array(list(slots.values()), dtype=np.int64)
        return Landmarks(
            ids=np.array(list(slots), dtype=np.int64),
            xy=np.stack([self._state[place], self._state[place + 1]], axis=-1),
            covariance=self.covariance.blocks(place),
            rows=np.array([rows[number] for number in slots], dtype=np.int64),
        )


def run_ekf(recording: Recording, ekf: EkfSlam, associator: Associator | None = None) -> FilterRun:
    """Take a filter through a run.

    Parameters
    ----------
    recording : Recording
        The run.
    ekf : EkfSlam
        A filter at the start; holds the map afterwards.
    associator : Associator, optional
        How rows are paired with landmarks; by default by their identifiers. If it is found out,
        discs that are far from all others are new ones, numbered from 1 in the order of their
        first sight; lines have no place before there is parallax, so that they can't be found
        again by it: their rows must be known.

    Returns
    -------
    FilterRun

    Raises
    ------
    SlamError
        If an update is not possible, the message names the step; or if lines without identifiers
        are to be mapped.
    """
    pairing = associator or Associator()
    if pairing.method != "known" and len(recording.lines):
        raise SlamError(
            f"association {pairing.method} with lines: EKF-SLAM finds out the identity of discs "
            "only; expected known association, or a run without lines"
        )
    new_id = count(1).__next__
    disc_ids: list[int] = []
    line_ids: list[tuple[int, ...]] = []
    poses = np.empty((len(recording) + 1, POSE_SIZE))
    covariance = np.empty((len(recording) + 1, POSE_SIZE, POSE_SIZE))
    poses[0], covariance[0] = ekf.state[:POSE_SIZE], ekf.covariance.pose()
    for k, rows in enumerate(frames_of(recording)):
        try:
            ekf.predict(recording.steps[k], recording.step_covariance[k])
            identified = pairing.identified(rows, ekf, new_id)
            ekf.measure(identified)
        except SlamError as error:
            raise SlamError(f"step {k + 1} ({recording.prefixes[k]}): {error}") from None
        disc_ids.extend(identified.disc_ids)
        line_ids.extend(identified.line_ids)
        poses[k + 1], covariance[k + 1] = ekf.state[:POSE_SIZE], ekf.covariance.pose()
    return FilterRun(
        path=Path2D(("start", *recording.prefixes), poses, covariance),
        count=ekf.count,
        disc_ids=np.array(disc_ids, dtype=np.int64),
        line_ids=tuple(line_ids),
    )
