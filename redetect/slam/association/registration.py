"""Locates a constellation of discs in a map: global localisation, or registration of another run.

Nothing is known about the pose. The constellation is aligned with the map by the motion that pairs
of discs vote for (`loops`). The motion is accepted if that many discs would agree by chance in less
than one of a thousand maps, and if no other place of the map fits nearly as well, since buildings
have repetitive structure.

For global localisation, odometry combines the discs of the first frames, of more and more until the
place is unique. For another run, each submap is located separately; submaps located by chance,
or in a similar place, do not agree with each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import wrap_angle
from redetect.plane import apply, chain_steps, rotation
from redetect.slam.association import loops
from redetect.slam.recording import Recording

#: Fewest frames that are tried, growth of their number, and most frames.
_FEWEST_FRAMES, _GROWTH, _MOST_FRAMES = 5, 1.5, 400
#: Rows closer together than this belong to one disc (m).
ONE_DISC_M = 0.25
#: Least standard deviation of a disc (m): that of raw rows from a leaning camera.
_DISC_SIGMA_M = 0.25
ANYWHERE = loops.Search(math.inf, math.inf, least_agreeing=5)
# Largest disagreement of submaps of one run, due to the drift of odometry.
_DRIFT = loops.Search()


@dataclass(frozen=True, eq=False)
class GlobalPose:
    """The pose at the start of a run, in a map."""

    pose: FloatArray  # (3,) m, m, rad
    covariance: FloatArray  # (3, 3)
    frames: int  # number of frames used
    discs: int  # number of discs in these
    agreeing: int  # number of these discs that are in the map


def localise_globally(recording: Recording, disc_xy: FloatArray) -> GlobalPose | None:
    """The pose at the start of a run from the discs of the first frames, whatever their IDs, and
    those of the map (M, 2) (m); None if it is not certain.
    """
    most = min(len(recording), _MOST_FRAMES)
    rows = recording.circles.only(recording.circles.frame < most)
    at = apply(chain_steps(recording.steps[:most])[rows.frame + 1], rows.xy)
    frames, before = min(_FEWEST_FRAMES, most), -1
    while True:
        discs = _merged(at[rows.frame < frames])
        # Without new discs the result would be the same.
        if len(discs) != before:
            found = located(discs, disc_xy)
            if found is not None:
                pose, pairs = found
                covariance = _covariance(pose, discs[pairs[:, 1]], disc_xy[pairs[:, 0]])
                covariance += _drift(recording.step_covariance[:frames], pose, discs)
                return GlobalPose(pose, covariance, frames, len(discs), len(pairs))
        if frames == most:
            return None
        frames, before = min(math.ceil(_GROWTH * frames), most), len(discs)


def _merged(xy: FloatArray) -> FloatArray:
    """(n, 2) means of rows close to each other, of `loops.likely_landmarks`."""
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
    rows = np.array(counts, dtype=np.int64)
    return np.array(means).reshape(-1, 2)[loops.likely_landmarks(rows, rows)]


def located(
    discs: FloatArray, disc_xy: FloatArray, false_alarms: float = ANYWHERE.false_alarms
) -> tuple[FloatArray, IntArray] | None:
    """The unique place of a constellation in a map, if there is one.

    Takes `discs` (n, 2), `disc_xy` (M, 2) of the map. Returns the constellation's pose (3,) in the
    map, and the agreeing discs (k, 2) of the map and of the constellation.
    """
    least = ANYWHERE.least_agreeing
    if min(len(discs), len(disc_xy)) < least:
        return None
    motion = loops.motion_onto(discs, disc_xy, ANYWHERE)
    if motion.agreeing < least:
        return None
    found = loops.refined_motion(discs, disc_xy, motion.pose, least)
    if found is None:
        return None
    pose, pairs = found
    chance = loops.chance_of_agreeing(disc_xy)
    alarms = loops.log10_false_alarms(len(pairs), len(discs), chance, motion.tried)
    if alarms > math.log10(false_alarms):
        return None
    # Also one on the same discs: pairs in a corridor look alike from both ends, and a period on.
    return None if loops.has_rival(discs, disc_xy, pose, len(pairs), ANYWHERE) else (pose, pairs)


def _covariance(pose: FloatArray, discs: FloatArray, targets: FloatArray) -> FloatArray:
    """Covariance of a pose that aligns discs with targets, from the residuals."""
    lever = discs @ rotation(pose[2]).T
    one, none = np.ones(len(lever)), np.zeros(len(lever))
    by_x, by_y = (one, none, -lever[:, 1]), (none, one, lever[:, 0])
    jacobian = np.concatenate([np.stack(by_x, axis=1), np.stack(by_y, axis=1)])
    variance = max(float(np.mean((apply(pose, discs) - targets) ** 2)), _DISC_SIGMA_M**2)
    return np.asarray(variance * np.linalg.inv(jacobian.T @ jacobian))


def _drift(step_covariance: FloatArray, pose: FloatArray, discs: FloatArray) -> FloatArray:
    """Covariance added by odometry along the path: all discs are moved, and rotated together.

    Errors of steps are random, and systematic ones add up: discs are seen after half of the path on
    average.
    """
    sigmas = np.sqrt(np.diagonal(step_covariance, axis1=1, axis2=2)).sum(axis=0)
    total = step_covariance.sum(axis=0) + np.diag((0.5 * loops.SYSTEMATIC_SIGMAS * sigmas) ** 2)
    from_discs = rotation(pose[2]) @ -discs.mean(axis=0)
    turned = np.array([-from_discs[1], from_discs[0], 1.0])
    moved = np.diag([1.0, 1.0, 0.0]) * 0.5 * (total[0, 0] + total[1, 1])
    return np.asarray(moved + total[2, 2] * np.outer(turned, turned))


def register_maps(
    places: Sequence[FloatArray], submaps: Sequence[Sequence[loops.Submap]]
) -> tuple[FloatArray, list[IntArray], list[int]]:
    """Register K maps in the first one, or in those already registered.

    Takes the landmarks (M, 2) of each map (m; NaN if unknown), and its submaps, without common
    frames, whose labels are the landmarks' indices. Returns poses (K, 3) of the maps' frames in the
    first one's, pairs (k, 2) of identical landmarks, numbered through all maps, and the maps that
    cannot be registered in the others.
    """
    offsets = np.cumsum([0, *map(len, places)])
    names = np.flatnonzero(np.isfinite(places[0][:, 0]))
    xy, motions = places[0][names], np.zeros((len(places), 3))
    pairs: list[IntArray] = []
    waiting = list(range(1, len(places)))
    while True:
        tried = ((k, register(submaps[k], xy)) for k in waiting)
        k, found = next(((k, found) for k, found in tried if found), (0, None))
        if found is None:
            return motions, pairs, waiting
        waiting.remove(k)
        motions[k] = found[0]
        pairs += [np.stack([names[a], offsets[k] + b], axis=1) for a, b in found[1]]
        own = apply(motions[k], places[k])
        fresh = np.flatnonzero(np.isfinite(own[:, 0]))
        fresh = fresh[KDTree(xy).query(own[fresh])[0] > ONE_DISC_M]
        xy, names = np.concatenate([xy, own[fresh]]), np.append(names, offsets[k] + fresh)


def register(
    submaps: Sequence[loops.Submap], xy: FloatArray
) -> tuple[FloatArray, list[tuple[IntArray, IntArray]]] | None:
    """The motion that registers a run's map in another one, and the identical landmarks.

    Each submap is located separately. The result is the motion on which most of them agree, within
    drift, if these are more than half; else there is none.

    Takes `xy` (M, 2), the other map's landmarks; returns a pose (3,) and, for each agreeing
    submap, indices into `xy` and labels, both (k,).
    """
    alarms = ANYWHERE.false_alarms / max(len(submaps), 1)
    tried = [(submap, located(submap.xy, xy, alarms)) for submap in submaps]
    found = [(submap, *place) for submap, place in tried if place is not None]
    if not found:
        return None
    poses = np.array([pose for _, pose, _ in found])
    middles = np.array([submap.xy.mean(axis=0) for submap, _, _ in found])
    off = np.linalg.norm(apply(poses[:, None], middles) - apply(poses, middles), axis=2)
    turned = np.abs(wrap_angle(poses[:, None, 2] - poses[:, 2]))
    agree = (off <= _DRIFT.most_shift_m) & (turned <= _DRIFT.most_turn_rad)
    best = int(np.argmax(agree.sum(axis=1)))
    if 2 * np.count_nonzero(agree[best]) <= len(found):
        return None
    return poses[best], [
        (pairs[:, 0], submap.labels[pairs[:, 1]])
        for (submap, _, pairs), right in zip(found, agree[best])
        if right
    ]
