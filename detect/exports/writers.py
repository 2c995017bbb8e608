"""Tables in other programs' formats: CSV, Parquet, and messages of ROS 2 in an MCAP file.

CSV is comma separated, with a line of names at the top, numbers as Python prints them: the shortest
text that gives the same float64; unknown values are empty; several identifiers are separated by
blanks. Columns of Parquet (package ``pyarrow``) have units and descriptions. MCAP (package
``rosbags``; no ROS is needed) has a message for each frame and table; the messages' definitions
follow from the tables' columns (`message_definitions`) and are in the file, so that readers need
none of this project's.
"""

from __future__ import annotations

import csv
import io
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from itertools import groupby, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from detect.errors import DetectError
from detect.exports.rows import TableRow
from landmarks.columns import FRAME_COLUMNS, TABLES, Column, TableName, Value

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_ROWS_AT_ONCE = 20_000

#: The robot frame of the data set, X left and Y backward: not ROS's base_link.
FRAME_ID = "robot_left_backward"

_PACKAGE = "redetect_msgs"
# Message of one row, message of a frame, topic.
_NAMES: dict[TableName, tuple[str, str, str]] = {
    "steps": ("Step", "Steps", "/redetect/steps"),
    "circles": ("Circle", "Circles", "/redetect/circles"),
    "lines": ("Line", "Lines", "/redetect/lines"),
    "markers": ("Marker", "Markers", "/redetect/markers"),
    "tilts": ("Tilt", "Tilts", "/redetect/tilts"),
}
_TYPES = {
    "text": "string",
    "number": "float64",
    "whole number": "int64",
    "whole numbers": "int64[]",
}


def write_csv(stream: BinaryIO, table: TableName, rows: Iterable[TableRow]) -> int:
    """Write a table.

    Parameters
    ----------
    stream : binary stream
    table : str
        Which table; rows of others are passed over.
    rows : iterable of TableRow

    Returns
    -------
    int
        How many rows were written.
    """

    def write(lines: Iterable[Iterable[str]]) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(lines)
        stream.write(text.getvalue().encode("utf-8", "surrogateescape"))

    write([[column.name for column in TABLES[table]]])
    count = 0
    for part in _parts(table, rows):
        write([[_text(value) for value in row] for row in part])
        count += len(part)
    return count


def _parts(table: TableName, rows: Iterable[TableRow]) -> Iterator[list[tuple[Value, ...]]]:
    """The values of a table's rows, many at once."""
    own = (row.all_values for row in rows if row.table == table)
    while part := list(islice(own, _ROWS_AT_ONCE)):
        yield part


def _text(value: Value) -> str:
    if value is None:
        return ""
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    return repr(value) if isinstance(value, float) else str(value)


def demand_pyarrow() -> None:
    """Refuse to begin where the package is not installed.

    Raises
    ------
    DetectError
        If it is not.
    """
    try:
        import pyarrow.parquet  # type: ignore[import-untyped]  # noqa: F401
    except ImportError:
        raise DetectError(
            "Parquet is written by the package pyarrow: install it by "
            "pip install 'redetect[parquet]', or write --to csv"
        ) from None


def write_parquet(stream: BinaryIO, table: TableName, rows: Iterable[TableRow], source: str) -> int:
    """Write a table; parameters as those of `write_csv`.

    Parameters
    ----------
    stream, table, rows
        See there.
    source : str
        Where the rows come from, for the file's own description.

    Returns
    -------
    int
        How many rows were written.

    Raises
    ------
    DetectError
        If an image's name is no Unicode.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    types: dict[str, Any] = {
        "text": pa.string(),
        "number": pa.float64(),
        "whole number": pa.int64(),
        "whole numbers": pa.list_(pa.int64()),
    }
    fields = [
        pa.field(
            column.name,
            types[column.kind],
            metadata={"unit": column.unit, "meaning": column.meaning},
        )
        for column in TABLES[table]
    ]
    schema = pa.schema(fields, metadata={"table": table, "source": source})
    count = 0
    with pq.ParquetWriter(stream, schema) as writer:
        for part in _parts(table, rows):
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
    row, frame, _ = _NAMES[table]
    columns = TABLES[table][len(FRAME_COLUMNS) :]
    return {
        f"{_PACKAGE}/msg/{row}": "".join(_field(column) for column in columns),
        f"{_PACKAGE}/msg/{frame}": (
            f"std_msgs/Header header  # time of the image; frame_id {FRAME_ID}\n"
            f"int64 frame  # {FRAME_COLUMNS[0].meaning}\n"
            f"string image  # {FRAME_COLUMNS[1].meaning}\n"
            f"{_PACKAGE}/{row}[] {table}\n"
        ),
    }


def topic_of(table: TableName) -> str:
    """The topic that a table's messages are recorded under."""
    return _NAMES[table][2]


def write_mcap(
    stream: BinaryIO, tables: Iterable[TableName], rows: Iterable[TableRow], source: str
) -> int:
    """Write the rows of a file as messages.

    Parameters
    ----------
    stream : binary stream
    tables : iterable of str
        The tables that there are.
    rows : iterable of TableRow
        With times; those of a frame are consecutive.
    source : str
        What messages call the file.

    Returns
    -------
    int
        How many messages were written.

    Raises
    ------
    DetectError
        If a frame has no time, or the package is not installed.
    """
    store = _typestore()
    from rosbags.rosbag2 import StoragePlugin, Writer

    count = 0
    tables = list(tables)
    with tempfile.TemporaryDirectory(prefix="redetect-") as folder:
        bag = Path(folder) / "detections"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            opened = {
                table: writer.add_connection(
                    topic_of(table), f"{_PACKAGE}/msg/{_NAMES[table][1]}", typestore=store
                )
                for table in tables
            }
            for table, time_ns, message in _messages(rows, tables, store, source):
                content = store.serialize_cdr(message, message.__msgtype__)
                writer.write(opened[table], time_ns, content)
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
        for table in tables:
            row_name, frame_name, _ = _NAMES[table]
            row_type = types[f"{_PACKAGE}/msg/{row_name}"]
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=FRAME_ID)
            content = [row_type(*_ros_values(row)) for row in found if row.table == table]
            message_type = types[f"{_PACKAGE}/msg/{frame_name}"]
            yield table, time_ns, message_type(header, frame, _ros_text(image), content)


def _ros_values(row: TableRow) -> Iterator[Any]:
    for value in row.values:
        if isinstance(value, tuple):
            yield np.array(value, dtype=np.int64)
        else:
            yield _ros_text(value) if isinstance(value, str) else value


def _ros_text(text: str) -> str:
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def _field(column: Column) -> str:
    unit = f"{column.unit}: " if column.unit else ""
    return f"{_TYPES[column.kind]} {column.name}  # {unit}{column.meaning}\n"


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
