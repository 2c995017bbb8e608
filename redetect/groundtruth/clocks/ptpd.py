"""Logs of ptpd: what the clocks' own synchronisation says about offset and drift.

Two layouts are read, as ptpd writes them: comma-separated statistics under a head that names the
columns, and debug messages, of which ``offset from master`` and ``observed drift`` count.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import StreamError
from redetect.storage.bounded import read_bounded

_LARGEST_FILE_BYTES = 1 << 28
_NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_OFFSET_MESSAGE = re.compile(
    r"offset from master:\s*([+-]?[0-9]{1,12})\s*s(?:ec)?\s+([+-]?[0-9]{1,12})\s*n"
)
_OFFSET_SECONDS = re.compile(rf"offset from master:\s*({_NUMBER})\s*(?:s\b|$)")
_DRIFT_MESSAGE = re.compile(rf"observed drift:\s*({_NUMBER})")
_LEADING_TIME = re.compile(rf"^\s*\[?({_NUMBER})\]?[\s,:]")
_CALENDAR = (
    "%Y-%m-%d %H:%M:%S.%f",
    "%Y-%m-%d %H:%M:%S",
    "%m/%d/%Y %H:%M:%S:%f",
    "%m/%d/%y %H:%M:%S:%f",
)
_PARTS_PER_BILLION = 1e-9
_OFFSET = "offset from master"


@dataclass(frozen=True, eq=False)
class PtpdLog:
    """Reports of ptpd."""

    times_s: FloatArray  # (N,): times of the reports (UTC seconds); NaN where the log has none.
    offset_s: FloatArray  # (N,): clock minus master
    # (N,): observed drift as a share (ptpd's parts per billion times 1e-9); NaN where not reported.
    drift: FloatArray


def read_ptpd(path: str | os.PathLike[str]) -> PtpdLog:
    """Read a log of ptpd.

    Raises
    ------
    StreamError
        If the file cannot be read, or no line of it reports an offset from the master.
    """
    rows = list(_rows(Path(path)))
    if not rows:
        raise StreamError(
            path, None, "no line reports an offset from master: expected a log of ptpd"
        )
    table = np.array(rows, dtype=np.float64)
    return PtpdLog(table[:, 0].copy(), table[:, 1].copy(), table[:, 2] * _PARTS_PER_BILLION)


def _rows(path: Path) -> Iterator[tuple[float, float, float]]:
    """Time, offset (s) and drift (ppb) of each report."""
    columns: dict[str, int] = {}
    pending: tuple[float, float] | None = None
    for line in _lines(path):
        lowered = line.lower()
        message = _OFFSET_MESSAGE.search(lowered)
        seconds = _OFFSET_SECONDS.search(lowered)
        drift = _DRIFT_MESSAGE.search(lowered)
        if message or seconds:
            if pending is not None:
                yield (*pending, math.nan)
            if message:
                offset = int(message[1]) + 1e-9 * int(message[2])
            else:
                assert seconds is not None
                offset = float(seconds[1])
            pending = (_leading_time(line), offset)
        elif drift:
            if pending is not None:
                yield (*pending, float(drift[1]))
            pending = None
        elif "offset from master" in lowered and "," in lowered:
            names = [name.strip(" #\t") for name in lowered.split(",")]
            found = {name: k for k, name in enumerate(names)}
            columns = found if _OFFSET in found else {}
        elif columns:
            row = _table_row(line, columns)
            if row is not None:
                yield row
    if pending is not None:
        yield (*pending, math.nan)


def _table_row(line: str, columns: dict[str, int]) -> tuple[float, float, float] | None:
    """A row of the comma-separated layout; None for states in which there is no offset."""
    words = [word.strip() for word in line.split(",")]
    at = columns[_OFFSET]
    if at >= len(words) or not re.fullmatch(_NUMBER, words[at]):
        return None
    time_at = columns.get("timestamp", len(words))
    time = _calendar_time(words[time_at]) if time_at < len(words) else math.nan
    drift_at = columns.get("observed drift", columns.get("drift"))
    drift = math.nan
    if drift_at is not None and drift_at < len(words) and re.fullmatch(_NUMBER, words[drift_at]):
        drift = float(words[drift_at])
    return time, float(words[at]), drift


def _leading_time(line: str) -> float:
    found = _LEADING_TIME.match(line)
    return float(found[1]) if found else math.nan


def _calendar_time(text: str) -> float:
    if re.fullmatch(_NUMBER, text):
        return float(text)
    for layout in _CALENDAR:
        try:
            return datetime.strptime(text, layout).replace(tzinfo=UTC).timestamp()
        except ValueError:
            continue
    return math.nan


def _lines(path: Path) -> Iterator[str]:
    try:
        text = read_bounded(path, _LARGEST_FILE_BYTES).decode("utf-8", errors="replace")
    except OSError as error:
        raise StreamError(path, None, f"cannot be read: {error.strerror}") from None
    yield from text.splitlines()
