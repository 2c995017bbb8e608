"""The command ``detect export``: rows in other programs' formats.

CSV has a header line, numbers in the shortest form that gives the same float64, and empty cells for
unknown values. Columns of Parquet (package ``pyarrow``) have units and descriptions. MCAP (package
``rosbags``; ROS is not needed) has standard messages of ROS 2 (`detect.ros_messages`).
"""

from __future__ import annotations

import codecs
import csv
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from detect.errors import DetectError
from detect.options import Export
from detect.ros_messages import TOPICS, ros_messages
from redetect.landmarks import FrameTilt, Landmark, Step, read_rows
from redetect.landmarks.columns import TABLE_OF, TABLES, TableName, Value, values_of
from redetect.landmarks.frame_files import numbered_tilts, read_times
from redetect.messages import counted, imported_for
from redetect.storage import demand_place, write_whole

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

# The table that each kind of file always has, even without rows.
_TABLES: dict[str, TableName] = {
    ".circles": "circles",
    ".lines": "lines",
    ".markers": "markers",
    ".tilt": "tilts",
    ".txt": "steps",
}
_OR_CSV = ", or write --to csv"

#: The values of a row's columns: number, prefix and time of the frame, then the table's own.
Row = tuple[Value, ...]


def perform(command: Export) -> int:
    """Export a file; returns the exit code."""
    file, to, rate_hz = command.file, command.to, command.rate_hz
    if file.is_dir():
        kinds = _TABLES.keys() - {".txt"}
        found = sorted(path.name for path in file.iterdir() if path.suffix in kinds)
        such = f", such as {', '.join(found)}" if found else ""
        raise DetectError(
            f"{file}: is a folder: expected a .circles, .lines, .markers or .tilt file{such}"
        )
    if file.suffix == ".cam":
        raise DetectError(
            f"{file}: is a calibration, not rows: camera convert {file} "
            "cameras.txt writes it for COLMAP (or for OpenCV, ROS, Kalibr)"
        )
    if rate_hz is not None and command.times is not None:
        raise DetectError("both --times and --rate-hz say when frames are: expected one of them")
    if to == "parquet":
        required_pyarrow()
    tables = read_tables(file, _times(command), rate_hz)
    if not tables:
        raise DetectError(f"{file}: contains no rows: expected STEP, LANDMARK or TILT rows")
    output = command.output or file.with_name(f"{file.name}.{to}")
    # The first table except steps is the output, others are beside it; MCAP is one file.
    first, *others = sorted(tables, key=lambda table: table == "steps")
    places = {first: output}
    if to != "mcap":
        places |= {t: output.with_name(f"{output.stem}.{t}{output.suffix}") for t in others}
    for path in places.values():
        if path.exists() and path.samefile(file):
            raise DetectError(f"{path}: is the file to export: expected a different output")
        demand_place(path, overwrite=command.force)
    for table, path in places.items():
        with write_whole(path, overwrite=command.force) as stream:
            written = counted(len(tables[table]), "row")
            if to == "mcap":
                written = counted(write_mcap(stream, tables, str(file)), "message")
            elif to == "csv":
                write_csv(stream, table, tables[table])
            else:
                write_parquet(stream, table, tables[table], file.name)
        print(f"{path}: {written}")
    return 0


def _times(command: Export) -> dict[str, float] | None:
    names = command.file.name, command.file.stem
    beside = [command.file.with_name(f"{name}.times") for name in names]
    found = [] if command.rate_hz is not None else [path for path in beside if path.is_file()]
    path = command.times or next(iter(found), None)
    return None if path is None else read_times(path)


def read_tables(
    path: Path, times: Mapping[str, float] | None, rate_hz: float | None
) -> dict[TableName, list[Row]]:
    """The tables of a landmark or tilt file; the first is implied by its name, and may be empty.

    The times of frames are from `times`, by prefix, or from the frame rate, if known.
    """
    named = _TABLES.get(path.suffix)
    tables: dict[TableName, list[Row]] = {} if named is None else {named: []}
    image, time_s = "", None
    for frame, record in _records(path):
        if isinstance(record, Step | FrameTilt):
            image = record.prefix
            if times is not None:
                time_s = times.get(image)
            elif rate_hz is not None:
                time_s = frame / rate_hz
        row = (frame, image, time_s, *values_of(record))
        tables.setdefault(TABLE_OF[type(record)], []).append(row)
    return dict(sorted(tables.items(), key=lambda table: (table[0] != named, table[0])))


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


