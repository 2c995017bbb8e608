"""Drawing, reporting and tuning give the same, whatever the images come out of."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from detect.cli import main
from tests.detect.commands import Captured, assert_refused
from tests.detect.recordings import images_of, write_bag, write_video


@pytest.fixture(scope="module")
def rows(small_run_template: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Flags that name what was found in the small run, and a reference that differs from it."""
    folder = tmp_path_factory.mktemp("rows")
    found, reference = folder / "detected.circles", folder / "map.circles"
    run = str(small_run_template)
    assert main(["circles", run, "-o", str(found)]) == 0
    assert main(["circles", run, "--preset", "published", "-o", str(reference)]) == 0
    return ["--rows", str(folder), "--reference", str(reference)]


def looked_at(source: Path, rows: list[str], output: Path) -> dict[str, bytes]:
    """The files that drawing, reporting and tuning write."""
    page, tuned, drawn = output / "page.html", output / "tuned", output / "drawn"
    output.mkdir()
    assert main(["draw", str(source), *rows, "-o", str(drawn)]) == 0
    assert main(["report", str(source), *rows, "-o", str(page)]) == 0
    grid = ["--vary", "evidence=-1,0,1", "--jobs", "1"]
    assert main(["tune", str(source), *grid, *rows[2:], "-o", str(tuned)]) == 0
    return {path.name: path.read_bytes() for path in [page, *drawn.iterdir(), tuned / "table.json"]}


@pytest.fixture(scope="module")
def expected(
    small_run_template: Path, rows: list[str], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, bytes]:
    """What is written of the folder of images."""
    files = looked_at(small_run_template, rows, tmp_path_factory.mktemp("of") / "folder")
    assert sorted(files) == ["page.html", "s.0000.png", "s.0001.png", "s.0002.png", "table.json"]
    assert b"data:image/jpeg" in files["page.html"]
    assert files["table.json"].count(b'"evidence": ') == 5
    return files


@pytest.mark.long
@pytest.mark.parametrize(("record", "name"), [(write_video, "s.avi"), (write_bag, "s")])
def test_the_same_pictures_page_and_table(
    small_run: Path,
    rows: list[str],
    expected: dict[str, bytes],
    tmp_path: Path,
    record: Callable[[Path, Sequence[NDArray[np.uint8]]], Path],
    name: str,
) -> None:
    folder = tmp_path / "recorded" / "s"
    folder.mkdir(parents=True)
    shutil.copy(small_run / "s.cam", folder / "s.cam")
    found = looked_at(record(folder / name, images_of(small_run)), rows, tmp_path / "output")
    assert sorted(found) == sorted(expected)
    for file, content in found.items():
        assert content == expected[file], file


@pytest.mark.parametrize("command", ["draw", "view", "report", "tune"])
def test_a_live_camera_shows_something_else_by_now(
    command: str, small_run: Path, capsys: Captured
) -> None:
    if command == "view":
        pytest.importorskip("rerun")
    arguments = [command, "camera:0", "-o", str(small_run / "output")]
    arguments += ["--vary", "evidence=0.5"] if command == "tune" else []
    assert_refused(arguments, small_run, "camera:0: its images are not those of the rows", capsys)
