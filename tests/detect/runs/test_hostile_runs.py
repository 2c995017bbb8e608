"""Runs from strangers: what a file of steps or a link names is read only if it is in the run."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera import Camera
from detect.cli import main
from detect.errors import FrameError
from detect.sources.grey_images import read_image
from detect.sources.opening import open_run
from redetect.landmarks import read_frames
from tests.detect.commands import Captured

STEP = "STEP {} 0 0 0 1e-6 0 1e-6 0 0 1e-6\n"


@pytest.fixture
def run(small_run: Path) -> Path:
    """The small run, with an image of the right size beside it that is none of its business."""
    first = min((small_run / "images").iterdir())
    (small_run.parent / "secret.png").write_bytes(first.read_bytes())
    return small_run


@pytest.mark.parametrize(
    ("prefix", "why"),
    [
        ("../../etc/passwd", "leads out"),
        ("../secret", "leads out"),
        ("../secret.png", "leads out"),
        ("..\\secret.png", "leads out"),
        ("images/../../secret", "leads out"),
        ("images/../../s/../secret", "leads out"),
        ("..", "leads out"),
        ("/etc/passwd", "absolute"),
        ("/s.0000", "absolute"),
        ("C:\\s.0000", "absolute"),
        ("\\\\server\\s.0000", "absolute"),
        ("s.0000\0", "NUL"),
        ("/dev/zero", "absolute"),
    ],
)
def test_prefixes_do_not_lead_out(run: Path, prefix: str, why: str) -> None:
    """One that does costs its frame, even where an image in the run has its last part's name."""
    (run / "s.txt").write_text(STEP.format(prefix) + STEP.format("s.0000"))
    (run / "images" / "secret.png").write_bytes((run / "images" / "s.0000.png").read_bytes())
    opened = open_run(run)
    refused, good = opened.frames
    assert refused.image is None
    with pytest.raises(FrameError, match=why) as refusal:
        read_image(refused, opened.camera)
    assert str(refusal.value).isprintable()
    assert read_image(good, opened.camera).shape == (288, 768)


@pytest.mark.parametrize(
    "prefix", ["s.0000", "s.0000.png", "images/s.0000", "../s/images/s.0000", "images\\s.0000.png",
               "./s.0000", "a..b/../s.0000", '"s.0000"'],
)  # fmt: skip
def test_prefixes_that_stay_are_followed(run: Path, prefix: str) -> None:
    (run / "s.txt").write_text(STEP.format(prefix))
    opened = open_run(run)
    (frame,) = opened.frames
    assert frame.step.prefix == prefix
    assert opened.frames.left_out == 2
    assert frame.image == run / "images" / "s.0000.png"


@pytest.mark.parametrize("odometry", [True, False])
@pytest.mark.parametrize("target", ["../../secret.png", "/etc/passwd", "/dev/zero", "../../gone"])
def test_links_do_not_lead_out(
    run: Path, published_camera: Camera, target: str, odometry: bool
) -> None:
    if not odometry:
        (run / "s.txt").unlink()
    image = run / "images" / "s.0001.png"
    image.unlink()
    image.symlink_to(target)
    frames = {frame.step.prefix: frame for frame in open_run(run).frames}
    with pytest.raises(FrameError, match="link that leads out"):
        read_image(frames["s.0001"], published_camera)
    assert read_image(frames["s.0000"], published_camera).shape == (288, 768)


def test_links_within_the_run_are_followed(run: Path, published_camera: Camera) -> None:
    for number, target in ((1, "s.0000.png"), (2, "../images/s.0000.png")):
        image = run / "images" / f"s.000{number}.png"
        image.unlink()
        image.symlink_to(target)
    images = [read_image(frame, published_camera) for frame in open_run(run).frames]
    np.testing.assert_array_equal(images[1], images[0])
    np.testing.assert_array_equal(images[2], images[0])


def test_a_folder_of_images_may_be_a_link(run: Path, published_camera: Camera) -> None:
    """Whoever unpacks a data set on another disk sees that link: it is their own."""
    (run / "images").rename(run.parent / "elsewhere")
    (run / "images").symlink_to("../elsewhere")
    for frame in open_run(run).frames:
        assert read_image(frame, published_camera).shape == (288, 768)


