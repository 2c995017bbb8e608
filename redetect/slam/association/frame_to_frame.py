"""Association from frame to frame, against a small map that travels with the robot.

The map's state are the landmarks in the frame of the robot now, with their joint covariance, and no
pose: a movement transforms them and adds odometry's error to all of them alike (J. A. Castellanos,
R. Martinez-Cantin, J. D. Tardos, J. Neira, "Robocentric map joining", Robotics and Autonomous
Systems 55, 2007). So nothing depends on how far the robot has drifted, the linearisation is about
what is in view, and the innovations of a frame carry the correlation that joint compatibility
needs. A disc is kept as (x, y); a vertical line, of which a row measures only the bearing, as
bearing and inverse distance from the camera, which is near Gaussian from the first sight on
(J. Civera, A. J. Davison, J. M. M. Montiel, "Inverse depth parametrization for monocular SLAM",
IEEE Transactions on Robotics 24(5), 2008).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.landmarks import wrap_angle
from redetect.plane import rotation
from redetect.slam.association.compatibility import compatible
from redetect.slam.recording import CircleRows, LineRows, Recording
from redetect.slam.settings import AssociateSettings

# Of the first sight of a line: half a metre to infinity within two standard deviations.
_INVERSE_DISTANCE_PRIOR = (0.4, 0.4)


#: Of the camera above the floor (m).
CAMERA_HEIGHT_M = 1.5
# A landmark that is unseen for longer is forgotten (frames); so is a disc whose position relative
# to the robot has become less certain than this (m), beyond some distance in proportion to it.
_FORGET_FRAMES, _FORGET_SIGMA_M, _NEAR_M = 60, 0.35, 4.0
# At most this many landmarks of each kind are kept, those seen last.
_MOST_LANDMARKS = 40


@dataclass(eq=False)
class LocalMap:
    """Landmarks in the frame of the robot."""

    # (m, 2): Discs: x, y (m). Lines: bearing (rad) and inverse distance (1/m) from the camera.
    mean: FloatArray
    covariance: FloatArray  # (2 m, 2 m)
    is_line: BoolArray  # (m,)
    number: IntArray  # (m,): number of the landmark; discs and lines are counted separately
    last_frame: IntArray  # (m,): when it was seen last

    @classmethod
    def empty(cls) -> LocalMap:
        """A map without landmarks."""
        whole = np.zeros(0, dtype=np.int64)
        return cls(np.zeros((0, 2)), np.zeros((0, 0)), np.zeros(0, dtype=np.bool_), whole, whole)


def moved(
    local: LocalMap, step: FloatArray, step_covariance: FloatArray, camera_xy: ArrayLike
) -> LocalMap:
    """The map in the frame of the robot after a step.

    Takes `step` (3,), `step_covariance` (3, 3), `camera_xy` (2,).
    """
    m = len(local.mean)
    if m == 0:
        return local
    turn = rotation(step[2])
    mean = np.empty((m, 2))
    by_landmark = np.empty((m, 2, 2))
    by_step = np.empty((m, 2, 3))

    discs = ~local.is_line
    now = (local.mean[discs] - step[:2]) @ turn
    mean[discs] = now
    by_landmark[discs] = turn.T
    by_step[discs, :, :2] = -turn.T
    by_step[discs, 0, 2], by_step[discs, 1, 2] = now[:, 1], -now[:, 0]

    if np.any(local.is_line):
        bearing, inverse = local.mean[local.is_line].T
        camera = np.asarray(camera_xy)
        shift = step[:2] + turn @ camera - camera
        sin, cos = np.sin(bearing), np.cos(bearing)
        # Where the line is from the camera's new place, times the inverse distance; old axes.
        seen = np.stack([sin, -cos], -1) - inverse[:, None] * shift
        squared = np.sum(seen**2, axis=-1)
        length = np.sqrt(squared)
        mean[local.is_line, 0] = wrap_angle(np.arctan2(seen[:, 0], -seen[:, 1]) - step[2])
        mean[local.is_line, 1] = inverse / length
        bearing_by_seen = np.stack([-seen[:, 1], seen[:, 0]], -1) / squared[:, None]
        inverse_by_seen = -(inverse / (squared * length))[:, None] * seen
        by_seen = np.stack([bearing_by_seen, inverse_by_seen], axis=1)
        seen_by_landmark = np.stack(
            [np.stack([cos, sin], -1), np.broadcast_to(-shift, seen.shape)], axis=-1
        )
        turned = turn @ camera
        seen_by_turn = -inverse[:, None] * np.array([-turned[1], turned[0]])
        jacobian = by_seen @ seen_by_landmark
        jacobian[:, 1, 1] += 1.0 / length
        by_landmark[local.is_line] = jacobian
        by_step[local.is_line, :, :2] = -inverse[:, None, None] * by_seen
        by_step[local.is_line, :, 2] = np.einsum("nab,nb->na", by_seen, seen_by_turn)
        by_step[local.is_line, 0, 2] -= 1.0

    blocks = local.covariance.reshape(m, 2, m, 2)
    blocks = np.einsum("iab,ibjc->iajc", by_landmark, blocks)
    covariance = np.einsum("iajb,jcb->iajc", blocks, by_landmark).reshape(2 * m, 2 * m)
    stacked = by_step.reshape(2 * m, 3)
    covariance = covariance + stacked @ step_covariance @ stacked.T
    return LocalMap(mean, covariance, local.is_line, local.number, local.last_frame)


def tilt_jacobian(disc_xy: FloatArray, height_m: float = CAMERA_HEIGHT_M) -> FloatArray:
    """How a small tilt of the robot moves the places on the floor that a camera seems to see.

    Takes `disc_xy` (n, 2); returns (n, 2, 2).
    """
    x, y = disc_xy.T
    rows = (x * y / height_m, -height_m - x**2 / height_m)
    others = (height_m + y**2 / height_m, -x * y / height_m)
    return np.stack([np.stack(rows, -1), np.stack(others, -1)], axis=1)


def kept(local: LocalMap, frame: int) -> LocalMap:
    """The map without landmarks that were not seen for long or have become too uncertain."""
    m = len(local.mean)
    if m == 0:
        return local
    variance = np.diagonal(local.covariance).reshape(m, 2).sum(axis=1)
    keep = frame - local.last_frame <= _FORGET_FRAMES
    farther = np.maximum(np.linalg.norm(local.mean, axis=1) / _NEAR_M, 1.0)
    keep &= local.is_line | (variance <= (farther * _FORGET_SIGMA_M) ** 2)
    for kind in (False, True):
        some = np.flatnonzero(keep & (local.is_line == kind))
        if len(some) > _MOST_LANDMARKS:
            oldest_first = some[np.argsort(local.last_frame[some], kind="stable")]
            keep[oldest_first[:-_MOST_LANDMARKS]] = False
    if np.all(keep):
        return local
    index = np.flatnonzero(np.repeat(keep, 2))
    return LocalMap(
        local.mean[keep],
        local.covariance[np.ix_(index, index)],
        local.is_line[keep],
        local.number[keep],
        local.last_frame[keep],
    )


@dataclass(frozen=True, eq=False)
class LocalAssociation:
    """Result of the association from frame to frame."""

    # (n,): the landmark of each row, numbered from 0 in order of first sight.
    circle_labels: IntArray
    line_labels: IntArray


def associate_locally(
    recording: Recording,
    settings: AssociateSettings | None = None,
    *,
    camera_xy: ArrayLike = (0.0, 0.0),
    progress: Callable[[int], None] | None = None,
) -> LocalAssociation:
    """Label the rows of a run, frame by frame, ignoring IDs in the file."""
    setting = settings or AssociateSettings()
    circles, lines = recording.circles, recording.lines
    circle_labels = np.full(len(circles), -1, dtype=np.int64)
    line_labels = np.full(len(lines), -1, dtype=np.int64)
    circle_starts = np.searchsorted(circles.frame, np.arange(len(recording) + 1))
    line_starts = np.searchsorted(lines.frame, np.arange(len(recording) + 1))
    local = LocalMap.empty()
    counts = [0, 0]
    lost = set(recording.lost.tolist())
    for frame in range(len(recording)):
        if frame in lost:
            local = LocalMap.empty()
        local = moved(local, recording.steps[frame], recording.step_covariance[frame], camera_xy)
        local = kept(local, frame)
        for is_line, starts, labels in (
            (False, circle_starts, circle_labels),
            (True, line_starts, line_labels),
        ):
            some = slice(starts[frame], starts[frame + 1])
            if some.start < some.stop:
                seen = _seen(circles, lines, some, is_line, setting)
                local, labels[some] = _observed(local, frame, seen, counts, setting)
        if progress:
            progress(frame + 1)
    return LocalAssociation(circle_labels, line_labels)


class _Seen(NamedTuple):
    """A frame's rows of one kind: n measurements of d numbers, of discs 2 and of lines 1."""

    is_line: bool
    measured: FloatArray  # (n, d)
    noise: FloatArray  # (n, d, d): covariances
    sway: FloatArray  # (n, d, 2): how the robot's tilt about two axes moves them, in deviations


