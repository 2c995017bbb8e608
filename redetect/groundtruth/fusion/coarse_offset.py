"""The clocks' offset to a tenth of a second, from turns and distances in a second at many offsets.

The refinement of the clock needs a start within a second. Offsets of many seconds, and robots that
hardly turn, are found here: the movements of both streams are compared at all offsets of a grid. An
offset far from the expected one is only taken if it explains them much better than any other.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.groundtruth.fusion.stream_errors import white_noise_sigmas
from redetect.groundtruth.trajectories.streams import PlanarPoses

#: Offsets this near the expected one are left to the refinement of the clock.
NEAR_S = 1.0
_WINDOW_S, _STEP_S = 1.0, 0.1
_MOST_SAMPLES = 3000
_FEWEST_SAMPLES = 20
_LONGEST_SESSION_S = 1e6
# Movements are not interpolated over longer gaps, or this many of a stream's usual intervals.
_LONGEST_GAP_S, _INTERVALS = 1.0, 3.0
# Errors of odometry's turns and distances, as a share of what is usual in the ground truth.
_SHARE = 0.1
_LEAST_TURN_RAD, _LEAST_DISTANCE_M = 1e-3, 1e-3
# Least duration of the parts before and after the clock was set, and least step (s).
_LEAST_PART_S, _LEAST_JUMP_S = 10.0, 0.5
# Where the clock was set, a step of odometry's stamps exceeds the usual one at least this many
# times, by the jump to this share, and a split there is at least this share of the best one's gain.
_LEAP, _LEAP_SHARE, _MUCH_OF_IT = 1.5, 0.2, 0.5
# Least share of the largest possible number of movements that an offset must compare.
_COVERED = 0.5
# Largest ratio of the squared errors at another offset to those near the expected one or of others'
# movements, and to those elsewhere, beyond the width of its own minimum.
_MUCH_BETTER, _ALONE, _OWN_WIDTH_S = 0.25, 0.5, 3.0
# Movements do not match if their squared errors are larger than this share of those of unrelated
# ones, in segments with much movement.
_UNRELATED, _MUCH_MOVEMENT = 0.5, 10.0
# Number of errors that are in memory at once.
_AT_ONCE = 1_000_000


@dataclass(frozen=True, eq=False)
class Splits:
    """A series split in two at each of its times, each part with its best alternative."""

    times_s: FloatArray  # (N,) the last of the first part
    costs: FloatArray  # (N,) of both parts, infinite where one is too short
    alternatives: IntArray  # (2, N)
    whole: float  # Cost of the best alternative without a split

    @classmethod
    def of(cls, costs: Iterable[FloatArray], times_s: FloatArray, least_s: float) -> Splits:
        """The splits into parts of a least duration, given the costs (K, N) of K alternatives in
        blocks.
        """
        columns, first, whole = np.arange(len(times_s)), 0, np.inf
        least, best = np.full((2, len(times_s)), np.inf), np.zeros((2, len(times_s)), np.int64)
        for block in costs:
            before = np.cumsum(block, axis=1)
            for side, total in enumerate((before, before[:, -1:] - before)):
                own = np.argmin(total, axis=0)
                best[side] = np.where(total[own, columns] < least[side], first + own, best[side])
                least[side] = np.minimum(total[own, columns], least[side])
            first, whole = first + len(block), min(whole, float(before[:, -1].min()))
        both = least.sum(axis=0)
        both[np.minimum(times_s - times_s[0], times_s[-1] - times_s) < least_s] = np.inf
        return cls(times_s, both, best, whole)

    def jump_s(self, offsets_s: FloatArray, odometry_s: FloatArray) -> float:
        """Time of the best split, on the ground truth's clock, if the alternatives are offsets.

        Movements show its time to some seconds, as long as the robot drives straight ahead. It is
        exact where the stamps of odometry leap by the difference of the offsets, if a split there
        explains much, too.
        """
        at = int(np.argmin(self.costs))
        before_s, after_s = offsets_s[self.alternatives[:, at]].tolist()
        steps_s = np.diff(odometry_s)
        usual_s = float(np.median(steps_s))
        leaps = np.flatnonzero(steps_s > _LEAP * usual_s)
        # One of the two offsets, at least, is right.
        times_s = np.concatenate(
            [odometry_s[leaps] + 0.5 * usual_s - before_s,
             odometry_s[leaps + 1] - 0.5 * usual_s - after_s]
        )  # fmt: skip
        last = np.clip(np.searchsorted(self.times_s, times_s) - 1, 0, len(self.times_s) - 1)
        jumps_s = np.diff(offsets_s[self.alternatives[:, last]], axis=0)[0]
        apart_s = np.abs(jumps_s - np.tile(steps_s[leaps] - usual_s, 2))
        most = self.whole - _MUCH_OF_IT * (self.whole - self.costs[at])
        good = (apart_s <= usual_s + _LEAP_SHARE * np.abs(jumps_s)) & (self.costs[last] <= most)
        if not np.any(good):
            return float(self.times_s[at])
        return float(times_s[good][np.argmin(self.costs[last][good])])


@dataclass(frozen=True, eq=False)
class Movements:
    """Turns (rad) and distances (m) over windows of a second, on a grid of times."""

    first: int  # Step of the grid, since time 0, of the first one
    values: FloatArray  # (N, 2)
    known: BoolArray  # (N,)
    noise: FloatArray  # (2,) variances of their noise

    @classmethod
    def of(cls, poses: PlanarPoses) -> Movements:
        """The movements of a stream at the grid's steps around its time."""
        first = int(np.floor(poses.times_s[0] / _STEP_S))
        middle = _STEP_S * np.arange(first, int(np.ceil(poses.times_s[-1] / _STEP_S)) + 1)
        longest = max(_LONGEST_GAP_S, _INTERVALS * float(np.median(np.diff(poses.times_s))))
        ends, known = [], np.ones(len(middle), dtype=np.bool_)
        for times in (middle - 0.5 * _WINDOW_S, middle + 0.5 * _WINDOW_S):
            at = np.clip(np.searchsorted(poses.times_s, times), 1, len(poses) - 1)
            known &= poses.times_s[at] - poses.times_s[at - 1] <= longest
            known &= (times >= poses.times_s[0]) & (times <= poses.times_s[-1])
            ends.append([np.interp(times, poses.times_s, values) for values in poses.continuous.T])
        dx, dy, turn = np.array(ends[1]) - np.array(ends[0])
        x, y, heading = white_noise_sigmas(poses)
        noise = 2.0 * np.array([heading**2, 0.5 * (x**2 + y**2)])
        return cls(first, np.column_stack([turn, np.hypot(dx, dy)]), known, noise)


