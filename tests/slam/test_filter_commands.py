"""The commands of both filters end to end: files in, files out, and refusals in one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from redetect.landmarks.map_file import (
    LandmarkMap,
    MapLandmarks,
    Path2D,
    no_landmarks,
    read_map,
    read_path,
)
from redetect.slam.cli import main
from redetect.slam.commands.filters import lost_lines
from redetect.slam.errors import SlamError
from redetect.slam.filters.base import RowCount
from redetect.slam.filters.run import FilterRun
from redetect.slam.recording import LineRows, Recording
from redetect.slam.scoring import map_distance, path_distance
from tests.slam.ekf_rows import circle_rows

STEP = "STEP a.{k} 0.0 -0.2 0.05 1e-4 0 1e-4 0 0 1e-5\n"
DISC = "LANDMARK_C {x} -2 0.9 0.002 0.0001 0.003 {id}\n"


def tiny(path: Path) -> Path:
    path.write_text(
        "".join(STEP.format(k=k) + DISC.format(x=0.1 * k, id=1 + k % 2) for k in range(6))
    )
    return path


@pytest.fixture
def run(tmp_path: Path, project_root: Path) -> Path:
    """The demo run's rows and calibration, without its images."""
    folder = tmp_path / "e"
    folder.mkdir()
    for name in ("e.cam", "map.circles", "map.lines"):
        shutil.copy(project_root / "images" / "e" / name, folder / name)
    return folder