def _seen(
    circles: CircleRows, lines: LineRows, rows: slice, is_line: bool, setting: AssociateSettings
) -> _Seen:
    if is_line:
        variance = lines.sigma_rad[rows, None, None] ** 2
        bearing = lines.bearing_rad[rows, None]
        return _Seen(True, bearing, variance, np.zeros((len(bearing), 1, 2)))
    xy = circles.xy[rows]
    noise = setting.sigma_scale**2 * circles.covariance[rows]
    return _Seen(False, xy, noise, setting.tilt_sigma_rad * tilt_jacobian(xy))


def _observed(
    local: LocalMap, frame: int, seen: _Seen, counts: list[int], setting: AssociateSettings
) -> tuple[LocalMap, IntArray]:
    """The map after rows of one kind, and their labels; new landmarks raise `counts`."""
    width = seen.measured.shape[1]
    candidates = np.flatnonzero(local.is_line == seen.is_line)
    index = 2 * candidates[:, None] + np.arange(width)
    innovations = seen.measured[:, None] - local.mean[candidates, :width]
    # A tilt is the same for all rows of the frame: it correlates their measurements.
    sway = np.zeros((len(candidates), width, 2))
    if seen.is_line:
        innovations = wrap_angle(innovations)
    else:
        sway = setting.tilt_sigma_rad * tilt_jacobian(local.mean[candidates])
    all_sway = sway.reshape(-1, 2)
    predicted = local.covariance[np.ix_(index.ravel(), index.ravel())] + all_sway @ all_sway.T
    landmark = compatible(
        setting.method, innovations, predicted, seen.noise, setting.gate_probability
    )
    rows, fresh = np.flatnonzero(landmark >= 0), np.flatnonzero(landmark < 0)
    paired = landmark[rows]
    labels = np.empty(len(seen.measured), dtype=np.int64)
    labels[rows] = local.number[candidates[paired]]
    labels[fresh] = counts[seen.is_line] + np.arange(len(fresh))
    counts[seen.is_line] += len(fresh)
    if len(rows):
        local = _updated(
            local, index[paired], innovations[rows, paired], seen.noise[rows], sway[paired]
        )
        local.last_frame[candidates[paired]] = frame
    return _with_new(local, frame, seen, fresh, labels[fresh]), labels


