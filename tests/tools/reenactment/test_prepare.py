"""The command, on a run of known truth and on the data set's own run."""

from __future__ import annotations

import shutil
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from camera import Camera, write_camera
from redetect.landmarks import read_frames, write_frames
from tests.tools.reenactment.synthetic import make_run, rows_of_frame
from tools.reenactment.__main__ import main
from tools.reenactment.mounted_discs import Geometry
from tools.reenactment.prepare import Stage, stages
from tools.reenactment.recording import Recording, read_map, read_path, recording_of_frames
from tools.reenactment.world import read_world


def laid_run(folder: Path, camera: Camera) -> Path:
    run = make_run(camera, 11, tilt_deg=0.3)
    write_frames(folder / "map.circles", run.frames)
    write_camera(camera, folder / "ring.cam")
    return folder


@pytest.fixture
def run_folder(tmp_path: Path, published_camera: Camera) -> Path:
    return laid_run(tmp_path, published_camera)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory, published_camera: Camera) -> Path:
    """A folder with a run and its world, not to be changed."""
    folder = laid_run(tmp_path_factory.mktemp("prepared"), published_camera)
    assert main(arguments(folder)) == 0
    return folder


def arguments(folder: Path, *more: str) -> list[str]:
    landmarks, camera, world = (
        str(folder / name) for name in ("map.circles", "ring.cam", "world.npz")
    )
    return ["prepare", landmarks, "--camera", camera, "-o", world, *more]


def test_world_shows_the_rows_again(prepared: Path, published_camera: Camera) -> None:
    world = read_world(prepared / "world.npz")
    geometry = Geometry(
        poses=world.poses,
        disc_xy=world.disc_xy,
        rotation=world.robot_from_camera[:, :3],
        centre=world.robot_from_camera[:, 3],
        tilt=world.tilt,
    )
    found = rows = 0
    for i, frame in enumerate(read_frames(prepared / "map.circles")):
        assert world.prefixes[i] == frame.step.prefix
        shown, _, seen = rows_of_frame(published_camera, geometry, i)
        ids = world.disc_ids[seen].tolist()
        for row in frame.circles:
            rows += 1
            if row.ids[0] in ids:
                error = shown[ids.index(row.ids[0])] - [row.px, row.py]
                covariance = [[row.cxx, row.cxy], [row.cxy, row.cyy]]
                found += error @ np.linalg.solve(covariance, error) <= 16.0
    assert found >= 0.98 * rows > 300


def test_same_bytes_again(
    prepared: Path, run_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(prepared / "world.npz", run_folder)
    first = (run_folder / "world.npz").read_bytes()
    assert main(arguments(run_folder)) == 1
    assert "world.npz: exists already" in capsys.readouterr().err
    assert main(arguments(run_folder, "--force")) == 0
    assert (run_folder / "world.npz").read_bytes() == first


def test_errors_are_one_line(run_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run_folder / "path.csv").write_text("0,0,0\n")
    path = str(run_folder / "path.csv")
    assert main(arguments(run_folder, "--path", path)) == 1
    assert "--path and --map belong together" in capsys.readouterr().err
    assert main(arguments(run_folder, "--path", path, "--map", path)) == 1
    assert "path.csv: 1 poses: expected 121" in capsys.readouterr().err
    (run_folder / "map.circles").write_text("STEP a 1 2 x\n")
    assert main(arguments(run_folder)) == 1
    error = capsys.readouterr().err
    assert "map.circles:1: " in error
    assert error.count("\n") == 1
    assert not (run_folder / "world.npz").exists()


@pytest.fixture(scope="module")
def run_e(shared_data: Path, published_camera: Camera) -> Recording:
    rows = read_frames(shared_data / "dlr" / "map.circles")
    return recording_of_frames(published_camera, rows)


@pytest.fixture(scope="module")
def least_squares(shared_data: Path, published_camera: Camera, run_e: Recording) -> list[Stage]:
    """The published solution of run e, and the one with the true mounting."""
    folder = shared_data / "dlr"
    start = (
        read_path(folder / "least_squares_path.csv", len(run_e.steps)),
        read_map(folder / "least_squares_map.csv", run_e.disc_ids),
    )
    return list(islice(stages(published_camera, run_e, start), 2))


@pytest.mark.long
def test_run_e_from_its_least_squares_solution(
    run_e: Recording, least_squares: list[Stage]
) -> None:
    counts = len(run_e.steps), len(run_e.frame), len(run_e.disc_ids)
    assert counts == (3297, 14_309, 576)
    published, corrected = (stage.quality for stage in least_squares)
    assert published.chi_squared == pytest.approx(56_871.4, abs=0.15)
    assert corrected.chi_squared == pytest.approx(37_450.2, abs=1.0)
    np.testing.assert_allclose(corrected.rotation, [-0.0366, 0.0099, 0.0024], atol=2e-4)
    assert corrected.height == pytest.approx(-0.0111, abs=5e-4)
    assert published.share_whole_pixel < corrected.share_whole_pixel < 0.999


@pytest.mark.long
def test_run_e_from_odometry_alone(
    published_camera: Camera, run_e: Recording, least_squares: list[Stage]
) -> None:
    *_, world = stages(published_camera, run_e, None)
    assert world.quality.share_whole_pixel >= 0.999
    assert world.quality.median_px < 0.8
    assert world.quality.out_of_sight <= 3
    corrected = least_squares[-1].geometry
    off = np.hypot(*(world.geometry.poses - corrected.poses)[:, :2].T)
    # Plain least squares is drawn aside by rows of confused discs.
    assert off.max() < 1.2
