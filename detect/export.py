"""The command ``detect export``: rows in other programs' formats.

CSV has a line of names at the top, the shortest numbers that give the same float64, empty cells for
unknown values. Columns of Parquet (package ``pyarrow``) have units and descriptions. MCAP (package
``rosbags``; no ROS is needed) has a message for each frame and table; the messages' definitions
follow from the tables' columns (`message_definitions`) and are in the file.
"""

from __future__ import annotations

import codecs
import csv
import math
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from itertools import groupby, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np

from detect.errors import DetectError
from detect.sources.interface import read_image_times
from detect.viewing_options import Export
from redetect.landmarks import FrameTilt, Landmark, Step, read_rows
from redetect.landmarks.columns import FRAME_COLUMNS, TABLES, TableName, Value, table_of, values_of
from redetect.landmarks.tilts import numbered_tilts
from redetect.storage import demand_place, write_whole

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

# Which table a file of a kind has rows of, even where there are none.
_TABLES: dict[str, TableName] = {
    ".circles": "circles",
    ".lines": "lines",
    ".markers": "markers",
    ".tilt": "tilts",
    ".txt": "steps",
}


def perform(command: Export) -> int:
    """Export a file; returns the exit code."""
    file, to, rate_hz = command.file, command.to, command.rate_hz
    if file.is_dir():
        kinds = _TABLES.keys() - {".txt"}
        found = sorted(path.name for path in file.iterdir() if path.suffix in kinds)
        such = f", such as {', '.join(found)} in it" if found else ""
        raise DetectError(
            f"{file}: is a folder: expected a .circles, .lines, .markers or .tilt file{such}"
        )
    if file.suffix == ".cam":
        raise DetectError(
            f"{file}: is a calibration, not rows: camera convert {file} "
            "cameras.txt writes it for COLMAP (or for OpenCV, ROS, Kalibr)"
        )
    if rate_hz is not None and not 0.0 < rate_hz < math.inf:
        raise DetectError(f"rate_hz is {rate_hz:g}: expected above 0")
    if to == "parquet":
        required_pyarrow()
    rows = partial(table_rows, file, _times(command), rate_hz)
    named = [_TABLES[file.suffix]] if file.suffix in _TABLES else []
    tables = list(dict.fromkeys([*named, *sorted({row.table for row in rows()})]))
    if not tables:
        raise DetectError(f"{file}: no rows in it: expected STEP, LANDMARK or TILT rows")
    output = command.output or file.with_name(f"{file.name}.{to}")
    places = {tables[0]: output} if to == "mcap" else _table_files(output, tables)
    for path in places.values():
        if path.exists() and path.samefile(file):
            raise DetectError(f"{path}: is the file to export: expected another output")
        demand_place(path, overwrite=command.force)
    for table, path in places.items():
        with write_whole(path, overwrite=command.force) as stream:
            if to == "mcap":
                count = write_mcap(stream, tables, rows(), str(file))
            elif to == "csv":
                count = write_csv(stream, table, rows())
            else:
                count = write_parquet(stream, table, rows(), file.name)
        print(f"{path}: {count} {'messages' if to == 'mcap' else 'rows'}")
    return 0


def _table_files(output: Path, tables: list[TableName]) -> dict[TableName, Path]:
    """The file of each table: the first but steps goes to `output`, others beside it."""
    first, *others = sorted(tables, key=lambda table: table == "steps")
    beside = {table: output.with_name(f"{output.stem}.{table}{output.suffix}") for table in others}
    return {first: output, **beside}


def _times(command: Export) -> dict[str, float] | None:
    if command.times is not None:
        return read_image_times(command.times)
    if command.rate_hz is not None:
        return None
    for name in (f"{command.file.name}.times", f"{command.file.stem}.times"):
        beside = command.file.with_name(name)
        if beside.is_file():
            return read_image_times(beside)
    return None


#: The robot frame of the data set, X left and Y backward: not ROS's base_link.
FRAME_ID = "robot_left_backward"

_ROWS_AT_ONCE = 20_000
_PACKAGE = "redetect_msgs/msg"
_TYPES = {
    "text": "string",
    "number": "float64",
    "whole number": "int64",
    "whole numbers": "int64[]",
}


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


def write_csv(stream: BinaryIO, table: TableName, rows: Iterable[TableRow]) -> int:
    """Write a table; rows of other tables are passed over. Returns how many rows were written."""
    text = codecs.getwriter("utf-8")(stream, "surrogateescape")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(column.name for column in TABLES[table])
    count = 0
    for row in rows:
        if row.table == table:
            writer.writerow(
                " ".join(map(str, value)) if isinstance(value, tuple) else value
                for value in row.all_values
            )
            count += 1
    return count


