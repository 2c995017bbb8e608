"""A recording frame by frame, as input of the filters: innovations, pairing, the way through a run.

Rows without identifiers are paired with landmarks of the filter's state, discs and lines apart from
each other, each frame for itself, by `redetect.slam.association.compatibility`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, Protocol

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import wrap_angle
from redetect.landmarks.map_file import Path2D
from redetect.plane import rotation
from redetect.slam.association.compatibility import (
    DEFAULT_GATE_PROBABILITY,
    Pairing,
    chi_squared_gates,
    individual_distances,
    joint_compatible,
    nearest_compatible,
)
from redetect.slam.errors import SlamError
from redetect.slam.models import bearing_jacobians, bearing_of_vertical
from redetect.slam.recording import UNKNOWN_ID, Recording


class MeasuredDiscs(NamedTuple):
    """Rows of d discs."""

    slot: IntArray  # (d,): where in the state the disc of each row begins
    # (d, 2), (d, 2, 2): measured, in the robot frame (m).
    xy: FloatArray
    covariance: FloatArray


class MeasuredLines(NamedTuple):
    """Rows of l lines, each of which may be that of several of e lines of the state."""

    slot: IntArray  # (e,): where in the state the lines of the rows begin
    # (l + 1,): row i measures the mean of the bearings of lines slot[start[i] : start[i + 1]].
    start: IntArray
    # (l,): measured.
    bearing_rad: FloatArray
    sigma_rad: FloatArray


def frame_innovation(
    state: FloatArray,
    linearised_at: FloatArray,
    discs: MeasuredDiscs,
    lines: MeasuredLines,
    camera_xy: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Measured minus predicted, its Jacobian and its noise, for all rows of a frame.

    Takes `state` (n,), `linearised_at` (n,), `camera_xy` (2,); returns `innovation` (m,),
    `jacobian` (m, 3 + 2 d + 2 e), `noise` (m, m), `index` (3 + 2 d + 2 e,).
    """
    d, rows = len(discs.slot), 2 * len(discs.slot) + len(lines.bearing_rad)
    slots = np.concatenate([discs.slot, lines.slot])
    places = slots[:, None] + np.arange(2)
    pose, xy, every_disc = state[:3], state[places], np.arange(d)
    turn = rotation(pose[2]).T
    innovation, by_place = np.empty(rows), np.zeros((rows, len(slots), 2))
    innovation[: 2 * d] = (discs.xy - (xy[:d] - pose[:2]) @ turn.T).ravel()
    by_place[: 2 * d].reshape(d, 2, len(slots), 2)[every_disc, :, every_disc] = turn
    if len(lines.slot):
        count = np.diff(lines.start)
        row = np.repeat(np.arange(len(count)), count)  # of each line
        off = wrap_angle(lines.bearing_rad[row] - bearing_of_vertical(pose, xy[d:], camera_xy))
        innovation[2 * d :] = np.bincount(row, off / count[row], minlength=len(count))
        _, by_line = bearing_jacobians(pose, xy[d:], camera_xy)
        by_place[2 * d + row, np.arange(d, len(slots))] = by_line / count[row, None]
    # Turning the robot is turning the landmarks about it the other way.
    offset = linearised_at[places] - linearised_at[:2]
    by_heading = by_place[:, :, 0] @ offset[:, 1] - by_place[:, :, 1] @ offset[:, 0]
    by_landmarks = by_place.reshape(rows, 2 * len(slots))
    jacobian = np.concatenate([-by_place.sum(axis=1), by_heading[:, None], by_landmarks], axis=1)

    noise = np.diag(np.concatenate([np.zeros(2 * d), lines.sigma_rad**2]))
    at = 2 * every_disc[:, None] + np.arange(2)
    noise[at[:, :, None], at[:, None, :]] = discs.covariance
    return innovation, jacobian, noise, np.concatenate([np.arange(3), places.ravel()])


NO_CAMERA = np.zeros(2)


