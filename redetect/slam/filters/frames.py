"""A recording frame by frame, as input of the filters: innovations, pairing, the way through a run.

Rows without identifiers are paired with landmarks of the filter's state, discs and lines apart from
each other, each frame for itself, by `redetect.slam.association.compatibility`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dtrtrs

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import wrap_angle
from redetect.landmarks.map_file import Path2D
from redetect.plane import apply, rotation
from redetect.slam.association.compatibility import (
    DEFAULT_GATE_PROBABILITY,
    chi_squared_gates,
    compatible,
    individual_distances,
)
from redetect.slam.errors import SlamError
from redetect.slam.models import (
    bearing_jacobians,
    bearing_of_vertical,
    disc_in_robot,
    move,
    move_jacobians,
)
from redetect.slam.recording import UNKNOWN_ID, CircleRows, LineRows, Recording

NO_CAMERA = np.zeros(2)


class FrameRows(NamedTuple):
    """Measurements of one frame."""

    circles: CircleRows
    lines: LineRows

    def only(self, discs: Sequence[int], lines: Sequence[int]) -> FrameRows:
        """Some of the rows."""
        return FrameRows(self.circles.only(discs), self.lines.only(lines))


class Prediction(NamedTuple):
    """How d discs and e lines of a filter's state are seen."""

    seen: FloatArray  # (2 d + e,): discs' places in the robot frame (m), lines' bearings (rad)
    jacobian: FloatArray  # (2 d + e, 3 + 2 d + 2 e): by these numbers of the state:
    numbers: IntArray  # (3 + 2 d + 2 e,)


class Innovation(NamedTuple):
    """Measured less predicted of a frame's rows, m numbers."""

    error: FloatArray  # (m,)
    jacobian: FloatArray  # (m, k): of the prediction, by these numbers of the state:
    numbers: IntArray  # (k,)
    noise: FloatArray  # (m, m): covariance of the measurements


def predicted(
    estimate: Filter, discs: ArrayLike, lines: ArrayLike, linearised_at: FloatArray
) -> Prediction:
    """How discs and lines of a filter's state are seen.

    Takes where in the state they begin, `discs` (d,) and `lines` (e,), and the state (n,) at which
    derivatives by the heading are evaluated.
    """
    state, camera_xy = estimate.state, estimate.camera_xy
    d = np.size(discs)
    slots = np.concatenate([discs, lines]).astype(np.int64)
    places = slots[:, None] + np.arange(2)
    pose, disc_xy, line_xy = state[:3], state[places[:d]], state[places[d:]]
    seen = disc_in_robot(pose, disc_xy).ravel()
    by_place = np.zeros((d + len(slots), len(slots), 2))
    every = np.arange(d)
    by_place[: 2 * d].reshape(d, 2, len(slots), 2)[every, :, every] = rotation(pose[2]).T
    if d < len(slots):
        seen = np.append(seen, bearing_of_vertical(pose, line_xy, camera_xy))
        every = np.arange(d, len(slots))
        by_place[d + every, every] = bearing_jacobians(pose, line_xy, camera_xy)[1]
    # Turning the robot is turning the landmarks about it the other way.
    offset = linearised_at[places] - linearised_at[:2]
    by_heading = by_place[:, :, 0] @ offset[:, 1] - by_place[:, :, 1] @ offset[:, 0]
    by_landmarks = by_place.reshape(len(seen), 2 * len(slots))
    jacobian = np.concatenate([-by_place.sum(axis=1), by_heading[:, None], by_landmarks], axis=1)
    return Prediction(seen, jacobian, np.concatenate([np.arange(3), places.ravel()]))


