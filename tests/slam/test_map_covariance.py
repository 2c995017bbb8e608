"""The joint covariance of a map's landmarks: against a dense inverse, and its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from redetect.landmarks import LandmarkFileError
from redetect.landmarks.map_file import (
    LandmarkMap,
    Landmarks,
    covariance_file,
    no_landmarks,
    read_map,
    with_joint_covariance,
    write_map,
)
from redetect.slam.commands.files import camera_of_run
from redetect.slam.mapping.graph_terms import Weighting
from redetect.slam.mapping.run_map import map_run
from redetect.slam.mapping.solve import equations_at, joint_covariance
from redetect.slam.recording import read_recording
from redetect.storage import OutputExistsError


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
    discs = Landmarks(np.array([1, 2]), np.zeros((2, 2)), covariance, np.array([1, 1]))
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
        (np.eye(6), "expected float64 of"),
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
