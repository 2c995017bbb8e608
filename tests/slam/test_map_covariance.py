"""The joint covariance of a map's landmarks: against a dense inverse, and its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from redetect.landmarks import LandmarkFileError, squared_mahalanobis, write_frames
from redetect.landmarks.map_file import (
    LandmarkMap,
    MapLandmarks,
    covariance_file,
    no_landmarks,
    read_map,
    with_joint_covariance,
    write_map,
)
from redetect.plane import chain_steps
from redetect.slam.mapping.graph_terms import Weighting
from redetect.slam.mapping.run_map import map_run
from redetect.slam.mapping.solve import equations_at, joint_covariance
from redetect.slam.models import disc_in_robot
from redetect.slam.recording import (
    LineRows,
    Recording,
    camera_of_run,
    frames_of_discs,
    read_recording,
)
from redetect.storage import OutputExistsError
from tests.slam.ekf_rows import circle_rows


@pytest.mark.parametrize("calibrate", [False, True])
def test_joint_covariance_is_the_inverse_of_the_normal_equations(
    project_root: Path, calibrate: bool
) -> None:
    run = project_root / "images" / "e"
    recording, camera = read_recording(run), camera_of_run(run)
    weighting = Weighting(calibrate=calibrate)
    mapped = map_run(recording, camera, weighting)
    found = joint_covariance(mapped.graph, mapped.estimate, weighting)
    equations = equations_at(mapped.graph, mapped.estimate, weighting)
    whole = np.block(
        [[equations.matrix.toarray(), equations.border], [equations.border.T, equations.corner]]
    )
    landmarks = np.arange(3 * len(recording), len(equations.matrix.toarray()))
    expected = np.linalg.inv(whole)[np.ix_(landmarks, landmarks)]
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6
    )
    assert mapped.covariance is not None
    np.testing.assert_allclose(found[2:4, 2:4], mapped.covariance.discs[1], rtol=1e-6)


@pytest.fixture
def some() -> LandmarkMap:
    covariance = np.tile(0.25 * np.eye(2), (2, 1, 1))
    discs = MapLandmarks(np.array([1, 2]), np.zeros((2, 2)), covariance, np.array([1, 1]))
    return LandmarkMap(discs, no_landmarks())


def test_file(tmp_path: Path, some: LandmarkMap) -> None:
    place = tmp_path / "map.csv"
    assert with_joint_covariance(some, place) is some
    joint = 0.25 * np.eye(4)
    joint[0, 2] = joint[2, 0] = 0.1
    jointly = replace(some, joint_covariance=joint)
    write_map(place, jointly)
    assert covariance_file(place).name == "map_covariance.npy"
    read = with_joint_covariance(read_map(place), place)
    np.testing.assert_array_equal(read.joint_covariance, joint)
    place.unlink()
    with pytest.raises(OutputExistsError):
        write_map(place, jointly)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (np.eye(6), r"expected \(4, 4\)"),
        (np.eye(4, dtype=np.float32), "expected 2-dimensional float64"),
        (np.eye(4), "not the covariance of"),
        (np.full((4, 4), np.nan), "not the covariance of"),
        (np.array([None]), "cannot be read"),
    ],
)
def test_files_of_another_map_are_refused(
    tmp_path: Path, some: LandmarkMap, content: np.ndarray, message: str
) -> None:
    place = tmp_path / "map.csv"
    np.save(covariance_file(place), content)
    with pytest.raises(LandmarkFileError, match=message):
        with_joint_covariance(some, place)
    covariance_file(place).write_bytes(b"no array")
    with pytest.raises(LandmarkFileError, match="cannot be read"):
        with_joint_covariance(some, place)


@pytest.mark.parametrize("frames", [1, 200])  # number over which the tilt stays the same
def test_a_tilt_that_frames_share_is_in_the_covariances_of_a_corridor(
    frames: int, tmp_path: Path
) -> None:
    found = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        way = np.column_stack([np.zeros(60), np.full(60, -0.3), 0.01 * rng.standard_normal(60)])
        poses, places = chain_steps(way), np.arange(1.0, 18.0, 1.5)
        discs = np.column_stack([rng.uniform(-1.0, 1.0, len(places)), -places])
        sigma, rows = np.radians(0.3), []
        tilts = np.repeat(sigma * rng.standard_normal((60, 2)), frames, axis=0)
        for k, pose in enumerate(poses[1:]):
            seen = disc_in_robot(pose, discs)
            near = np.flatnonzero((seen[:, 1] < -1.0) & (seen[:, 1] > -5.0))
            for i, (x, y) in zip(near, seen[near]):
                by_tilt = np.outer([x, y], [y, -x]) / 1.5
                spread = 1e-4 * np.eye(2) + sigma**2 * by_tilt @ by_tilt.T
                off = by_tilt @ tilts[k] + 0.01 * rng.standard_normal(2)
                rows.append((k, seen[i] + off, spread, int(i)))
        noise = np.diag([1e-4, 4e-4, 1e-5])
        steps = way + rng.multivariate_normal(np.zeros(3), noise, 60)
        names = tuple(f"f.{k}" for k in range(60))
        run = Recording(names, steps, np.tile(noise, (60, 1, 1)), circle_rows(rows), LineRows.of())
        head = "settings radius_m=0.1 refine=True evidence=-0.1 tilt_sigma_deg=0.3"
        write_frames(tmp_path / f"{seed}.circles", frames_of_discs(run), head=head)
        mapped = map_run(read_recording(tmp_path / f"{seed}.circles"))
        error = mapped.estimate.disc_xy - discs[mapped.graph.disc_ids]
        found.append(np.mean(squared_mahalanobis(error, mapped.covariance.discs)) / 2.0)
        joint = joint_covariance(mapped.graph, mapped.estimate, Weighting())
        np.testing.assert_allclose(joint[-2:, -2:], mapped.covariance.discs[-1], rtol=1e-6)
    assert 0.2 < np.mean(found) < 2.0  # 0.5 and 0.8; as if independent 1.0 and 4.2


@pytest.mark.parametrize(
    ("settings", "tilted"),
    [
        ("refine=True evidence=-0.1 tilt_sigma_deg=None", True),
        ("refine=True evidence=-0.1 tilt_sigma_deg=0.0", False),
        ("refine=True evidence=-0.1 tilt_sigma_deg=0.05", True),
        ("refine=False evidence=-0.1 tilt_sigma_deg=None", False),  # the published detector's
    ],
)
def test_which_rows_state_a_tilt(tmp_path: Path, settings: str, tilted: bool) -> None:
    run = Recording(
        ("f.0",), np.array([[0.0, -0.2, 0.0]]), 1e-4 * np.eye(3)[None],
        circle_rows([(0, np.array([0.0, -2.0]), 1e-4 * np.eye(2), 1)]), LineRows.of(),
    )  # fmt: skip
    path = tmp_path / "a.circles"
    write_frames(path, frames_of_discs(run), head=f"settings radius_m=0.1 {settings}")
    assert read_recording(path).tilted is tilted
