"""The loop of a filter over a run: rows are paired with landmarks, and wheel slips are noticed.

Rows without identifiers are paired with landmarks of the filter's state, discs and lines
separately, frame by frame, by `redetect.slam.association.compatibility`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.bounds import PROBABILITY, Bounded
from redetect.landmarks.map_file import Path2D
from redetect.plane import apply
from redetect.slam.association.compatibility import (
    chi_squared_gates,
    compatible,
    individual_distances,
)
from redetect.slam.association.registration import GlobalPose
from redetect.slam.errors import SlamError
from redetect.slam.filters.base import POSE_SIZE, Filter, FrameRows, RowCount
from redetect.slam.recording import UNKNOWN_ID, CircleRows, LineRows, Recording
from redetect.slam.settings import DEFAULT_GATE_PROBABILITY, Association

_XY = np.arange(2)
# A row shows a new disc if its distance from all known discs is this many times the gate.
_NEW_DISC_GATES = 4.0
# Largest distance at which lines are expected to be visible (m), since walls hide others.
_FARTHEST_LINE_M = 15.0
# Least number of discs by which a slip is noticed; factors on the covariance of its step.
_SEVERAL, _SLIPS = 3, (10.0, 100.0, 1000.0)
# Largest distance of a disc from its row: metres, plus this many standard deviations of the pose.
_NEAR_M, _NEAR_SIGMAS = 0.6, 4.0


@dataclass(frozen=True, eq=False)
class FilterRun:
    """Poses of a run as a filter estimated them at the time, and the use of the rows."""

    path: Path2D  # the start, and the pose after each step and its frame; theta is not wrapped
    count: RowCount
    disc_ids: IntArray  # (n,): the disc of each row, from the file or association; -1 for none
    line_ids: tuple[tuple[int, ...], ...]  # the lines of each row; empty for none
    located: GlobalPose | None = None  # where the start is in the map, if it was unknown


def frames_of(recording: Recording) -> Iterator[FrameRows]:
    """The rows of each frame of a run, in order."""
    frames, rows = np.arange(len(recording) + 1), FrameRows(recording.circles, recording.lines)
    discs = np.searchsorted(rows.circles.frame, frames)
    lines = np.searchsorted(rows.lines.frame, frames)
    for k in range(len(recording)):
        yield rows.only(slice(discs[k], discs[k + 1]), slice(lines[k], lines[k + 1]))


@dataclass(frozen=True)
class Associator(Bounded, error=SlamError):
    """Pairs rows with landmarks."""

    method: Association = "known"  # `known`, `nearest` or `joint`
    # Share of correct rows that pass.
    gate_probability: Annotated[float, PROBABILITY] = DEFAULT_GATE_PROBABILITY
    new_id: Callable[[], int] | None = None  # gives the IDs of new discs; None: there are none

    def identified(self, rows: FrameRows, estimate: Filter) -> FrameRows:
        """Rows with the identifiers of their paired landmarks."""
        if self.method == "known":
            return rows
        discs, lines = self._discs(rows.circles, estimate), self._lines(rows.lines, estimate)
        return FrameRows(replace(rows.circles, ids=discs), replace(rows.lines, ids=lines))

    def _discs(self, rows: CircleRows, estimate: Filter) -> IntArray:
        names = _near_discs(rows.xy, estimate)
        compared = estimate.compared(rows, names)
        landmark = compatible(self.method, *compared, self.gate_probability)
        found = np.append(names, UNKNOWN_ID)[landmark]
        if self.new_id is not None:
            closest = np.min(individual_distances(*compared), axis=1, initial=np.inf)
            far = _NEW_DISC_GATES * chi_squared_gates(self.gate_probability, 2, 1)[1]
            for k in np.flatnonzero((found == UNKNOWN_ID) & (closest > far)):
                found[k] = self.new_id()
        return found

    def _lines(self, rows: LineRows, estimate: Filter) -> tuple[tuple[int, ...], ...]:
        names, slots = np.array([*estimate.line_slots.items()], dtype=np.int64).reshape(-1, 2).T
        away = np.linalg.norm(estimate.state[slots[:, None] + _XY] - estimate.state[:2], axis=1)
        names = names[away < _FARTHEST_LINE_M]
        landmark = compatible(self.method, *estimate.compared(rows, names), self.gate_probability)
        return tuple((int(names[j]),) if j >= 0 else () for j in landmark)


BY_IDENTIFIERS = Associator()


def run_filter(
    recording: Recording, estimate: Filter, pairing: Associator = BY_IDENTIFIERS
) -> FilterRun:
    """Run a filter, which is at the start, over a run.

    Rows without a landmark are ignored. Raises `SlamError`, which names the step, if an update is
    not possible.
    """
    disc_ids: list[int] = []
    line_ids: list[tuple[int, ...]] = []
    poses = np.empty((len(recording) + 1, 3))
    covariance = np.empty((len(recording) + 1, 3, 3))
    poses[0], covariance[0] = estimate.state[:3], estimate.pose_covariance
    expected: set[int] = set()
    for k, rows in enumerate(frames_of(recording)):
        try:
            added = estimate.predict(recording.steps[k], recording.step_covariance[k])
            identified = pairing.identified(rows, estimate)
            if pairing.method != "known":
                jointly = partial(replace(pairing, method="joint").identified, rows, estimate)
                identified, _ = after_slip(identified, expected, added, estimate, jointly)
            expected = known_discs(identified, estimate)
            estimate.measure(identified)
        except SlamError as error:
            raise SlamError(f"step {k + 1} ({recording.prefixes[k]}): {error}") from None
        disc_ids.extend(identified.circles.ids.tolist())
        line_ids.extend(identified.lines.ids)
        poses[k + 1], covariance[k + 1] = estimate.state[:3], estimate.pose_covariance
    count, what = estimate.count, "ID" if pairing.method == "known" else "match"
    count.leave_out(f"disc without {what}", disc_ids.count(UNKNOWN_ID))
    count.leave_out(f"line without {what}", line_ids.count(()))
    return FilterRun(
        path=Path2D(("start", *recording.prefixes), poses, covariance),
        count=count,
        disc_ids=np.array(disc_ids, dtype=np.int64),
        line_ids=tuple(line_ids),
    )


def known_discs(rows: FrameRows, estimate: Filter) -> set[int]:
    """The discs of the estimate that a frame's rows show."""
    return set(rows.circles.ids.tolist()) & estimate.disc_slots.keys()


