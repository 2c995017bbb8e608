"""Exported tables: the numbers of the files, under the names of the one schema."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Any

import pytest

from detect.cli import main
from detect.export import FRAME_ID, message_definitions, topic_of
from redetect.landmarks import read_frames, read_tilts
from redetect.landmarks.columns import TABLES, TableName, values_of

Captured = pytest.CaptureFixture[str]

FILES = {
    "circles": """\
# head
STEP "a.0000"  0.00125 -0.25000  0.01000 0.000020000000 0.000001000000 0.000030000000 0 0 4e-4
LANDMARK_C 0.1 -1.20003 0.98 0.0016 -1e-07 0.00161 4 7
LANDMARK_C -0.3 -2 0.61 0.0016 0 0.002
STEP b,1 0 0 0 0 0 0 0 0 0
STEP c#2 1e-3 0 0 0 0 0 0 0 0
LANDMARK_C 1e-05 -2 0.61 0.0016 0 0.002 -1
""",
    "lines": """\
STEP a.0000 0.1 0 0 0 0 0 0 0 0
LANDMARK_L 0.1 -0.5 0.12 0.6 0.333333 -0.01 0 0.0013 3
LANDMARK_L -0.1 -0.5 -0.12 0.6 -0.333333 0.01 0 0.0013 -1
""",
    "markers": """\
STEP a.0000 0 0 0 0 0 0 0 0 0
LANDMARK_M rawseeds 12 0.97 10.5 20.25 0.01 1e-4 0.02 30.1 20 0.01 0 0.02 30 40.2 0.01 0 0.02 10 40 0.01 0 0.03
""",  # noqa: E501
    "tilt": """\
