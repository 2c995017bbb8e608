"""Exported tables: the numbers of the files, under the names of the one schema."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Any

import pytest

from detect.cli import main
from detect.ros_messages import TOPICS
from redetect.landmarks import read_frames, read_tilts
from redetect.landmarks.columns import TABLES, TableName, values_of
from tests.detect.commands import Captured

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
    rows: dict[TableName, list[tuple[Any, ...]]] = {TABLE[path.suffix[1:]]: [], "steps": []}
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


def messages(path: Path) -> list[tuple[str, float, Any]]:
    """Topic, time (s) and message of all in a recording."""
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as bag:
        return [
            (c.topic, time_ns * 1e-9, bag.deserialize(content, c.msgtype))
            for c, time_ns, content in bag.messages()
        ]


@pytest.mark.lowest
def test_mcap_has_standard_messages_of_each_frame(file: Path) -> None:
    pytest.importorskip("rosbags", reason="the extra [bags] is not installed")
    from rosbags.typesys import Stores, get_typestore

    assert main(["export", str(file), "--to", "mcap", "--rate-hz", "4"]) == 0
    found = messages(file.with_name(f"{file.name}.mcap"))
    rows = expected_rows(file)
    standard = get_typestore(Stores.ROS2_HUMBLE).types
    for topic, time_s, message in found:
        (type_name,) = (types[topic] for types in TOPICS.values() if topic in types)
        assert message.__msgtype__ == type_name
        assert type_name in standard
        if hasattr(message, "header"):
            assert message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec == time_s
    for table, of_table in rows.items():
        topic = "/tf" if table == "steps" else f"/redetect/{table}"
        if table in ("circles", "lines", "tilts"):
            topic += "/poses"
        assert [t for name, t, _ in found if name == topic] == [row[0] / 4 for row in of_table]


def test_messages_are_in_the_axes_of_ros(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="the extra [bags] is not installed")
    from scipy.spatial.transform import Rotation

    def turn(q: Any) -> Any:
        return Rotation.from_quat([q.x, q.y, q.z, q.w]).as_rotvec()

    by_topic: dict[str, list[Any]] = {}
    for kind, text in FILES.items():
        path = tmp_path / f"x.{kind}"
        path.write_text(text)
        assert main(["export", str(path), "--to", "mcap", "--rate-hz", "4"]) == 0
        for topic, _, message in messages(path.with_name(f"{path.name}.mcap")):
            by_topic.setdefault(topic, []).append(message)

    disc = by_topic["/redetect/circles/poses"][0]
    assert disc.header.frame_id == "base_link"
    assert (disc.pose.pose.position.x, disc.pose.pose.position.y) == (1.20003, 0.1)
    assert disc.pose.covariance[[0, 1, 6, 7]] == pytest.approx([0.00161, 1e-7, 1e-7, 0.0016])
    shapes = by_topic["/redetect/circles"]
    assert [len(array.markers) for array in shapes] == [3, 1, 2]  # The first one clears
    assert shapes[0].markers[1].text == "4 7"
    assert shapes[0].markers[1].pose == disc.pose.pose
    vertical = by_topic["/redetect/lines/poses"][0].pose
    assert turn(vertical.pose.orientation) == pytest.approx([0.0, 0.0, 0.333333])
    assert vertical.covariance[35] == pytest.approx(0.0013**2)
    tilt = by_topic["/redetect/tilts/poses"][0].pose
    assert turn(tilt.pose.orientation) == pytest.approx([0.010553, 0.036596, 0.0])
    assert tilt.covariance[[21, 22, 28]] == pytest.approx([3e-6, 2e-8, 1e-6])
    (square,) = by_topic["/redetect/markers"]
    assert (square.ns, square.id) == ("rawseeds", 12)
    assert [(p.x, p.y) for p in square.points] == [(10.5, 20.25), (30.1, 20), (30, 40.2), (10, 40)]
    # The first file's: 0.25 m forward and 1.25 mm to the left, then 1 mm to the left, turned.
    places = [message.transforms[0].transform.translation for message in by_topic["/tf"][:3]]
    assert (places[0].x, places[0].y) == pytest.approx((0.25, 0.00125))
    assert (places[2].x, places[2].y) == pytest.approx((0.25 - 1e-5, 0.00225), abs=1e-7)


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
        (
            "STEP a 0 0 0 0 0 0 0 0 0\nLANDMARK_L 0 0 0 1 0.1 0 0 1e24 3\n",
            ["--to", "mcap", "--rate-hz", "1"],
            None,
        ),
        (FILES["circles"], ["--to", "mcap"], 'no time for "a.0000": messages need one'),
        (FILES["circles"], ["--times", "x.times", "--rate-hz", "9"], "both --times and --rate-hz"),
        (FILES["circles"], ["--to", "mcap", "--rate-hz", "1e-309"], "b,1 is from inf s"),
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
