"""The base of both filters: the state, predicted measurements, innovations and updates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dtrtrs

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.landmarks import wrap_angle
from redetect.plane import rotation
from redetect.slam import models
from redetect.slam.errors import SlamError
from redetect.slam.recording import CircleRows, LineRows

POSE_SIZE = 3
_POSE = np.arange(POSE_SIZE)


class FrameRows(NamedTuple):
    """Measurements of one frame."""

    circles: CircleRows
    lines: LineRows

    def only(self, discs: BoolArray | slice, lines: BoolArray | slice) -> FrameRows:
        """The selected rows."""
        return FrameRows(self.circles.only(discs), self.lines.only(lines))


class Prediction(NamedTuple):
    """Predicted measurements of d discs and e lines of a filter's state."""

    seen: FloatArray  # (2 d + e,): discs in the robot frame (m), lines' bearings (rad)
    jacobian: FloatArray  # (2 d + e, k): with respect to components of the state
    components: IntArray  # (k,): their indices
    sway: FloatArray  # (2 d + e, 2): changes due to tilts of the robot by one standard deviation


class Innovation(NamedTuple):
    """Measured minus predicted values of a frame's rows, m components."""

    error: FloatArray  # (m,)
    jacobian: FloatArray  # (m, k): of the prediction, with respect to components of the state
    components: IntArray  # (k,): their indices
    noise: FloatArray  # (m, m): covariance of the measurements


@dataclass
class RowCount:
    """Use of a run's rows."""

    discs: int = 0  # rows that were used
    lines: int = 0
    left_out: Counter[str] = field(default_factory=Counter)  # rows that were not, by the reason
    innovation_squared: float = 0.0  # sum of the squared normalised innovations
    degrees_of_freedom: int = 0  # its expectation

    def use(self, rows: FrameRows, whitened: FloatArray) -> None:
        """Count rows that are used, with their whitened innovation (m,)."""
        self.discs += len(rows.circles)
        self.lines += len(rows.lines)
        self.innovation_squared += float(whitened @ whitened)
        self.degrees_of_freedom += len(whitened)

    def leave_out(self, reason: str, rows: int) -> None:
        """Count rows that are not used."""
        if rows:
            self.left_out[reason] += rows


