"""EKF-SLAM: the pose and all landmarks with one joint covariance, updated frame by frame in place.

Landmarks are added to the state when they are first seen, with the correlations due to the pose
from which they were seen (Smith, Self, Cheeseman: Estimating uncertain spatial relationships in
robotics, 1990). All rows of a frame are one measurement, so that all of them are linearised at the
pose predicted from odometry.

Of a vertical line only the bearing is measured. It is represented by the ray of its first sight,
from the camera's position then, and the inverse of its distance along the ray. In these four
components bearings are nearly linear from the first sight on, however far away the line may be
(J. Civera, A. J. Davison, J. M. M. Montiel, "Inverse depth parametrization for monocular SLAM",
IEEE Transactions on Robotics 24(5), 2008).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import count

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag
from scipy.linalg.blas import dgemm

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.landmarks.map_file import LandmarkMap, MapLandmarks
from redetect.plane import apply, rotation
from redetect.slam.errors import SlamError
from redetect.slam.filters import base
from redetect.slam.filters.run import BY_IDENTIFIERS, Associator, FilterRun, frames_of, run_filter
from redetect.slam.models import common_tilt_jacobian, move, tilt_jacobian
from redetect.slam.recording import NO_CAMERA, LineRows, Recording

#: Largest relative uncertainty of the distance of lines in the map, since users of their x and y
#: assume that bearings are linear in these.
LARGEST_RANGE_SIGMA = 0.05
# Inverse distance of a line at first sight, and its standard deviation: half a metre to infinity
# within two of these (1/m).
_INVERSE_DISTANCE, _INVERSE_DISTANCE_SIGMA = 0.4, 0.4

# Most iterations of an update with bearings, the change below which it ends, and the largest change
# of an inverse distance in one iteration (1/m).
_MOST_ITERATIONS, _CONVERGED, _LONGEST_STEP = 20, 1e-4, 0.2

# Increment of the state's size; some unused components cost less than copying its covariance often.
_CHUNK = 64
# For poses alone the state is limited to this many discs: its update costs their number squared.
_MOST_DISCS = 300


class EkfSlam(base.Filter):
    """The filter.

    Parameters
    ----------
    start, start_covariance, camera_xy, common_tilt_variance : array_like
        As in `Filter`.
    tilt_sigma_rad : float
        Standard deviation of the robot's sway about the floor's axes, added to rows' covariances.
    """

    line_size = 4

    def __init__(
        self,
        start: ArrayLike = (0.0, 0.0, 0.0),
        start_covariance: ArrayLike | None = None,
        camera_xy: ArrayLike = NO_CAMERA,
        *,
        common_tilt_variance: float = 0.0,
        tilt_sigma_rad: float = 0.0,
    ) -> None:
        super().__init__(start, start_covariance, camera_xy, common_tilt_variance)
        self.tilt_sigma_rad = tilt_sigma_rad
        self.disc_rows: Counter[int] = Counter()
        self.line_rows: Counter[int] = Counter()

    def line_points(self, index: IntArray) -> tuple[FloatArray, FloatArray]:
        """See `Filter.line_points`; the scale is the inverse distance along the first ray."""
        x, y, direction, inverse = self._state[index].T
        sin, cos = np.sin(direction), np.cos(direction)
        points = np.stack([inverse * x + sin, inverse * y - cos, inverse], axis=1)
        by_numbers = np.zeros((len(index), 3, 4))
        by_numbers[:, 0, 0] = by_numbers[:, 1, 1] = inverse
        by_numbers[:, 0, 2], by_numbers[:, 1, 2] = cos, sin
        by_numbers[:, :, 3] = np.stack([x, y, np.ones(len(x))], axis=1)
        return points, by_numbers

    def measure(self, rows: base.FrameRows) -> None:
        """Update with the rows of the frame: known landmarks first, then new ones.

        Rows of several lines are ignored unless all of them are in the state then.
        """
        known, others = self._known(rows)
        self._update(known)
        discs, lines = others
        new_discs = _first_rows([(i,) for i in discs.ids.tolist()])
        for k in np.flatnonzero(new_discs):
            self._add_disc(int(discs.ids[k]), discs.xy[k], discs.covariance[k])
        new_lines = _first_rows(lines.ids)
        for k in np.flatnonzero(new_lines):
            self._add_line(lines.ids[k][0], float(lines.bearing_rad[k]), float(lines.sigma_rad[k]))
        again, unknown = self._known(others.only(~new_discs, ~new_lines))
        self._update(again)
        self.count.leave_out("row of lines not in the map yet", len(unknown.lines))

    def landmark_map(self) -> LandmarkMap:
        """The landmarks with known positions, with their covariances."""
        of_discs = base.indices_from([*self.disc_slots.values()], 2)
        of_lines = base.indices_from([*self.line_slots.values()], self.line_size)
        inverse = of_lines[:, 3]
        sigma = np.sqrt(self._covariance[inverse, inverse])
        placed = sigma < LARGEST_RANGE_SIGMA * self._state[inverse]
        of_lines = of_lines[placed]
        points, by_numbers = self.line_points(of_lines)
        line_xy = points[:, :2] / points[:, 2:]
        by_xy = np.tile(np.eye(2), (len(points), 1, 1))
        by_points = np.concatenate([by_xy, -line_xy[..., None]], axis=2)
        by_lines = by_points @ by_numbers / points[:, 2, None, None]
        jacobian = block_diag(np.eye(of_discs.size), *by_lines)
        joint = jacobian @ self.block(np.append(of_discs.ravel(), of_lines.ravel())) @ jacobian.T
        every = np.arange(len(of_discs) + len(of_lines))
        xy = np.concatenate([self._state[of_discs], line_xy])
        own = joint.reshape(len(every), 2, len(every), 2)[every, :, every]

        def landmarks(ids: list[int], some: slice, rows: Counter[int]) -> MapLandmarks:
            counts = np.array([rows[i] for i in ids], dtype=np.int64)
            return MapLandmarks(np.array(ids, dtype=np.int64), xy[some], own[some], counts)

        line_ids = [number for number, good in zip(self.line_slots, placed) if good]
        return LandmarkMap(
            discs=landmarks(list(self.disc_slots), slice(len(of_discs)), self.disc_rows),
            lines=landmarks(line_ids, slice(len(of_discs), None), self.line_rows),
            joint_covariance=joint,
        )

    def forget(self, discs: set[int], lines: set[int]) -> None:
        """Remove landmarks from the state."""
        if not discs and not lines:
            return
        kept = self._moving
        for slots, size, dropped in (
            (self.disc_slots, 2, discs),
            (self.line_slots, self.line_size, lines),
        ):
            for number in dropped:
                del slots[number]
            numbers = base.indices_from([*slots.values()], size).ravel()
            slots.update(zip([*slots], range(len(kept), len(kept) + len(numbers), size)))
            kept = np.append(kept, numbers)
        self.size = len(kept)
        self._state, self._linearised = self._state[kept], self._linearised[kept]
        self._covariance = np.asfortranarray(self.block(kept))

    def _update(self, rows: base.FrameRows) -> None:
        """Use rows whose landmarks are in the state."""
        if not len(rows.circles) and not len(rows.lines):
            return
        before, tilt = self._state.copy(), self._covariance[self._tilt, self._tilt].copy()
        inverse = base.indices_from([*self.line_slots.values()], self.line_size)[:, 3]
        for _ in range(_MOST_ITERATIONS if len(rows.lines) else 1):
            factor, last = self._whitened(self.innovation_of(rows), before)
            change = before + factor @ last - self._state
            change[self._tilt] = 0.0
            nearer = np.abs(change[inverse])
            self._state += change * min(1.0, _LONGEST_STEP / max(nearer.max(initial=0.0), 1e-9))
            if np.max(np.abs(change)) < _CONVERGED:
                break
        self.count.use(rows, last)
        # P - K S K^T, in place.
        self._covariance = dgemm(
            -1.0, factor, factor, 1.0, self._covariance, trans_b=1, overwrite_c=1
        )
        self._covariance[self._tilt, self._tilt] = tilt  # it is not estimated
        self.disc_rows.update(rows.circles.ids.tolist())
        self.line_rows.update(number for numbers in rows.lines.ids for number in numbers)

    def _add_disc(self, number: int, seen_xy: FloatArray, noise: FloatArray) -> None:
        by_seen = rotation(self._state[2])
        sway = self.tilt_sigma_rad * tilt_jacobian(seen_xy[None])[0]
        noise = by_seen @ (noise + sway @ sway.T) @ by_seen.T
        xy = self._state[:2] + by_seen @ seen_xy
        by_tilt = -by_seen @ common_tilt_jacobian(seen_xy[None])[0]
        by_all = np.column_stack([self._turned_about(xy), by_tilt])[:, : len(self._moving)]
        self.disc_slots[number] = self._append(by_all, noise, xy)
        self.disc_rows[number] = 1
        self.count.discs += 1

    def _add_line(self, number: int, bearing_rad: float, sigma_rad: float) -> None:
        xy = apply(self._state[:3], self.camera_xy)
        value = np.array([*xy, self._state[2] + bearing_rad, _INVERSE_DISTANCE])
        by_pose = np.concatenate([self._turned_about(xy), [[0.0, 0.0, 1.0], np.zeros(3)]])
        noise = np.diag([0.0, 0.0, sigma_rad**2, _INVERSE_DISTANCE_SIGMA**2])
        self.line_slots[number] = self._append(by_pose, noise, value)
        self.line_rows[number] = 1
        self.count.lines += 1

    def _turned_about(self, xy: FloatArray) -> FloatArray:
        """(2, 3) derivative of a position fixed to the robot, with respect to its pose."""
        x, y = xy - self._linearised[:2]
        return np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])

    def _append(self, jacobian: FloatArray, noise: FloatArray, value: FloatArray) -> int:
        """`_put` components that depend on the first ones at the end; returns their slot."""
        slot, self.size = self.size, self.size + len(value)
        if self.size > len(self._state):
            self._grow(_CHUNK)
        self._put(slot, self._moving[: jacobian.shape[1]], jacobian, noise, value)
        return slot


def _first_rows(ids: Sequence[tuple[int, ...]]) -> BoolArray:
    """Mask of rows that are the first to show a single landmark alone."""
    first: dict[int, int] = {}
    for k, numbers in enumerate(ids):
        if len(numbers) == 1:
            first.setdefault(numbers[0], k)
    chosen = np.zeros(len(ids), dtype=np.bool_)
    chosen[list(first.values())] = True
    return chosen


def run_ekf(recording: Recording, ekf: EkfSlam, pairing: Associator = BY_IDENTIFIERS) -> FilterRun:
    """`run_filter` with EKF-SLAM, which contains the map afterwards.

    If identities have to be found, discs far from all others are new ones, numbered from 1. Lines
    may be anywhere on a ray at first: `SlamError` is raised if their rows have no identifiers.
    """
    if pairing.method != "known" and len(recording.lines):
        raise SlamError(
            f"association {pairing.method} with lines: EKF-SLAM finds identities of discs only: "
            "expected known association, or a run without lines"
        )
    return run_filter(recording, ekf, replace(pairing, new_id=count(1).__next__))


def filtered_poses(recording: Recording, start: ArrayLike = (0.0, 0.0, 0.0)) -> FloatArray:
    """Poses by EKF-SLAM with the identifiers of discs: a start where odometry is too wrong.

    Odometry with a systematic error winds up: after a loop its heading may be half a turn off, and
    least squares from there end in a wrong minimum, with the path wound once too often. The filter
    corrects the pose in each frame, so that no error winds up while discs are in view. It forgets
    discs not seen for long, and begins again after a lost step.

    Takes the first pose (3,) (m, m, rad); returns the start and the pose after each step (N + 1, 3)
    as estimated at the time, theta not wrapped; a `SlamError` if covariances are contradictory.
    """
    lost = set(recording.lost.tolist())
    poses = np.empty((len(recording) + 1, 3))
    poses[0] = start
    ekf, seen = EkfSlam(poses[0]), dict[int, int]()
    for k, rows in enumerate(frames_of(recording)):
        if k in lost:
            ekf, seen = EkfSlam(move(poses[k], recording.steps[k])), {}
        else:
            ekf.predict(recording.steps[k], recording.step_covariance[k])
        ekf.measure(rows._replace(lines=LineRows.of()))
        seen.update(dict.fromkeys(rows.circles.ids[rows.circles.identified].tolist(), k))
        if len(seen) > _MOST_DISCS:
            kept = dict(sorted(seen.items(), key=lambda item: -item[1])[: _MOST_DISCS // 2])
            ekf.forget(seen.keys() - kept.keys(), set())
            seen = kept
        poses[k + 1] = ekf.state[:3]
    return poses