@pytest.mark.lowest
@pytest.mark.long
def test_map_then_localise(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ekf", str(run), "--circles", "--lines"]) == 0
    first = run / "slam" / "ekf"
    printed = capsys.readouterr().out
    assert "rows used         304 of discs" in printed
    assert "steps/s" in printed
    landmark_map = read_map(first / "map.csv")
    assert len(landmark_map.discs) == 31
    assert len(landmark_map.lines) > 30
    content = json.loads((first / "ekf.json").read_text())
    assert content["landmarks"]["discs"] == 31
    assert content["figures"]["rows_left_out"]["disc without ID"] == 10

    arguments = ["localize", str(run), "--circles", "--lines", "--map", str(first / "map.csv")]
    assert main([*arguments, "--reference", str(first / "path.csv")]) == 0
    second = run / "slam" / "localize"
    assert {path.name for path in second.iterdir()} == {
        "path.csv",
        "localize.json",
        "map.png",
        "errors.png",
    }
    content = json.loads((second / "localize.json").read_text())
    distance = content["figures"]["distance_from_reference"]
    assert distance["position_rms_m"] < 0.1
    path = read_path(second / "path.csv")
    assert len(path.poses) == 81
    assert path.covariance is not None
    assert path.prefixes[1] == "e.0000"
    capsys.readouterr()

    # What is there is not replaced unasked; and the same again gives the same bytes.
    before = {name: (second / name).read_bytes() for name in ("path.csv", "localize.json")}
    assert main(arguments) == 1
    assert "exists already" in capsys.readouterr().err
    assert main([*arguments, "--reference", str(first / "path.csv"), "--force"]) == 0
    again = json.loads((second / "localize.json").read_text())
    again["settings"]["force"] = False
    assert again == content
    assert (second / "path.csv").read_bytes() == before["path.csv"]


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Path:
    """Results of EKF-SLAM on the demo run's discs, by their identifiers."""
    folder = tmp_path_factory.mktemp("known")
    assert main(["ekf", str(project_root / "images" / "e"), "-o", str(folder)]) == 0
    return folder


@pytest.mark.long
@pytest.mark.parametrize("method", ["nearest", "joint"])
def test_identities_are_found_in_the_demo_run(run: Path, known: Path, method: str) -> None:
    reference = ["--reference", str(known / "path.csv")]
    some_map = ["--map", str(known / "map.csv")]
    assert main(["localize", str(run), "--association", method, *some_map, *reference]) == 0
    content = json.loads((run / "slam/localize/localize.json").read_text())
    assert content["figures"]["disc_rows_used"] > 290
    assert content["figures"]["distance_from_reference"]["position_max_m"] < 0.15
    assert main(["ekf", str(run), "--association", method, "-o", str(run / "found")]) == 0
    # Nearly as many landmarks as there are discs: hardly one is there twice.
    assert 28 <= len(read_map(run / "found/map.csv").discs) <= 36


def test_distances_are_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tiny(tmp_path / "a.circles")
    assert main(["ekf", str(file), "-o", str(tmp_path / "one")]) == 0
    reference = ["--reference", str(tmp_path / "one/path.csv")]
    reference += ["--reference-map", str(tmp_path / "one/map.csv")]
    assert main(["ekf", str(file), "-o", str(tmp_path / "two"), *reference]) == 0
    printed = capsys.readouterr().out
    assert "position rms 0.000 m" in printed
    assert "landmarks rms 0.000 m" in printed
    content = json.loads((tmp_path / "two/ekf.json").read_text())
    assert content["distance_from_reference_map"]["landmarks"] == 2


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--reference", "missing.csv"], "missing.csv: cannot be read"),
        (["--reference-map", "missing.csv"], "missing.csv: cannot be read"),
        (["--reference-map", "other.csv"], "no landmark is in both"),
        (["--interactive"], "no window can be opened here"),
    ],
)
def test_nothing_is_written_before_everything_is_read(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    tiny(Path("a.circles"))
    Path("other.csv").write_text("id,x_m,y_m,rows\n77,0,0,1\n")
    assert main(["ekf", "a.circles", *flags]) == 1
    assert message in capsys.readouterr().err
    if flags == ["--interactive"]:
        assert main(["map", "a.circles", *flags]) == 1
    assert not Path("slam").exists()


def test_distance_of_paths_and_maps() -> None:
    path = Path2D(("start", "a"), np.array([[0.0, 0, 0], [3.0, 4.0, 3.1]]))
    distance = path_distance(path, np.array([[0.0, 0, 0], [0.0, 0.0, -3.1]]))
    assert distance["position_max_m"] == distance["position_last_m"] == 5.0
    assert distance["position_rms_m"] == pytest.approx(np.sqrt(12.5))
    assert distance["heading_last_rad"] == pytest.approx(2 * np.pi - 6.2)

    def discs(ids: list[int], xy: list[list[float]]) -> LandmarkMap:
        covariance = np.tile(0.25 * np.eye(2), (len(ids), 1, 1))
        some = MapLandmarks(
            np.array(ids), np.array(xy), covariance, np.ones(len(ids), dtype=np.int64)
        )
        return LandmarkMap(some, no_landmarks())

    found = map_distance(
        discs([3, 1], [[0.0, 1], [5, 5]]), discs([1, 2, 3], [[5.0, 5], [9, 9], [0, 0]])
    )
    assert found == {
        "landmarks": 2.0,
        "rms_m": pytest.approx(np.sqrt(0.5)),
        "median_m": 0.5,
        "max_m": 1.0,
        "normalised": pytest.approx(1.0),
    }
    with pytest.raises(SlamError, match="no landmark is in both"):
        map_distance(discs([1], [[0.0, 0]]), discs([2], [[0.0, 0]]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (DISC.format(x=1, id=1) + STEP.format(k=0), "landmark before any STEP"),
        (STEP.format(k=0).replace("1e-5", "0"), "covariance is not positive definite"),
        (STEP.format(k=0) + DISC.format(x="nan", id=1), "px is 'nan'"),
        (STEP.format(k=0) + DISC.format(x=1, id=-1), "no landmark in the map"),
        ("# nothing\n", "no STEP row"),
    ],
)
def test_runs_that_can_not_be_mapped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    file = tmp_path / "a.circles"
    file.write_text(text)
    assert main(["ekf", str(file)]) == 1
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1
    assert not list(tmp_path.glob("slam/*/*"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--start-sigma", "0", "-1", "0"], "--start-sigma is -1: expected"),
        (["--start", "0", "nan", "0"], "--start is nan: expected -1e+12 to 1e+12"),
        (["--gate-probability", "1"], "--gate-probability is 1: expected"),
    ],
)
def test_impossible_settings_are_refused(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["localize", "a.circles", "--map", "map.csv", *arguments])
    assert message in capsys.readouterr().err


AWAY = ["--start", "50", "50", "0"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--reference", "short.csv"], "short.csv: 2 poses: expected 7"),
        (["--map", "other.csv"], "expected identifiers of the same run, or --association joint"),
        (["--map", "other.csv", "--association", "joint", *AWAY], "expected some near one, seen"),
        (["--map", "missing.csv"], "cannot be read"),
    ],
)
def test_localisation_that_is_refused(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    tiny(Path("a.circles"))
    head = "kind,id,x_m,y_m,cxx_m2,cxy_m2,cyy_m2,rows\n"
    Path("map.csv").write_text(head + "disc,1,0.0,-2.2,0.01,0,0.01,3\ndisc,2,0.2,-2.4,0,0,0,3\n")
    Path("other.csv").write_text(head + "disc,7,0.0,-2.2,0.01,0,0.01,3\n")
    Path("short.csv").write_text("prefix,x_m,y_m,theta_rad\nstart,0,0,0\na.0,0,0,0\n")
    if "--map" not in arguments:
        arguments = [*arguments, "--map", "map.csv"]
    assert main(["localize", "a.circles", *arguments]) == 1
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.err.count("\n") == 1
    assert not list(tmp_path.glob("slam/*/*"))


def test_lines_need_a_calibration(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "e.cam").unlink()
    assert main(["ekf", str(run), "--lines"]) == 1
    assert "calibration" in capsys.readouterr().err
    assert main(["ekf", str(run)]) == 0


def test_a_wrong_start_is_a_reason_for_large_errors(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["map", str(run)]) == 0
    localize = ["localize", str(run), "--map", str(run / "slam" / "map.csv"), "--force"]
    assert main(localize) == 0
    assert "--start" not in capsys.readouterr().out
    assert main([*localize, "--start", "1", "0", "0.5"]) == 0
    assert "larger than stated: is --start where the run begins?" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("first", "last", "each", "said"),
    [
        (15, 37, 100, "only 0 of 20 rows in 20 frames with discs, from f15 on"),
        (15, 30, 100, ""),
        (10, 60, 4, "only 10 of 45 rows in 45 frames with discs, from f11 on"),
        (10, 60, 2, ""),
    ],
)
def test_where_the_pose_is_lost_is_said(first: int, last: int, each: int, said: str) -> None:
    """Where few discs match: a lost robot among many discs is near some of them by chance."""
    count = 60
    seen = [k for k in range(count) if k % 10]  # every tenth frame shows none
    names = tuple(f"f{k}" for k in range(count))
    rows = circle_rows((k, (0.0, -2.0), np.eye(2), -1) for k in seen)
    none = np.tile(np.eye(3), (count, 1, 1))
    recording = Recording(names, np.zeros((count, 3)), none, rows, LineRows.of())
    matched = np.array([-1 if first <= k < last and k % each else 5 for k in seen])
    path = Path2D(("start", *names), np.zeros((count + 1, 3)))
    found = lost_lines(FilterRun(path, RowCount(), matched, ()), recording)
    assert bool(found) == bool(said)
    assert not said or said in found[0]
