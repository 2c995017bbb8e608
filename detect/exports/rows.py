"""The rows of a file one after the other, each with its frame and its time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from detect.errors import DetectError
from landmarks import FrameTilt, Landmark, Step, read_rows
from landmarks.columns import TableName, Value, table_of, values_of
from landmarks.tilts import numbered_tilts

# Which table a file of a kind has rows of, even where there are none.
_TABLE_BY_SUFFIX: dict[str, TableName] = {
    ".circles": "circles",
    ".lines": "lines",
    ".markers": "markers",
    ".tilt": "tilts",
    ".txt": "steps",
}


@dataclass(frozen=True, slots=True)
class TableRow:
    """A row of a table.

    Attributes
    ----------
    table : str
    frame : int
        The frame's number in its file.
    image : str
        Its prefix.
    time_s : float or None
    values : tuple
        The values of the columns after those.
    """

    table: TableName
    frame: int
    image: str
    time_s: float | None
    values: tuple[Value, ...]

    @property
    def all_values(self) -> tuple[Value, ...]:
        """The values of all columns."""
        return (self.frame, self.image, self.time_s, *self.values)


class ExportedRows:
    """The rows of a landmark or tilt file; iterating again starts over.

    Parameters
    ----------
    path : path
    times : mapping or None
        Times by image prefix.
    rate_hz : float or None
        Frames in a second, where there are no times.

    Raises
    ------
    DetectError
        If the rate is none.
    """

    def __init__(
        self, path: Path, times: Mapping[str, float] | None, rate_hz: float | None
    ) -> None:
        if rate_hz is not None and not 0.0 < rate_hz < float("inf"):
            raise DetectError(f"rate_hz is {rate_hz:g}: expected above 0")
        self.path = path
        self._times = times
        self._rate_hz = rate_hz

    def __iter__(self) -> Iterator[TableRow]:
        image, time_s = "", None
        for frame, record in self._records():
            if isinstance(record, Step | FrameTilt):
                image = record.prefix
                if self._times is not None:
                    time_s = self._times.get(image)
                elif self._rate_hz is not None:
                    time_s = frame / self._rate_hz
            yield TableRow(table_of(record), frame, image, time_s, values_of(record))

    def tables(self) -> list[TableName]:
        """The tables that the file has rows of, the one that its ending names first."""
        found = sorted({row.table for row in self})
        named = _TABLE_BY_SUFFIX.get(self.path.suffix)
        return found if named is None else [named, *(t for t in found if t != named)]

    def _records(self) -> Iterator[tuple[int, Step | Landmark | FrameTilt]]:
        """The records with the numbers of their frames."""
        if self.path.suffix == ".tilt":
            yield from numbered_tilts(self.path)
            return
        frame = -1
        for row in read_rows(self.path):
            if isinstance(row.record, Step | Landmark):
                frame += isinstance(row.record, Step)
                yield frame, row.record
