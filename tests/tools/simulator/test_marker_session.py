"""Simulated sessions: what the files say and what the images show is one and the same."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from camera import parse_camera, read_camera
from camera.boards.board import Board
from redetect.groundtruth.markers.adjustment import Chain, ChainPoints, project_chain
from redetect.groundtruth.markers.boards import BoardImage, view_of_board
from redetect.groundtruth.markers.session import read_network, read_rig
from redetect.groundtruth.trajectories import se3
from redetect.groundtruth.trajectories.streams import read_planar_poses
from redetect.landmarks.frame_files import read_times
from tests.pictures import read_grey
from tools.simulator.__main__ import main
from tools.simulator.driving import planar_transform
from tools.simulator.markers.calibration_set import (
    DOUBLE,
    WORLD,
    board_surface,
    board_views,
    first_from_second,
    write_calibration_set,
)
from tools.simulator.markers.rendering import Imaging, grey_image, render_light
from tools.simulator.markers.room import facing_pose, robot_rig
from tools.simulator.markers.session import (
    DEMO,
    CalibrationErrors,
    SessionPlan,
    SessionSettings,
    SessionWriter,
    disturbed_network,
    disturbed_rig,
    plan_session,
    random_for,
    seen_markers,
    view_frame,
    write_session,
)

SMALL = SessionSettings(
    name="small", seed=2, cameras=2, area_m=(2.4, 2.0), width=640, height=480, references=2,
    steps=2, rate_hz=0.5, samples=4,
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("session") / "small"
    assert write_session(SMALL, path, SessionWriter(image_format="png")) == 8
    return path


@pytest.fixture(scope="module")
def full_plan() -> SessionPlan:
    return plan_session(SessionSettings())


def _corners_by_files(folder: Path, truth: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """All true corners, and where poses, rig, network and calibrations of the files put them."""
    rig, network = read_rig(folder / "rig.json"), read_network(folder / "network.json")
    poses = read_planar_poses(folder / "truth.csv")
    camera, body, part, pixels = [], [], [], []
    for row in truth["frames"]:
        time_s = read_times(folder / row["camera"] / f"{row['camera']}.times")[row["image"]]
        assert time_s == pytest.approx(row["t"], abs=1e-6)
        for marker in row["markers"]:
            camera += [network.names.index(row["camera"])] * 4
            body += [int(np.argmin(np.abs(poses.times_s - time_s)))] * 4
            part += [rig.ids.index(marker["id"])] * 4
            pixels += marker["corners"]
    points = np.tile(np.arange(4), len(part) // 4)
    seen = ChainPoints(
        np.array(camera), np.array(body), np.array(part), rig.corners[np.array(part), points],
        np.array(pixels), np.tile(np.eye(2), (len(part), 1, 1)),
    )  # fmt: skip
    bodies = np.stack([planar_transform(*(float(x) for x in pose)) for pose in poses.poses])
    cameras, places = network.cameras, network.world_from_camera
    projected = project_chain(Chain(cameras, places, bodies, rig.robot_from_marker), seen)
    return seen.pixels, projected


def test_corners_follow_from_the_files(folder: Path) -> None:
    truth = json.loads((folder / "truth.json").read_text())
    pixels, projected = _corners_by_files(folder, truth)
    assert len(pixels) > 60
    # truth.csv has six decimals.
    assert np.abs(projected - pixels).max() < 2e-3


def test_folder_is_laid_out_as_agreed(folder: Path) -> None:
    truth = json.loads((folder / "truth.json").read_text())
    assert truth["note"].startswith("SIMULATED")
    network = json.loads((folder / "network.json").read_text())
    assert network["note"].startswith("SIMULATED")
    names = sorted(network["cameras"])
    assert names == ["a", "b"]
    prefixes = [f"small.{k:04d}" for k in range(4)]
    for name in names:
        times = read_times(folder / name / f"{name}.times")
        assert list(times) == prefixes
        assert list(np.diff(list(times.values()))) == pytest.approx([2.0, 2.0, 2.0])
        images = sorted(p.name for p in (folder / name / "images").iterdir())
        assert images == [f"{prefix}.png" for prefix in prefixes]
        camera = read_camera(folder / name / f"{name}.cam")
        assert camera == parse_camera(truth["cameras"][name]["calibration"])
        image = cv2.imread(str(folder / name / "images" / images[0]), cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert image.shape == (480, 640)
    poses, references = (
        read_planar_poses(folder / f"{name}.csv") for name in ("truth", "reference")
    )
    assert len(poses.times_s) == 4
    np.testing.assert_array_equal(references.poses, poses.poses[:2])
    assert poses.covariances is None


def test_images_are_the_plans_views(folder: Path) -> None:
    plan = plan_session(SMALL)
    for name, camera, frame in (("b", 1, 3), ("a", 0, 0)):
        view = view_frame(plan, (camera, frame))
        path = folder / name / "images" / f"small.{frame:04d}.png"
        np.testing.assert_array_equal(view.image, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


def test_markers_are_in_the_image_where_the_truth_says(folder: Path) -> None:
    """Just inside its outline a marker is dark, just outside it is light."""
    truth = json.loads((folder / "truth.json").read_text())
    checked = 0
    for row in truth["frames"]:
        path = folder / row["camera"] / "images" / f"{row['image']}.png"
        image = read_grey(path)
        for marker in row["markers"]:
            if marker["visible"] < 1.0 or marker["rim_visible"] < 1.0 or marker["slant_deg"] > 55:
                continue
            corners = np.array(marker["corners"])
            middle = corners.mean(axis=0)
            edges = np.concatenate([corners + t * (np.roll(corners, -1, axis=0) - corners)
                                    for t in (0.2, 0.5, 0.8)])  # fmt: skip
            inside = np.rint(middle + 0.85 * (edges - middle)).astype(int)
            outside = np.rint(middle + 1.15 * (edges - middle)).astype(int)
            dark = image[inside[:, 1], inside[:, 0]].astype(float)
            light = image[outside[:, 1], outside[:, 0]].astype(float)
            assert light.min() > dark.max()
            assert light.mean() - dark.mean() == pytest.approx(marker["contrast_grey"], rel=0.35)
            checked += 1
    assert checked >= 10


def test_published_like_session(full_plan: SessionPlan) -> None:
    assert len(full_plan.network.names) == 4
    assert full_plan.settings.references == 23
    assert len(full_plan.rig.ids) == 6
    times, poses = full_plan.times_s, full_plan.poses
    drive = slice(23, None)
    assert np.diff(times[drive]) == pytest.approx(np.full(299, 0.2))
    assert np.all(np.diff(times) > 0.0)
    assert np.all(full_plan.speeds[:23] == 0.0)
    # The derivative is the path's, and the robot moves forward.
    step = (poses[drive][2:, :2] - poses[drive][:-2, :2]) / 0.4
    np.testing.assert_allclose(step, full_plan.speeds[24:-1, :2], atol=0.02)
    heading = np.column_stack([np.cos(poses[23:, 2]), np.sin(poses[23:, 2])])
    forward = np.sum(heading * full_plan.speeds[23:, :2], axis=1)
    np.testing.assert_allclose(forward, np.linalg.norm(full_plan.speeds[23:, :2], axis=1))
    assert 0.2 < forward.mean() < 0.5
    assert np.all((poses[:, :2] > 0.0) & (poses[:, :2] < full_plan.settings.area_m))


@pytest.mark.long
def test_markers_are_seen_by_several_cameras(full_plan: SessionPlan) -> None:
    widths, cameras_per_pose = [], []
    for frame in (0, 100):
        seen = 0
        for camera in range(4):
            markers = seen_markers(full_plan, camera, full_plan.poses[frame])
            good = [m for m in markers if m.clear and m.slant_deg < 65.0]
            widths += [m.width_px for m in good]
            seen += bool(good)
        cameras_per_pose.append(seen)
    assert min(cameras_per_pose) >= 2
    assert np.percentile(widths, 5) > 15.0
    assert 25.0 < np.median(widths) < 60.0


def test_errors_have_the_covariance_that_the_files_state(full_plan: SessionPlan) -> None:
    errors = CalibrationErrors(0.02, 0.3, 0.004, 0.5, 0.002, 1.5)
    squared, focal, centre = [], [], []
    for seed in range(40):
        network = disturbed_network(full_plan.network, errors, random_for(seed, "errors", 0))
        rig = disturbed_rig(full_plan.rig, errors, random_for(seed, "errors", 1))
        for true, said, covariance in (
            (full_plan.network.world_from_camera, network.world_from_camera, network.covariance),
            (full_plan.rig.robot_from_marker, rig.robot_from_marker, rig.covariance),
        ):
            tangents = se3.log(se3.inverse(said) @ true).ravel()
            squared.append(tangents @ np.linalg.solve(covariance, tangents))
        pairs = list(zip(network.cameras, full_plan.network.cameras))
        focal += [c.scale_x / t.scale_x - 1.0 for c, t in pairs]
        centre += [c.offset_x - t.offset_x for c, t in pairs]
    dof = 40 * (24 + 36)
    assert chi2.ppf(1e-4, dof) < np.sum(squared) < chi2.ppf(1.0 - 1e-4, dof)
    assert np.std(focal) == pytest.approx(0.002, rel=0.2)
    assert np.std(centre) == pytest.approx(1.5, rel=0.2)
    exact = disturbed_network(full_plan.network, CalibrationErrors(), random_for(1, "errors", 0))
    assert not exact.covariance.any()
    np.testing.assert_allclose(exact.world_from_camera, full_plan.network.world_from_camera)


def test_images_do_not_depend_on_the_errors_in_the_files(tmp_path: Path, folder: Path) -> None:
    errors = CalibrationErrors(network_m=0.05, rig_deg=1.0, focal=0.01)
    write_session(SMALL, tmp_path / "small", SessionWriter(errors, "png"))
    for path in (folder / "a" / "images").iterdir():
        assert path.read_bytes() == (tmp_path / "small" / "a" / "images" / path.name).read_bytes()
    truths = [json.loads((f / "truth.json").read_text()) for f in (folder, tmp_path / "small")]
    assert truths[0]["frames"] == truths[1]["frames"]
    assert truths[0]["cameras"] == truths[1]["cameras"]
    network = read_network(tmp_path / "small" / "network.json")
    assert np.sqrt(np.diag(network.covariance))[:6] == pytest.approx([0.05] * 3 + [0.0] * 3)
    said = json.loads((tmp_path / "small" / "network.json").read_text())["errors"]
    assert said["network_m"] == 0.05
    pixels, projected = _corners_by_files(tmp_path / "small", truths[1])
    assert np.median(np.abs(projected - pixels)) > 1.0


def test_rigs_boards_look_outward_and_differ_from_robot_to_robot() -> None:
    rig, other = (robot_rig(np.random.default_rng(seed)) for seed in (1, 2))
    assert rig.dictionary == "rawseeds"
    assert not np.allclose(rig.robot_from_marker, other.robot_from_marker, atol=1e-3)
    for pose in rig.robot_from_marker:
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert pose[:3, 2] @ (pose[:3, 3] - [0.0, 0.0, 0.2]) > 0.0
        assert pose[2, 2] > 0.2
    assert robot_rig(np.random.default_rng(1), "4x4_50").ids == (0, 1, 2, 3, 4, 5)


@pytest.mark.long
def test_calibration_set(tmp_path: Path) -> None:
    plan = plan_session(SMALL)
    count = write_calibration_set(plan, tmp_path, SessionWriter(image_format="png"))
    content = json.loads((tmp_path / "network" / "boards.json").read_text())
    truth = json.loads((tmp_path / "network" / "truth.json").read_text())["boards"]
    assert count == 48 + len(truth)
    network = read_network(tmp_path / "network" / "network.json")
    offset = _pose(content["first_from_second"])
    placements: dict[int, dict[str, np.ndarray]] = {}
    errors = []
    for row, known in zip(content["images"], truth):
        assert row["image"] == known["image"]
        board = {"first": DOUBLE, "second": DOUBLE, "world": WORLD}[row["board"]]
        said = content["boards"][row["board"]]
        assert (said["columns"], said["rows"]) == (board.columns, board.rows)
        pose = _pose(known["world_from_board"])
        placements.setdefault(row["placement"], {})[row["board"]] = pose
        camera = network.names.index(row["camera"])
        points = se3.apply(se3.inverse(network.world_from_camera[camera]) @ pose, board.points)
        corners = np.array(known["corners"])
        np.testing.assert_allclose(network.cameras[camera].project(points), corners, atol=1e-3)
        image = read_grey(tmp_path / "network" / row["image"])
        start = corners.astype(np.float32).reshape(-1, 1, 2).copy()
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
        fitted = cv2.cornerSubPix(image, start, (3, 3), (-1, -1), criteria).reshape(-1, 2)
        errors.append(fitted - corners)
    residual = np.concatenate(errors)
    assert np.median(np.abs(residual)) < 0.1
    assert np.abs(np.median(residual, axis=0)).max() < 0.02
    for poses in placements.values():
        if "world" in poses:
            np.testing.assert_allclose(poses["world"], _pose(content["world_from_board"]))
        else:
            np.testing.assert_allclose(poses["first"] @ offset, poses["second"], atol=1e-9)
    # The robot turns on the spot and shows two markers or more nearly always.
    frames = json.loads((tmp_path / "rig" / "truth.json").read_text())["frames"]
    several = [sum(m["visible"] == 1.0 for m in frame["markers"]) >= 2 for frame in frames]
    assert len(frames) == 48
    assert np.mean(several) > 0.9
    turning = read_planar_poses(tmp_path / "rig" / "truth.csv").poses
    assert np.ptp(turning[:24, :2], axis=0) == pytest.approx([0.0, 0.0])
    pixels, projected = _corners_by_files(
        tmp_path / "rig", json.loads((tmp_path / "rig" / "truth.json").read_text())
    )
    assert np.abs(projected - pixels).max() < 2e-3


def _pose(entry: dict[str, list[float]]) -> np.ndarray:
    return se3.transform(
        Rotation.from_quat(entry["quaternion_xyzw"]).as_matrix(), entry["translation_m"]
    )


def test_every_pair_of_neighbours_sees_the_double_board(full_plan: SessionPlan) -> None:
    views = board_views(full_plan, first_from_second(np.random.default_rng(0)))
    pairs: dict[int, set[int]] = {}
    for view in views[:-1]:
        pairs.setdefault(view.placement, set()).add(view.camera)
    assert views[-1].board == "world"
    assert views[-1].camera == 0
    assert {frozenset(pair) for pair in pairs.values()} == {
        frozenset(pair) for pair in ((0, 1), (1, 2), (2, 3), (3, 0))
    }


def test_wrong_number_of_cameras_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["marker-session", "/nowhere/x", "--session.cameras", "5"]) == 1
    assert "expected 1 to 4" in capsys.readouterr().err


def test_demo_session_comes_out_again(project_root: Path) -> None:
    folder = project_root / "images" / "m"
    plan = plan_session(DEMO)
    for name, camera, frame in (("a", 0, 2), ("b", 1, 11)):
        path = folder / name / "images" / f"m.{frame:04d}.jpg"
        committed = read_grey(path)
        image = view_frame(plan, (camera, frame)).image
        # JPEG, and other machines may round differently in the last digit.
        assert np.abs(image.astype(int) - committed.astype(int)).mean() < 2.0
    truth = json.loads((folder / "truth.json").read_text())
    pixels, projected = _corners_by_files(folder, truth)
    assert np.abs(projected - pixels).max() < 2e-3
    assert len(truth["frames"]) == 36


def test_boards_have_the_frame_of_those_that_are_looked_for(
    full_plan: SessionPlan, tmp_path: Path
) -> None:
    """What the simulator calls a board is what `groundtruth` finds in an image."""
    for board, pose in ((DOUBLE, 0.3), (WORLD, -0.4)):
        same = Board("checkerboard", board.columns, board.rows, board.square_m)
        np.testing.assert_allclose(board.points, same.points, atol=1e-12)
        camera = full_plan.network.cameras[0]
        camera_from_board = facing_pose(np.zeros(3), pose, 0.2, 0.5)
        # From the world's axes to the camera's, three metres before it.
        axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
        camera_from_board[:3, :3] = axes @ camera_from_board[:3, :3]
        camera_from_board[:3, 3] = [0.1, 0.2, 3.0]
        empty = np.full((camera.height, camera.width), 0.4, np.float32)
        imaging = Imaging(blur_px=0.8)
        light = render_light(camera, [[board_surface(board, camera_from_board)]], empty)
        path = tmp_path / "a.png"
        cv2.imwrite(str(path), grey_image(light, 1.0, imaging, np.random.default_rng(0)))
        truth = camera.project(se3.apply(camera_from_board, board.points))
        found = view_of_board(BoardImage("a", "b", 0, path), same, camera)
        assert np.abs(found.corners - truth).max() < 0.5
