"""``slam export`` and ``slam import`` as commands: what they print, write, and refuse."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from redetect.landmarks import CircleLandmark, Frame, format_frame, read_frames
from redetect.landmarks.map_file import (
    LandmarkMap,
    Landmarks,
    Path2D,
    no_landmarks,
    read_map,
    read_path,
    write_map,
    write_path,
)
from redetect.slam.cli import main
from redetect.slam.formats.g2o import read_g2o
from redetect.slam.formats.text import covariance_from_dataset, from_dataset
from redetect.slam.models import chain_steps
from redetect.slam.recording import read_recording

DEMO = Path(__file__).parents[2] / "images" / "e"
Capture = pytest.CaptureFixture[str]


def refused(arguments: list[str], message: str, capsys: Capture) -> None:
    assert main(arguments) == 1
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.startswith("error: ")
    assert printed.count("\n") == 1


@pytest.fixture
def solution(tmp_path: Path) -> Path:
    """A folder as `slam map` writes it, of the demo run, off by 1 m."""
    recording = read_recording(DEMO)
    poses = chain_steps(recording.steps, (1.0, 2.0, 0.1))
    spread = np.tile(np.diag([1e-4, 4e-4, 1e-5]), (len(poses), 1, 1))
    folder = tmp_path / "solution"
    folder.mkdir()
    write_path(folder / "path.csv", Path2D(("start", *recording.prefixes), poses, spread))
    ids = np.unique(recording.circles.ids[recording.circles.ids >= 0])
    xy = np.column_stack([ids, 2.0 * ids]).astype(np.float64)
    covariance = np.tile([[1e-3, 2e-4], [2e-4, 5e-3]], (len(ids), 1, 1))
    discs = Landmarks(ids, xy, covariance, np.full(len(ids), 4))
    write_map(folder / "map.csv", LandmarkMap(discs, no_landmarks()))
    return folder


def test_a_graph_there_and_back(tmp_path: Path, capsys: Capture) -> None:
    graph, again = tmp_path / "e.g2o", tmp_path / "again.circles"
    assert main(["export", str(DEMO), "-o", str(graph)]) == 0
    assert capsys.readouterr().out == (
        f"{graph}: 81 poses, 31 discs, 80 steps, 304 measurements of discs "
        "(10 without ID left out)\n"
    )
    assert main(["import", str(graph), "-o", str(again)]) == 0
    assert capsys.readouterr().out == f"{again}: 80 steps, 304 measurements of discs\n"
    expected = [
        Frame(
            frame.step,
            tuple(r for r in frame.landmarks if isinstance(r, CircleLandmark) and r.identified),
        )
        for frame in read_frames(DEMO / "map.circles")
    ]
    rows = [line for line in again.read_bytes().splitlines(True) if not line.startswith(b"#")]
    assert b"".join(rows) == b"".join(map(format_frame, expected))
    first = graph.read_bytes()
    refused(["export", str(DEMO), "-o", str(graph)], "exists already", capsys)
    assert main(["export", str(DEMO), "-o", str(graph), "--force"]) == 0
    assert graph.read_bytes() == first
    refused(["import", str(graph), "-o", str(again)], "exists already", capsys)
    other = ["import", str(graph), "-o", str(tmp_path / "x.circles"), "--axes", "dataset"]
    refused(other, "the file's axes are 'robotics'", capsys)


def test_the_estimates_of_a_solution(tmp_path: Path, solution: Path, capsys: Capture) -> None:
    graph = tmp_path / "e.g2o"
    assert main(["export", str(DEMO), "-o", str(graph), "--solution", str(solution)]) == 0
    read = read_g2o(graph)
    np.testing.assert_array_equal(read.path.poses, read_path(solution / "path.csv").poses)
    np.testing.assert_array_equal(read.discs, read_map(solution / "map.csv").discs.xy)
    assert main(["import", str(graph), "-o", str(tmp_path / "p.csv")]) == 0
    path = read_path(tmp_path / "p.csv")
    np.testing.assert_array_equal(path.poses, read.path.poses)
    assert path.prefixes[:2] == ("start", "e.0000")
    capsys.readouterr()

    rows = (solution / "path.csv").read_text().splitlines(keepends=True)
    (solution / "path.csv").write_text("".join(rows[:-1]))
    arguments = ["export", str(DEMO), "-o", str(tmp_path / "x"), "--solution", str(solution)]
    refused(arguments, "path.csv: 80 poses: expected 81 of this run", capsys)
    (solution / "path.csv").write_text("".join(rows).replace("e.0003", "f.0003"))
    refused(arguments, "pose 4 is f.0003: expected e.0003 of this run", capsys)
    (solution / "path.csv").write_text("".join(rows))
    rows = (solution / "map.csv").read_text().splitlines(keepends=True)
    (solution / "map.csv").write_text("".join(rows[:1] + rows[2:]))
    refused(arguments, "map.csv: no disc 1: expected all that the run measured", capsys)


def test_a_trajectory_there_and_back(tmp_path: Path, solution: Path, capsys: Capture) -> None:
    poses = read_path(solution / "path.csv").poses
    for number, (run, more) in enumerate(
        [(solution / "path.csv", []), (DEMO, ["--solution", str(solution)])]
    ):
        tum, again = tmp_path / f"{number}.tum", tmp_path / f"{number}.csv"
        assert main(["export", str(run), "--to", "tum", "-o", str(tum), *more]) == 0
        assert main(["import", str(tum), "-o", str(again)]) == 0
        assert capsys.readouterr().out == f"{tum}: 81 poses\n{again}: 81 poses\n"
        np.testing.assert_array_equal(read_path(again).poses[:, :2], poses[:, :2])
        np.testing.assert_allclose(read_path(again).poses[:, 2], poses[:, 2], atol=1e-14)
    # Without a solution it is odometry's.
    assert main(["export", str(DEMO), "--to", "tum", "-o", str(tmp_path / "o.txt")]) == 0
    assert main(["import", str(tmp_path / "o.txt"), "-o", str(tmp_path / "o.csv")]) == 0
    expected = chain_steps(read_recording(DEMO).steps)
    np.testing.assert_allclose(read_path(tmp_path / "o.csv").poses, expected, atol=1e-14)


def test_tables(tmp_path: Path, solution: Path, capsys: Capture) -> None:
    out = tmp_path / "tables"
    arguments = ["export", str(DEMO), "--to", "csv", "-o", str(out), "--solution", str(solution)]
    assert main([*arguments, "--circles", "--lines"]) == 0
    assert capsys.readouterr().out == (
        f"{out}: 80 steps, 304 measurements of discs (10 without ID left out), 976 bearings\n"
    )
    names = ["bearings.csv", "discs.csv", "map.csv", "odometry.csv", "path.csv"]
    assert sorted(path.name for path in out.iterdir()) == names
    # A map and path in the project's own layout, in the other axes, covariances too.
    path, turned = read_path(solution / "path.csv"), read_path(out / "path.csv")
    np.testing.assert_array_equal(turned.poses, from_dataset(path.poses, "robotics"))
    assert path.covariance is not None
    np.testing.assert_array_equal(
        turned.covariance, covariance_from_dataset(path.covariance, "robotics")
    )
    discs = read_map(solution / "map.csv").discs
    np.testing.assert_array_equal(
        read_map(out / "map.csv").discs.covariance,
        covariance_from_dataset(discs.covariance, "robotics"),
    )

    # None is written where one stands already.
    for name in names[1:]:
        (out / name).unlink()
    refused([*arguments, "--lines"], "bearings.csv: exists already", capsys)
    assert [path.name for path in out.iterdir()] == ["bearings.csv"]


def test_verticals_have_no_edge(tmp_path: Path, capsys: Capture) -> None:
    output = ["-o", str(tmp_path / "e.g2o")]
    refused(["export", str(DEMO), "--lines", *output], "have no edge in g2o", capsys)
    refused(["export", str(DEMO / "map.lines"), *output], "have no edge in g2o", capsys)
    assert not (tmp_path / "e.g2o").exists()


def test_bearings_need_a_camera(tmp_path: Path, capsys: Capture) -> None:
    lines = tmp_path / "a.lines"
    lines.write_bytes((DEMO / "map.lines").read_bytes())
    arguments = ["export", str(lines), "--to", "csv", "-o", str(tmp_path / "out")]
    refused(arguments, "no calibration: expected a .cam file in it", capsys)
    assert not (tmp_path / "out").exists()
    assert main([*arguments, "--camera", str(DEMO / "e.cam")]) == 0
    for name in ("one.cam", "two.cam"):
        (tmp_path / name).write_bytes((DEMO / "e.cam").read_bytes())
    refused([*arguments, "--force"], "several calibrations (one.cam, two.cam)", capsys)


def test_what_the_digits_of_a_row_cannot_hold(tmp_path: Path, capsys: Capture) -> None:
    graph, output = tmp_path / "a.g2o", tmp_path / "a.circles"
    graph.write_text(
        "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1e14 0 0 1e14 0 400\n"
    )
    refused(["import", str(graph), "-o", str(output)], "in the digits of a .circles", capsys)
    assert not output.exists()


def test_unknown_qualities_are_told(tmp_path: Path, capsys: Capture) -> None:
    graph, output = tmp_path / "a.g2o", tmp_path / "a.circles"
    graph.write_text(
        "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_XY 2 3 1\n"
        "EDGE_SE2 0 1 1 0 0 100 0 0 100 0 400\nEDGE_SE2_XY 1 2 2 1 100 0 100\n"
    )
    assert main(["import", str(graph), "-o", str(output)]) == 0
    assert capsys.readouterr().out == (
        f"{output}: 1 steps, 1 measurements of discs; 1 of them without quality: 1 is written\n"
    )
    (frame,) = read_frames(output)
    assert frame.landmarks == (CircleLandmark(1.0, -2.0, 1.0, 0.01, 0.0, 0.01, (2,)),)


def test_a_trajectory_with_times(tmp_path: Path, capsys: Capture) -> None:
    """Of the file named, else of that beside the run which has all frames; the start has none."""
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(DEMO / "map.circles", run)
    prefixes = read_recording(run).prefixes
    times = 1e9 + 0.25 * np.arange(len(prefixes))
    rows = [f"{name} {time_s:.6f}\n" for name, time_s in zip(prefixes, times)]
    (run / "b.times").write_text("# <image> <seconds>\n" + "".join(rows))
    (run / "a.times").write_text("".join(rows[:-1]))
    arguments = ["export", str(run), "--to", "tum", "-o"]
    assert main([*arguments, str(tmp_path / "e.tum")]) == 0
    exported = np.loadtxt(tmp_path / "e.tum")
    np.testing.assert_array_equal(exported[:, 0], times)
    poses = chain_steps(read_recording(run).steps)
    np.testing.assert_allclose(exported[:, 1:3], from_dataset(poses, "robotics")[1:, :2])
    named = [*arguments, str(tmp_path / "f.tum"), "--times"]
    refused([*named, str(run / "a.times")], f"no time of {prefixes[-1]}: expected", capsys)
    (tmp_path / "c.times").write_text(rows[0] + "e.0001 x\n")
    refused([*named, str(tmp_path / "c.times")], "c.times:2: 'e.0001 x': expected", capsys)
    (tmp_path / "c.times").write_text("e.0001\n")
    refused([*named, str(tmp_path / "c.times")], "c.times:1: 'e.0001': expected", capsys)
