"""IDs of own rows from files to files: of shipped rows, and of a map seen from a path."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from detect.cli import main
from detect.runs.plan import MapByImage
from redetect.landmarks import CircleLandmark, LandmarkFileError, read_frames
from tests.detect.commands import Captured
from tests.detect.demo_frames import demo_frames

FRAMES = 30


@pytest.fixture
def run(project_root: Path, tmp_path: Path) -> Path:
    """Some frames of the demo run."""
    run = demo_frames(project_root, tmp_path / "e", range(FRAMES))
    steps = (project_root / "images" / "e" / "e.txt").read_text().splitlines(keepends=True)
    rows = [row for row in steps if row.startswith("STEP")]
    (run / "e.txt").write_text("".join(rows[:FRAMES]))
    return run


def named(path: Path) -> dict[tuple[str, int], CircleLandmark]:
    """Rows with an ID, by their image and ID."""
    rows = [(frame.step.prefix, row) for frame in read_frames(path) for row in frame.circles]
    found = {(Path(prefix).name, row.ids[0]): row for prefix, row in rows if row.ids != (-1,)}
    assert len(found) == sum(row.ids != (-1,) for _, row in rows)  # no ID twice in a frame
    return found


@pytest.mark.parametrize("command", ["circles", "all"])
def test_ids_of_rows_and_of_a_map(
    run: Path, project_root: Path, tmp_path: Path, command: str
) -> None:
    """The map is made of the rows that --ids-from named; by itself it names nearly all of them."""
    shipped = project_root / "images" / "e" / "map.circles"
    truth = named(shipped)
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir()
    target = ["-o", str(first / "detected.circles" if command == "circles" else first)]
    assert main([command, str(run), *target, "--ids-from", str(shipped)]) == 0
    own = named(first / "detected.circles")
    in_view = {key: row for key, row in truth.items() if key[0] < f"e.{FRAMES:04d}"}
    assert len(own.keys() & in_view.keys()) > 0.9 * len(in_view)
    assert own.keys() <= in_view.keys()

    from redetect.slam.cli import main as slam

    assert slam(["map", str(first / "detected.circles"), "-o", str(first / "map")]) == 0
    target = ["-o", str(second / "detected.circles" if command == "circles" else second)]
    places = ["--ids-from-map", str(first / "map" / "map.csv")]
    places += ["--path", str(first / "map" / "path.csv")]
    assert main([command, str(run), *target, *places]) == 0
    by_map = named(second / "detected.circles")
    # A disc may also be seen where the truth does not list it.
    assert len(by_map.keys() & own.keys()) > 0.97 * len(own)


def test_the_tilt_may_be_left_out(run: Path, tmp_path: Path) -> None:
    heads = []
    for number, flags in enumerate([[], ["--tilt", "none"]]):
        file = tmp_path / f"{number}.circles"
        assert main(["circles", str(run), "-o", str(file), *flags]) == 0
        heads.append(file.read_text().partition("STEP e")[0])
    assert ["tilt_sigma_deg=None" in head for head in heads] == [False, True]


def test_files_of_another_run_are_noticed(
    small_run: Path, project_root: Path, tmp_path: Path, capsys: Captured
) -> None:
    others, own = project_root / "images" / "e" / "map.circles", tmp_path / "own.circles"
    command = ["circles", str(small_run), "-o", str(own), "--force"]
    assert main([*command, "--ids-from", str(others)]) == 0
    assert "no image of this run is in the files" in capsys.readouterr().err
    own.rename(tmp_path / "before.circles")
    assert main([*command, "--ids-from", str(tmp_path / "before.circles")]) == 0
    assert "no image of this run" not in capsys.readouterr().err


def test_a_map_needs_its_path(run: Path, tmp_path: Path, capsys: Captured) -> None:
    (tmp_path / "map.csv").write_text("kind,id,x_m,y_m,cxx_m2,cxy_m2,cyy_m2,rows\n")
    assert main(["circles", str(run), "--ids-from-map", str(tmp_path / "map.csv")]) == 1
    assert re.search("error: .*--path", capsys.readouterr().err)


@pytest.mark.parametrize("command", ["circles", "lines", "all"])
def test_line_ends_are_those_asked_for(run: Path, tmp_path: Path, command: str) -> None:
    written = []
    for ends in ("lf", "crlf"):
        folder = tmp_path / ends
        folder.mkdir()
        kind = "lines" if command == "lines" else "circles"
        target = folder if command == "all" else folder / f"detected.{kind}"
        assert main([command, str(run), "-o", str(target), "--line-ends", ends]) == 0
        content = (folder / f"detected.{kind}").read_bytes()
        first = content.index(b"STEP")
        written.append(content[first:])
    assert b"\r" not in written[0]
    assert written[1] == written[0].replace(b"\n", b"\r\n")


def test_a_maps_discs_are_seen_from_the_frames_pose(tmp_path: Path) -> None:
    columns = "kind,id,x_m,y_m,cxx_m2,cxy_m2,cyy_m2,rows"
    (tmp_path / "map.csv").write_text(
        f"{columns}\ndisc,4,1,3,0.0004,0,0.0001,7\ndisc,5,40,0,1,0,1,2\n"
    )
    (tmp_path / "path.csv").write_text(
        "prefix,x_m,y_m,theta_rad\nstart,0,0,0\nimages/k.0007,1,1,1.5707963267948966\n"
    )
    seen = MapByImage(tmp_path / "map.csv", tmp_path / "path.csv")

    (disc,) = seen.get("k.0007.png") or ()  # the other is too far away
    assert disc.ids == (4,)
    assert (disc.px, disc.py) == pytest.approx((2.0, 0.0))
    assert (disc.cxx, disc.cxy, disc.cyy) == pytest.approx((1e-4, 0.0, 4e-4))
    assert seen.get("k.0008") is None


@pytest.mark.parametrize("row", ["disc,4,1,3,0.0004,0,0.0001", "disc,4,1,x,0.0004,0,0.0001,7"])
def test_a_malformed_map_is_refused(tmp_path: Path, row: str) -> None:
    (tmp_path / "map.csv").write_text(f"kind,id,x_m,y_m,cxx_m2,cxy_m2,cyy_m2,rows\n{row}\n")
    (tmp_path / "path.csv").write_text("prefix,x_m,y_m,theta_rad\nstart,0,0,0\n")
    with pytest.raises(LandmarkFileError, match=r"map\.csv:2: "):
        MapByImage(tmp_path / "map.csv", tmp_path / "path.csv")