def after_slip(
    identified: FrameRows, expected: set[int], added: FloatArray, estimate: Filter,
    jointly: Callable[[], FrameRows],
) -> tuple[FrameRows, float]:  # fmt: skip
    """Rows of a frame, identified with a larger error of the step if that finds lost discs again.

    Wheels may have slipped: `expected` are the known discs that the frame before shows, `added` is
    what the step added to the covariance of the pose. Rows are identified again `jointly`, since
    the nearest disc is often another one with such errors. Also returns the factor on that
    covariance, which the estimate then includes.
    """
    known, half = known_discs(identified, estimate), len(expected) // 2
    several = min(len(identified.circles), len(expected)) >= _SEVERAL
    are_lost = 2 * len(known) <= len(identified.circles) and len(known & expected) <= half
    best, most, slip = identified, half, 1.0
    if not (several and are_lost):
        return best, slip
    for factor in _SLIPS:
        estimate.inflate_pose_covariance((factor - 1.0) * added)
        again = jointly()
        estimate.inflate_pose_covariance((1.0 - factor) * added)
        if (count := len(expected & known_discs(again, estimate))) > most:
            best, most, slip = again, count, factor
    estimate.inflate_pose_covariance((slip - 1.0) * added)
    return best, slip


def _near_discs(seen_xy: FloatArray, estimate: Filter) -> IntArray:
    """The discs near any of the rows."""
    names, slots = np.array([*estimate.disc_slots.items()], dtype=np.int64).reshape(-1, 2).T
    state, spread = estimate.state, estimate.block(np.arange(POSE_SIZE))
    away = np.linalg.norm(state[slots[:, None, None] + _XY] - apply(state[:3], seen_xy), axis=2)
    reach = np.sqrt(spread[0, 0] + spread[1, 1]) + np.sqrt(spread[2, 2]) * np.hypot(*seen_xy.T)
    return names[np.any(away < _NEAR_M + _NEAR_SIGMAS * reach, axis=1)]