def required_pyarrow() -> Any:
    """The package; a DetectError where it is not installed."""
    try:
        import pyarrow.parquet  # type: ignore[import-untyped]
    except ImportError:
        raise DetectError(
            "Parquet is written by the package pyarrow: install it by "
            "pip install 'redetect[parquet]', or write --to csv"
        ) from None
    return pyarrow


def write_parquet(stream: BinaryIO, table: TableName, rows: Iterable[TableRow], source: str) -> int:
    """Write a table as `write_csv`; `source` is for the file's own description."""
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
    schema = pa.schema(fields, metadata={"table": table, "source": source})
    own = (row.all_values for row in rows if row.table == table)
    count = 0
    with pa.parquet.ParquetWriter(stream, schema) as writer:
        while part := list(islice(own, _ROWS_AT_ONCE)):
            try:
                arrays = [pa.array(c, f.type) for c, f in zip(zip(*part), fields)]
            except UnicodeEncodeError:
                raise DetectError(
                    f"{source}: the name of an image is no Unicode: Parquet cannot hold it"
                ) from None
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
            count += len(part)
        if not count:
            writer.write_table(schema.empty_table())
    return count


def message_definitions(table: TableName) -> dict[str, str]:
    """The definitions of a table's messages, by their names, in ROS's own notation."""
    row, frame = _message_types(table)
    columns = TABLES[table][len(FRAME_COLUMNS) :]
    return {
        row: "".join(
            f"{_TYPES[c.kind]} {c.name}  # {f'{c.unit}: ' if c.unit else ''}{c.meaning}\n"
            for c in columns
        ),
        frame: (
            f"std_msgs/Header header  # time of the image; frame_id {FRAME_ID}\n"
            f"int64 frame  # {FRAME_COLUMNS[0].meaning}\n"
            f"string image  # {FRAME_COLUMNS[1].meaning}\n"
            f"{row.replace('/msg', '')}[] {table}\n"
        ),
    }


def topic_of(table: TableName) -> str:
    """The topic that a table's messages are recorded under."""
    return f"/redetect/{table}"


def write_mcap(
    stream: BinaryIO, tables: list[TableName], rows: Iterable[TableRow], source: str
) -> int:
    """Write rows, those of a frame consecutive, as messages; returns how many."""
    store = _typestore()
    from rosbags.rosbag2 import StoragePlugin, Writer

    count = 0
    with tempfile.TemporaryDirectory(prefix="redetect-") as folder:
        bag = Path(folder) / "detections"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections = {
                table: writer.add_connection(
                    topic_of(table), _message_types(table)[1], typestore=store
                )
                for table in tables
            }
            for table, time_ns, message in _messages(rows, tables, store, source):
                content = store.serialize_cdr(message, message.__msgtype__)
                writer.write(connections[table], time_ns, content)
                count += 1
        with (bag / "detections.mcap").open("rb") as written:
            shutil.copyfileobj(written, stream)
    return count


def _messages(
    rows: Iterable[TableRow], tables: list[TableName], store: Typestore, source: str
) -> Iterator[tuple[TableName, int, Any]]:
    """A message for each frame and table, also where a frame has no rows of it."""
    types = store.types
    for frame, of_frame in groupby(rows, key=lambda row: row.frame):
        found = list(of_frame)
        image, time_s = found[0].image, found[0].time_s
        if time_s is None:
            raise DetectError(
                f"{source}: no time of {image}: messages need one: name a file of rows "
                "'prefix seconds' by --times, or give --rate-hz"
            )
        time_ns = round(time_s * 1e9)
        if not 0 <= time_ns < 2**31 * 10**9:
            raise DetectError(f"{source}: {image} is from {time_s:g} s: expected 0 to 2^31 s")
        stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=FRAME_ID)
        for table in tables:
            row_type, frame_type = (types[name] for name in _message_types(table))
            content = [row_type(*map(_ros_value, r.values)) for r in found if r.table == table]
            yield table, time_ns, frame_type(header, frame, _ros_value(image), content)


def _message_types(table: TableName) -> tuple[str, str]:
    """The types of a row and of a frame's message, such as Circle and Circles."""
    name = table.capitalize()
    return f"{_PACKAGE}/{name.removesuffix('s')}", f"{_PACKAGE}/{name}"


def _ros_value(value: Value) -> Any:
    if isinstance(value, tuple):
        return np.array(value, dtype=np.int64)
    if isinstance(value, str):
        return value.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    return value


def _typestore() -> Typestore:
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise DetectError(
            "MCAP is written by the package rosbags: install it by "
            "pip install 'redetect[bags]', or write --to csv"
        ) from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    for table in TABLES:
        for name, definition in message_definitions(table).items():
            store.register(get_types_from_msg(definition, name))
    return store
