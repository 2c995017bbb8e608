"""The command, on a run of known truth and on the data set's own run; worlds and their files."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from camera import Camera, write_camera
from redetect.landmarks import read_frames, write_frames
from redetect.slam.mapping.graph import Estimate, graph_of_recording
from redetect.slam.recording import read_recording
from tests.tools.reenactment.synthetic import make_run, rows_of_pose
from tools.reenactment.__main__ import main
from tools.reenactment.prepare import assess, stages
from tools.reenactment.world import WorldError, read_world


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
    estimate = Estimate(
        world.poses, world.disc_xy, np.zeros((0, 2)), world.robot_from_camera, world.tilt
    )
    found = rows = 0
    for i, frame in enumerate(read_frames(prepared / "map.circles")):
        assert world.prefixes[i] == frame.step.prefix
        shown, _, seen = rows_of_pose(published_camera, estimate, i)
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
    rows = (run_folder / "map.circles").read_text()
    steps = [line for line in rows.splitlines() if "LANDMARK" not in line]
    for text, message in (
        ("\n".join(steps) + "\n", "map.circles: no disc with an ID"),
        (rows + "LANDMARK_C 0 9 0.9 0.01 0 0.01 5\n", "lie where the camera as calibrated cannot"),
        ("STEP a 1 2 x\n", "map.circles:1: "),
    ):
        (run_folder / "map.circles").write_text(text)
        assert main(arguments(run_folder)) == 1
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert not (run_folder / "world.npz").exists()


def test_files_that_hold_no_world(tmp_path: Path) -> None:
    np.savez(tmp_path / "lacking.npz", poses=np.zeros((2, 3)))
    with pytest.raises(WorldError, match=r"lacking.npz: .*prefixes"):
        read_world(tmp_path / "lacking.npz")
    (tmp_path / "text.npz").write_text("poses")
    np.save(tmp_path / "array.npy", np.zeros((2, 3)))
    for name in ("text.npz", "array.npy"):
        with pytest.raises(WorldError, match=rf"{name}: .*expected a .npz"):
            read_world(tmp_path / name)


@pytest.mark.long
def test_run_e(shared_data: Path, published_camera: Camera) -> None:
    folder = shared_data / "dlr"
    graph = graph_of_recording(read_recording(folder / "map.circles"), published_camera)
    counts = len(graph.steps), len(graph.disc_pose), len(graph.disc_ids)
    assert counts == (3297, 14_309, 576)
    every = [assess(*stage[1:]) for stage in stages(graph)]
    published, corrected, world = every[0], every[1], every[-1]
    assert published.chi_squared == pytest.approx(56_871.4, abs=0.15)
    assert corrected.chi_squared == pytest.approx(37_450.2, abs=1.0)
    expected = [-0.0366, 0.0099, 0.0024, -0.0111]
    np.testing.assert_allclose(corrected.mounting, expected, atol=5e-4)
    assert published.share_whole_pixel < corrected.share_whole_pixel < 0.999
    assert world.share_whole_pixel >= 0.999
    assert world.median_px < 0.8
    assert world.out_of_sight <= 3