def innovation_of(rows: FrameRows, estimate: Filter, linearised_at: FloatArray) -> Innovation:
    """Innovation of rows whose landmarks are in a filter's state; see `predicted`.

    A row of several lines measures the mean of their bearings.
    """
    seen, jacobian, index = predicted(
        estimate,
        [estimate.disc_slots[number] for number in rows.circles.ids.tolist()],
        [estimate.line_slots[number] for numbers in rows.lines.ids for number in numbers],
        linearised_at,
    )
    d = 2 * len(rows.circles)
    error = rows.circles.xy.ravel() - seen[:d]
    if rows.lines.ids:
        members = np.array([len(numbers) for numbers in rows.lines.ids])
        mean = np.repeat(np.diag(1.0 / members), members, axis=1)
        off = wrap_angle(np.repeat(rows.lines.bearing_rad, members) - seen[d:])
        error = np.append(error, mean @ off)
        jacobian = np.concatenate([jacobian[:d], mean @ jacobian[d:]])
    noise = np.diag(np.append(np.zeros(d), rows.lines.sigma_rad**2))
    at = np.arange(d).reshape(-1, 2)
    noise[at[:, :, None], at[:, None, :]] = rows.circles.covariance
    return Innovation(error, jacobian, index, noise)


@dataclass
class RowCount:
    """How a run's rows were used."""

    # Rows that were used.
    discs: int = 0
    lines: int = 0
    left_out: Counter[str] = field(default_factory=Counter)  # rows that were not, by the reason
    # Sum of the squared innovations, normalised by their covariances.
    innovation_squared: float = 0.0
    # Their degrees of freedom: if the covariances are right, what the sum is expected to be.
    innovation_numbers: int = 0


@dataclass(frozen=True, eq=False)
class FilterRun:
    """Poses of a run as a filter had them at the time, and what became of the rows."""

    # The start, and the pose after each step and its frame, with covariances; theta is not wrapped.
    path: Path2D
    count: RowCount
    # (n,): the disc that each row was taken to show, -1 where none: the file's, or what association
    # found; the same of lines, empty where none.
    disc_ids: IntArray
    line_ids: tuple[tuple[int, ...], ...]


def frames_of(recording: Recording) -> Iterator[FrameRows]:
    """The rows of each frame of a run, in order."""
    frames = np.arange(len(recording) + 1)
    discs = np.searchsorted(recording.circles.frame, frames)
    lines = np.searchsorted(recording.lines.frame, frames)
    for k in range(len(recording)):
        yield FrameRows(
            recording.circles.only(slice(discs[k], discs[k + 1])),
            recording.lines.only(slice(lines[k], lines[k + 1])),
        )


POSE_SIZE = 3
_POSE = np.arange(POSE_SIZE)


