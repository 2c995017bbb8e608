"""Lays the maps of several runs of one building on each other, by constellations of landmarks.

Nothing is known of where a run lies in another's map. Each of its stretches is placed there by
itself, as a robot that wakes up is (`waking`). Stretches that are placed by chance, or in a room
like another, do not agree with each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import wrap_angle
from redetect.plane import apply
from redetect.slam.association.loops import LoopSettings, Stretch
from redetect.slam.association.waking import ANYWHERE, ONE_DISC_M, placed

# How far stretches of one run may disagree, by the drift of its odometry.
_DRIFT = LoopSettings()


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
    settings = replace(ANYWHERE, false_alarms=alarms)
    tried = [(stretch, placed(stretch.xy, xy, settings)) for stretch in stretches]
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
