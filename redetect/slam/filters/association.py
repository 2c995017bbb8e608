"""Rows without identifiers: which landmarks of a filter's state do they show?

Discs and lines are paired apart from each other, each frame for itself, by
`redetect.slam.association.compatibility`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import wrap_angle
from redetect.landmarks.map_file import Path2D
from redetect.slam.association.compatibility import (
    DEFAULT_GATE_PROBABILITY,
    Pairing,
    chi_squared_gates,
    joint_compatible,
    nearest_compatible,
)
from redetect.slam.errors import SlamError
from redetect.slam.filters.frames import Filter, FilterRun, FrameRows, frames_of
from redetect.slam.filters.innovation_kernels import MeasuredDiscs, MeasuredLines, frame_innovation
from redetect.slam.recording import UNKNOWN_ID, Recording

Association = Literal["known", "nearest", "joint"]

#: A row shows a new disc if its distance from all known discs is this many times the gate.
NEW_DISC_GATES = 4.0
#: Lines farther than this from the camera are not taken to be in view (m): walls hide them.
FARTHEST_LINE_M = 15.0

# Largest distance of a disc from its row: metres, plus this many standard deviations of the pose.
_NEAR_M, _NEAR_SIGMAS = 0.6, 4.0

_NONE = np.zeros(0, dtype=np.int64)
_NO_DISCS = MeasuredDiscs(_NONE, np.zeros((0, 2)), np.zeros((0, 2, 2)))
_NO_LINES = MeasuredLines(
    np.zeros(0, dtype=np.int64), np.zeros(1, dtype=np.int64), np.zeros(0), np.zeros(0)
)


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
        return rows.identified(discs, lines)

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
            closest = _closest(innovation, predicted, rows.disc_covariance)
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
    pairing: Associator,
    new_id: Callable[[], int] | None = None,
) -> FilterRun:
    """Take a filter through a run; a `SlamError` names the step."""
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


def _closest(innovation: FloatArray, predicted: FloatArray, noise: FloatArray) -> FloatArray:
    """Squared Mahalanobis distance of each row of a disc from the landmark closest to it: (n,)."""
    pairs = np.arange(innovation.shape[1])
    own = predicted.reshape(len(pairs), 2, len(pairs), 2)[pairs, :, pairs, :]
    covariance = own[None] + noise[:, None]
    solved = np.linalg.solve(covariance, innovation[..., None])[..., 0]
    return np.asarray(np.min(np.sum(innovation * solved, axis=2), axis=1))