class OffsetSearch:
    """The search of offsets of one odometry with distinct times, within a bound either way."""

    def __init__(
        self, odometry: PlanarPoses, parts: Sequence[PlanarPoses], largest_s: float
    ) -> None:
        """`parts` of the ground truth, in order, for which offsets will be searched."""
        long = [part.times_s for part in parts if len(part) >= _FEWEST_SAMPLES]
        # Single times may be years off, as of a clock that was not set yet.
        reach = largest_s + _WINDOW_S
        near = odometry
        if long:
            near = odometry.only(odometry.during(long[0][0] - reach, long[-1][-1] + reach))
        few = len(near) < _FEWEST_SAMPLES or np.ptp(near.times_s) > _LONGEST_SESSION_S
        self._own = None if few else Movements.of(near)
        largest = int(np.ceil(largest_s / _STEP_S))
        self._steps = np.arange(-largest, largest + 1)

    def offset_s(self, parts: Sequence[PlanarPoses], around_s: float) -> float:
        """Robot time minus ground truth time for parts of the ground truth: `around_s`, which is
        expected, unless another one fits their movements much better.
        """
        compared = self._compared(parts)
        if compared is None:
            return around_s
        steps = compared.overlapping(self._steps)
        errors = compared.errors(steps)
        if not len(steps):
            return around_s
        near = np.abs(_STEP_S * steps - around_s) <= NEAR_S
        best = int(np.argmin(errors))
        beside = np.abs(steps - steps[best]) > _OWN_WIDTH_S / _STEP_S
        least = errors[best]
        if (
            near[best]
            or not least < _MUCH_BETTER * compared.unrelated
            or not least < _MUCH_BETTER * np.min(errors[near], initial=np.inf)
            or not least < _ALONE * np.min(errors[beside], initial=np.inf)
        ):
            return around_s
        return float(_STEP_S * steps[best])

    def set_at_s(
        self, part: PlanarPoses, odometry_s: FloatArray, largest_drift: float
    ) -> float | None:
        """Time at which the clock was set by more than a refinement finds, within a part.

        `odometry_s`: stamps of odometry.
        """
        compared = self._compared([part])
        if compared is None or compared.unrelated < _MUCH_MOVEMENT:
            return None
        steps = compared.overlapping(self._steps)
        if not len(steps):
            return None
        blocks = compared.single_errors(steps)
        costs = (np.minimum(block, compared.unrelated) for block in blocks)
        times_s = np.asarray(_STEP_S * (compared.at + compared.own.first))
        splits = Splits.of(costs, times_s, _LEAST_PART_S)
        at = int(np.argmin(splits.costs))
        cost, offsets = splits.costs[at], splits.alternatives[:, at]
        if cost > _MUCH_BETTER * splits.whole or _STEP_S * np.ptp(offsets) < _LEAST_JUMP_S:
            return None
        # A clock that drifts has the mean offsets of both parts at their middles.
        drifts = np.array([1.6, 2.0, 2.4]) * np.diff(offsets) / np.ptp(compared.at)
        between = np.arange(steps[offsets.min()], steps[offsets.max()] + 1)
        for drift in drifts[np.abs(drifts) <= largest_drift].tolist():
            for block in compared.drifting(drift).single_errors(between):
                if np.minimum(block, compared.unrelated).sum(axis=1).min() < cost:
                    return None
        return splits.jump_s(np.asarray(_STEP_S * steps), odometry_s)

    def best_near(
        self, part: PlanarPoses, around_s: float, largest_drift: float
    ) -> tuple[float, float]:
        """The best offset (s) near the expected one, and the drift, 0 unless another is better."""
        compared = self._compared([part])
        if compared is None:
            return around_s, 0.0
        near = int(NEAR_S / _STEP_S)
        steps = round(around_s / _STEP_S) + np.arange(-near, near + 1)
        # From one to the next the ends of the part move by two steps.
        count = int(largest_drift * np.ptp(compared.at) / 4)
        drifts = np.arange(-count, count + 1) * (largest_drift / max(count, 1))
        errors = np.stack([compared.drifting(drift).errors(steps) for drift in drifts.tolist()])
        least = errors.min(axis=1)
        best = int(np.argmin(least))
        if not least[best] < _ALONE * least[count]:
            best = count
        if not np.isfinite(least[best]):
            return around_s, 0.0
        return float(_STEP_S * steps[np.argmin(errors[best])]), float(drifts[best])

    def matches(self, part: PlanarPoses, offset_s: float, drift: float) -> bool:
        """Whether the movements of a part agree with a clock, unless there is hardly any."""
        compared = self._compared([part])
        if compared is None or compared.unrelated < _MUCH_MOVEMENT:
            return True
        (error,) = compared.drifting(drift).errors(np.array([round(offset_s / _STEP_S)]))
        return bool(not np.isfinite(error) or error < _UNRELATED * compared.unrelated)

    def _compared(self, parts: Sequence[PlanarPoses]) -> _Compared | None:
        if self._own is None:
            return None
        moved = [Movements.of(part) for part in parts if len(part) > 1]
        at = [one.first - self._own.first + np.flatnonzero(one.known) for one in moved]
        if sum(map(len, at)) < _FEWEST_SAMPLES or not np.any(self._own.known):
            return None
        values = np.concatenate([one.values[one.known] for one in moved])
        noise = np.mean([one.noise for one in moved], axis=0) + self._own.noise
        floor = np.array([_LEAST_TURN_RAD, _LEAST_DISTANCE_M])
        usual = np.sqrt(np.array([np.mean(values[:, 0] ** 2), np.var(values[:, 1])]))
        weights = 1.0 / (noise + (_SHARE * usual) ** 2 + floor**2)
        # Odometry without distances, as from a gyroscope, has nothing to compare.
        if np.max(self._own.values[self._own.known, 1]) < _LEAST_DISTANCE_M:
            weights[1] = 0.0
        stride = 1 + len(values) // _MOST_SAMPLES
        return _Compared(self._own, np.concatenate(at)[::stride], values[::stride], weights)


