"""Association from frame to frame, against recently seen landmarks.

These are the state of an EKF-SLAM (`redetect.slam.filters.ekf_slam`) that forgets landmarks out of
sight. Its innovations include the correlation that joint compatibility needs. Accumulated drift
does not affect them: landmarks share that error, and Jacobians with respect to the heading are
evaluated at first estimates, so that it cancels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray, IntArray
from redetect.slam.association.compatibility import compatible
from redetect.slam.filters.base import FrameRows
from redetect.slam.filters.ekf_slam import EkfSlam
from redetect.slam.filters.run import after_slip, frames_of, known_discs
from redetect.slam.recording import UNKNOWN_ID, CircleRows, LineRows, Recording
from redetect.slam.settings import AssociateSettings

# A landmark unseen for longer is forgotten (frames); so is a disc whose position relative to the
# robot is more uncertain than this (m), a limit that grows in proportion beyond some distance.
_FORGET_FRAMES, _FORGET_SIGMA_M, _NEAR_M = 60, 0.35, 4.0
# At most this many landmarks of each kind are kept, those seen last.
_MOST_LANDMARKS = 40


class LocalLabels(NamedTuple):
    """Labels of a run's rows from frame to frame, from 0 in the order of first sight."""

    circles: IntArray  # (n,)
    lines: IntArray  # (m,)
    #: (N,) factors on the covariances of steps: more than 1 where wheels have slipped
    slips: FloatArray


def associate_locally(
    recording: Recording,
    settings: AssociateSettings | None = None,
    *,
    camera_xy: ArrayLike = (0.0, 0.0),
    progress: Callable[[int], None] | None = None,
) -> LocalLabels:
    """Label the rows of a run, frame by frame, ignoring IDs in the file."""
    settings = settings or AssociateSettings()
    discs = recording.circles
    scaled = replace(discs, covariance=settings.sigma_scale**2 * discs.covariance)
    none = FrameRows(discs.only([]), LineRows.of())
    disc_labels: list[int] = []
    line_labels: list[int] = []
    slips: list[float] = []
    discs_seen: dict[int, int] = {}  # frame of each landmark's last sight
    lines_seen: dict[int, int] = {}
    lost = {0, *recording.lost.tolist()}
    for frame, rows in enumerate(frames_of(replace(recording, circles=scaled))):
        if frame in lost:
            ekf = EkfSlam(camera_xy=camera_xy, tilt_sigma_rad=settings.tilt_sigma_rad)
            expected: set[int] = set()
        added = ekf.predict(recording.steps[frame], recording.step_covariance[frame])
        _forget(ekf, frame, discs_seen, lines_seen)
        # Discs first, since they improve the pose.
        labelled = partial(_labelled, ekf, rows.circles, len(discs_seen))
        jointly = partial(labelled, replace(settings, method="joint"))
        found, slip = after_slip(labelled(settings), expected, added, ekf, jointly)
        expected = known_discs(found, ekf)
        ekf.measure(found)
        slips.append(slip)
        labels = found.circles.ids.tolist()
        disc_labels += labels
        discs_seen.update(dict.fromkeys(labels, frame))
        if len(rows.lines):
            labels = _labels(ekf, rows.lines, len(lines_seen), settings)
            line_labels += labels
            lines_seen.update(dict.fromkeys(labels, frame))
            ekf.measure(none._replace(lines=replace(rows.lines, ids=tuple((k,) for k in labels))))
        if progress:
            progress(frame + 1)
    circles, lines = (np.array(each, dtype=np.int64) for each in (disc_labels, line_labels))
    return LocalLabels(circles, lines, np.array(slips))


def _labelled(ekf: EkfSlam, rows: CircleRows, fresh: int, settings: AssociateSettings) -> FrameRows:
    """Discs with the landmarks that they show as identifiers; see `_labels`."""
    found = np.array(_labels(ekf, rows, fresh, settings), dtype=np.int64)
    return FrameRows(replace(rows, ids=found), LineRows.of())


def _labels(
    ekf: EkfSlam, rows: CircleRows | LineRows, fresh: int, settings: AssociateSettings
) -> list[int]:
    """The landmarks that rows of one kind show; new ones are numbered from `fresh` on."""
    slots = ekf.line_slots if isinstance(rows, LineRows) else ekf.disc_slots
    names = np.array(list(slots), dtype=np.int64)
    landmark = compatible(settings.method, *ekf.compared(rows, names), settings.gate_probability)
    found = np.append(names, UNKNOWN_ID)[landmark]
    found[landmark < 0] = fresh + np.arange(np.count_nonzero(landmark < 0))
    return [int(label) for label in found]


def _forget(
    ekf: EkfSlam, frame: int, discs_seen: dict[int, int], lines_seen: dict[int, int]
) -> None:
    """Remove landmarks that were not seen for long, or have become too uncertain."""
    names = list(ekf.disc_slots)
    place, jacobian, index, _ = ekf.predicted(list(ekf.disc_slots.values()), [])
    spread = np.einsum("ij,jk,ik->i", jacobian, ekf.block(index), jacobian)
    variance = spread.reshape(-1, 2).sum(axis=1)
    farther = np.maximum(np.linalg.norm(place.reshape(-1, 2), axis=1) / _NEAR_M, 1.0)
    vague = np.flatnonzero(variance > (farther * _FORGET_SIGMA_M) ** 2)

    def stale(slots: dict[int, int], seen: dict[int, int]) -> set[int]:
        latest_first = sorted(slots, key=lambda number: -seen[number])
        long_ago = (number for number in slots if frame - seen[number] > _FORGET_FRAMES)
        return {*long_ago, *latest_first[_MOST_LANDMARKS:]}

    discs = stale(ekf.disc_slots, discs_seen) | {names[k] for k in vague}
    ekf.forget(discs, stale(ekf.line_slots, lines_seen))
