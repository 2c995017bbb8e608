"""Model of the robot's clock relative to the ground truth's: a straight line per segment.

Within a segment ``robot_time = time + offset + (rate - 1) (time - reference)``, `time` being the
ground truth's; between segments the offset is interpolated, before the first and after the last
their lines are extrapolated.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import read_json_value

Status = Literal["ok", "no turns", "jump", "at a bound"]

_MOST_SEGMENTS = 100_000
_LARGEST_RATE_ERROR = 0.5
_LARGEST_NUMBER = 1e15


@dataclass(frozen=True)
class ClockSegment:
    """The two clocks over one segment of the ground truth."""

    # `from_s`, `to_s`: The segment, on the ground truth's clock
    from_s: float
    to_s: float
    reference_s: float  # Where in it the offset holds, on the ground truth's clock
    offset_s: float = 0.0  # Robot time minus ground truth time there
    rate: float = 1.0  # Seconds of the robot's clock per second of the ground truth's
    angle_rad: float = 0.0  # Heading of the ground truth minus heading of the odometry
    # `sigma_offset_s`, `sigma_rate`, `sigma_angle_rad`: Standard deviations; infinite where the
    # segment does not determine the value.
    sigma_offset_s: float = math.inf
    sigma_rate: float = math.inf
    sigma_angle_rad: float = math.inf
    turned_rad: float = 0.0  # Sum of the absolute values of the robot's turns
    # `ok`; `no turns`: the segment cannot be synchronised, its numbers follow from the others;
    # `jump`: its two halves disagree, as where a clock was set; `at a bound`: the optimum is at the
    # limit of the search range.
    status: Status = "ok"
    note: str = ""  # Details of the status


@dataclass(frozen=True)
class ClockModel:
    """The robot's clock against the ground truth's over a session."""

    segments: tuple[ClockSegment, ...]  # In order; at least one whose offset is determined.

    def __post_init__(self) -> None:
        if not self.segments:
            raise GroundTruthError("a clock without segments: expected at least one")

    def robot_times(self, times_s: ArrayLike) -> FloatArray:
        """Robot times of times on the ground truth's clock."""
        knots, offsets = self._knots()
        times = np.asarray(times_s, dtype=np.float64)
        offset = np.interp(times, knots, offsets)
        first, last = self.segments[0], self.segments[-1]
        early, late = times < knots[0], times > knots[-1]
        offset[early] += (first.rate - 1.0) * (times[early] - knots[0])
        offset[late] += (last.rate - 1.0) * (times[late] - knots[-1])
        return np.asarray(times + offset)

    def groundtruth_times(self, robot_times_s: ArrayLike) -> FloatArray:
        """Times on the ground truth's clock of robot times: the inverse of `robot_times`."""
        knots, offsets = self._knots()
        robot = knots + offsets
        backward = np.flatnonzero(np.diff(robot) <= 0.0)
        if backward.size:
            i = int(backward[0])
            raise GroundTruthError(
                f"the robot's clock goes back between {knots[i]:.3f} s and {knots[i + 1]:.3f} s: "
                "its times are ambiguous there"
            )
        times = np.asarray(robot_times_s, dtype=np.float64)
        result = np.interp(times, robot, knots)
        first, last = self.segments[0], self.segments[-1]
        early, late = times < robot[0], times > robot[-1]
        result[early] = knots[0] + (times[early] - robot[0]) / first.rate
        result[late] = knots[-1] + (times[late] - robot[-1]) / last.rate
        return np.asarray(result)

    def _knots(self) -> tuple[FloatArray, FloatArray]:
        """The segments' ends and the offsets there."""
        knots, offsets = [], []
        for segment in self.segments:
            for time in (segment.from_s, max(segment.to_s, segment.from_s + 1e-9)):
                knots.append(time)
                offsets.append(
                    segment.offset_s + (segment.rate - 1.0) * (time - segment.reference_s)
                )
        return np.array(knots), np.array(offsets)


def clock_document(segments: Sequence[ClockSegment]) -> list[dict[str, Any]]:
    """Segments as written in a clock file: infinite deviations are null."""
    return [
        {
            name: None if isinstance(value, float) and math.isinf(value) else value
            for name, value in asdict(segment).items()
        }
        for segment in segments
    ]