def write_csv(stream: BinaryIO, table: TableName, rows: Sequence[Row]) -> None:
    """Write a table."""
    text = codecs.getwriter("utf-8")(stream, "surrogateescape")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(column.name for column in TABLES[table])
    writer.writerows(
        [" ".join(map(str, value)) if isinstance(value, tuple) else value for value in row]
        for row in rows
    )


def required_pyarrow() -> Any:
    """The package; a DetectError if it is not installed."""
    with imported_for("Parquet is written by the package pyarrow", "parquet", DetectError, _OR_CSV):
        import pyarrow.parquet  # type: ignore[import-untyped]
    return pyarrow


def write_parquet(stream: BinaryIO, table: TableName, rows: Sequence[Row], source: str) -> None:
    """Write a table like `write_csv`; `source` is stored in the file's description."""
    pa = required_pyarrow()
    types: dict[str, Any] = {
        "text": pa.string(),
        "number": pa.float64(),
        "whole number": pa.int64(),
        "whole numbers": pa.list_(pa.int64()),
    }
    fields = [
        pa.field(c.name, types[c.kind], metadata={"unit": c.unit, "meaning": c.meaning})
        for c in TABLES[table]
    ]
    columns = list(zip(*rows)) or [()] * len(fields)
    try:
        schema = pa.schema(fields, metadata={"table": table, "source": source})
        arrays = [pa.array(column, field.type) for column, field in zip(columns, fields)]
    except UnicodeEncodeError:
        raise DetectError(
            f"{source}: its name, or that of an image, is not valid Unicode, as Parquet needs it"
        ) from None
    pa.parquet.write_table(pa.Table.from_arrays(arrays, schema=schema), stream)


def write_mcap(stream: BinaryIO, tables: Mapping[TableName, Sequence[Row]], source: str) -> int:
    """Write the messages of each frame, at its time; returns their number."""
    with imported_for("MCAP is written by the package rosbags", "bags", DetectError, _OR_CSV):
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    store = get_typestore(Stores.ROS2_HUMBLE)
    frames = {row[:3]: {table: list[Row]() for table in tables} for row in chain(*tables.values())}
    for table, rows in tables.items():
        for row in rows:
            frames[row[:3]][table].append(row[3:])
    timed = [
        (_nanoseconds(image, time_s, source), found)
        for (_, image, time_s), found in sorted(frames.items())
    ]
    written = 0
    with tempfile.TemporaryDirectory(prefix="redetect-") as folder:
        bag = Path(folder) / "detections"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections = {
                topic: writer.add_connection(topic, message_type, typestore=store)
                for table in tables
                for topic, message_type in TOPICS[table].items()
            }
            for time_ns, topic, message in ros_messages(partial(_message, store), timed):
                content = store.serialize_cdr(message, message.__msgtype__)
                writer.write(connections[topic], time_ns, content)
                written += 1
        stream.write((bag / "detections.mcap").read_bytes())
    return written


def _message(store: Typestore, kind: str, **fields: Any) -> Any:
    """A message of a type in the store; missing fields are zero or empty."""
    _, descriptions = store.fielddefs[kind]
    empty = {name: _empty(store, of) for name, (_, of) in descriptions if name not in fields}
    return store.types[kind](**empty, **fields)


def _empty(store: Typestore, kind: Any) -> Any:
    """The default value of a field of some kind: message, number or text, or array."""
    if isinstance(kind, str):
        return _message(store, kind)
    element, _ = kind
    if isinstance(element, str):
        return "" if element == "string" else 0
    return [] if isinstance(element[1], str) else np.zeros(0, np.uint8)


def _nanoseconds(image: Value, time_s: Value, source: str) -> int:
    """The time of a message about an image."""
    if not isinstance(time_s, float):
        raise DetectError(
            f"{source}: no time for {image}: messages need one: give --times (a file of "
            "rows 'prefix seconds') or --rate-hz"
        )
    if not 0.0 <= time_s < 2.0**31:
        raise DetectError(f"{source}: {image} is from {time_s:g} s: expected 0 to 2^31 s")
    return round(time_s * 1e9)
