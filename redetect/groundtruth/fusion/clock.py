"""Model of the robot's clock relative to the ground truth's: a straight line per segment.

Within a segment ``robot_time = time + offset + (rate - 1) (time - reference)``, `time` being the
ground truth's; between segments the offset is interpolated, before the first and after the last
their lines are extrapolated.

Logs of ptpd contain offset and drift from the clocks' own synchronisation. Two layouts are read:
comma-separated statistics under a head with the names of the columns, and debug messages, of which
``offset from master`` and ``observed drift`` are used.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import StrEnum
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from redetect.array_types import FloatArray
from redetect.bounds import NOT_NEGATIVE, NUMBER, from_to, inside
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import JsonObject, PathLike
from redetect.storage.bounded import read_content

#: A rate is nearly 1, which is above 0.5 and below 1.5; times are seconds since 1970 at most.
_RATE, _SECONDS, _SIGMA = inside(0.5, 1.5), from_to(-1e15, 1e15), NOT_NEGATIVE
# Confidence level of the chi-square test that all segments lie on one line.
_AGREEMENT = 0.999
_LARGEST_FILE_BYTES = 1 << 28
# Messages, column and times in logs of ptpd.
_OFFSET_MESSAGE = re.compile(
    rf"offset from master:\s*({NUMBER})\s*(?:s(?:ec)?\s+([+-]?[0-9]{{1,12}})\s*n|s\b|$)"
)
_DRIFT_MESSAGE = re.compile(rf"observed drift:\s*({NUMBER})")
_LEADING_TIME = re.compile(rf"^\s*\[?({NUMBER})\]?(?:[\s,]|:(?![0-9]))")
_CALENDAR = (
    "%Y-%m-%d %H:%M:%S.%f",
    "%Y-%m-%d %H:%M:%S",
    "%m/%d/%Y %H:%M:%S:%f",
    "%m/%d/%y %H:%M:%S:%f",
)
_OFFSET = "offset from master"
_PARTS_PER_BILLION = 1e-9
# Segments of a single pose are this long, so that their ends differ in doubles since 1970, too.
_LEAST_LENGTH_S = 1e-6
# Least step of a clock between segments that is looked for in a gap of its times.
_LEAST_STEP_S = 0.5


class ClockStatus(StrEnum):
    """How the clocks over a segment were found."""

    OK = "ok"
    NO_TURNS = "no turns"  #: It cannot be synchronised: its numbers follow from the others
    JUMP = "jump"  #: Its two halves disagree, since a clock was set
    AT_A_BOUND = "at a bound"  #: Not synchronised either: the optimum is at a limit of the search


@dataclass(frozen=True)
class ClockSegment:
    """The two clocks over one segment of the ground truth."""

    from_s: float  # Start and end of the segment, on the ground truth's clock
    to_s: float
    reference_s: float  # Time for which the offset holds, on the ground truth's clock
    offset_s: float = 0.0  # Robot time minus ground truth time there
    rate: float = 1.0  # Seconds of the robot's clock per second of the ground truth's
    angle_rad: float = 0.0  # Heading of the ground truth minus heading of the odometry
    sigma_offset_s: float = math.inf  # Standard deviations; infinite if not determined
    sigma_rate: float = math.inf
    turned_rad: float = 0.0  # Sum of the absolute values of the robot's turns
    status: ClockStatus = ClockStatus.OK
    note: str = ""  # Details of the status
    own_offset_s: float | None = None  # From the segment alone, if one line replaced these two
    own_sigma_s: float | None = None

    @property
    def is_determined(self) -> bool:
        """Whether its numbers are its own."""
        return self.status not in (ClockStatus.NO_TURNS, ClockStatus.AT_A_BOUND)


@dataclass(frozen=True)
class ClockModel:
    """The robot's clock against the ground truth's over a session."""

    segments: tuple[ClockSegment, ...]  # In order; at least one whose offset is determined.

    def robot_times(self, times_s: ArrayLike) -> FloatArray:
        """Convert times on the ground truth's clock to robot times."""
        knots, offsets = knots_of(self.segments)
        times = np.asarray(times_s, dtype=np.float64)
        drifts = (self.segments[0].rate - 1.0, self.segments[-1].rate - 1.0)
        return times + _extended(times, knots, offsets, drifts)

    def groundtruth_times(self, robot_times_s: ArrayLike) -> FloatArray:
        """Convert robot times to the ground truth's clock, the inverse of `robot_times`.

        If the clock was set forward between two segments, and the robot times, in order, have a gap
        of that length there, it was set in the gap.
        """
        knots, offsets = knots_of(self.segments)
        robot = knots + offsets
        backward = np.flatnonzero(np.diff(robot) <= 0.0)
        if backward.size:
            i = int(backward[0])
            raise GroundTruthError(
                f"the robot's clock goes back between {knots[i]:.3f} s and {knots[i + 1]:.3f} s: "
                "its times are ambiguous there"
            )
        times = np.asarray(robot_times_s, dtype=np.float64)
        knots, robot = _with_steps(knots, robot, times)
        slopes = (1.0 / self.segments[0].rate, 1.0 / self.segments[-1].rate)
        return _extended(times, robot, knots, slopes)


