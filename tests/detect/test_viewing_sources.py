"""Drawing, reporting and tuning give the same, whatever the images come out of."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detect.cli import main
from tests.detect.recordings import Ros, Said, write_video
from tests.detect.test_cli import assert_refused

Images = list[NDArray[np.uint8]]


def as_video(folder: Path, images: Images) -> Path:
    return write_video(folder / "s.avi", images)


def as_bag(folder: Path, images: Images) -> Path:
    pytest.importorskip("rosbags")
    ros = Ros()
    said = [Said("/i", k, ros.image(image, "mono8", k)) for k, image in enumerate(images, 1)]
    return ros.write(folder / "s", said)


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
    grid = ["--vary", "threshold=0.3,0.6,0.9", "--jobs", "1"]
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
    assert files["table.json"].count(b'"threshold": 0.') == 4
    return files


@pytest.mark.long
@pytest.mark.parametrize("record", [as_video, as_bag], ids=["video", "bag"])
def test_the_same_pictures_page_and_table(
    small_run: Path,
    rows: list[str],
    expected: dict[str, bytes],
    tmp_path: Path,
    record: Callable[[Path, Images], Path],
) -> None:
    images = [
        np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
        for path in sorted((small_run / "images").iterdir())
    ]
    folder = tmp_path / "recorded" / "s"
    folder.mkdir(parents=True)
    shutil.copy(small_run / "s.cam", folder / "s.cam")
    found = looked_at(record(folder, images), rows, tmp_path / "output")
    assert sorted(found) == sorted(expected)
    for name, content in found.items():
        assert content == expected[name], name


@pytest.mark.parametrize("command", ["draw", "view", "report", "tune"])
def test_a_live_camera_shows_something_else_by_now(
    command: str, small_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if command == "view":
        pytest.importorskip("rerun")
    arguments = [command, "camera:0", "-o", str(small_run / "output")]
    arguments += ["--vary", "threshold=0.5"] if command == "tune" else []
    assert_refused(arguments, small_run, "camera:0: its images are not those of the rows", capsys)