class Filter(ABC):
    """The pose and landmarks of a robot with their joint covariance, updated along a run.

    Jacobians with respect to the heading are evaluated at predicted poses and first estimates of
    landmarks (G. P. Huang, A. I. Mourikis, S. I. Roumeliotis, "Observability-based rules for
    designing consistent EKF SLAM estimators", International Journal of Robotics Research 29, 2010):
    at the latest estimates, corrections would add spurious information on the map's orientation.

    Parameters
    ----------
    start : (3,) array_like
        Pose at the start (m, m, rad).
    start_covariance : (3, 3) array_like or None
        Its covariance; None if the start defines the map.
    camera_xy : (2,) array_like
        The camera's centre in the robot frame (m); only lines need it.
    common_tilt_variance : float
        Variance of a pitch and a roll common to all frames (rad^2). Their effect on discs is part
        of the covariances, but they are not estimated (Schmidt-Kalman filter): an error of odometry
        looks the same.
    """

    #: Number of the state's components for a line.
    line_size = 2
    #: Standard deviation of a tilt that moves all discs of a frame together (rad).
    tilt_sigma_rad = 0.0

    def __init__(
        self,
        start: ArrayLike,
        start_covariance: ArrayLike | None,
        camera_xy: ArrayLike,
        common_tilt_variance: float,
    ) -> None:
        self.camera_xy = np.asarray(camera_xy, dtype=np.float64)
        #: Index of each landmark's first component in the state, by identifier.
        self.disc_slots: dict[int, int] = {}
        self.line_slots: dict[int, int] = {}
        self.count = RowCount()  #: Use of the rows.
        # Components of the pose, and of the common tilt, if there is one.
        self._moving = np.arange(POSE_SIZE + 2 if common_tilt_variance else POSE_SIZE)
        self._tilt = slice(POSE_SIZE, len(self._moving))
        self.size = len(self._moving)  #: Number of components of the state.
        self._state = np.zeros(self.size)
        self._state[_POSE] = start
        self._linearised = self._state.copy()
        self._covariance = common_tilt_variance * np.eye(self.size)
        of_pose = 0.0 if start_covariance is None else start_covariance
        self._covariance[:POSE_SIZE, :POSE_SIZE] = of_pose

    @property
    def state(self) -> FloatArray:
        """The pose, the common tilt if there is one, then landmarks at their slots: (n,)."""
        return self._state[: self.size]

    @property
    def pose_covariance(self) -> FloatArray:
        """(3, 3)."""
        return self.block(_POSE)

    def block(self, index: IntArray) -> FloatArray:
        """Rows and columns `index` of the state's covariance."""
        return np.asarray(self._covariance[np.ix_(index, index)])

    def predict(self, step: FloatArray, noise: FloatArray) -> FloatArray:
        """Predict the pose after an odometry step (3,) of covariance (3, 3).

        Returns what that adds to the covariance of the pose, (3, 3).
        """
        at = self._linearised
        pose = models.move(self._state[_POSE], step)
        by_pose, by_step = models.move_jacobians(self._state[_POSE], step)
        by_pose[0, 2], by_pose[1, 2] = at[1] - pose[1], pose[0] - at[0]
        added = by_step @ noise @ by_step.T
        self._put(0, _POSE, by_pose, added, pose)
        return np.asarray(added)

    def inflate_pose_covariance(self, covariance: FloatArray) -> None:
        """Add (3, 3) to the covariance of the pose."""
        self._covariance[:POSE_SIZE, :POSE_SIZE] += covariance

    @abstractmethod
    def measure(self, rows: FrameRows) -> None:
        """Update with the rows of a frame that have an identifier.

        A row of several lines measures the mean of their bearings.
        """

    def line_points(self, index: IntArray) -> tuple[FloatArray, FloatArray]:
        """Lines as homogeneous points (e, 3): the position is x / w, y / w.

        Takes the components of the state (e, k) that describe them; also returns the derivatives
        (e, 3, k) with respect to these.
        """
        points = np.insert(self._state[index], 2, 1.0, axis=1)
        return points, np.tile(np.eye(3, 2), (len(index), 1, 1))

    def predicted(self, discs: ArrayLike, lines: ArrayLike) -> Prediction:
        """Predicted measurements of discs and lines with the slots (d,) and (e,)."""
        of_discs = indices_from(discs, 2)
        of_lines = indices_from(lines, self.line_size)
        pose, turn, d, e = self._state[:3], rotation(self._state[2]), len(of_discs), len(of_lines)
        index = np.concatenate([self._moving, of_discs.ravel(), of_lines.ravel()])
        first = len(self._moving)
        jacobian = np.zeros((2 * d + e, len(index)))
        seen = models.disc_in_robot(pose, self._state[of_discs])
        if self._tilt.stop > self._tilt.start:
            jacobian[: 2 * d, self._tilt] = models.common_tilt_jacobian(seen).reshape(-1, 2)
        by_disc = np.zeros((d, 2, d, 2))
        by_disc[np.arange(d), :, np.arange(d)] = turn.T
        jacobian[: 2 * d, first : first + 2 * d] = by_disc.reshape(2 * d, 2 * d)
        jacobian[: 2 * d, :2] = np.tile(-turn.T, (d, 1))
        sway = np.zeros((len(jacobian), 2))
        if self.tilt_sigma_rad:
            sway[: 2 * d] = self.tilt_sigma_rad * models.tilt_jacobian(seen).reshape(-1, 2)
        bearing = np.zeros(0)
        if e:
            points, by_numbers = self.line_points(of_lines)
            off = (points[:, :2] - points[:, 2:] * pose[:2]) @ turn - points[:, 2:] * self.camera_xy
            bearing = np.arctan2(off[:, 0], -off[:, 1])
            by_off = np.stack([-off[:, 1], off[:, 0]], axis=1) / np.sum(off**2, axis=1)[:, None]
            by_xy = by_off @ turn.T
            by_scale = -by_xy @ pose[:2] - by_off @ self.camera_xy
            by_line = np.einsum("ei,eij->ej", np.column_stack([by_xy, by_scale]), by_numbers)
            every = np.arange(e)[:, None]
            columns = first + 2 * d + np.arange(of_lines.size).reshape(e, -1)
            jacobian[2 * d + every, columns] = by_line
            jacobian[2 * d :, :2] = -points[:, 2:] * by_xy
        # Rotating the robot is rotating the landmarks about it the other way.
        turned = [np.zeros(of_discs.shape), np.zeros(of_lines.shape)]
        for own, places in zip(turned, (of_discs, of_lines[:, :2])):
            x, y = (self._linearised[places] - self._linearised[:2]).T
            own[:, 0], own[:, 1] = -y, x
        turned[1][:, 2:3] = 1.0  # the direction of a ray
        jacobian[:, 2] = -jacobian[:, first:] @ np.concatenate([own.ravel() for own in turned])
        return Prediction(np.append(seen.ravel(), bearing), jacobian, index, sway)

    def innovation_of(self, rows: FrameRows) -> Innovation:
        """Innovation of rows whose landmarks are in the state."""
        members = np.array([len(numbers) for numbers in rows.lines.ids], dtype=np.int64)
        seen, jacobian, index, sway = self.predicted(
            [self.disc_slots[number] for number in rows.circles.ids.tolist()],
            [self.line_slots[number] for numbers in rows.lines.ids for number in numbers],
        )
        d = 2 * len(rows.circles)
        mean = np.repeat(np.diag(1.0 / members), members, axis=1)
        off = wrap_angle(np.repeat(rows.lines.bearing_rad, members) - seen[d:])
        error = np.append(rows.circles.xy.ravel() - seen[:d], mean @ off)
        jacobian = np.concatenate([jacobian[:d], mean @ jacobian[d:]])
        noise = np.diag(np.append(np.zeros(d), rows.lines.sigma_rad**2))
        at = np.arange(d).reshape(-1, 2)
        noise[at[:, :, None], at[:, None, :]] = rows.circles.covariance
        noise[:d, :d] += sway[:d] @ sway[:d].T
        return Innovation(error, jacobian, index, noise)

    def compared(
        self, rows: CircleRows | LineRows, names: IntArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rows of one kind against m landmarks of that kind, as input of `compatible`.

        Returns innovations (n, m, d), covariances of predictions (m d, m d) and of rows (n, d, d).
        """
        if isinstance(rows, LineRows):
            prediction = self.predicted([], [self.line_slots[i] for i in names.tolist()])
            innovation = wrap_angle(rows.bearing_rad[:, None] - prediction.seen)[:, :, None]
            noise = rows.sigma_rad[:, None, None] ** 2
        else:
            prediction = self.predicted([self.disc_slots[i] for i in names.tolist()], [])
            innovation = rows.xy[:, None] - prediction.seen.reshape(-1, 2)
            noise = rows.covariance
        _, jacobian, index, sway = prediction
        spread = jacobian @ self.block(index) @ jacobian.T + sway @ sway.T
        return innovation, spread, noise

    def _known(self, rows: FrameRows) -> tuple[FrameRows, FrameRows]:
        """The rows whose landmarks are all in the state, and the others that have identifiers."""
        of_discs, of_lines = rows.circles.identified, rows.lines.identified
        discs = np.array([i in self.disc_slots for i in rows.circles.ids.tolist()], dtype=bool)
        lines = np.array([self.line_slots.keys() >= set(ids) for ids in rows.lines.ids], dtype=bool)
        others = rows.only(of_discs & ~discs, of_lines & ~lines)
        return rows.only(of_discs & discs, of_lines & lines), others

    def _whitened(
        self, innovation: Innovation, before: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Cross-covariance of state and innovation (n, m), and the innovation (m,), both whitened.

        That is, divided by a root of the innovation's covariance; `SlamError` if there is none.
        `before` is the state of the innovation, if linearised at the current one.
        """
        error, jacobian, index, noise = innovation
        if before is not None:
            error = error + jacobian @ (self._state - before)[index]
        projected = self._covariance[:, index] @ jacobian.T
        try:
            root = np.linalg.cholesky(jacobian @ projected[index] + noise)
        except np.linalg.LinAlgError:
            raise SlamError(
                "the covariance of the innovation is not positive definite: rows or steps with "
                "covariances that contradict each other"
            ) from None
        both = dtrtrs(root, np.vstack([projected, error]).T, lower=1)[0].T
        return both[:-1], both[-1]

    def _grow(self, count: int) -> None:
        """Extend the arrays by some zeros. In column-major order, as BLAS needs it."""
        before = len(self._state)
        self._state = np.pad(self._state, (0, count))
        self._linearised = np.pad(self._linearised, (0, count))
        covariance = np.zeros((before + count, before + count), order="F")
        covariance[:before, :before] = self._covariance
        self._covariance = covariance

    def _put(
        self, slot: int, index: IntArray, jacobian: FloatArray, noise: FloatArray, value: FloatArray
    ) -> None:
        """Set d components of the state, from `slot` on, to a function of others and a measurement.

        Takes the indices of the others, `index` (k,), the derivative with respect to them,
        `jacobian` (d, k), and the measurement's covariance, `noise` (d, d).
        """
        own = slice(slot, slot + len(value))
        columns = self._covariance[:, index] @ jacobian.T
        spread = jacobian @ columns[index] + noise
        columns[own] = 0.5 * (spread + spread.T)
        self._covariance[:, own] = columns
        self._covariance[own] = columns.T
        self._linearised[own] = self._state[own] = value


def indices_from(slots: ArrayLike, size: int) -> IntArray:
    """(n, size) indices of the state from (n,) slots on."""
    return np.asarray(slots, dtype=np.int64).reshape(-1, 1) + np.arange(size)