class Filter(ABC):
    """The pose and landmarks of a robot with their joint covariance, to be taken through a run.

    Parameters
    ----------
    start : (3,) array_like
        Pose at the start (m, m, rad).
    start_covariance : (3, 3) array_like or None
        Its covariance; none if the start defines the map.
    camera_xy : (2,) array_like
        The camera's centre in the robot frame (m); only lines need it.
    first_estimates : bool
        Whether derivatives are evaluated at the poses as predicted and at the first estimates of
        landmarks, or at the latest ones.

    Attributes
    ----------
    disc_slots, line_slots : dict of int to int
        Where in the state landmarks begin, by their identifiers.
    count : RowCount
    size : int
        How many numbers the state has.
    """

    def __init__(
        self,
        start: ArrayLike,
        start_covariance: ArrayLike | None,
        camera_xy: ArrayLike,
        *,
        first_estimates: bool,
    ) -> None:
        self.camera_xy = np.asarray(camera_xy, dtype=np.float64)
        self.disc_slots: dict[int, int] = {}
        self.line_slots: dict[int, int] = {}
        self.count = RowCount()
        self.size = POSE_SIZE
        self._state = np.array(start, dtype=np.float64)
        # The same array unless derivatives are evaluated elsewhere.
        self._linearised = self._state.copy() if first_estimates else self._state
        self._covariance = np.zeros((POSE_SIZE, POSE_SIZE))
        if start_covariance is not None:
            self._covariance += np.asarray(start_covariance, dtype=np.float64)

    @property
    def state(self) -> FloatArray:
        """The pose, then landmarks, as the slots say: (n,)."""
        return self._state[: self.size]

    @property
    def pose_covariance(self) -> FloatArray:
        """(3, 3)."""
        return self.block(_POSE)

    def block(self, index: IntArray) -> FloatArray:
        """Rows and columns `index` of the state's covariance."""
        return np.asarray(self._covariance[np.ix_(index, index)])

    def predict(self, step: FloatArray, noise: FloatArray) -> None:
        """The robot moves by an odometry step (3,), of covariance (3, 3)."""
        at = self._linearised
        pose = move(self._state[_POSE], step)
        by_pose, by_step = move_jacobians(self._state[_POSE], step)
        by_pose[0, 2], by_pose[1, 2] = at[1] - pose[1], pose[0] - at[0]
        self._put(0, _POSE, by_pose, by_step @ noise @ by_step.T, pose, pose)

    @abstractmethod
    def measure(self, rows: FrameRows) -> None:
        """Update with the rows of a frame."""

    def _whitened(self, innovation: Innovation) -> tuple[FloatArray, FloatArray]:
        """The state's covariance with an innovation (n, m), and the innovation (m,), both whitened.

        That is, over a root of the innovation's covariance; `SlamError` where there is none.
        """
        error, jacobian, index, noise = innovation
        projected = self._covariance[:, index] @ jacobian.T
        try:
            root = np.linalg.cholesky(jacobian @ projected[index] + noise)
        except np.linalg.LinAlgError:
            raise SlamError(
                "the covariance of the innovation is not positive definite: rows or steps with "
                "covariances that contradict each other"
            ) from None
        both = dtrtrs(root, np.vstack([projected, error]).T, lower=1)[0].T
        self.count.innovation_squared += float(both[-1] @ both[-1])
        self.count.innovation_numbers += len(error)
        return both[:-1], both[-1]

    def _grow(self, count: int) -> None:
        """Lengthen the arrays by some numbers, 0 so far. BLAS has matrices by columns."""
        separate, before = self._linearised is not self._state, len(self._state)
        self._state = np.pad(self._state, (0, count))
        self._linearised = np.pad(self._linearised, (0, count)) if separate else self._state
        covariance = np.zeros((before + count, before + count), order="F")
        covariance[:before, :before] = self._covariance
        self._covariance = covariance

    def _put(
        self,
        slot: int,
        index: IntArray,
        jacobian: FloatArray,
        noise: FloatArray,
        value: FloatArray,
        linearised: FloatArray,
    ) -> None:
        """Set d numbers of the state, from `slot` on, to a function of others and a measurement.

        Takes where the others are, `index` (k,), its derivative by them, `jacobian` (d, k), and the
        measurement's covariance, `noise` (d, d).
        """
        own = slice(slot, slot + len(value))
        columns = self._covariance[:, index] @ jacobian.T
        spread = jacobian @ columns[index] + noise
        columns[own] = 0.5 * (spread + spread.T)
        self._covariance[:, own] = columns
        self._covariance[own] = columns.T
        self._linearised[own] = linearised
        self._state[own] = value


Association = Literal["known", "nearest", "joint"]

#: A row shows a new disc if its distance from all known discs is this many times the gate.
NEW_DISC_GATES = 4.0
#: Lines farther than this from the camera are not taken to be in view (m): walls hide them.
FARTHEST_LINE_M = 15.0

# Largest distance of a disc from its row: metres, plus this many standard deviations of the pose.
_NEAR_M, _NEAR_SIGMAS = 0.6, 4.0


