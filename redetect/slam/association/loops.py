"""Detects loops: parts of a run's map that are the same place, by mutual distances of landmarks.

Landmarks seen in a short part of the run, a submap, form a constellation that the drift of odometry
hardly deforms. Two constellations of one place are aligned by a rigid motion that pairs of
landmarks vote for. A match is accepted if that many landmarks would agree by chance in less than
one of a thousand runs. The criterion is the expected number of matches at least as good among
random constellations, over all motions tried ("number of false alarms", A. Desolneux, L. Moisan,
J.-M. Morel, "Meaningful alignments", International Journal of Computer Vision 40, 2000).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import KDTree
from scipy.special import bdtrc

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.compiled import kernel
from redetect.plane import apply, fitted, rotation

# Landmarks are in order of first sight, so neighbours in this order are near each other.
_NEIGHBOURS = 5
# Largest difference of the lengths of two pairs of landmarks that vote, and least length (m).
_LENGTH_TOLERANCE_M, _LEAST_LENGTH_M = 0.08, 0.8
# Motions of a constellation are different ones from this shift of its centre or turn on.
_OTHER_SHIFT_M, _OTHER_TURN_RAD = 0.5, 0.3
#: Largest distance of landmarks that agree (m).
REACH_M = 0.12
# A constellation covers the area within this distance of its landmarks.
_COVER_M = 0.6
# Spacing at which the area is measured.
_GRID_M = 0.15
#: Least number of frames whose landmarks form a constellation, and constellations in their length.
SUBMAP_FRAMES, _OVERLAPPING = 50, 5
# A submap that shares landmarks with one this many lengths earlier is part of the map already.
_LONG_AGO = 4
#: Most landmarks of a constellation that is compared with others, at the cost of their number to
#: the fourth power. Beyond these, most labels of a submap are parts of one landmark.
MOST_COMPARED = 80
# Labels with fewer rows than this share of what a typical row's label has may be clutter.
_LEAST_SHARE = 0.2
# Largest share of the agreeing landmarks with which another motion may fit.
_RIVAL_SHARE = 0.7
#: Largest systematic error of each step of odometry, in standard deviations.
SYSTEMATIC_SIGMAS = 2.0
#: Submaps that share at least this many landmarks are known to be the same place.
SHARED_BY_ONE_PLACE = 3


class Search(NamedTuple):
    """Parameters of the search."""

    most_turn_rad: float = 0.8  # largest motion between the two constellations
    most_shift_m: float = 8.0
    least_agreeing: int = 7  # of landmarks, whatever the number of false alarms
    false_alarms: float = 1e-3  # largest expected number of them in the whole search
    submap_frames: int = SUBMAP_FRAMES  # length of the submaps
    # Whether most of the map is in its place already: then only every second submap is matched,
    # unless it shares landmarks with one long before it.
    mostly_closed: bool = False


class _EqualPairs(NamedTuple):
    """Landmarks in the order of x, and their pairs that are as long as pairs of others."""

    fixed: FloatArray  # (m, 2)
    bins: IntArray  # (b,): where each bin of x begins, of the width of the reach
    first: IntArray  # (k,): landmarks of each pair of the others
    second: IntArray
    starts: IntArray  # (k,): where the pairs of its length begin and end in:
    ends: IntArray
    pairs: IntArray  # (p, 2)


def _pairs_of_equal_length(moved: FloatArray, unsorted: FloatArray) -> _EqualPairs:
    """Pairs of landmarks (m, 2), `unsorted`, that are as long as pairs of others (n, 2)."""
    fixed = unsorted[np.argsort(unsorted[:, 0], kind="stable")]
    first, second = np.triu_indices(len(moved), 1)
    length = np.hypot(*(moved[second] - moved[first]).T)
    used = (second - first <= _NEIGHBOURS) & (length >= _LEAST_LENGTH_M)
    first, second, length = first[used], second[used], length[used]
    tree, longest = KDTree(fixed), length.max(initial=0.0) + _LENGTH_TOLERANCE_M
    near = tree.sparse_distance_matrix(tree, longest, output_type="ndarray")
    near = near[np.lexsort((near["j"], near["i"], near["v"]))]
    limits = np.add(length, [[-_LENGTH_TOLERANCE_M], [_LENGTH_TOLERANCE_M]])
    starts, ends = np.searchsorted(near["v"], limits)
    edges = np.arange(fixed[0, 0] - REACH_M, fixed[-1, 0] + 4.0 * REACH_M, REACH_M)
    bins = np.searchsorted(fixed[:, 0], edges)
    pairs = np.stack([near["i"], near["j"]], axis=1)
    return _EqualPairs(fixed, bins, first, second, starts, ends, pairs)


@kernel()
def _agreement(
    moved: FloatArray, motion: tuple[float, float, float, float], equal: _EqualPairs, enough: int
) -> tuple[int, float]:
    """Number of landmarks that a motion puts on others, and their squared distances' sum (m^2).

    The motion is cosine and sine of the rotation, and the shift. Stops as soon as there cannot be
    `enough`.
    """
    cos, sin, shift_x, shift_y = motion
    fixed, bins = equal.fixed, equal.bins
    low = fixed[0, 0] - REACH_M
    count, squared, n = 0, 0.0, len(moved)
    for i in range(n):
        if count + n - i < enough:
            break
        x, y = moved[i, 0], moved[i, 1]
        at_x, at_y = shift_x + cos * x - sin * y, shift_y + sin * x + cos * y
        k = int((at_x - low) / REACH_M)
        if at_x < low or k + 2 >= len(bins):
            continue
        nearest = np.inf
        for j in range(bins[max(k - 1, 0)], bins[k + 2]):
            off_x, off_y = fixed[j, 0] - at_x, fixed[j, 1] - at_y
            nearest = min(nearest, off_x * off_x + off_y * off_y)
        if nearest <= REACH_M * REACH_M:
            count += 1
            squared += nearest
    return count, squared


@kernel()
def _best_motion(
    moved: FloatArray, equal: _EqualPairs, search: Search, excluding: FloatArray
) -> tuple[float, float, float, int, int]:
    """The motion under which most landmarks of one constellation fall on those of another.

    Both are relative to the centre of the first. Every pair of its landmarks with every pair of the
    second of the same length gives a motion. Returns rotation and shift, the number of agreeing
    landmarks, and that of motions tried, without those near `excluding`: a rotation and a shift
    (3,), NaN for none.
    """
    best_turn, best_x, best_y = 0.0, 0.0, 0.0
    best_count, best_squared, tried = search.least_agreeing - 1, 0.0, 0
    fixed = equal.fixed
    for k in range(len(equal.first)):
        a, b = equal.first[k], equal.second[k]
        ab_x, ab_y = moved[b, 0] - moved[a, 0], moved[b, 1] - moved[a, 1]
        for place in range(equal.starts[k], equal.ends[k]):
            c, d = equal.pairs[place]
            cd_x, cd_y = fixed[d, 0] - fixed[c, 0], fixed[d, 1] - fixed[c, 1]
            turn = math.atan2(ab_x * cd_y - ab_y * cd_x, ab_x * cd_x + ab_y * cd_y)
            if abs(turn) > search.most_turn_rad:
                continue
            cos, sin = math.cos(turn), math.sin(turn)
            # The middle of one pair goes to the middle of the other.
            x = 0.5 * (moved[a, 0] + moved[b, 0])
            y = 0.5 * (moved[a, 1] + moved[b, 1])
            shift_x = 0.5 * (fixed[c, 0] + fixed[d, 0]) - (cos * x - sin * y)
            shift_y = 0.5 * (fixed[c, 1] + fixed[d, 1]) - (sin * x + cos * y)
            if math.hypot(shift_x, shift_y) > search.most_shift_m:
                continue
            off = math.hypot(shift_x - excluding[1], shift_y - excluding[2])
            near = math.cos(turn - excluding[0]) > math.cos(_OTHER_TURN_RAD)
            if near and off < _OTHER_SHIFT_M:
                continue
            tried += 1
            motion = (cos, sin, shift_x, shift_y)
            count, squared = _agreement(moved, motion, equal, best_count)
            if count > best_count or (count == best_count and squared < best_squared):
                best_turn, best_x, best_y = turn, shift_x, shift_y
                best_count, best_squared = count, squared
    if best_count < search.least_agreeing:
        best_count = 0
    return best_turn, best_x, best_y, best_count, tried


@dataclass(frozen=True, eq=False)
class Submap:
    """Landmarks seen in some consecutive frames."""

    middle_frame: int
    labels: IntArray  # (n,): ascending
    xy: FloatArray  # (n, 2): their positions in the map (m)

    def without(self, other: Submap) -> Submap:
        """The landmarks that another submap does not have."""
        own = ~np.isin(self.labels, other.labels)
        return Submap(self.middle_frame, self.labels[own], self.xy[own])


@dataclass(frozen=True, eq=False)
class Match:
    """Two submaps that show one place."""

    earlier_frame: int  # middle frames of the two
    later_frame: int
    pairs: IntArray  # (k, 2): labels of the same landmark in the earlier and the later submap
    motion: FloatArray  # (3,): maps the later submap's landmarks onto the earlier one's
    log10_false_alarms: float  # of the expected number of matches as good by chance


def likely_landmarks(rows: IntArray, in_all: IntArray) -> BoolArray:
    """(n,) mask of labels without clutter, if that is more than a third of them; else all.

    Takes the numbers of their rows (n,) here and in all of the run. Those of clutter are less than
    a share of the typical one, that of the median row's label. So slow robots, which see each disc
    dozens of times, leave out clutter, and fast ones keep what they see once. A little clutter does
    no harm, and discs seen for a moment are of use.
    """
    ordered = np.sort(rows)
    middle = np.searchsorted(np.cumsum(ordered), 0.5 * ordered.sum())
    often = in_all >= _LEAST_SHARE * np.append(ordered, 0)[middle]
    return np.asarray(often | (3 * np.count_nonzero(often) >= 2 * len(rows)))


def submaps_of(
    frames: IntArray,
    labels: IntArray,
    xy: FloatArray,
    count: int,
    *,
    length: int = SUBMAP_FRAMES,
    overlapping: bool = True,
    least: int = Search().least_agreeing,
    most: int | None = None,
) -> list[Submap]:
    """The constellations with enough landmarks along a run of `count` frames.

    They consist of `length` frames; if overlapping, one begins each fifth of it. With `most`, they
    are for comparing places: of `likely_landmarks`, those with most rows count. `frames, labels`
    (n,), `xy` (M, 2).
    """
    found, stride = [], length // _OVERLAPPING if overlapping else length
    in_all = np.bincount(labels)
    for start in range(0, max(count - length // 2, 1), stride):
        first, last = np.searchsorted(frames, [start, start + length])
        seen, rows = np.unique(labels[first:last], return_counts=True)
        known = np.isfinite(xy[seen, 0])
        if most is not None:
            known &= likely_landmarks(rows, in_all[seen])
        seen, rows = seen[known], rows[known]
        seen = np.sort(seen[np.argsort(-rows, kind="stable")[:most]])
        if len(seen) >= least:
            found.append(Submap(min(start + length // 2, count - 1), seen, xy[seen]))
    return found


def sightings(submaps: Sequence[Submap]) -> csr_array:
    """(S, M) sparse int64, 1 where a submap shows a label."""
    labels = np.concatenate([np.zeros(0, dtype=np.int64), *(s.labels for s in submaps)])
    starts = np.cumsum([0, *(len(s.labels) for s in submaps)])
    shape = (len(submaps), int(labels.max(initial=-1)) + 1)
    return csr_array((np.ones(len(labels), dtype=np.int64), labels, starts), shape=shape)


def shared_landmarks(submaps: Sequence[Submap]) -> csr_array:
    """(S, S) sparse int64, number of landmarks that two submaps have in common."""
    seen = sightings(submaps)
    return csr_array(seen @ seen.T)


def find_matches(submaps: list[Submap], search: Search) -> list[Match]:
    """All pairs of submaps that show one place significantly, the most significant first.

    Landmarks that two submaps share are ignored; if these are three or more, they need no match.
    """
    candidates: list[tuple[Submap, Submap, Motion]] = []
    centres = np.array([s.xy.mean(axis=0) for s in submaps]).reshape(-1, 2)
    extents = np.array([np.linalg.norm(s.xy - s.xy.mean(axis=0), axis=1).max() for s in submaps])
    together = shared_landmarks(submaps)
    later_step, earlier_step = (2, 3) if search.mostly_closed else (1, 2)
    for k in range(0, len(submaps), later_step):
        later = submaps[k]
        shared = together[[k], :k].toarray()[0]
        gap = np.array([later.middle_frame - s.middle_frame for s in submaps[:k]], dtype=np.int64)
        apart = (gap >= search.submap_frames) & (shared < SHARED_BY_ONE_PLACE)
        long_ago = gap >= _LONG_AGO * search.submap_frames
        if search.mostly_closed and np.any(~apart & long_ago):
            continue
        reach = search.most_shift_m + extents[:k] + extents[k]
        near = np.linalg.norm(centres[:k] - centres[k], axis=1) < reach
        near[np.arange(k) % earlier_step != 0] = False
        for i in np.flatnonzero(near & apart):
            fixed, moved = submaps[i].without(later), later.without(submaps[i])
            if min(len(fixed.labels), len(moved.labels)) >= search.least_agreeing:
                candidates.append((fixed, moved, motion_onto(moved.xy, fixed.xy, search)))
    tried = sum(motion.tried for _, _, motion in candidates)
    matches = []
    for fixed, moved, motion in candidates:
        if motion.agreeing < search.least_agreeing:
            continue
        match = _refined(fixed, moved, motion.pose, tried, search)
        if match is None or match.log10_false_alarms > np.log10(search.false_alarms):
            continue
        if not has_rival(moved.xy, fixed.xy, match.motion, len(match.pairs), search):
            matches.append(match)
    return sorted(matches, key=lambda m: (m.log10_false_alarms, m.later_frame, m.earlier_frame))


class Motion(NamedTuple):
    """A motion that aligns landmarks with others."""

    pose: FloatArray  # (3,)
    agreeing: int  # number of landmarks that fall on others; 0 if too few
    tried: int  # number of motions tried


def motion_onto(
    moved: FloatArray, fixed: FloatArray, search: Search, excluding: FloatArray | None = None
) -> Motion:
    """The motion under which most landmarks (n, 2) fall on those of another constellation; with
    `excluding` (3,), the best one that is not near this pose.
    """
    centre = moved.sum(axis=0) / max(len(moved), 1)
    known = np.full(3, np.nan)
    if excluding is not None:
        known = np.array([excluding[2], *(apply(excluding, centre) - centre)])
    moved = moved - centre
    equal = _pairs_of_equal_length(moved, fixed - centre)
    turn, x, y, agreeing, tried = _best_motion(moved, equal, search, known)
    pose = np.array([*(centre + np.array([x, y]) - rotation(turn) @ centre), turn])
    return Motion(pose, agreeing, tried)


def has_rival(
    moved: FloatArray, fixed: FloatArray, pose: FloatArray, agreeing: int, search: Search
) -> bool:
    """Whether another motion than a pose (3,) puts nearly as many landmarks on others, as in a
    regular pattern of discs: more than seven tenths of those that agree with it.
    """
    enough = max(math.floor(_RIVAL_SHARE * agreeing) + 1, search.least_agreeing)
    rival = motion_onto(moved, fixed, search._replace(least_agreeing=enough), excluding=pose)
    return rival.agreeing > 0


def refined_motion(
    place: FloatArray, target: FloatArray, pose: FloatArray, least_agreeing: int
) -> tuple[FloatArray, IntArray] | None:
    """The pose that aligns landmarks with those they agree with, by least squares, and the pairs.

    From a pose nearby; None if too few agree. Pairs are (k, 2), as from `mutual_pairs`: the
    target's first.
    """
    for _ in range(5):
        pairs = mutual_pairs(target, apply(pose, place), REACH_M)
        if len(pairs) < least_agreeing:
            return None
        pose = fitted(place[pairs[:, 1]], target[pairs[:, 0]])
    return pose, pairs


def mutual_pairs(first: FloatArray, second: FloatArray, reach_m: float) -> IntArray:
    """(k, 2) indices of points (n, 2), (m, 2) that are each other's nearest, and within reach."""
    if len(first) == 0 or len(second) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    distance = np.linalg.norm(first[:, None] - second[None], axis=2)
    to_second, to_first = distance.argmin(axis=1), distance.argmin(axis=0)
    index = np.arange(len(first))
    mutual = (to_first[to_second] == index) & (distance[index, to_second] <= reach_m)
    return np.stack([index[mutual], to_second[mutual]], axis=1).astype(np.int64)