def _with_steps(
    knots: FloatArray, robot: FloatArray, times: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Knots on both clocks, with those beside gaps of robot times in which the clock was set."""
    added: list[tuple[float, float]] = []
    for i in range(1, len(knots) - 1, 2):
        before, after = robot[i] - knots[i], robot[i + 1] - knots[i + 1]
        own = times[(times > robot[i]) & (times < robot[i + 1])]
        if after - before < _LEAST_STEP_S or len(own) < 2:
            continue
        at = int(np.argmax(np.diff(own)))
        if own[at + 1] - own[at] > after - before:
            added += [(own[at] - before, own[at]), (own[at + 1] - after, own[at + 1])]
    both = np.concatenate([np.column_stack([knots, robot]), np.reshape(added, (-1, 2))])
    both = both[np.argsort(both[:, 0], kind="stable")]
    return both[:, 0], both[:, 1]


def knots_of(segments: Sequence[ClockSegment]) -> tuple[FloatArray, FloatArray]:
    """The ends of segments and the offsets there."""
    ends = [
        (time, segment.offset_s + (segment.rate - 1.0) * (time - segment.reference_s))
        for segment in segments
        for time in (segment.from_s, max(segment.to_s, segment.from_s + _LEAST_LENGTH_S))
    ]
    times, offsets = np.array(ends).T
    return times, offsets


def _extended(
    at: FloatArray, knots: FloatArray, values: FloatArray, slopes: tuple[float, float]
) -> FloatArray:
    """Values between knots, and beyond the first and the last along straight lines."""
    before, after = np.minimum(at - knots[0], 0.0), np.maximum(at - knots[-1], 0.0)
    beyond = slopes[0] * before + slopes[1] * after
    return np.asarray(np.interp(at, knots, values) + beyond)


def read_clock(path: PathLike) -> ClockModel:
    """Read a clock file that `groundtruth sync` wrote.

    Raises `GroundTruthError` if the file cannot be read or a value is missing or impossible; the
    message names it.
    """
    rows = JsonObject.read(path).rows("segments")
    segments = tuple(map(_segment, rows))
    for row, (before, after) in zip(rows[1:], pairwise(segments)):
        if after.from_s < before.to_s:
            raise GroundTruthError(f"{row.place}: begins before the one before it ends")
    return ClockModel(segments)


def _segment(row: JsonObject) -> ClockSegment:
    values: dict[str, Any] = {}
    for name in ClockSegment.__dataclass_fields__:
        if name.startswith("own_"):
            if row.values.get(name) is not None:
                values[name] = row.number(name)
        elif name.startswith("sigma_"):
            # Infinite where the segment does not determine it, which JSON cannot say.
            known = row.values.get(name) not in (None, math.inf)
            values[name] = row.number(name, _SIGMA) if known else math.inf
        elif name not in ("status", "note"):
            values[name] = row.number(name, _RATE if name == "rate" else _SECONDS)
    if values["to_s"] < values["from_s"]:
        raise row.wrong("to_s", "it not to end before it begins")
    if (status := row.text("status")) not in list(ClockStatus):
        raise row.wrong("status", f"one of {', '.join(ClockStatus)}")
    note = row.values.get("note", "")
    note = note if isinstance(note, str) else ""
    return ClockSegment(**values, status=ClockStatus(status), note=note)


def on_one_line(segments: Sequence[ClockSegment]) -> list[ClockSegment]:
    """Put segments on the straight line through all of them, if that agrees with each.

    A clock that is neither disciplined nor set has a constant rate over minutes. Segments that are
    minutes apart then determine its rate much better than each alone, and its offset somewhat
    better. They are unchanged if fewer than two are determined, a clock was set, or one line does
    not explain them: its squared error has a probability below one in a thousand.
    """
    determined = [segment for segment in segments if segment.status == ClockStatus.OK]
    others = {segment.status for segment in segments} - {ClockStatus.OK, ClockStatus.NO_TURNS}
    if len(determined) < 2 or others:
        return list(segments)
    middle = float(np.mean([segment.reference_s for segment in determined]))
    rows: list[tuple[float, ...]] = []  # Derivatives by the line, value, sigma
    for s in determined:
        rows.append((1.0, s.reference_s - middle, s.offset_s, s.sigma_offset_s))
        rows.append((0.0, 1.0, s.rate - 1.0, s.sigma_rate))
    table = np.array(rows)
    weight = 1.0 / table[:, 3]
    design, target = table[:, :2] * weight[:, None], table[:, 2] * weight
    covariance = np.linalg.inv(design.T @ design)
    line = covariance @ design.T @ target
    squared = float(np.sum((target - design @ line) ** 2))
    dof = len(rows) - 2
    if squared > chdtri(dof, 1.0 - _AGREEMENT):
        return list(segments)
    note = f"one line through {len(determined)} segments: chi2 {squared:.1f} of {dof}"
    result = []
    for segment in segments:
        at = np.array([1.0, segment.reference_s - middle])
        if segment.status == ClockStatus.OK:
            segment = replace(
                segment,
                offset_s=float(at @ line),
                rate=1.0 + float(line[1]),
                sigma_offset_s=math.sqrt(at @ covariance @ at),
                sigma_rate=math.sqrt(covariance[1, 1]),
                note=note,
                own_offset_s=segment.offset_s,
                own_sigma_s=segment.sigma_offset_s,
            )
        result.append(segment)
    return result


@dataclass(frozen=True, eq=False)
class PtpdLog:
    """Reports of ptpd."""

    times_s: FloatArray  # (N,): times of the reports (UTC seconds); NaN where the log has none.
    offset_s: FloatArray  # (N,): clock minus master
    drift: FloatArray  # (N,): observed drift as a share; NaN where not reported


def compare_with_ptpd(model: ClockModel, log: PtpdLog) -> dict[str, float | int | None]:
    """Compare the clocks estimated from headings with ptpd's reports on the robot's clock.

    Returns the number of reports, and of those in determined segments, the rms difference of their
    offsets from the model's (s), the mean drift of both, and the residual of ptpd's offsets about
    the best straight line (s). None if undefined.
    """
    determined = [segment for segment in model.segments if segment.is_determined]
    timed = np.isfinite(log.times_s)
    times, offsets = log.times_s[timed], log.offset_s[timed]
    groundtruth = times - offsets
    within = np.zeros(len(times), dtype=np.bool_)
    bends = []
    for segment in determined:
        here = (groundtruth >= segment.from_s) & (groundtruth <= segment.to_s)
        within |= here
        if np.count_nonzero(here) >= 3:
            t = groundtruth[here] - segment.reference_s
            bends.append(offsets[here] - np.polyval(np.polyfit(t, offsets[here], 1), t))
    expected = model.robot_times(groundtruth[within]) - groundtruth[within]
    drift = log.drift[np.isfinite(log.drift)]
    return {
        "reports": len(log.offset_s),
        "reports_in_segments": int(np.count_nonzero(within)),
        "rms_difference_s": _rms(offsets[within] - expected),
        "mean_drift_ptpd": float(np.mean(drift)) if drift.size else None,
        "mean_drift_headings": float(np.mean([segment.rate - 1.0 for segment in determined])),
        "rms_from_line_s": _rms(np.concatenate(bends)) if bends else None,
    }


def _rms(values: Any) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def read_ptpd(path: PathLike) -> PtpdLog:
    """Read a log of ptpd.

    Raises `GroundTruthError` if the file cannot be read, or reports no offset from the master.
    """
    rows: list[list[float]] = []  # Time, offset (s) and drift (ppb) of each report
    columns: dict[str, int] = {}
    content = read_content(path, _LARGEST_FILE_BYTES, "log of ptpd", GroundTruthError)
    for line in content.decode(errors="replace").splitlines():
        lowered = line.lower()
        if message := _OFFSET_MESSAGE.search(lowered):
            time = _LEADING_TIME.match(line)
            offset = float(message[1]) + 1e-9 * int(message[2] or 0)
            rows.append([float(time[1]) if time else math.nan, offset, math.nan])
        elif drift := _DRIFT_MESSAGE.search(lowered):
            # The drift follows the offset of the same report.
            if rows and math.isnan(rows[-1][2]):
                rows[-1][2] = float(drift[1])
        elif _OFFSET in lowered and "," in lowered:
            found = {name.strip(" #\t"): k for k, name in enumerate(lowered.split(","))}
            columns = found if _OFFSET in found else {}
        elif columns:
            words = [word.strip() for word in line.split(",")]
            named = {name: words[at] for name, at in columns.items() if at < len(words)}
            # There is none in some states.
            if not math.isnan(offset := _number(named.get(_OFFSET, ""))):
                share = _number(named.get("observed drift", named.get("drift", "")))
                rows.append([_time(named.get("timestamp", "")), offset, share])
    if not rows:
        raise GroundTruthError(
            f"{path}: no line reports an offset from master: expected a log of ptpd"
        )
    table = np.array(rows, dtype=np.float64)
    return PtpdLog(table[:, 0].copy(), table[:, 1].copy(), table[:, 2] * _PARTS_PER_BILLION)


def _number(word: str) -> float:
    return float(word) if re.fullmatch(NUMBER, word) else math.nan


def _time(text: str) -> float:
    """Seconds since 1970 of a number, or of a date and time; NaN for anything else."""
    for layout in _CALENDAR:
        try:
            return datetime.strptime(text, layout).replace(tzinfo=UTC).timestamp()
        except ValueError:
            continue
    return _number(text)