def test_names_that_a_terminal_would_act_upon_are_escaped(run: Path, capsys: Captured) -> None:
    name = "s.0000\x1b[2J\x1b]0;owned\x07\u202e"
    cv2.imwrite(str(run / "images" / f"{name}.png"), np.zeros((3, 3), np.uint8))
    (run / "s.txt").write_text(STEP.format(name) + STEP.format("s.0000") + STEP.format("\x1b[31m"))
    assert main(["circles", str(run), "--force"]) == 3
    shown = capsys.readouterr()
    for text in (shown.out, shown.err):
        assert all(character.isprintable() or character in "\n\r\t" for character in text)
    assert "\\x1b[31m" in shown.err
    for path in run.glob("*.json"):
        json.loads(path.read_text())


def mounted(text: str, pose: list[list[float]]) -> str:
    """The calibration with another sensor2World."""
    begin, end = text.index("sensor2World:"), text.index("mountIndex")
    rows = " ".join(f"[ {', '.join(map(repr, row))} ]" for row in pose)
    return f"{text[:begin]}sensor2World: {rows}\n{text[end:]}"


LEVEL = [[-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, -1.0, 0.0, 1.5]]
DOWN = [[-1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.5]]
UP = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.5]]


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ([*LEVEL[:2], [0.0, -1.0, 0.0, -1.5]], "the camera is -1.5 m above the floor"),
        ([*LEVEL[:2], [0.0, -1.0, 0.0, 0.0]], "the camera is 0 m above the floor"),
        ([*LEVEL[:2], [0.0, -1.1, 0.0, 1.5]], "sensor2World is not a rotation"),
        ([[1.0, *LEVEL[0][1:]], *LEVEL[1:]], "sensor2World is not a rotation but a reflection"),
        ([*LEVEL[:2], [0.0, -1.0, float("nan"), 1.5]], "sensor2World has 'nan'"),
    ],
)
def test_impossible_mountings_are_refused(
    run: Path, capsys: Captured, pose: list[list[float]], message: str
) -> None:
    (run / "s.cam").write_text(mounted((run / "s.cam").read_text(), pose))
    assert main(["all", str(run)]) == 1
    assert message in capsys.readouterr().err
    assert not list(run.glob("detected.*"))


@pytest.mark.parametrize("pose", [DOWN, UP])
def test_a_horizon_outside_the_image_means_no_verticals(
    run: Path, pose: list[list[float]], capsys: Captured
) -> None:
    """And a camera that sees no floor finds no discs; neither is an error, nor a warning."""
    (run / "s.cam").write_text(mounted((run / "s.cam").read_text(), pose))
    assert main(["all", str(run)]) == 0
    for name in ("detected.lines", *(["detected.circles"] if pose is UP else [])):
        frames = list(read_frames(run / name))
        assert [frame.step.prefix for frame in frames] == ["s.0000", "s.0001", "s.0002"]
        assert not any(frame.landmarks for frame in frames)
    assert "NOTILT s.0000 0" in (run / "detected.frames.tilt").read_text()
    capsys.readouterr()


def test_a_lens_that_folds_in_the_corners_is_used_where_it_sees(
    run: Path, tmp_path: Path, capsys: Captured
) -> None:
    text = (run / "s.cam").read_text()
    begin = text.index("coef:")
    (run / "s.cam").write_text(text[:begin] + "coef: { 0 -0.33 0 0 0 } }\n")
    assert main(["all", str(run), "--force"]) == 0
    assert "only 67 % of the pixels are used" in capsys.readouterr().err
    assert main(["draw", str(run), "-o", str(tmp_path / "drawn")]) == 0
    assert main(["report", str(run), "-o", str(tmp_path / "report.html")]) == 0


def test_a_distortion_that_folds_inside_the_image_is_refused(run: Path, capsys: Captured) -> None:
    text = (run / "s.cam").read_text()
    begin = text.index("coef:")
    (run / "s.cam").write_text(text[:begin] + "coef: { 0 -0.9 0 0 0 } }\n")
    assert main(["all", str(run)]) == 1
    assert "the distortion folds inside the image" in capsys.readouterr().err
