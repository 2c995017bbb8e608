"""``slam export`` and ``slam import`` as commands: what they print, write, and refuse."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from redetect.landmarks.axes import from_dataset
from redetect.landmarks.map_file import Path2D, read_path, write_path
from redetect.plane import chain_steps
from redetect.slam.cli import main
from redetect.slam.recording import read_recording

DEMO = Path(__file__).parents[2] / "images" / "e"
Capture = pytest.CaptureFixture[str]


def refused(arguments: list[str], message: str, capsys: Capture) -> None:
    assert main(arguments) == 1
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.startswith("error: ")
    assert printed.count("\n") == 1


def test_a_graph_there_and_back(tmp_path: Path, capsys: Capture) -> None:
    graph, again = tmp_path / "e.g2o", tmp_path / "again.circles"
    assert main(["export", str(DEMO), "-o", str(graph)]) == 0
    assert capsys.readouterr().out == (
        f"{graph}: 81 poses, 31 discs, 80 steps, 304 measurements of discs "
        "(10 without ID left out)\n"
    )
    assert main(["import", str(graph), "-o", str(again)]) == 0
    assert capsys.readouterr().out == f"{again}: 80 steps, 304 measurements of discs\n"
    one, other = read_recording(again).circles, read_recording(DEMO).circles
    np.testing.assert_array_equal(one.xy, other.xy[other.identified])
    np.testing.assert_array_equal(one.ids, other.ids[other.identified])
    np.testing.assert_allclose(one.covariance, other.covariance[other.identified], rtol=1e-5)
    assert main(["import", str(graph), "-o", str(tmp_path / "p.csv")]) == 0
    path = read_path(tmp_path / "p.csv")
    np.testing.assert_array_equal(path.poses, chain_steps(read_recording(DEMO).steps))
    assert path.prefixes[:2] == ("start", "vertex.1")
    capsys.readouterr()
    first = graph.read_bytes()
    refused(["export", str(DEMO), "-o", str(graph)], "exists already", capsys)
    assert main(["export", str(DEMO), "-o", str(graph), "--force"]) == 0
    assert graph.read_bytes() == first
    refused(["import", str(graph), "-o", str(again)], "exists already", capsys)


def test_a_trajectory_there_and_back(tmp_path: Path, capsys: Capture) -> None:
    """Of a path, and of a run, whose is odometry's."""
    recording = read_recording(DEMO)
    poses = chain_steps(recording.steps)
    write_path(tmp_path / "path.csv", Path2D(("start", *recording.prefixes), poses))
    for number, run in enumerate([tmp_path / "path.csv", DEMO]):
        tum, again = tmp_path / f"{number}.tum", tmp_path / f"{number}.csv"
        assert main(["export", str(run), "--to", "tum", "-o", str(tum)]) == 0
        assert main(["import", str(tum), "-o", str(again)]) == 0
        assert capsys.readouterr().out == f"{tum}: 81 poses\n{again}: 81 poses\n"
        np.testing.assert_array_equal(read_path(again).poses[:, :2], poses[:, :2])
        np.testing.assert_allclose(read_path(again).poses[:, 2], poses[:, 2], atol=1e-14)


def test_frames_of_one_name_have_one_time(tmp_path: Path, capsys: Capture) -> None:
    write_path(tmp_path / "path.csv", Path2D(("start", "a", "b", "a"), np.zeros((4, 3))))
    (tmp_path / "e.times").write_text("a 5\nb 6\n")
    arguments = ["export", str(tmp_path / "path.csv"), "--to", "tum", "-o", str(tmp_path / "e.tum")]
    refused(arguments, "e.times: the frames' times do not ascend", capsys)


@pytest.mark.parametrize(
    ("file", "output", "expected"),
    [
        ("e.tum", "t.circles", ".csv"),
        ("Landmark_Groundtruth.dat", "m.circles", ".csv"),
        ("aa3_dr.mat", "r.csv", ".circles"),
        ("e.g2o", "e.txt", ".circles or .csv"),
    ],
)
def test_results_of_another_suffix_are_refused(
    file: str, output: str, expected: str, capsys: Capture
) -> None:
    refused(["import", file, "-o", output], f"{output}: expected a {expected} file", capsys)