@dataclass(frozen=True, eq=False)
class _Compared:
    """Movements of the ground truth, and those of odometry with which they are compared."""

    own: Movements
    at: IntArray  # (M,) steps of odometry's grid with the same times
    values: FloatArray  # (M, 2)
    weights: FloatArray  # (2,) inverse variances of the differences

    @property
    def unrelated(self) -> float:
        """Mean squared normalised error that is expected of unrelated movements."""
        own = self.own.values[self.own.known]
        apart = np.var(self.values, axis=0) + np.var(own, axis=0)
        return float((apart + (self.values.mean(axis=0) - own.mean(axis=0)) ** 2) @ self.weights)

    def drifting(self, drift: float) -> _Compared:
        """The same with a drift of odometry's clock from the middle."""
        later = np.rint(drift * (self.at - self.at.mean())).astype(np.int64)
        return replace(self, at=self.at + later)

    def overlapping(self, steps: IntArray) -> IntArray:
        """Those of some steps of the grid at which any movement is within odometry's time."""
        last = len(self.own.known) - 1
        return np.asarray(steps[(steps >= -self.at.max()) & (steps <= last - self.at.min())])

    def single_errors(self, steps: IntArray) -> Iterator[FloatArray]:
        """Squared normalised errors of all movements at steps (K,), infinite where odometry is
        unknown, in blocks (k, M).
        """
        for own in np.array_split(steps, 1 + len(steps) * len(self.at) // _AT_ONCE):
            at = self.at + own[:, None]
            inside = (at >= 0) & (at < len(self.own.known))
            at = np.where(inside, at, 0)
            apart = self.values - self.own.values[at]
            known = inside & self.own.known[at]
            yield np.asarray(np.where(known, np.square(apart) @ self.weights, np.inf))

    def errors(self, steps: IntArray) -> FloatArray:
        """(K,) mean squared normalised errors at offsets `steps` (K,) of the grid; infinite where
        too few movements are compared.
        """
        sums = []
        for block in self.single_errors(steps):
            known = np.isfinite(block)
            sums.append([known.sum(axis=1), np.where(known, block, 0.0).sum(axis=1)])
        compared, total = np.concatenate(sums, axis=1)
        errors = total / np.maximum(compared, 1)
        enough = compared >= max(_FEWEST_SAMPLES, _COVERED * compared.max(initial=0))
        return np.asarray(np.where(enough, errors, np.inf))