@dataclass(frozen=True)
class Associator:
    """How rows are paired with landmarks."""

    method: Association = "known"  # `known`, `nearest` or `joint`
    gate_probability: float = DEFAULT_GATE_PROBABILITY  # share of right rows that pass
    # The identifier of the next new disc; None: there are none.
    new_id: Callable[[], int] | None = None

    def __post_init__(self) -> None:
        chi_squared_gates(self.gate_probability, 1, 1)

    def identified(self, rows: FrameRows, estimate: Filter) -> FrameRows:
        """Rows with the identifiers of the landmarks they are found to show."""
        if self.method == "known":
            return rows
        discs = self._discs(rows.circles, estimate)
        lines = self._lines(rows.lines, estimate)
        return FrameRows(replace(rows.circles, ids=discs), replace(rows.lines, ids=lines))

    def _discs(self, rows: CircleRows, estimate: Filter) -> IntArray:
        names, slots = _near_discs(rows.xy, estimate)
        found = np.full(len(rows), UNKNOWN_ID, dtype=np.int64)
        closest = np.full(len(found), np.inf)
        if len(slots):
            seen, jacobian, index = predicted(estimate, slots, [], estimate.state)
            spread = jacobian @ estimate.block(index) @ jacobian.T
            innovation = rows.xy[:, None] - seen.reshape(-1, 2)
            landmark = compatible(
                self.method, innovation, spread, rows.covariance, self.gate_probability
            )
            found[landmark >= 0] = names[landmark[landmark >= 0]]
            distances = individual_distances(innovation, spread, rows.covariance)
            closest = np.min(distances, axis=1)
        if self.new_id is not None:
            far = NEW_DISC_GATES * chi_squared_gates(self.gate_probability, 2, 1)[1]
            for k in np.flatnonzero((found == UNKNOWN_ID) & (closest > far)):
                found[k] = self.new_id()
        return found

    def _lines(self, rows: LineRows, estimate: Filter) -> tuple[tuple[int, ...], ...]:
        slots = np.array(list(estimate.line_slots.values()), dtype=np.int64)
        names = np.array(list(estimate.line_slots), dtype=np.int64)
        state = estimate.state
        away = np.hypot(state[slots] - state[0], state[slots + 1] - state[1])
        slots, names = slots[away < FARTHEST_LINE_M], names[away < FARTHEST_LINE_M]
        if not len(slots) or not len(rows):
            return ((),) * len(rows)
        seen, jacobian, index = predicted(estimate, [], slots, state)
        innovation = wrap_angle(rows.bearing_rad[:, None] - seen)
        spread = jacobian @ estimate.block(index) @ jacobian.T
        noise = rows.sigma_rad[:, None, None] ** 2
        landmark = compatible(
            self.method, innovation[:, :, None], spread, noise, self.gate_probability
        )
        return tuple((int(names[j]),) if j >= 0 else () for j in landmark)


def run_filter(
    recording: Recording,
    estimate: Filter,
    associator: Associator | None = None,
) -> FilterRun:
    """Take a filter, which is at the start, through a run.

    Rows are paired with landmarks by their identifiers, unless an associator says otherwise. Raises
    `SlamError`, which names the step, if an update is not possible.
    """
    pairing = associator or Associator()
    disc_ids: list[int] = []
    line_ids: list[tuple[int, ...]] = []
    poses = np.empty((len(recording) + 1, 3))
    covariance = np.empty((len(recording) + 1, 3, 3))
    poses[0], covariance[0] = estimate.state[:3], estimate.pose_covariance
    for k, rows in enumerate(frames_of(recording)):
        try:
            estimate.predict(recording.steps[k], recording.step_covariance[k])
            identified = pairing.identified(rows, estimate)
            estimate.measure(identified)
        except SlamError as error:
            raise SlamError(f"step {k + 1} ({recording.prefixes[k]}): {error}") from None
        disc_ids.extend(identified.circles.ids.tolist())
        line_ids.extend(identified.lines.ids)
        poses[k + 1], covariance[k + 1] = estimate.state[:3], estimate.pose_covariance
    return FilterRun(
        path=Path2D(("start", *recording.prefixes), poses, covariance),
        count=estimate.count,
        disc_ids=np.array(disc_ids, dtype=np.int64),
        line_ids=tuple(line_ids),
    )


def _near_discs(seen_xy: FloatArray, estimate: Filter) -> tuple[IntArray, IntArray]:
    """Names and slots of the discs that any of the rows may show."""
    slots = np.array(list(estimate.disc_slots.values()), dtype=np.int64)
    names = np.array(list(estimate.disc_slots), dtype=np.int64)
    if not len(slots):
        return names, slots
    state, spread = estimate.state, estimate.pose_covariance
    away = np.linalg.norm(
        state[slots[:, None, None] + np.arange(2)] - apply(state[:3], seen_xy), axis=2
    )
    reach = np.sqrt(spread[0, 0] + spread[1, 1]) + np.sqrt(spread[2, 2]) * np.hypot(*seen_xy.T)
    near = np.any(away < _NEAR_M + _NEAR_SIGMAS * reach, axis=1)
    return names[near], slots[near]
