"""Where a robot wakes up: the pose at which the discs of its first frames are those of a map.

Nothing is known of the pose. Odometry puts the discs of the first frames together into one
constellation, which is laid on the map by the motion that pairs of discs vote for (`loops`). It is
believed if as many discs agree as would by chance in less than one of a thousand maps, and if the
rest of the map has no place that fits nearly as well: buildings repeat themselves. Else the robot
has to go on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.plane import apply, rotation
from redetect.slam.association.loops import (
    LoopSettings,
    covered_area,
    log10_false_alarms,
    motion_onto,
    settled,
)
from redetect.slam.models import chain_steps
from redetect.slam.recording import Recording

#: Frames that are tried, and by how much more each time.
_FEWEST_FRAMES, _MORE, _MOST_FRAMES = 5, 1.5, 400
#: Rows nearer than this are of one disc (m).
ONE_DISC_M = 0.25
#: Another place may fit with this share of the agreeing discs at most.
_RIVAL_SHARE = 0.7
#: Standard deviation of a disc at least (m): of raw rows, seen by a camera that leans.
_DISC_SIGMA_M = 0.25
ANYWHERE = LoopSettings(
    least_agreeing=5, most_turn_rad=math.inf, most_shift_m=math.inf, false_alarms=1e-3
)


class Place(NamedTuple):
    """Where a constellation lies in a map."""

    pose: FloatArray  # (3,) m, m, rad
    pairs: IntArray  # (k, 2): discs of the map and of the constellation that agree
    log10_false_alarms: float  # how many places fit as well by chance, as a logarithm


@dataclass(frozen=True, eq=False)
class Waking:
    """The pose at the start of a run, in a map."""

    pose: FloatArray  # (3,) m, m, rad
    covariance: FloatArray  # (3, 3)
    frames: int  # of the run that it took
    discs: int  # of these,
    agreeing: int  # and how many of them are in the map
    log10_false_alarms: float  # how many places fit as well by chance, as a logarithm


def wake_up(
    recording: Recording, disc_xy: FloatArray, settings: LoopSettings = ANYWHERE
) -> Waking | None:
    """The pose at the start of a run by the discs of its first frames; None if none is certain.

    Parameters
    ----------
    recording : Recording
        Identifiers are not looked at.
    disc_xy : (M, 2) float64
        Discs of the map, metres.
    settings : LoopSettings
        How discs are compared; its stretches are not used.
    """
    if len(recording) == 0:
        return None
    most = min(len(recording), _MOST_FRAMES)
    poses = chain_steps(recording.steps[:most])
    rows = recording.circles.only(recording.circles.frame < most)
    at = apply(poses[rows.frame + 1], rows.xy)
    frames, before = min(_FEWEST_FRAMES, most), -1
    while True:
        discs = _merged(at[rows.frame < frames])
        # Where nothing new came into view there is nothing to be found.
        if len(discs) != before:
            found = placed(discs, disc_xy, settings)
            if found is not None:
                pose, pairs, alarms = found
                covariance = _covariance(pose, discs[pairs[:, 1]], disc_xy[pairs[:, 0]])
                covariance += _drift(recording.step_covariance[:frames], pose, discs)
                return Waking(pose, covariance, frames, len(discs), len(pairs), alarms)
        if frames == most:
            return None
        frames, before = min(math.ceil(_MORE * frames), most), len(discs)


def _merged(xy: FloatArray) -> FloatArray:
    """(n, 2) means of rows that are near each other."""
    means: list[FloatArray] = []
    counts: list[int] = []
    for row in xy:
        distance = np.linalg.norm(np.array(means).reshape(-1, 2) - row, axis=1)
        k = int(distance.argmin()) if len(means) else -1
        if k >= 0 and distance[k] < ONE_DISC_M:
            counts[k] += 1
            means[k] = means[k] + (row - means[k]) / counts[k]
        else:
            means.append(row)
            counts.append(1)
    return np.array(means).reshape(-1, 2)


def placed(discs: FloatArray, disc_xy: FloatArray, settings: LoopSettings) -> Place | None:
    """The only place of a map that a constellation fits.

    Takes `discs` (n, 2), `disc_xy` (M, 2) of the map.
    """
    if min(len(discs), len(disc_xy)) < settings.least_agreeing:
        return None
    turn, x, y, agreeing, tried = motion_onto(discs, disc_xy, settings)
    if agreeing < settings.least_agreeing:
        return None
    found = settled(discs, disc_xy, turn, np.array([x, y]), settings)
    if found is None:
        return None
    pose, pairs = found
    chance = len(disc_xy) * np.pi * settings.reach_m**2 / covered_area(disc_xy)
    alarms = log10_false_alarms(len(pairs), len(discs), chance, tried)
    if alarms > math.log10(settings.false_alarms):
        return None
    others = np.delete(disc_xy, pairs[:, 0], axis=0)
    if len(others) >= settings.least_agreeing:
        rival = motion_onto(discs, others, settings)[3]
        if rival > _RIVAL_SHARE * len(pairs):
            return None
    return Place(pose, pairs, alarms)


def _covariance(pose: FloatArray, discs: FloatArray, targets: FloatArray) -> FloatArray:
    """Of a pose that lays discs on targets, by how far they are off."""
    lever = discs @ rotation(pose[2]).T
    one, none = np.ones(len(lever)), np.zeros(len(lever))
    by_x, by_y = (one, none, -lever[:, 1]), (none, one, lever[:, 0])
    jacobian = np.concatenate([np.stack(by_x, axis=1), np.stack(by_y, axis=1)])
    off = apply(pose, discs) - targets
    variance = max(float(np.mean(off**2)), _DISC_SIGMA_M**2)
    return np.asarray(variance * np.linalg.inv(jacobian.T @ jacobian))


def _drift(step_covariance: FloatArray, pose: FloatArray, discs: FloatArray) -> FloatArray:
    """What odometry along the way adds: the discs as a whole are moved, and turned about them."""
    total = step_covariance.sum(axis=0)
    from_discs = rotation(pose[2]) @ -discs.mean(axis=0)
    turned = np.array([-from_discs[1], from_discs[0], 1.0])
    moved = np.diag([1.0, 1.0, 0.0]) * 0.5 * (total[0, 0] + total[1, 1])
    return np.asarray(moved + total[2, 2] * np.outer(turned, turned))