def log10_false_alarms(agreeing: int, present: int, chance: float, tried: int) -> float:
    """Logarithm of the expected number of matches at least as good by chance.

    Two of the landmarks agree because they define the motion; each of the others agrees by chance
    with probability `chance`.
    """
    with np.errstate(divide="ignore"):
        tail = float(np.log(bdtrc(agreeing - 3, max(present - 2, 0), min(chance, 1.0))))
    return float(np.log10(max(tried, 1)) + tail / np.log(10.0))


def chance_of_agreeing(xy: FloatArray) -> float:
    """Probability that a landmark in the covered area falls on one of (n, 2) by chance."""
    low, high = xy.min(axis=0) - _COVER_M, xy.max(axis=0) + _COVER_M
    xs, ys = (np.arange(low[a], high[a] + _GRID_M, _GRID_M) for a in (0, 1))
    covered = np.zeros((len(xs), len(ys)), dtype=np.bool_)
    for x, y in xy:
        near_x, near_y = (
            slice(*np.searchsorted(axis, [at - _COVER_M - _GRID_M, at + _COVER_M + _GRID_M]))
            for axis, at in ((xs, x), (ys, y))
        )
        squared = (xs[near_x, None] - x) ** 2 + (ys[near_y] - y) ** 2
        covered[near_x, near_y] |= squared <= _COVER_M**2
    area_m2 = float(np.count_nonzero(covered) * _GRID_M**2)
    return float(len(xy) * np.pi * REACH_M**2 / area_m2)


def _refined(
    earlier: Submap, later: Submap, pose: FloatArray, tried: int, search: Search
) -> Match | None:
    """Refine a match by least squares over all agreeing landmarks; None if too few agree then."""
    found = refined_motion(later.xy, earlier.xy, pose, search.least_agreeing)
    if found is None:
        return None
    pose, pairs = found
    nearest, _ = KDTree(earlier.xy).query(apply(pose, later.xy))
    present = max(int(np.sum(nearest <= _COVER_M)), len(pairs))
    return Match(
        earlier.middle_frame,
        later.middle_frame,
        np.stack([earlier.labels[pairs[:, 0]], later.labels[pairs[:, 1]]], axis=1),
        pose,
        log10_false_alarms(len(pairs), present, chance_of_agreeing(earlier.xy), tried),
    )
