"""The rows of a file one after the other, each with its frame and its time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from landmarks import FrameTilt, Landmark, Step, read_rows
from landmarks.columns import TableName, Value, table_of, values_of
from landmarks.tilts import numbered_tilts


class TableRow(NamedTuple):
    """A row of a table: the number of its frame, the frame's prefix and time, and what follows."""

    table: TableName
    frame: int
    image: str
    time_s: float | None
    values: tuple[Value, ...]

    @property
    def all_values(self) -> tuple[Value, ...]:
        """The values of all columns."""
        return (self.frame, self.image, self.time_s, *self.values)


def table_rows(
    path: Path, times: Mapping[str, float] | None, rate_hz: float | None
) -> Iterator[TableRow]:
    """The rows of a landmark or tilt file.

    The times of frames are `times`, by their prefix, or follow from the frame rate, if known.
    """
    image, time_s = "", None
    for frame, record in _records(path):
        if isinstance(record, Step | FrameTilt):
            image = record.prefix
            if times is not None:
                time_s = times.get(image)
            elif rate_hz is not None:
                time_s = frame / rate_hz
        yield TableRow(table_of(record), frame, image, time_s, values_of(record))


def _records(path: Path) -> Iterator[tuple[int, Step | Landmark | FrameTilt]]:
    """The records of a file with the numbers of their frames."""
    if path.suffix == ".tilt":
        yield from numbered_tilts(path)
        return
    frame = -1
    for row in read_rows(path):
        if isinstance(row.record, Step | Landmark):
            frame += isinstance(row.record, Step)
            yield frame, row.record