def test_tables(tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "tables"
    arguments = ["export", str(DEMO), "--to", "csv", "-o", str(out)]
    assert main([*arguments, "--circles", "--lines"]) == 0
    assert capsys.readouterr().out == (
        f"{out}: 80 steps, 304 measurements of discs (10 without ID left out), 976 bearings\n"
    )
    names = ["bearings.csv", "discs.csv", "odometry.csv"]
    assert sorted(path.name for path in out.iterdir()) == names

    # None is written where one stands already.
    for name in names[1:]:
        (out / name).unlink()
    refused([*arguments, "--lines"], "bearings.csv: exists already", capsys)
    assert [path.name for path in out.iterdir()] == ["bearings.csv"]


def test_tables_are_written_into_a_folder_not_one_of_the_name_of_a_table(
    tmp_path: Path, capsys: Capture
) -> None:
    out = tmp_path / "tt.csv"
    arguments = ["export", str(DEMO), "--to", "csv", "-o", str(out)]
    refused(arguments, "several tables are written: expected a folder, such as tt", capsys)
    assert not out.exists()
    out.mkdir()
    assert main(arguments) == 0


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


def test_flags_that_do_not_apply_are_refused(tmp_path: Path, capsys: Capture) -> None:
    graph, tables = tmp_path / "e.g2o", ["--to", "csv", "-o", str(tmp_path / "tables")]
    refused(
        ["export", str(DEMO), "--times", "missing", "-o", str(graph)],
        "--times: only --to tum has times, not g2o", capsys,
    )  # fmt: skip
    refused(["export", str(DEMO / "map.circles"), "--lines", *tables], "has discs, not", capsys)
    assert main(["export", str(DEMO), "-o", str(graph)]) == 0
    capsys.readouterr()
    again = ["import", str(graph), "-o", str(tmp_path / "e.circles")]
    refused([*again, "--range-sigma", "0.1"], "--range-sigma: has no effect on e.g2o", capsys)
    refused([*again, "--no-calibrated"], "--no-calibrated: has no effect on e.g2o", capsys)
    with pytest.raises(SystemExit, match="2"):
        main([*again, "--range-sigma", "-3"])
    assert "--range-sigma is -3: expected above 0" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["e.g2o"]


def test_the_first_pose_of_a_path_without_a_start_has_its_time(tmp_path: Path) -> None:
    file, tum = tmp_path / "path.csv", tmp_path / "e.tum"
    write_path(file, Path2D(("a", "b"), np.array([[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]])))
    (tmp_path / "e.times").write_text("a 5\nb 6\n")
    assert main(["export", str(file), "--to", "tum", "-o", str(tum)]) == 0
    np.testing.assert_array_equal(np.loadtxt(tum)[:, 0], [5.0, 6.0])


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
    np.testing.assert_allclose(exported[:, 1:3], from_dataset(poses)[1:, :2])
    named = [*arguments, str(tmp_path / "f.tum"), "--times"]
    refused([*named, str(run / "a.times")], f"no time of {prefixes[-1]}: expected", capsys)
    swapped = [rows[0].split()[0] + " 2e9\n", *rows[1:]]
    (run / "b.times").write_text("".join(swapped))
    refused([*named, str(run / "b.times")], "b.times: the frames' times do not ascend", capsys)
    (run / "b.times").write_text("".join([f"{prefixes[0]} {times[1]:.6f}\n", *rows[1:]]))
    refused([*named, str(run / "b.times")], "b.times: the frames' times do not ascend", capsys)
    (tmp_path / "c.times").write_text(rows[0] + "e.0001 x\n")
    refused([*named, str(tmp_path / "c.times")], "c.times:2: 'e.0001 x': expected", capsys)
    (tmp_path / "c.times").write_text("e.0001\n")
    refused([*named, str(tmp_path / "c.times")], "c.times:1: 'e.0001': expected", capsys)
