"""Tables as Parquet, by the package ``pyarrow``: columns have units and descriptions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, BinaryIO

from detect.errors import DetectError
from detect.exports.rows import TableRow
from landmarks.columns import TABLES, TableName

_ROWS_AT_ONCE = 20_000


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
    """Write a table; parameters as those of `detect.exports.csv_file.write_csv`.

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
    waiting: list[tuple[Any, ...]] = []
    with pq.ParquetWriter(stream, schema) as writer:

        def flush() -> None:
            columns = list(zip(*waiting)) if waiting else [()] * len(fields)
            try:
                arrays = [pa.array(c, f.type) for c, f in zip(columns, fields)]
            except UnicodeEncodeError:
                raise DetectError(
                    f"{source}: the name of an image is no Unicode: Parquet cannot hold it"
                ) from None
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
            waiting.clear()

        for row in rows:
            if row.table == table:
                waiting.append(row.all_values)
                count += 1
                if len(waiting) == _ROWS_AT_ONCE:
                    flush()
        if waiting or not count:
            flush()
    return count
