"""The command ``detect export``."""

from __future__ import annotations

from pathlib import Path

from detect.errors import DetectError
from detect.exports.options import Export
from detect.exports.rows import ExportedRows
from detect.exports.writers import demand_pyarrow, write_csv, write_mcap, write_parquet
from detect.sources.times import read_image_times
from landmarks.columns import TableName
from storage import OutputExistsError, write_whole

_LANDMARKS = (".circles", ".lines", ".markers", ".tilt")


def perform(command: Export) -> int:
    """Export a file; returns the exit code.

    Raises
    ------
    DetectError
        If times are needed and there are none, the output is the file itself, or a package is not
        installed.
    landmarks.LandmarkFileError
        If the file cannot be read.
    storage.OutputExistsError
        If an output exists and must not be replaced.
    """
    file = command.file
    if file.is_dir():
        found = sorted(path.name for path in file.iterdir() if path.suffix in _LANDMARKS)
        such = f", such as {', '.join(found)} in it" if found else ""
        raise DetectError(
            f"{file}: is a folder: expected a .circles, .lines, .markers or .tilt file{such}"
        )
    if file.suffix == ".cam":
        raise DetectError(
            f"{file}: is a calibration, not rows: camera convert {file} "
            "cameras.txt writes it for COLMAP (or for OpenCV, ROS, Kalibr)"
        )
    rows = ExportedRows(file, _times(command), command.rate_hz)
    output = command.output or file.with_name(f"{file.name}.{command.to}")
    if command.to == "parquet":
        demand_pyarrow()
    tables = rows.tables()
    if not tables:
        raise DetectError(f"{file}: no rows in it: expected STEP, LANDMARK or TILT rows")
    places = {tables[0]: output} if command.to == "mcap" else _table_files(output, tables)
    for path in places.values():
        if path.exists() and path.samefile(file):
            raise DetectError(f"{path}: is the file to export: expected another output")
        if path.exists() and not command.force:
            raise OutputExistsError(path)
    for table, path in places.items():
        with write_whole(path, overwrite=command.force) as stream:
            if command.to == "mcap":
                count = write_mcap(stream, tables, rows, str(file))
            elif command.to == "csv":
                count = write_csv(stream, table, rows)
            else:
                count = write_parquet(stream, table, rows, file.name)
        print(f"{path}: {count} {'messages' if command.to == 'mcap' else 'rows'}")
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
