"""The same images out of a folder, a pattern, a video: the same rows; and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera import Camera
from detect.cli import main
from detect.errors import DetectError
from detect.options import SourceOptions
from detect.sources.grey_images import read_image
from detect.sources.interface import Run
from detect.sources.opening import open_run, open_source
from redetect.landmarks import read_frames
from redetect.landmarks.frame_files import read_times
from tests.detect.commands import Captured, assert_refused, rows_in
from tests.detect.recordings import images_of, write_bag, write_video
from tests.pictures import read_grey

PREFIXES = ["s.0000", "s.0001", "s.0002"]


@pytest.fixture
def video(small_run: Path, tmp_path: Path) -> Path:
    path = tmp_path / "film" / "s.avi"
    path.parent.mkdir()
    shutil.copy(small_run / "s.cam", path.with_suffix(".cam"))
    return write_video(path, images_of(small_run))


@pytest.fixture
def expected_rows(small_run: Path, tmp_path: Path) -> list[str]:
    output = tmp_path / "expected.circles"
    assert main(["circles", str(small_run), "-o", str(output)]) == 0
    return rows_in(output)


# -- video ----------------------------------------------------------------------------------


@pytest.mark.lowest
def test_a_video_gives_the_rows_of_its_images(
    video: Path, expected_rows: list[str], capsys: Captured
) -> None:
    assert main(["circles", str(video)]) == 0
    output = video.parent / "s.detected.circles"
    assert f"{output}: 3 discs in 3 frames" in capsys.readouterr().out
    landmarks = [row for row in expected_rows if row.startswith("LANDMARK_C")]
    assert [row for row in rows_in(output) if row.startswith("LANDMARK_C")] == landmarks
    steps = [frame.step for frame in read_frames(output)]
    assert [step.prefix for step in steps] == PREFIXES
    assert all(step.dx == step.cxx == 0.0 for step in steps)
    times = read_times(f"{output}.times")
    assert times == pytest.approx({p: 0.1 * k for k, p in enumerate(PREFIXES)}, abs=1e-6)


def test_all_of_a_video_is_named_after_it(video: Path) -> None:
    assert main(["all", str(video)]) == 0
    names = sorted(path.name for path in video.parent.iterdir() if "log" not in path.name)
    endings = ("circles", "frames.tilt", "lines", "tilt", "times")
    assert names == sorted(["s.avi", "s.cam", *(f"s.detected.{ending}" for ending in endings)])
    assert main(["all", str(video)]) == 1  # nothing is overwritten unasked
    lines = video.parent / "s.detected.lines"
    assert main(["export", str(lines)]) == 0
    times = [row.split(",")[2] for row in Path(f"{lines}.csv").read_text().splitlines()[1:]]
    assert set(times) <= {"0.0", "0.1", "0.2"}
    for ending in endings[:-1]:
        (video.parent / f"s.detected.{ending}").unlink()
    assert main(["all", str(video)]) == 1  # the times stand there


def test_any_number_of_frames(video: Path) -> None:
    run = open_run(video, None, SourceOptions(frames=2))
    assert run.frames.expected == 2
    assert [frame.step.prefix for frame in run.frames] == PREFIXES[:2]
    assert [frame.step.prefix for frame in run.frames] == PREFIXES[:2]  # begun anew


@pytest.mark.long
@pytest.mark.parametrize("kind", ["video", "bag"])
def test_workers_write_the_same_bytes(project_root: Path, tmp_path: Path, kind: str) -> None:
    source = project_root / "images" / "e"
    images = [read_grey(path) for path in sorted((source / "images").glob("*.jpg"))[:20]]
    write = write_bag if kind == "bag" else write_video
    path = write(tmp_path / ("e" if kind == "bag" else "e.avi"), images)
    arguments = ["all", str(path), "--camera", str(source / "e.cam")]
    written = []
    for jobs in (1, 2):
        folder = tmp_path / f"jobs{jobs}"
        folder.mkdir()
        assert main([*arguments, "--jobs", str(jobs), "-o", str(folder)]) == 0
        kinds = ("circles", "lines", "tilt", "times")
        written.append([(folder / f"detected.{kind}").read_bytes() for kind in kinds])
    assert b"LANDMARK_C" in written[0][0]
    assert written[0] == written[1]


def test_frames_of_a_video_of_another_size_say_so(
    tmp_path: Path, small_run: Path, capsys: Captured
) -> None:
    path = write_video(tmp_path / "small.avi", [np.zeros((48, 64), np.uint8)] * 3)
    assert main(["circles", str(path), "--camera", str(small_run / "s.cam")]) == 3
    told = "is 64x48 px: expected 768x288, the calibration's size: name the calibration"
    assert told in capsys.readouterr().err


def test_a_video_that_is_cut_off_says_so(video: Path, caplog: pytest.LogCaptureFixture) -> None:
    content = video.read_bytes()
    video.write_bytes(content[: int(0.6 * len(content))])
    run = open_source(video, None, SourceOptions(odometry="none"))
    with caplog.at_level("INFO", logger="redetect"):
        count = len(list(run.frames))
    assert count < 3
    assert count == run.frames.expected or f"only {count} of 3 frames" in caplog.text


# -- images ---------------------------------------------------------------------------------


def test_a_pattern_takes_what_it_matches(small_run: Path, expected_rows: list[str]) -> None:
    pattern = small_run / "images" / "s.000[01].png"
    assert main(["circles", str(pattern), "--odometry", str(small_run / "s.txt")]) == 3
    assert rows_in(small_run / "detected.circles") == [
        *expected_rows[: expected_rows.index(next(r for r in expected_rows if "s.0002" in r))],
        next(row for row in expected_rows if "s.0002" in row),
    ]


def test_patterns_and_single_images(small_run: Path, published_camera: Camera) -> None:
    pattern = open_source(small_run / "images" / "*1.png")
    assert isinstance(pattern, Run)
    assert pattern.camera == published_camera
    (frame,) = pattern.frames
    assert frame.step.prefix == "s.0001"
    assert pattern.output("circles") == small_run / "detected.circles"
    (alone,) = open_source(small_run / "images" / "s.0002.png").frames
    assert alone.image == small_run / "images" / "s.0002.png"


def test_a_calibration_above_or_among_the_images(
    small_run: Path, published_camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = small_run / "images"
    assert open_run(folder).camera == published_camera
    assert open_run(folder).output_base == small_run / "detected"
    monkeypatch.chdir(folder)
    for name in (".", "*.png", "../images"):
        assert open_run(Path(name)).output_base.resolve() == small_run / "detected"
    (small_run / "s.cam").rename(folder / "s.cam")
    for name in (".", "*.png"):
        assert open_run(Path(name)).camera == published_camera


def test_names_that_look_like_patterns(small_run: Path) -> None:
    folder = (small_run / "images").rename(small_run / "drive[1]")
    (folder / "s.0000.png").rename(folder / "s[1].png")
    (folder / "s.0001.png").rename(folder / "s1.png")
    (frame,) = open_source(folder / "s[1].png").frames
    assert frame.image == folder / "s[1].png"
    assert len(list(open_source(folder / "*.png").frames)) == 3


def test_more_frames_than_there_can_be() -> None:
    with pytest.raises(DetectError, match="frames is 100000000000000000000: expected a whole"):
        SourceOptions(frames=10**20)


def test_two_images_of_the_same_name(small_run: Path) -> None:
    folder = small_run / "images"
    (folder / "s.0001.png").rename(folder / "s.0000.tiff")
    with pytest.raises(DetectError, match=r"'s\.0000\.png' and 's\.0000\.tiff' would be the same"):
        list(open_source(folder).frames)
    assert len(list(open_source(folder / "*.png").frames)) == 2


@pytest.mark.parametrize(
    ("deep", "significant"), [(4095, 12), (1023, 10), (65535, 16), (200, 8), (0, 8)]
)
def test_deep_images_by_their_significant_bits(tmp_path: Path, deep: int, significant: int) -> None:
    """The 8 highest of the bits that the image uses."""
    values = np.linspace(0, deep, 64 * 48).reshape(48, 64).astype(np.uint16)
    assert cv2.imwrite(str(tmp_path / "a.png"), values)
    assert cv2.imwrite(str(tmp_path / "b.tiff"), values)
    for frame in open_source(tmp_path).frames:
        np.testing.assert_array_equal(read_image(frame, None), values >> (significant - 8))


def test_a_hot_pixel_darkens_no_other(tmp_path: Path) -> None:
    values = np.full((200, 200), 900, np.uint16)
    values[3, 5] = 4095
    assert cv2.imwrite(str(tmp_path / "a.png"), values)
    (frame,) = open_source(tmp_path).frames
    image = read_image(frame, None)
    assert (image[3, 5], image[4, 5]) == (255, 900 >> 2)


def test_a_description_of_images_makes_no_bag(small_run: Path) -> None:
    (small_run / "metadata.yaml").write_text("camera: front\n")
    assert open_source(small_run).frames.expected == 3


# -- what a newcomer meets ------------------------------------------------------------------


def no_video(tmp_path: Path, _: Path) -> list[str]:
    (tmp_path / "notes.mp4").write_text("no video")
    return [str(tmp_path / "notes.mp4")]


REFUSED: dict[str, tuple[Callable[[Path, Path], list[str]], str]] = {
    "nothing there": (
        lambda tmp_path, run: [str(tmp_path / "gone")],
        "no such folder or file: expected a run folder, a folder of images",
    ),
    "no video": (no_video, "no video that OpenCV can read: expected a run folder, images"),
    "no calibration": (
        lambda tmp_path, run: [str((run / "images").rename(tmp_path / "x") / "*.png")],
        "no calibration: expected a .cam file beside the images, or one named by --camera",
    ),
    "no match": (lambda tmp_path, run: [str(run / "images" / "*.jpg")], "no image matches"),
    "wildcards in folders": (
        lambda tmp_path, run: [str(run / "*" / "a.png")],
        "wildcards in a folder's name: expected them in the last part only",
    ),
    "no such camera": (
        lambda tmp_path, run: ["camera:97", "--camera", str(run / "s.cam")],
        "camera:97: no camera of that number answers",
    ),
    "topic without a bag": (
        lambda tmp_path, run: [str(run), "--image-topic", "/i"],
        "--image-topic /i: only bags have topics",
    ),
    "odometry topic without a bag": (
        lambda tmp_path, run: [str(run), "--odometry", "/odom"],
        "has no topic /odom: only bags do",
    ),
    "no odometry": (
        lambda tmp_path, run: [str(run), "--odometry", str(tmp_path / "gone.txt")],
        "gone.txt: no such landmark file",
    ),
    "trajectory without times": (
        lambda tmp_path, run: [str(run), "--odometry", str(tmp_path / "a.tum")],
        "no times of the images, which a trajectory needs",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_tell_what_to_do(
    small_run: Path, tmp_path: Path, capsys: Captured, case: str
) -> None:
    make, told = REFUSED[case]
    arguments = make(tmp_path, small_run)
    assert_refused(["circles", *arguments], small_run, told, capsys)
