"""Rows from files drawn into images where they belong, and refused in one line otherwise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from detect.cli import main
from detect.drawing.frame import SIGMA_COLOUR, draw_rows, line_curves, sigma_bars
from detect.projection import DiscProjection, circle_on_floor
from detect.row_files import ImageRows, circle_settings_of
from detect.settings import CircleSettings
from detect.sources.interface import SomeFrames
from detect.sources.opening import open_source
from redetect.landmarks import CircleLandmark, Frame, LineLandmark, Step, circle_landmarks
from redetect.landmarks.files import read_head
from tests.detect.commands import Captured, assert_refused
from tests.pictures import changed, read_grey

FloatArray = NDArray[np.float64]

SETTINGS = CircleSettings()
STEP = Step("x.0001", *[0.0] * 9)


def discs(*places: tuple[float, float]) -> tuple[CircleLandmark, ...]:
    xy = np.array(places, float).reshape(-1, 2)
    covariance = np.tile(1e-4 * np.eye(2), (len(xy), 1, 1))
    return circle_landmarks(xy, np.full(len(xy), 0.9), covariance, np.full(len(xy), -1))


def vertical(camera: Camera, bearing: float, sigma: float) -> LineLandmark:
    """A vertical edge 4 m away from the robot's origin, from the floor to 2.2 m."""
    x, y = 4.0 * np.sin(bearing), -4.0 * np.cos(bearing)
    ends = camera.robot_to_camera(np.array([[x, y, 2.2], [x, y, 0.0]]))
    (xt, yt), (xb, yb) = (ends[:, :2] / ends[:, 2:]).tolist()
    seen = np.array([x, y]) - camera.centre[:2]
    alpha = float(np.arctan2(seen[0], -seen[1]))
    return LineLandmark(xt, yt, xb, yb, alpha, 0.0, 0.0, sigma, (-1,))


@pytest.fixture
def image() -> NDArray[np.uint8]:
    return np.random.default_rng(2).integers(60, 130, (288, 768)).astype(np.uint8)


# -- where things are drawn -------------------------------------------------------------------


def test_bars_cross_the_horizon_and_are_as_wide_as_their_sigma(published_camera: Camera) -> None:
    bearing, sigma = np.array([0.3, -0.5, 0.02]), np.array([0.01, 0.004, 0.002])
    rows = [vertical(published_camera, b, s) for b, s in zip(bearing, sigma)]
    ends = np.array([(r.xtop, r.ytop, r.xbottom, r.ybottom) for r in rows])
    bars = sigma_bars(published_camera, ends, sigma)
    direction = published_camera.directions_robot(bars)
    # The calibration's rotation has six digits.
    np.testing.assert_allclose(direction[..., 2], 0.0, atol=1e-6)
    reached = np.arctan2(direction[..., 0], -direction[..., 1])
    alpha = np.array([r.alpha for r in rows])
    np.testing.assert_allclose(reached, alpha[:, None] + sigma[:, None] * [1.0, -1.0], atol=2e-6)


def test_lines_go_through_the_lens(published_camera: Camera) -> None:
    row = vertical(published_camera, 0.6, 0.01)
    curve = line_curves(
        published_camera, np.array([[row.xtop, row.ytop, row.xbottom, row.ybottom]])
    )[0]
    back = published_camera.undistort(curve)
    along = np.array([row.xbottom - row.xtop, row.ybottom - row.ytop])
    off = (back - [row.xtop, row.ytop]) @ [-along[1], along[0]] / np.hypot(*along)
    np.testing.assert_allclose(off, 0.0, atol=1e-8)
    # It bends in the picture: the middle is pixels away from the chord.
    chord = curve[-1] - curve[0]
    bend = (curve - curve[0]) @ [-chord[1], chord[0]] / np.hypot(*chord)
    assert np.abs(bend).max() > 2.0


def test_matched_extra_and_missed_have_colours_of_their_own(
    image: NDArray[np.uint8], published_camera: Camera
) -> None:
    rows = ImageRows(
        circles=Frame(STEP, discs((0.2, -1.3), (-0.6, -1.5), (0.0, -2.0))),
        reference_circles=Frame(STEP, discs((0.21, -1.3), (0.7, -1.6))),
        unlisted=Frame(STEP, discs((0.0, -2.0))),
        lines=Frame(STEP, (vertical(published_camera, 0.3, 0.002),)),
        reference_lines=Frame(STEP, (vertical(published_camera, -0.4, 0.002),)),
    )
    canvas = draw_rows(image, DiscProjection(published_camera, SETTINGS), rows, "x.0001")
    assert canvas.shape[0] > 576
    assert canvas[576:].any()

    def colour_at(place: FloatArray) -> NDArray[np.uint8]:
        u, v = np.rint(2.0 * place + 0.5).astype(int)
        return np.asarray(canvas[v, u].astype(int))

    project = published_camera.project_floor
    for centre, expected in (
        ((0.2, -1.3), (0, 170, 255)),
        ((0.0, -2.0), (0, 170, 255)),
        ((-0.6, -1.5), (255, 60, 255)),
        ((0.7, -1.6), (60, 60, 255)),
    ):
        edge = np.array([colour_at(p) for p in project(circle_on_floor(centre, 0.1, 32))])
        assert np.median(np.abs(edge - expected).sum(axis=1)) < 120, centre
    for bearing, expected in ((0.3, (255, 60, 255)), (-0.4, (60, 60, 255))):
        row = vertical(published_camera, bearing, 0.002)
        curve = line_curves(
            published_camera, np.array([[row.xtop, row.ytop, row.xbottom, row.ybottom]])
        )[0]
        inside = curve[(curve[:, 1] > 40) & (curve[:, 1] < 280)]
        seen = np.array([colour_at(p) for p in inside])
        assert np.median(np.abs(seen - expected).sum(axis=1)) < 250, bearing