def read_clock(path: str | os.PathLike[str]) -> ClockModel:
    """Read a clock file that `groundtruth sync` wrote.

    Raises
    ------
    GroundTruthError
        If the file cannot be read or a value is missing or impossible; the message names it.
    """
    place = Path(path)
    document = read_json_value(place)
    rows = document.get("segments") if isinstance(document, dict) else None
    if not isinstance(rows, list) or not 0 < len(rows) <= _MOST_SEGMENTS:
        raise GroundTruthError(f"{place}: no list of segments: expected what `sync` writes")
    segments = tuple(_segment(place, k, row) for k, row in enumerate(rows, 1))
    for k, (before, after) in enumerate(pairwise(segments), 2):
        if after.from_s < before.to_s:
            raise GroundTruthError(f"{place}: segment {k} begins before segment {k - 1} ends")
    return ClockModel(segments)


def _segment(place: Path, number: int, row: Any) -> ClockSegment:
    if not isinstance(row, dict):
        raise GroundTruthError(f"{place}: segment {number} is no object")
    values: dict[str, float] = {}
    names = [name for name in ClockSegment.__dataclass_fields__ if name not in ("status", "note")]
    for name in names:
        value = row.get(name)
        if value is None and name.startswith("sigma_"):
            value = math.inf
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise GroundTruthError(f"{place}: segment {number}: {name} is not a number")
        endless = value == math.inf and name.startswith("sigma_")
        # NaN fails this; a whole number may fit no double.
        if not (endless or abs(value) <= _LARGEST_NUMBER):
            raise GroundTruthError(f"{place}: segment {number}: {name} is not finite")
        values[name] = float(value)
    if not abs(values["rate"] - 1.0) < _LARGEST_RATE_ERROR:
        raise GroundTruthError(
            f"{place}: segment {number}: rate is {values['rate']:g}: expected nearly 1"
        )
    if values["to_s"] < values["from_s"]:
        raise GroundTruthError(f"{place}: segment {number}: it ends before it begins")
    status = row.get("status")
    if status not in ("ok", "no turns", "jump", "at a bound"):
        raise GroundTruthError(f"{place}: segment {number}: its status is unknown")
    note = row.get("note", "")
    return ClockSegment(**values, status=status, note=note if isinstance(note, str) else "")


_AGREEMENT = 0.999


def on_one_line(segments: Sequence[ClockSegment]) -> list[ClockSegment]:
    """Put segments on the straight line through all of them, if that agrees with each.

    A clock that is neither disciplined nor set runs evenly over minutes. Segments that are minutes
    apart then determine its rate much better than each alone, and its offset somewhat better. They
    stay as they are where fewer than two are determined, a clock was set, or one line does not
    explain them: its squared error is larger than one session in a thousand has by chance.
    """
    determined = [segment for segment in segments if segment.status == "ok"]
    others = {segment.status for segment in segments} - {"ok", "no turns"}
    if len(determined) < 2 or others:
        return list(segments)
    middle = float(np.mean([segment.reference_s for segment in determined]))
    rows, values, sigmas = [], [], []
    for segment in determined:
        rows += [(1.0, segment.reference_s - middle), (0.0, 1.0)]
        values += [segment.offset_s, segment.rate - 1.0]
        sigmas += [segment.sigma_offset_s, segment.sigma_rate]
    weight = 1.0 / np.array(sigmas)
    design = np.array(rows) * weight[:, None]
    target = np.array(values) * weight
    covariance = np.linalg.inv(design.T @ design)
    line = covariance @ design.T @ target
    squared = float(np.sum((target - design @ line) ** 2))
    freedom = len(values) - 2
    if squared > chdtri(freedom, 1.0 - _AGREEMENT):
        return list(segments)
    note = f"one line through {len(determined)} segments: chi2 {squared:.1f} of {freedom}"
    result = []
    for segment in segments:
        at = np.array([1.0, segment.reference_s - middle])
        if segment.status == "ok":
            segment = replace(
                segment,
                offset_s=float(at @ line),
                rate=1.0 + float(line[1]),
                sigma_offset_s=math.sqrt(at @ covariance @ at),
                sigma_rate=math.sqrt(covariance[1, 1]),
                note=note,
            )
        result.append(segment)
    return result
