"""SQLite bags with some of their cells changed, which random changes of bytes hardly ever give.

Random changes of a database's bytes damage its pages, and it is refused before any message is read.
Here a recipe says which cells of a recorded bag are changed, and how, so that the result is always
a sound database. The empty recipe gives the bag itself.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing, suppress
from functools import cache

#: Largest number of edits in a recipe.
_MOST_EDITS = 16
_HEAD_BYTES = 4

Cell = tuple[str, int, str]


def bag_with_edits(recorded: bytes, recipe: bytes) -> bytes:
    """A database with changed cells."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as database:
        database.deserialize(recorded)
        cells = _cells(recorded)
        at = 0
        for _ in range(_MOST_EDITS):
            head = recipe[at : at + _HEAD_BYTES]
            if len(head) < _HEAD_BYTES:
                break
            kind, which, place, length = head
            at += _HEAD_BYTES
            content = recipe[at : at + length]
            at += length
            # What the tables' own constraints refuse, nobody could write either.
            with suppress(sqlite3.Error, OverflowError):
                _edit(database, kind % 8, cells[which % len(cells)], place, content)
        return database.serialize()


def _edit(database: sqlite3.Connection, kind: int, cell: Cell, place: int, content: bytes) -> None:
    table, row, column = cell
    here = f'FROM "{table}" WHERE rowid = {row}'
    if kind == 0:
        database.execute(f"DELETE {here}")
        return
    if kind == 1:
        names = [name for _, name, *_ in database.execute(f'PRAGMA table_info("{table}")')]
        others = ", ".join(f'"{name}"' for name in names if name != "id")
        database.execute(f'INSERT INTO "{table}" ({others}) SELECT {others} {here}')
        return
    found = database.execute(f'SELECT "{column}" {here}').fetchone()
    if found is None:
        return
    new = _changed(found[0], kind, place, content)
    # Including text that is not valid UTF-8.
    value = "CAST(? AS TEXT)" if isinstance(found[0], str) and isinstance(new, bytes) else "?"
    database.execute(f'UPDATE "{table}" SET "{column}" = {value} WHERE rowid = {row}', (new,))


def _changed(value: object, kind: int, place: int, content: bytes) -> object:
    if kind == 2:
        return int.from_bytes(content[:8], "little", signed=True)
    if kind == 3:
        return None if place % 2 else float(place) * 1e300
    if isinstance(value, int | float | None):
        return content
    old = value.encode() if isinstance(value, str) else bytes(value)  # type: ignore[call-overload]
    # Any place can be chosen near the beginning or the end, even if there are over 256 bytes.
    first = place * len(old) // 256 if place < 128 else max(0, len(old) - 256 + place)
    if kind == 4:
        return content
    if kind == 5:
        return old[:first] + content + old[first:]
    if kind == 6:
        return old[:first] + content
    return old[:first] + content + old[first + len(content) :]


@cache
def _cells(recorded: bytes) -> list[Cell]:
    """Table, row and column of every cell."""
    with closing(sqlite3.connect(":memory:")) as database:
        database.deserialize(recorded)
        tables = database.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
        ).fetchall()
        found = []
        for (table,) in tables:
            rows = [row for (row,) in database.execute(f'SELECT rowid FROM "{table}"')]
            names = [name for _, name, *_ in database.execute(f'PRAGMA table_info("{table}")')]
            found += [(table, row, name) for row in rows for name in names]
        return found