def test_without_reference_nothing_is_missed_or_extra(
    image: NDArray[np.uint8], published_camera: Camera
) -> None:
    rows = ImageRows(circles=Frame(STEP, discs((0.2, -1.3))))
    canvas = draw_rows(image, DiscProjection(published_camera, SETTINGS), rows).astype(int)
    seen = published_camera.project_floor(circle_on_floor((0.2, -1.3), 0.1, 32))
    edge = np.rint(2.0 * seen + 0.5).astype(int)
    apart = np.abs(canvas[edge[:, 1], edge[:, 0]] - (0, 170, 255)).sum(axis=1)
    assert np.median(apart) < 120


# -- which frames -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "every", "expected"),
    [(0, 1, [0, 1, 2]), (0, 2, [0, 2]), (2, 1, [0, 1]), (2, 2, [0]), (9, 2, [0, 2])],
)
def test_frames_are_selected(small_run: Path, count: int, every: int, expected: list[int]) -> None:
    frames = SomeFrames(open_source(small_run).frames, count, every)
    assert [frame.step.prefix for frame in frames] == [f"s.{k:04d}" for k in expected]
    assert frames.expected == len(expected)


# -- the command ------------------------------------------------------------------------------


def test_rows_are_drawn_without_detecting_again(small_run: Path, tmp_path: Path) -> None:
    (small_run / "detected.circles").write_text(
        "STEP s.0001 0 0 0 0 0 0 0 0 0\nLANDMARK_C 0.3 -1.5 0.77 1e-4 0 1e-4 -1\n"
    )
    assert main(["draw", str(small_run), "-o", str(tmp_path / "d")]) == 0
    names = sorted(path.name for path in (tmp_path / "d").iterdir())
    assert names == ["s.0000.png", "s.0001.png", "s.0002.png"]
    for name in names:
        picture = cv2.imread(str(tmp_path / "d" / name))
        grey = read_grey(small_run / "images" / name)
        assert picture is not None
        assert changed(np.asarray(picture[:576], np.uint8), grey).any() == (name == "s.0001.png")
    again = tmp_path / "again"
    assert main(["draw", str(small_run), "-o", str(again)]) == 0
    assert (again / "s.0001.png").read_bytes() == (tmp_path / "d" / "s.0001.png").read_bytes()


def test_pictures_without_rows_are_counted(
    small_run: Path, tmp_path: Path, capsys: Captured
) -> None:
    assert main(["circles", str(small_run), "--frames", "1"]) == 0
    assert main(["draw", str(small_run), "-o", str(tmp_path / "d")]) == 0
    assert "d: 3 pictures of circles; 2 frames without rows" in capsys.readouterr().out


def test_settings_and_tilt_are_read_from_the_head(small_run: Path) -> None:
    assert main(["circles", str(small_run), "--outer-ring", "1.5"]) == 0
    head = read_head(small_run / "detected.circles")
    assert circle_settings_of(head) == CircleSettings(outer_ring=1.5)
    assert not head.level
    assert main(["all", str(small_run), "--tilt", "frame", "--force"]) == 0
    assert read_head(small_run / "detected.circles").level


def test_video_has_a_picture_per_frame(small_run: Path, tmp_path: Path) -> None:
    assert main(["circles", str(small_run)]) == 0
    video, folder = tmp_path / "v.mp4", tmp_path / "d"
    arguments = ["draw", str(small_run), "--video", str(video), "-o", str(folder), "--fps", "4"]
    assert main(arguments) == 0
    reader = cv2.VideoCapture(str(video))
    assert reader.get(cv2.CAP_PROP_FPS) == pytest.approx(4.0)
    for name in ("s.0000", "s.0001", "s.0002"):
        good, picture = reader.read()
        assert good
        still = cv2.imread(str(folder / f"{name}.png"))
        assert still is not None
        assert np.abs(picture.astype(int) - still).mean() < 12.0
    assert not reader.read()[0]


OPENCVS_WRITER = cv2.VideoWriter


class FullDisk:
    """OpenCV's writer of videos, which drops frames silently; its own class has no subclasses."""

    fourcc = OPENCVS_WRITER.fourcc

    def __init__(self) -> None:
        self._writer = OPENCVS_WRITER()
        self.open, self.isOpened = self._writer.open, self._writer.isOpened
        self.release = self._writer.release

    def write(self, image: object) -> None:
        """Drop a frame."""