@dataclass(frozen=True, eq=False)
class FrameRows:
    """Measurements of one frame."""

    disc_ids: tuple[int, ...]  # -1 where unknown
    disc_xy: FloatArray  # (d, 2): in the robot frame (m)
    disc_covariance: FloatArray  # (d, 2, 2)
    line_ids: tuple[tuple[int, ...], ...]  # all lines that a row shows; empty where unknown
    bearing_rad: FloatArray  # (l,)
    sigma_rad: FloatArray  # (l,)

    def innovation(
        self,
        discs: Sequence[int],
        lines: Sequence[int],
        disc_slots: Mapping[int, int],
        line_slots: Mapping[int, int],
        state: FloatArray,
        linearised_at: FloatArray,
        camera_xy: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
        """Innovation of some of the rows.

        Takes `state, linearised_at` (n,), `camera_xy` (2,).
        """
        line_ids = [self.line_ids[k] for k in lines]
        return frame_innovation(
            state,
            linearised_at,
            MeasuredDiscs(
                np.array([disc_slots[self.disc_ids[k]] for k in discs], dtype=np.int64),
                self.disc_xy[discs],
                self.disc_covariance[discs],
            ),
            MeasuredLines(
                np.array([line_slots[i] for ids in line_ids for i in ids], dtype=np.int64),
                np.cumsum([0, *map(len, line_ids)]),
                self.bearing_rad[lines],
                self.sigma_rad[lines],
            ),
            camera_xy,
        )


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
    circles, lines = recording.circles, recording.lines
    frames = np.arange(len(recording) + 1)
    disc_start = np.searchsorted(circles.frame, frames)
    line_start = np.searchsorted(lines.frame, frames)
    disc_ids = circles.ids.tolist()
    for k in range(len(recording)):
        discs = slice(disc_start[k], disc_start[k + 1])
        some = slice(line_start[k], line_start[k + 1])
        yield FrameRows(
            disc_ids=tuple(disc_ids[discs]),
            disc_xy=circles.xy[discs],
            disc_covariance=circles.covariance[discs],
            line_ids=lines.ids[some],
            bearing_rad=lines.bearing_rad[some],
            sigma_rad=lines.sigma_rad[some],
        )


class Filter(Protocol):
    """A filter that is taken through a run."""

    disc_slots: dict[int, int]
    line_slots: dict[int, int]
    camera_xy: FloatArray
    count: RowCount

    @property
    def state(self) -> FloatArray:
        """The pose, then landmarks, as the slots say."""

    @property
    def pose_covariance(self) -> FloatArray:
        """(3, 3)."""

    def block(self, index: IntArray) -> FloatArray:
        """Rows and columns of the state's covariance."""

    def predict(self, step: FloatArray, noise: FloatArray) -> None:
        """The robot moves by an odometry step (3,), of covariance (3, 3)."""

    def measure(self, rows: FrameRows) -> None:
        """Update with the rows of a frame."""


Association = Literal["known", "nearest", "joint"]

#: A row shows a new disc if its distance from all known discs is this many times the gate.
NEW_DISC_GATES = 4.0
#: Lines farther than this from the camera are not taken to be in view (m): walls hide them.
FARTHEST_LINE_M = 15.0

# Largest distance of a disc from its row: metres, plus this many standard deviations of the pose.
_NEAR_M, _NEAR_SIGMAS = 0.6, 4.0

_NONE = np.zeros(0, dtype=np.int64)
_NO_DISCS = MeasuredDiscs(_NONE, np.zeros((0, 2)), np.zeros((0, 2, 2)))
_NO_LINES = MeasuredLines(_NONE, np.zeros(1, dtype=np.int64), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class Associator:
    """How rows are paired with landmarks."""

    method: Association = "known"  # `known`, `nearest` or `joint`
    gate_probability: float = DEFAULT_GATE_PROBABILITY  # share of right rows that pass

    def __post_init__(self) -> None:
        chi_squared_gates(self.gate_probability, 1, 1)

    def identified(
        self, rows: FrameRows, estimate: Filter, new_id: Callable[[], int] | None = None
    ) -> FrameRows:
        """Rows with the identifiers of the landmarks they are found to show."""
        if self.method == "known":
            return rows
        discs = self._discs(rows, estimate, new_id) if rows.disc_ids else ()
        lines = self._lines(rows, estimate) if rows.line_ids else ()
        return replace(rows, disc_ids=discs, line_ids=lines)

    def _discs(
        self, rows: FrameRows, estimate: Filter, new_id: Callable[[], int] | None
    ) -> tuple[int, ...]:
        names, slots = _near_discs(rows.disc_xy, estimate)
        found = np.full(len(rows.disc_xy), UNKNOWN_ID, dtype=np.int64)
        closest = np.full(len(found), np.inf)
        if len(slots):
            prediction, jacobian, _, index = frame_innovation(
                estimate.state,
                estimate.state,
                MeasuredDiscs(slots, np.zeros((len(slots), 2)), np.zeros((len(slots), 2, 2))),
                _NO_LINES,
                estimate.camera_xy,
            )
            predicted = jacobian @ estimate.block(index) @ jacobian.T
            innovation = rows.disc_xy[:, None] + prediction.reshape(-1, 2)
            pairing = self._paired(innovation, predicted, rows.disc_covariance)
            paired = pairing.landmark >= 0
            found[paired] = names[pairing.landmark[paired]]
            closest = np.min(
                individual_distances(innovation, predicted, rows.disc_covariance), axis=1
            )
        if new_id is not None:
            far = NEW_DISC_GATES * chi_squared_gates(self.gate_probability, 2, 1)[1]
            for k in np.flatnonzero((found == UNKNOWN_ID) & (closest > far)):
                found[k] = new_id()
        return tuple(int(number) for number in found)

    def _lines(self, rows: FrameRows, estimate: Filter) -> tuple[tuple[int, ...], ...]:
        slots = np.array(list(estimate.line_slots.values()), dtype=np.int64)
        names = np.array(list(estimate.line_slots), dtype=np.int64)
        state = estimate.state
        away = np.hypot(state[slots] - state[0], state[slots + 1] - state[1])
        slots, names = slots[away < FARTHEST_LINE_M], names[away < FARTHEST_LINE_M]
        if not len(slots):
            return ((),) * len(rows.line_ids)
        zeros = np.zeros(len(slots))
        prediction, jacobian, _, index = frame_innovation(
            state,
            state,
            _NO_DISCS,
            MeasuredLines(slots, np.arange(len(slots) + 1), zeros, zeros),
            estimate.camera_xy,
        )
        innovation = wrap_angle(rows.bearing_rad[:, None] + prediction)
        predicted = jacobian @ estimate.block(index) @ jacobian.T
        noise = rows.sigma_rad[:, None, None] ** 2
        landmark = self._paired(innovation[:, :, None], predicted, noise).landmark
        return tuple((int(names[j]),) if j >= 0 else () for j in landmark)

    def _paired(self, innovation: FloatArray, predicted: FloatArray, noise: FloatArray) -> Pairing:
        pair = joint_compatible if self.method == "joint" else nearest_compatible
        return pair(innovation, predicted, noise, gate_probability=self.gate_probability)


def run_filter(
    recording: Recording,
    estimate: Filter,
    associator: Associator | None = None,
    new_id: Callable[[], int] | None = None,
) -> FilterRun:
    """Take a filter, which is at the start, through a run.

    Rows are paired with landmarks by their identifiers, unless an associator says otherwise;
    `new_id` gives the next one for a row that is found to show a new disc. Raises `SlamError`,
    which names the step, if an update is not possible.
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
            identified = pairing.identified(rows, estimate, new_id)
            estimate.measure(identified)
        except SlamError as error:
            raise SlamError(f"step {k + 1} ({recording.prefixes[k]}): {error}") from None
        disc_ids.extend(identified.disc_ids)
        line_ids.extend(identified.line_ids)
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
    state = estimate.state
    cos, sin = np.cos(state[2]), np.sin(state[2])
    rotated = seen_xy @ np.array([[cos, sin], [-sin, cos]])
    offset = np.stack([state[slots], state[slots + 1]], axis=-1)[:, None] - state[:2] - rotated
    pose = estimate.block(np.arange(3))
    reach = np.sqrt(pose[0, 0] + pose[1, 1]) + np.sqrt(pose[2, 2]) * np.hypot(*seen_xy.T)
    near = np.any(np.hypot(*offset.transpose(2, 0, 1)) < _NEAR_M + _NEAR_SIGMAS * reach, axis=1)
    return names[near], slots[near]


def innovation_root(covariance: FloatArray) -> FloatArray:
    """Cholesky factor of an innovation's covariance; `SlamError` where there is none."""
    try:
        return np.asarray(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        raise SlamError(
            "the covariance of the innovation is not positive definite: rows or steps with "
            "covariances that contradict each other"
        ) from None
