"""Tables as CSV: comma separated, a line of names at the top, numbers as Python prints them.

A number is the shortest text that gives the same float64; unknown values are empty; several
identifiers are separated by blanks.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from typing import BinaryIO

from detect.exports.rows import TableRow
from landmarks.columns import TABLES, TableName, Value

_ROWS_AT_ONCE = 1000


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
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in TABLES[table]])
    count = 0
    for row in rows:
        if row.table != table:
            continue
        writer.writerow([_text(value) for value in row.all_values])
        count += 1
        if count % _ROWS_AT_ONCE == 0:
            stream.write(text.getvalue().encode("utf-8", "surrogateescape"))
            text.seek(0)
            text.truncate()
    stream.write(text.getvalue().encode("utf-8", "surrogateescape"))
    return count


def _text(value: Value) -> str:
    if value is None:
        return ""
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    return repr(value) if isinstance(value, float) else str(value)
