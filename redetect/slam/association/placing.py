"""Where a constellation of discs lies in a map: of a robot that wakes up, or of another run.

Nothing is known of the pose. The constellation is laid on the map by the motion that pairs of discs
vote for (`loops`). It is believed if as many discs agree as would by chance in less than one of a
thousand maps, and if the rest of the map has no place that fits nearly as well: buildings repeat
themselves.

Odometry puts the discs of a robot's first frames together, of more and more until they have such a
place. Of another run, each stretch is placed by itself. Stretches that are placed by chance, or in
a room like another, do not agree with each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import wrap_angle
from redetect.plane import apply, chain_steps, rotation
from redetect.slam.association.loops import (
    Search,
    Stretch,
    chance_of_agreeing,
    log10_false_alarms,
    motion_onto,
    settled,
)
from redetect.slam.recording import Recording

#: Frames that are tried, and by how much more each time.
_FEWEST_FRAMES, _MORE, _MOST_FRAMES = 5, 1.5, 400
#: Rows nearer than this are of one disc (m).
ONE_DISC_M = 0.25
#: Another place may fit with this share of the agreeing discs at most.
_RIVAL_SHARE = 0.7
#: Standard deviation of a disc at least (m): of raw rows, seen by a camera that leans.
_DISC_SIGMA_M = 0.25
ANYWHERE = Search(math.inf, math.inf, least_agreeing=5)
# How far stretches of one run may disagree, by the drift of its odometry.
_DRIFT = Search()


class Place(NamedTuple):
    """Where a constellation lies in a map."""

    pose: FloatArray  # (3,) m, m, rad
    pairs: IntArray  # (k, 2): discs of the map and of the constellation that agree


@dataclass(frozen=True, eq=False)
class Waking:
    """The pose at the start of a run, in a map."""

    pose: FloatArray  # (3,) m, m, rad
    covariance: FloatArray  # (3, 3)
    frames: int  # of the run that it took
    discs: int  # of these,
    agreeing: int  # and how many of them are in the map


def wake_up(recording: Recording, disc_xy: FloatArray) -> Waking | None:
    """The pose at the start of a run by the discs of its first frames; None if none is certain.

    Identifiers are not used. Takes the map's discs (M, 2) (m).
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
            found = placed(discs, disc_xy)
            if found is not None:
                pose, pairs = found
                covariance = _covariance(pose, discs[pairs[:, 1]], disc_xy[pairs[:, 0]])
                covariance += _drift(recording.step_covariance[:frames], pose, discs)
                return Waking(pose, covariance, frames, len(discs), len(pairs))
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


def placed(
    discs: FloatArray, disc_xy: FloatArray, false_alarms: float = ANYWHERE.false_alarms
) -> Place | None:
    """The only place of a map that a constellation fits.

    Takes `discs` (n, 2), `disc_xy` (M, 2) of the map.
    """
    least = ANYWHERE.least_agreeing
    if min(len(discs), len(disc_xy)) < least:
        return None
    motion = motion_onto(discs, disc_xy, ANYWHERE)
    if motion.agreeing < least:
        return None
    found = settled(discs, disc_xy, motion.pose, least)
    if found is None:
        return None
    pose, pairs = found
    chance = chance_of_agreeing(disc_xy)
    alarms = log10_false_alarms(len(pairs), len(discs), chance, motion.tried)
    if alarms > math.log10(false_alarms):
        return None
    others = np.delete(disc_xy, pairs[:, 0], axis=0)
    if len(others) >= least:
        rival = motion_onto(discs, others, ANYWHERE)
        if rival.agreeing > _RIVAL_SHARE * len(pairs):
            return None
    return Place(pose, pairs)


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


def lay_together(
    places: Sequence[FloatArray], stretches: Sequence[Sequence[Stretch]]
) -> tuple[FloatArray, list[IntArray], list[int]]:
    """Lay maps on the first one, or on those that are laid on it.

    Parameters
    ----------
    places : K arrays of (M, 2)
        Landmarks of each map (m); NaN where they have no place.
    stretches : K lists of Stretch
        Of each map, which share no frames; their labels are the landmarks' indices.

    Returns
    -------
    motions : (K, 3) float64
        Poses of the maps' frames in the first one's.
    pairs : list of (k, 2) int64
        Landmarks that are one, numbered through all maps.
    apart : list of int
        Maps that nothing lays on the others.
    """
    offsets = np.cumsum([0, *map(len, places)])
    names = np.flatnonzero(np.isfinite(places[0][:, 0]))
    xy, motions = places[0][names], np.zeros((len(places), 3))
    pairs: list[IntArray] = []
    waiting = list(range(1, len(places)))
    while True:
        laid = ((k, lay_on(stretches[k], xy)) for k in waiting)
        k, found = next(((k, found) for k, found in laid if found), (0, None))
        if found is None:
            return motions, pairs, waiting
        waiting.remove(k)
        motions[k] = found[0]
        pairs += [np.stack([names[a], offsets[k] + b], axis=1) for a, b in found[1]]
        own = apply(motions[k], places[k])
        fresh = np.flatnonzero(np.isfinite(own[:, 0]))
        fresh = fresh[KDTree(xy).query(own[fresh])[0] > ONE_DISC_M]
        xy, names = np.concatenate([xy, own[fresh]]), np.append(names, offsets[k] + fresh)


def lay_on(
    stretches: Sequence[Stretch], xy: FloatArray
) -> tuple[FloatArray, list[tuple[IntArray, IntArray]]] | None:
    """The motion that lays a run's map on another, and the landmarks that are the same then.

    Each stretch is placed by itself. The motion is taken that most of them agree with, as far as
    drift lets them, if these are more than half; else there is none.

    Takes `xy` (M, 2), the other map's landmarks; returns a pose (3,) and of each stretch that
    agrees indices into `xy` and labels, both (k,).
    """
    alarms = ANYWHERE.false_alarms / max(len(stretches), 1)
    tried = [(stretch, placed(stretch.xy, xy, alarms)) for stretch in stretches]
    found = [(stretch, place) for stretch, place in tried if place is not None]
    if not found:
        return None
    poses = np.array([place.pose for _, place in found])
    middles = np.array([stretch.xy.mean(axis=0) for stretch, _ in found])
    off = np.linalg.norm(apply(poses[:, None], middles) - apply(poses, middles), axis=2)
    turned = np.abs(wrap_angle(poses[:, None, 2] - poses[:, 2]))
    agree = (off <= _DRIFT.most_shift_m) & (turned <= _DRIFT.most_turn_rad)
    best = int(np.argmax(agree.sum(axis=1)))
    if 2 * np.count_nonzero(agree[best]) <= len(found):
        return None
    return poses[best], [
        (place.pairs[:, 0], stretch.labels[place.pairs[:, 1]])
        for (stretch, place), right in zip(found, agree[best])
        if right
    ]