def _updated(
    local: LocalMap, index: IntArray, innovation: FloatArray, noise: FloatArray, sway: FloatArray
) -> LocalMap:
    """The map after k measurements (k, d) of the numbers `index` (k, d) of its state."""
    chosen, moving, width = index.ravel(), sway.reshape(-1, 2), index.shape[1]
    covariance = local.covariance
    innovation_covariance = covariance[np.ix_(chosen, chosen)] + moving @ moving.T
    for k, own in enumerate(noise):
        block = slice(k * width, (k + 1) * width)
        innovation_covariance[block, block] += own
    gain = np.linalg.solve(innovation_covariance, covariance[chosen]).T
    mean = local.mean + (gain @ innovation.ravel()).reshape(-1, 2)
    covariance = covariance - gain @ covariance[chosen]
    covariance = 0.5 * (covariance + covariance.T)
    return replace(local, mean=mean, covariance=covariance, last_frame=local.last_frame.copy())


def _with_new(
    local: LocalMap, frame: int, seen: _Seen, rows: IntArray, numbers: IntArray
) -> LocalMap:
    """The map with landmarks that some of the rows show, of these numbers."""
    k, width = len(rows), seen.measured.shape[1]
    mean = np.full((k, 2), _INVERSE_DISTANCE_PRIOR[0])
    mean[:, :width] = seen.measured[rows]
    spread = np.tile(_INVERSE_DISTANCE_PRIOR[1] ** 2 * np.eye(2), (k, 1, 1))
    sway = seen.sway[rows]
    spread[:, :width, :width] = seen.noise[rows] + sway @ sway.swapaxes(1, 2)
    return LocalMap(
        np.concatenate([local.mean, mean]),
        block_diag(local.covariance, *spread),
        np.concatenate([local.is_line, np.full(k, seen.is_line)]),
        np.concatenate([local.number, numbers]),
        np.concatenate([local.last_frame, np.full(k, frame)]),
    )
