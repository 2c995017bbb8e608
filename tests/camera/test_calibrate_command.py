"""From rendered pictures to a .cam file and its pose; what a newcomer gets wrong."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera, read_camera, write_camera
from camera.boards.board import Board
from camera.boards.points import find_board
from camera.calibration.floor import on_floor, place_on_floor, read_floor_points
from camera.calibration.model import COUNT
from camera.cli import main
from camera.errors import CalibrationError
from camera.rotations import rotation_of
from camera.uncertainty import covariance_of
from redetect import __version__
from redetect.array_types import FloatArray
from tests.camera.conftest import BOARD, PICTURES
from tools.evaluation.boards import Rays, projection_difference, render_board
from tools.evaluation.calibration import BOARDS, calibrate_rendered

FLAGS = ["--columns", "9", "--rows", "6", "--square-m", "0.04"]


def placed(camera: Camera) -> Camera:
    """The camera 0.6 m above the floor, looking ahead (-Y) and 40 degrees down."""
    c, s = math.cos(math.radians(40.0)), math.sin(math.radians(40.0))
    return replace(
        camera,
        robot_from_camera=((-1.0, 0.0, 0.0, 0.05), (0.0, s, -c, -0.1), (0.0, -c, -s, 0.6)),
    )


@pytest.mark.long
def test_from_pictures_to_a_placed_camera(
    rays: Rays, photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = placed(rays.camera)
    # Lying with its top ahead of the robot, its middle at (0.03, -0.75).
    turn = np.diag([-1.0, -1.0, 1.0])
    R, centre = truth.rotation.T, truth.centre
    floor = render_board(
        rays, BOARD, R @ turn, R @ (np.array([0.03, -0.75, 0.0]) - centre), seed=50
    )
    cv2.imwrite(str(tmp_path / "floor.png"), floor)
    output = tmp_path / "my.cam"
    # A count that is wrong.
    command = [
        "calibrate", str(photographs), "--columns", "10", "--rows", "7", "--square-m", "0.04",
        "--pictures", str(tmp_path / "check"), "-o", str(tmp_path / "lens.cam"),
        "--coefficients", "2", "--tangential", "off",
    ]  # fmt: skip
    assert main(command) == 0
    assert "the board has 9 x 6 inner corners" in capsys.readouterr().err
    command = [
        "floor", str(tmp_path / "lens.cam"), str(tmp_path / "floor.png"), *FLAGS,
        "--floor-origin", "0.03", "-0.75", "--floor-yaw", "180",
        "--pictures", str(tmp_path / "check"), "-o", str(output),
    ]  # fmt: skip
    assert main(command) == 0
    assert "covariance" in capsys.readouterr().out
    found = read_camera(output)
    assert projection_difference(truth, found).max() < 0.1
    assert found.scale_y / found.scale_x == pytest.approx(1.0, abs=0.004)
    covariance = covariance_of(found)
    assert covariance is not None
    for name in ("grid", "from-above"):
        assert cv2.imread(str(tmp_path / "check" / f"floor.png.{name}.png")) is not None
    assert len(list((tmp_path / "check").glob("*.corners.png"))) >= PICTURES - 2
    # The board lies along the pixels' rows, where edges are rendered to a quarter of a pixel.
    sigma = np.sqrt(np.diag(covariance)[COUNT:])
    assert np.all(np.abs(found.centre - truth.centre) < 5.0 * sigma[:3])
    assert np.linalg.norm(found.centre - truth.centre) < 0.005
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=0.005)
    for name in ("residuals", "coverage"):
        assert cv2.imread(str(tmp_path / f"lens.{name}.png")) is not None
    report = json.loads((tmp_path / "lens.json").read_text())
    assert report["options"]["square_m"] == 0.04
    assert report["version"] == __version__
    assert len(report["views"]) + len(report["left_out"]) >= PICTURES - 2
    errors = np.array([view["rms_px"] for view in report["views"]])
    points = np.array([view["points"] for view in report["views"]])
    assert np.sqrt(points @ errors**2 / points.sum()) == pytest.approx(report["rms_px"], rel=0.05)
    assert report["rms_px"] < 0.2
    # The same from known places: a table instead of a picture.
    places = on_floor(BOARD.points, (0.03, -0.75), math.pi)
    rows = [
        f"{u},{v},{x},{y}"
        for (u, v), (x, y) in zip(truth.project_floor(places[:, :2]), places[:, :2])
    ]
    (tmp_path / "places.csv").write_text("\n".join(["u,v,x,y", *rows, ""]))
    again = tmp_path / "again.cam"
    assert main(["floor", str(output), str(tmp_path / "places.csv"), "-o", str(again)]) == 0
    np.testing.assert_allclose(read_camera(again).centre, truth.centre, atol=0.005)


@pytest.mark.long
def test_a_video_gives_what_its_frames_give(
    rays: Rays, photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "board.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (320, 240))
    for image in sorted(photographs.iterdir()):
        frame = cv2.imread(str(image))
        assert frame is not None
        writer.write(frame)
    writer.release()
    output = tmp_path / "video.cam"
    command = ["calibrate", str(path), *FLAGS, "-o", str(output)]
    command += ["--coefficients", "2", "--tangential", "off"]
    assert main(command) == 0
    assert f"of {PICTURES} pictures of 320 x 240" in capsys.readouterr().out
    found = read_camera(output)
    # The video's compression costs some of the points' accuracy.
    assert projection_difference(rays.camera, found).max() < 1.0
    # The same bytes again, and not unasked.
    first = output.read_bytes()
    assert main(command) == 1
    assert "--force" in capsys.readouterr().err
    assert main([*command, "--force"]) == 0
    assert output.read_bytes() == first


@pytest.mark.long
def test_rendered_boards_through_the_published_camera(published_camera: Camera) -> None:
    board, distances = BOARDS["checkerboard"]
    made = calibrate_rendered(published_camera, board, distances, views=10, seed=7)
    assert made.found == 10
    # At the points' own noise, less what the fit takes up.
    assert made.calibration.adjusted.rms_px < 1.02 * made.floor_px
    assert projection_difference(published_camera, made.camera).max() < 0.1


@pytest.mark.parametrize(
    "board",
    [
        Board("checkerboard", 7, 6, 0.04),
        Board("charuco", 7, 6, 0.05, marker_m=0.036),
        Board("asymmetric-circles", 4, 7, 0.03, circle_m=0.028),
        Board("circles", 6, 5, 0.05, circle_m=0.025),
    ],
    ids=lambda board: board.kind,
)
def test_points_are_found_in_the_boards_order(rays: Rays, board: Board) -> None:
    facing = np.diag([1.0, -1.0, -1.0])
    tilt = rotation_of(np.array([0.2, -0.3, 0.15])) @ facing
    t = np.array([0.01, 0.0, 0.42])
    # Circles' images are shifted by perspective, by less than this here.
    allowed = 0.5 if "circles" in board.kind else 0.15
    indices, pixels = find_board(render_board(rays, board, tilt, t, noise=1.0), board)
    expected = rays.camera.project(board.points @ tilt.T + t)[indices]
    assert len(indices) > 0.8 * len(board.points)
    assert np.linalg.norm(pixels - expected, axis=1).max() < allowed


def test_a_board_upside_down_is_still_in_its_order(rays: Rays) -> None:
    turned = np.diag([-1.0, 1.0, -1.0])
    t = np.array([0.0, 0.0, 0.5])
    _, pixels = find_board(render_board(rays, BOARD, turned, t), BOARD)
    expected = rays.camera.project(BOARD.points @ turned.T + t)
    # Upright edges are rendered to a quarter of a pixel.
    assert np.linalg.norm(pixels - expected, axis=1).max() < 0.3


@pytest.mark.parametrize("times", [5, 6])
def test_large_pictures_are_searched_reduced_and_measured_whole(
    rays: Rays, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched = []
    find = cv2.findChessboardCorners

    def finding(image: NDArray[np.uint8], size: tuple[int, int]) -> object:
        searched.append(image.shape)
        return find(image, size)

    monkeypatch.setattr(cv2, "findChessboardCorners", finding)
    turned = rotation_of(np.array([0.2, -0.3, 0.15])) @ np.diag([1.0, -1.0, -1.0])
    t = np.array([0.01, 0.0, 0.42])
    image = render_board(rays, BOARD, turned, t, noise=1.0)
    large = cv2.resize(image, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
    _, pixels = find_board(np.asarray(large, dtype=np.uint8), BOARD)
    expected = (rays.camera.project(BOARD.points @ turned.T + t) + 0.5) * times - 0.5
    assert np.linalg.norm(pixels - expected, axis=1).max() < 0.15 * times
    assert searched == [(960, 1280)]


def test_a_board_that_is_not_there_is_not_searched_in_a_whole_large_picture(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched = []

    def finding(image: NDArray[np.uint8], _: tuple[int, int]) -> tuple[bool, None]:
        searched.append(image.shape)
        return False, None

    monkeypatch.setattr(cv2, "findChessboardCorners", finding)
    with pytest.raises(CalibrationError, match="are --columns and --rows right"):
        find_board(np.zeros((3000, 4000), np.uint8), BOARD)
    assert searched == [(960, 1280), (1920, 1280), (1536, 2048), (3072, 2048)]


@pytest.mark.parametrize("shape", [(14, 640), (640, 14), (1, 1)])
def test_a_picture_of_a_few_rows_has_no_board(shape: tuple[int, int]) -> None:
    with pytest.raises(CalibrationError, match="no checkerboard"):
        find_board(np.zeros(shape, np.uint8), BOARD)


def test_pose_on_the_floor_and_its_covariance(published_camera: Camera) -> None:
    rng = np.random.default_rng(6)
    floor_xy = rng.uniform([-0.8, -2.5], [0.8, -0.8], size=(25, 2))
    # The scale is found from 50 residuals, so compare at the true one; 40 trials know the mean to
    # 9 %.
    nees = floor_errors(published_camera, floor_xy, 40, rng, known=True)
    assert np.mean(nees) == pytest.approx(6.0, rel=0.2)


def test_the_covariance_from_few_points_is_not_too_small(published_camera: Camera) -> None:
    """Two or four redundant numbers hardly show the noise."""
    rng = np.random.default_rng(7)
    for count in (4, 5):
        corners = np.array([[-0.6, -2.2], [0.6, -2.2], [0.6, -1.0], [-0.6, -1.0], [0.1, -1.7]])
        nees = floor_errors(published_camera, corners[:count], 60, rng, known=False)
        assert np.mean(nees) / 6.0 < 2.2


def floor_errors(
    camera: Camera, floor_xy: FloatArray, trials: int, rng: np.random.Generator, *, known: bool
) -> list[float]:
    """Squared normalised errors of poses from noisy points; `known`: at the true noise."""
    exact = camera.project_floor(floor_xy)
    # The file's rotation has six digits; the estimate's is a rotation.
    still = place_on_floor(camera, exact, floor_xy)
    np.testing.assert_allclose(still.camera.centre, camera.centre, atol=1e-3)
    nees = []
    for _ in range(trials):
        noisy = exact + rng.normal(scale=0.2, size=exact.shape)
        found = place_on_floor(camera, noisy, floor_xy)
        turn = found.camera.rotation @ still.camera.rotation.T
        vector = 0.5 * np.array(
            [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        )
        shift = found.camera.centre - still.camera.centre
        error = np.concatenate([shift, vector])
        scale = (0.2 / found.fit.sigma_px) ** 2 if known else 1.0
        nees.append(float(error @ np.linalg.solve(scale * found.covariance, error)))
    return nees


def test_mirrored_floor_axes_are_told(published_camera: Camera) -> None:
    floor_xy = np.random.default_rng(6).uniform([-0.8, -2.5], [0.8, -0.8], size=(12, 2))
    pixels = published_camera.project_floor(floor_xy)
    with pytest.raises(CalibrationError, match="mirrored"):
        place_on_floor(published_camera, pixels, floor_xy * [-1.0, 1.0])


def test_points_in_a_line_are_told(published_camera: Camera) -> None:
    floor_xy = np.column_stack([np.zeros(6), np.linspace(-2.0, -1.0, 6)])
    with pytest.raises(CalibrationError, match="in a line"):
        place_on_floor(published_camera, published_camera.project_floor(floor_xy), floor_xy)


def test_a_line_and_a_point_beside_it_are_told(published_camera: Camera) -> None:
    """Two that are one point, too: three places see the camera at several poses."""
    line = np.column_stack([np.zeros(3), np.linspace(-2.0, -1.0, 3)])
    for floor_xy in ([*line, [0.5, -1.5]], [*line[:2], [0.5, -1.5], [0.5, -1.5]]):
        pixels = published_camera.project_floor(floor_xy)
        with pytest.raises(CalibrationError, match="all but one, lie in a line"):
            place_on_floor(published_camera, pixels, np.array(floor_xy))
    square = np.array([[-0.5, -2.0], [0.5, -2.0], [0.5, -1.0], [-0.5, -1.0]])
    found = place_on_floor(published_camera, published_camera.project_floor(square), square)
    np.testing.assert_allclose(found.camera.centre, published_camera.centre, atol=1e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,u,v\n", "expected u,v,x,y"),
        ("u,v,x,y\n1,2,3\n", ":2: .*: expected 4 numbers"),
        ("u,v,x,y\n1,2,3,inf\n", ":2: .*: expected 4 numbers"),
    ],
)
def test_bad_floor_files(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "places.csv"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=message):
        read_floor_points(path)


def test_what_a_newcomer_gets_wrong(
    rays: Rays, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = ["-o", str(tmp_path / "my.cam")]

    def error(*arguments: str) -> str:
        assert main(list(arguments)) == 1
        return capsys.readouterr().err

    lost = ["-o", str(tmp_path / "none" / "my.cam")]
    assert "no such folder" in error("calibrate", str(tmp_path), *FLAGS, *lost)
    assert "no such picture" in error("calibrate", str(tmp_path / "none"), *FLAGS, *output)
    assert "no pictures in" in error("calibrate", str(tmp_path), *FLAGS, *output)
    empty = np.full((240, 320), 128, dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), empty)
    told = error("calibrate", str(tmp_path), *FLAGS, *output)
    assert "in any of 1 pictures" in told
    assert "10 x 7 squares has 9 x 6" in told
    assert len(told.splitlines()) == 1
    facing = np.diag([1.0, -1.0, -1.0])
    near = render_board(rays, BOARD, facing, np.array([0.0, 0.0, 0.5]))
    cv2.imwrite(str(tmp_path / "a.png"), near)
    for name in ("b.png", "c.png"):
        cv2.imwrite(str(tmp_path / name), empty)
    told = error("calibrate", str(tmp_path), *FLAGS, *output)
    assert "error: 1 pictures of the board" in told
    assert told.startswith("b.png, c.png: no checkerboard")
    (tmp_path / "c.png").unlink()
    markers = ["--board", "charuco", "--marker-m", "0.03"]
    told = error("calibrate", str(tmp_path), *FLAGS, *markers, "--dictionary", "NONE", *output)
    assert told.count("'NONE' is unknown") == 1
    assert "a.png" not in told
    told = error("calibrate", str(tmp_path), *FLAGS, *markers, *output)
    assert "the --dictionary?" in told
    assert len(told.splitlines()) == 1
    cv2.imwrite(str(tmp_path / "b.png"), empty[:200])
    assert "pictures before" in error("calibrate", str(tmp_path), *FLAGS, *output)
    (tmp_path / "b.png").write_bytes(b"no picture")
    assert "expected an image" in error("calibrate", str(tmp_path), *FLAGS, *output)
    cam = tmp_path / "c.cam"
    write_camera(rays.camera, cam)
    assert "floor_yaw is nan" in error("floor", str(cam), "a.png", "--floor-yaw", "nan", *output)
    told = error("floor", str(cam), str(tmp_path / "a.png"), *output)
    assert "--columns, --rows and --square-m" in told
    even = ["--columns", "8", "--rows", "6", "--square-m", "0.04"]
    assert "looks the same turned" in error(
        "floor", str(cam), str(tmp_path / "a.png"), *even, *output
    )
    assert not (tmp_path / "my.cam").exists()


@pytest.mark.parametrize("command", ["calibrate", "floor", "convert"])
def test_help_shows_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    assert f"Example: camera {command}" in " ".join(capsys.readouterr().out.split())


def test_pictures_of_the_same_name_are_told_apart(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Cameras number the pictures of each folder from the beginning."""
    for i, picture in enumerate(sorted(photographs.glob("*.png"))[:8]):
        place = tmp_path / "ab"[i % 2] / f"{i // 2}.png"
        place.parent.mkdir(exist_ok=True)
        place.write_bytes(picture.read_bytes())
    output, drawn = tmp_path / "my.cam", tmp_path / "drawn"
    command = [
        "calibrate", str(tmp_path / "a"), str(tmp_path / "b"), *FLAGS, "-o", str(output),
        "--coefficients", "1", "--tangential", "off", "--keep-outliers", "--pictures", str(drawn),
    ]  # fmt: skip
    assert main(command) == 0
    views = [view["name"] for view in json.loads(output.with_suffix(".json").read_text())["views"]]
    assert {"a/1.png", "b/1.png"} < set(views)
    assert len(set(views)) == len(views)
    pictures = [(drawn / f"{name}.corners.png").read_bytes() for name in views]
    assert len(set(pictures)) == len(views)
    # What exists is noticed at once, not after the calibration.
    capsys.readouterr()
    command[command.index(str(output))] = str(tmp_path / "other.cam")
    assert main(command) == 1
    written = capsys.readouterr()
    assert written.out == ""
    assert "1.png.corners.png: exists already" in written.err
    assert not (tmp_path / "other.cam").exists()