NOTILT a.0000 1
TILT b.0001 0.036596 -0.010553 1e-06 -2e-08 3e-06 9
""",
}

TABLE: dict[str, TableName] = {
    "circles": "circles", "lines": "lines", "markers": "markers", "tilt": "tilts",
}  # fmt: skip


@pytest.fixture(params=FILES)
def file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / f"x.{request.param}"
    path.write_text(FILES[request.param])
    return path


def expected_rows(path: Path) -> dict[TableName, list[tuple[Any, ...]]]:
    """What the file says: frame, image and values of each row, by table."""
    if path.suffix == ".tilt":
        (tilt,) = read_tilts(path).values()
        return {"tilts": [(1, tilt.prefix, *values_of(tilt))]}
    rows: dict[TableName, list[tuple[Any, ...]]] = {
        TABLE[path.suffix[1:]]: [],
        "steps": [],
    }
    for number, frame in enumerate(read_frames(path)):
        for table, records in (("steps", [frame.step]), (path.suffix[1:], frame.landmarks)):
            for record in records:
                rows[table].append((number, frame.step.prefix, *values_of(record)))  # type: ignore[index]
    return rows


def parsed(text: str, kind: str) -> Any:
    if kind == "number":
        return float(text) if text else None
    if kind == "whole numbers":
        return tuple(map(int, text.split()))
    return int(text) if kind == "whole number" else text


def read_csv(path: Path, table: TableName) -> list[tuple[Any, ...]]:
    with path.open(newline="", encoding="utf-8") as stream:
        head, *rows = csv.reader(stream)
    assert head == [column.name for column in TABLES[table]]
    return [
        tuple(parsed(v, c.kind) for v, c in zip(row, TABLES[table], strict=True)) for row in rows
    ]


def without_time(rows: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
    return [(frame, image, *values) for frame, image, _, *values in rows]


def files_of(path: Path, suffix: str) -> dict[TableName, Path]:
    own = path.with_name(f"{path.name}.{suffix}")
    if path.suffix == ".tilt":
        return {"tilts": own}
    return {TABLE[path.suffix[1:]]: own, "steps": path.with_name(f"{path.name}.steps.{suffix}")}


def test_csv_has_the_files_numbers(file: Path) -> None:
    assert main(["export", str(file)]) == 0
    expected = expected_rows(file)
    assert files_of(file, "csv").keys() == expected.keys()
    for table, path in files_of(file, "csv").items():
        found = read_csv(path, table)
        assert without_time(found) == expected[table]
        assert {row[2] for row in found} <= {None}


@pytest.mark.lowest
def test_parquet_has_the_files_numbers_and_units(file: Path) -> None:
    pytest.importorskip("pyarrow", reason="the extra [parquet] is not installed")
    import pyarrow.parquet as pq  # type: ignore[import-untyped]

    assert main(["export", str(file), "--to", "parquet"]) == 0
    expected = expected_rows(file)
    for table, path in files_of(file, "parquet").items():
        read = pq.read_table(path)
        columns = [column.to_pylist() for column in read.columns]
        rows = [tuple(tuple(v) if isinstance(v, list) else v for v in row) for row in zip(*columns)]
        assert without_time(rows) == expected[table]
        for column, field in zip(TABLES[table], read.schema, strict=True):
            assert field.name == column.name
            assert field.metadata[b"unit"].decode() == column.unit
        assert read.schema.metadata[b"source"].decode() == file.name


@pytest.mark.lowest
def test_mcap_has_the_files_numbers(file: Path) -> None:
    pytest.importorskip("rosbags", reason="the extra [bags] is not installed")
    from rosbags.highlevel import AnyReader

    assert main(["export", str(file), "--to", "mcap", "--rate-hz", "4"]) == 0
    expected = expected_rows(file)
    found: dict[str, list[tuple[Any, ...]]] = {table: [] for table in expected}
    with AnyReader([file.with_name(f"{file.name}.mcap")]) as bag:
        assert {c.topic for c in bag.connections} == {topic_of(table) for table in expected}
        for connection, time_ns, content in bag.messages():
            message: Any = bag.deserialize(content, connection.msgtype)
            table = connection.topic.rpartition("/")[2]
            stamp = message.header.stamp
            assert stamp.sec + 1e-9 * stamp.nanosec == message.frame / 4 == time_ns * 1e-9
            assert message.header.frame_id == FRAME_ID
            names = [column.name for column in TABLES[table][3:]]  # type: ignore[index]
            for row in getattr(message, table):
                values = [getattr(row, name) for name in names]
                values = [tuple(v.tolist()) if hasattr(v, "tolist") else v for v in values]
                found[table].append((message.frame, message.image, *values))
    assert found == expected


def test_definitions_are_made_of_the_columns() -> None:
    """The notation of ROS, with the units: as the documentation shows it."""
    circle = message_definitions("circles")["redetect_msgs/msg/Circle"].splitlines()
    assert circle[0].startswith("float64 px_m  # m: ")
    assert circle[-1].startswith("int64[] ids  # ")


def test_times_stand_beside_the_rows(tmp_path: Path) -> None:
    path = tmp_path / "x.lines"
    path.write_text(FILES["lines"])
    (tmp_path / "x.lines.times").write_text("a.0000 12.5\n")
    assert main(["export", str(path), "-o", str(tmp_path / "o.csv")]) == 0
    assert [row[2] for row in read_csv(tmp_path / "o.csv", "lines")] == [12.5, 12.5]
    (tmp_path / "other.times").write_text("a.0000 99\n")
    named = ["--times", str(tmp_path / "other.times"), "--force"]
    assert main(["export", str(path), "-o", str(tmp_path / "o.csv"), *named]) == 0
    assert [row[2] for row in read_csv(tmp_path / "o.steps.csv", "steps")] == [99.0]


def test_files_of_several_kinds(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_text(FILES["lines"] + FILES["markers"])
    assert main(["export", str(path)]) == 0
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["x.txt", "x.txt.csv", "x.txt.markers.csv", "x.txt.steps.csv"]
    assert len(read_csv(tmp_path / "x.txt.csv", "lines")) == 2


def test_a_file_without_landmarks_has_a_table_without_rows(tmp_path: Path) -> None:
    path = tmp_path / "x.circles"
    path.write_text("STEP a 0 0 0 0 0 0 0 0 0\n")
    assert main(["export", str(path)]) == 0
    assert read_csv(tmp_path / "x.circles.csv", "circles") == []
    assert len(read_csv(tmp_path / "x.circles.steps.csv", "steps")) == 1


@pytest.mark.parametrize("to", ["csv", "parquet", "mcap"])
def test_the_same_bytes_and_nothing_overwritten(tmp_path: Path, to: str, capsys: Captured) -> None:
    pytest.importorskip({"csv": "csv", "parquet": "pyarrow", "mcap": "rosbags"}[to])
    path = tmp_path / "x.circles"
    path.write_text(FILES["circles"])
    arguments = ["export", str(path), "--to", to, "--rate-hz", "10"]
    assert main(arguments) == 0
    output = tmp_path / f"x.circles.{to}"
    first = output.read_bytes()
    capsys.readouterr()
    assert main(arguments) == 1
    assert "exists already: give --force" in capsys.readouterr().err
    assert main([*arguments, "--force"]) == 0
    assert output.read_bytes() == first


@pytest.mark.parametrize(
    ("content", "arguments", "told"),
    [
        (None, [], "no such landmark file"),
        ("# nothing\n", ["-o", "o.csv"], None),
        (FILES["circles"], ["--to", "mcap"], 'no time of "a.0000": messages need one'),
        (FILES["circles"], ["--rate-hz", "0"], "rate_hz is 0: expected above 0"),
        (FILES["circles"], ["--times", "gone.times"], "gone.times: no such file of times"),
        ("LANDMARK_C 1 2\n", [], "x.circles:1: LANDMARK_C with 2 values"),
        (FILES["circles"], ["-o", "x.circles", "--force"], "x.circles: is the file to export"),
        (
            FILES["circles"],
            ["-o", "./x.circles", "--force", "--to", "mcap", "--rate-hz", "1"],
            "x.circles: is the file to export",
        ),
    ],
)
def test_refusals(
    tmp_path: Path, content: str | None, arguments: list[str], told: str | None, capsys: Captured,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    if "mcap" in arguments:
        pytest.importorskip("rosbags")
    path = tmp_path / "x.circles"
    if content is not None:
        path.write_text(content)
    code = main(["export", str(path), *arguments])
    if told is None:
        assert code == 0
        return
    assert code == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert told in line
    assert [p.name for p in tmp_path.iterdir()] == ([] if content is None else ["x.circles"])
    assert content is None or path.read_text() == content


@pytest.mark.parametrize(
    ("to", "module", "extra"),
    [("parquet", "pyarrow.parquet", "[parquet]"), ("mcap", "rosbags.typesys", "[bags]")],
)
def test_without_the_package(
    tmp_path: Path, to: str, module: str, extra: str, monkeypatch: pytest.MonkeyPatch,
    capsys: Captured,
) -> None:  # fmt: skip
    monkeypatch.setitem(sys.modules, module, None)
    path = tmp_path / "x.circles"
    path.write_text(FILES["circles"])
    assert main(["export", str(path), "--to", to]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert f"pip install 'redetect{extra}'" in line


def test_a_calibration_is_another_commands(project_root: Path, capsys: Captured) -> None:
    from camera.cli import main as camera_main

    source = project_root / "images" / "e" / "e.cam"
    assert main(["export", str(source)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert f"camera convert {source} cameras.txt" in line
    with pytest.raises(SystemExit) as left:
        camera_main(["convert", "--help"])
    assert left.value.code == 0
    assert "cameras.txt" in capsys.readouterr().out


def test_the_documentation_shows_the_schema(project_root: Path) -> None:
    text = (project_root / "docs" / "outputs.md").read_text()
    for table, columns in TABLES.items():
        _, _, section = text.partition(f"\n### {table}\n")
        section = section.partition("\n### ")[0]
        for column in columns[3:] if table != "markers" else columns[3:11]:
            assert f"| `{column.name}` | {column.kind} | {column.unit} |" in section
