"""The command ``detect export``."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

from detect.errors import DetectError
from detect.exports.options import Export
from detect.exports.writers import (
    demand_pyarrow,
    table_rows,
    write_csv,
    write_mcap,
    write_parquet,
)
from detect.sources.times import read_image_times
from redetect.landmarks.columns import TableName
from redetect.storage import OutputExistsError, write_whole

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
        demand_pyarrow()
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
        if path.exists() and not command.force:
            raise OutputExistsError(path)
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
