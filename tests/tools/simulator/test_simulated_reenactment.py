"""Re-enactments of a made-up recording: what is rendered lies where the recording says."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera, write_camera
from camera.uncertainty import with_pose
from redetect.landmarks import CircleLandmark, Frame, read_frames, write_frames
from redetect.plane import between
from redetect.slam.models import disc_in_robot
from tools.reenactment.world import World, write_world
from tools.simulator.driving import step_record
from tools.simulator.reenact import (
    REENACTED_SENSOR,
    prepare,
    reenacted_frame,
    true_camera,
    write_reenactment,
)
from tools.simulator.runs import SIMULATED

PREFIXES = ["run.0000", "run.0001", "run.0002", "run.0003"]
DISC_XY = np.array([[0.4, -1.8], [-0.6, -2.2], [0.1, -3.1], [8.0, 8.0]])


@pytest.fixture(scope="module")
def recorded(
    tmp_path_factory: pytest.TempPathFactory, published_camera: Camera
) -> tuple[Path, Path, Path]:
    """A landmark file, a calibration, and the world: the camera looks 2 degrees lower."""
    from scipy.spatial.transform import Rotation

    folder = tmp_path_factory.mktemp("recorded")
    poses = np.array([[0.01 * k, -0.12 * k, 0.02 * k] for k in range(4)])
    tilt = np.radians([[0.3, -0.2], [0.0, 0.1], [-0.4, 0.0], [0.2, 0.3]])
    turned = Rotation.from_rotvec([0.035, -0.01, 0.002]).as_matrix() @ published_camera.rotation
    mounting = np.column_stack([turned, published_camera.centre - [0.0, 0.0, 0.04]])
    ids = np.array([11, 12, 13, 14])
    world = World(np.array(PREFIXES), poses, tilt, ids, DISC_XY, mounting)
    before = np.vstack([[0.0, 0.1, 0.0], poses[:-1]])
    frames = []
    for prefix, step, pose in zip(PREFIXES, between(before, poses), poses):
        rows = tuple(
            CircleLandmark(float(x), float(y), 0.9, 0.002, 0.0, 0.003, (int(i),))
            for i, (x, y) in zip(ids[:3], disc_in_robot(pose, DISC_XY[:3]))
        )
        frames.append(Frame(step_record(prefix, step), rows))
    write_frames(folder / "map.circles", frames)
    write_camera(published_camera, folder / "run.cam")
    write_world(folder / "world.npz", world)
    return folder / "map.circles", folder / "run.cam", folder / "world.npz"


def _brightest(grey: NDArray[np.uint8], pixel: NDArray[np.float64]) -> NDArray[np.float64]:
    """Centroid of what is brighter than the surroundings near a pixel."""
    u0, v0 = np.rint(pixel).astype(int)
    window = grey[v0 - 9 : v0 + 10, u0 - 30 : u0 + 31].astype(np.float64)
    weight = np.clip(window - 0.5 * (np.median(window) + window.max()), 0.0, None)
    v, u = np.indices(window.shape)
    at = np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()
    return np.asarray(at + np.array([u0 - 30, v0 - 9]))


def test_discs_are_rendered_through_the_true_camera(recorded: tuple[Path, Path, Path]) -> None:
    run = prepare(*recorded, seed=1)
    for index in range(4):
        frame = reenacted_frame(run, index, REENACTED_SENSOR)
        assert {d.disc_id for d in frame.discs} == {11, 12, 13}
        for disc in frame.discs:
            robot_xy = disc_in_robot(run.world.poses[index], DISC_XY[disc.disc_id - 11])
            # Mounting and tilt written out: the tilt turns the camera about its own centre.
            p, q = run.world.tilt[index]
            turn = cv2.Rodrigues(np.array([p, q, 0.0]))[0]
            mounting = run.world.robot_from_camera
            pose = np.column_stack([turn @ mounting[:, :3], mounting[:, 3]])
            expected = with_pose(run.camera, pose).project_floor(robot_xy)
            np.testing.assert_allclose(disc.pixel, expected, atol=1e-9)
            assert np.abs(_brightest(frame.grey, expected) - expected).max() < 1.0
            nominal = run.camera.project_floor(robot_xy)
            assert np.hypot(*(nominal - expected)) > 5.0


def test_discs_that_nobody_reported_are_not_shown(recorded: tuple[Path, Path, Path]) -> None:
    run = prepare(*recorded, seed=1)
    looking = run.world.poses.copy()
    looking[:] = [8.0, 9.8, 0.0]
    from dataclasses import replace

    there = replace(run, world=run.world._replace(poses=looking))
    frame = reenacted_frame(there, 0, REENACTED_SENSOR)
    assert frame.discs == ()
    pixel = true_camera(there, 0).project_floor(disc_in_robot(looking[0], DISC_XY[3]))
    u, v = np.rint(pixel).astype(int)
    window = frame.grey[v - 12 : v + 13, u - 30 : u + 31]
    assert float(window.max()) - float(np.median(window)) < 40.0


def test_run_folder_holds_the_recorded_rows(
    recorded: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    run = prepare(*recorded, seed=2)
    assert write_reenactment(run, tmp_path / "again", 2) == 2
    shipped = [f for k, f in enumerate(read_frames(recorded[0])) if k % 2 == 0]
    frames = list(read_frames(tmp_path / "again" / "map.circles"))
    assert [f.landmarks for f in frames] == [f.landmarks for f in shipped]
    assert [f.step.prefix for f in frames] == PREFIXES[::2]
    steps = [f.step for f in read_frames(tmp_path / "again" / "again.txt")]
    assert steps == [f.step for f in frames]
    move = between(run.world.poses[0], run.world.poses[2])
    np.testing.assert_allclose([steps[1].dx, steps[1].dy, steps[1].dphi], move, atol=2e-5)
    assert "SIMULATED" in (tmp_path / "again" / "map.circles").read_text()[:300]
    assert SIMULATED.split("{")[0] in (tmp_path / "again" / "again.txt").read_text()
    truth = json.loads((tmp_path / "again" / "truth.json").read_text())
    assert [f["prefix"] for f in truth["frames"]] == PREFIXES[::2]
    write_reenactment(prepare(*recorded, seed=2), tmp_path / "twice", 2)
    for name in ("images/run.0002.jpg", "truth.json", "map.circles"):
        first, second = ((tmp_path / d / name).read_bytes() for d in ("again", "twice"))
        assert first == second


def test_world_of_another_run_is_refused(recorded: tuple[Path, Path, Path], tmp_path: Path) -> None:
    frames = list(read_frames(recorded[0]))[:3]
    write_frames(tmp_path / "other.circles", frames)
    with pytest.raises(ValueError, match="its image prefixes are not those of"):
        prepare(tmp_path / "other.circles", recorded[1], recorded[2], seed=1)