def test_a_video_that_could_not_be_written_is_none(
    small_run: Path, tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["circles", str(small_run)]) == 0
    capsys.readouterr()
    monkeypatch.setattr(cv2, "VideoWriter", FullDisk)
    draw = ["draw", str(small_run), "--video", str(tmp_path / "v.mp4")]
    assert_refused(draw, small_run, "No space left on device", capsys)
    assert not list(tmp_path.glob("*.mp4"))


def test_markers_are_drawn_without_a_calibration(small_run: Path, tmp_path: Path) -> None:
    (small_run / "s.cam").unlink()
    corners = "100 50 1 0 1 160 50 1 0 1 160 110 1 0 1 100 110 1 0 1"
    (small_run / "detected.markers").write_text(
        f"STEP s.0000 0 0 0 0 0 0 0 0 0\nLANDMARK_M rawseeds 5 0.9 {corners}\n"
    )
    assert main(["draw", str(small_run), "-o", str(tmp_path / "d"), "--frames", "1"]) == 0
    picture = cv2.imread(str(tmp_path / "d" / "s.0000.png"))
    assert picture is not None
    green = np.abs(picture[101, 221:300].astype(int) - (60, 220, 60)).sum(axis=1)
    assert np.median(green) < 60


def test_refusals(small_run: Path, tmp_path: Path, capsys: Captured) -> None:
    run, out = str(small_run), str(tmp_path / "d")
    assert_refused(["draw", run, "-o", out], small_run, "detect all", capsys)
    (small_run / "detected.circles").write_text("STEP s.0000 0 0 0 0 0 0 0 0 0\n")
    assert_refused(["draw", run], small_run, "--video", capsys)
    assert_refused(["draw", run, "-o", out, "--rows", "no"], small_run, "no/detected", capsys)
    for flag, expected in (("every", "a whole number"), ("fps", "above 0")):
        with pytest.raises(SystemExit):
            main(["draw", run, "-o", out, f"--{flag}", "0"])
        assert f"{flag} is 0: expected {expected}" in " ".join(capsys.readouterr().err.split())
    video = tmp_path / "v.mp4"
    fast = ["draw", run, "--video", str(video), "--fps", "1e9"]
    assert_refused(fast, small_run, "expected another --fps", capsys)
    video.write_bytes(b"mine")
    assert_refused(["draw", run, "--video", str(video)], small_run, "--force", capsys)
    assert video.read_bytes() == b"mine"
    (small_run / "s.cam").unlink()
    assert_refused(["draw", run, "-o", out], small_run, "--camera", capsys)


def test_steps_that_name_one_image_have_one_picture(small_run: Path, tmp_path: Path) -> None:
    steps = small_run / "s.txt"
    lines = steps.read_text().splitlines(keepends=True)
    steps.write_text("".join([*lines, lines[-1]]))
    drawn = tmp_path / "d"
    assert main(["circles", str(small_run), "--draw", str(drawn)]) == 0
    assert len(list(drawn.iterdir())) == 3


def test_no_picture_is_written_if_one_exists(
    small_run: Path, tmp_path: Path, capsys: Captured
) -> None:
    drawn = tmp_path / "d"
    drawn.mkdir()
    (drawn / "s.0002.png").write_bytes(b"mine")
    circles = ["circles", str(small_run), "--draw", str(drawn)]
    assert_refused(circles, small_run, "s.0002.png: exists already", capsys)
    assert main(circles[:2]) == 0
    capsys.readouterr()
    assert_refused(["draw", str(small_run), "-o", str(drawn)], small_run, "s.0002.png", capsys)
    assert [path.name for path in drawn.iterdir()] == ["s.0002.png"]


def test_labels_of_verticals_do_not_cover_each_other(published_camera: Camera) -> None:
    image = np.full((288, 768), 90, np.uint8)
    rows = [replace(vertical(published_camera, 0.02 * k, 0.01), ids=(k,)) for k in range(4)]

    def orange(*rows: LineLandmark) -> int:
        frame = Frame(STEP, rows)
        seen = ImageRows(lines=frame, reference_lines=frame)
        picture = draw_rows(image, DiscProjection(published_camera, SETTINGS), seen).astype(int)
        return int(np.sum((picture == SIGMA_COLOUR).all(axis=2)))

    assert orange(*rows) >= 0.97 * sum(orange(row) for row in rows)


def test_an_image_that_cannot_be_read_costs_its_frame(
    small_run: Path, tmp_path: Path, capsys: Captured
) -> None:
    assert main(["circles", str(small_run)]) == 0
    (small_run / "images" / "s.0001.png").write_bytes(b"no image")
    capsys.readouterr()
    assert main(["draw", str(small_run), "-o", str(tmp_path / "d")]) == 3
    assert "s.0001.png" in capsys.readouterr().err
    assert sorted(p.name for p in (tmp_path / "d").iterdir()) == ["s.0000.png", "s.0002.png"]
