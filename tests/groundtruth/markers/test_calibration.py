"""Rig and network files: what is written is read back, what cannot be is refused by name."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import write_camera
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.markers.session import (
    Network,
    Rig,
    read_network,
    read_rig,
    write_network,
    write_rig,
)
from tests.groundtruth.markers.scene import box_rig, hall_cameras, lens

FloatArray = NDArray[np.float64]


def some_covariance(size: int, seed: int) -> FloatArray:
    root = np.random.default_rng(seed).normal(0, 1e-3, (size, size))
    return root @ root.T


def test_a_rig_comes_back(tmp_path: Path) -> None:
    rig = box_rig()
    full = Rig(rig.dictionary, rig.ids, rig.widths_m, rig.robot_from_marker, some_covariance(36, 1))
    for number, each in enumerate((rig, full)):
        path = tmp_path / f"{number}.json"
        write_rig(path, each, {"made_by": {"version": "1"}})
        read = read_rig(path)
        assert (read.dictionary, read.ids) == (each.dictionary, each.ids)
        np.testing.assert_array_equal(read.widths_m, each.widths_m)
        np.testing.assert_allclose(read.robot_from_marker, each.robot_from_marker, atol=1e-14)
        np.testing.assert_allclose(read.covariance, each.covariance, rtol=1e-12, atol=0)
    np.testing.assert_allclose(read.corners[0, 0], [-0.12, 0.12, 0.0])


def test_a_network_comes_back(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    write_camera(lens(), tmp_path / "a" / "a.cam")
    poses = hall_cameras(3)
    network = Network(
        ("a", "b", "c"), (lens(),) * 3, ("a/a.cam",) * 3, poses, some_covariance(18, 2)
    )
    write_network(tmp_path / "network.json", network)
    read = read_network(tmp_path / "network.json")
    assert read.names == network.names
    assert read.cameras[0].coef == lens().coef
    np.testing.assert_allclose(read.world_from_camera, poses, atol=1e-14)
    np.testing.assert_allclose(read.covariance, network.covariance, rtol=1e-12, atol=0)


def test_a_joint_covariance_follows_the_order_it_names(tmp_path: Path) -> None:
    content = {
        "dictionary": "rawseeds",
        "markers": {
            name: {
                "width_m": 0.2,
                "translation_m": [0, 0, 0],
                "quaternion_xyzw": [0, 0, 0, 1],
            }
            for name in ("7", "31", "100")
        },
        "covariance": {
            "markers": ["100", "7", "31"],
            "matrix": np.diag(np.repeat([3.0, 1.0, 2.0], 6)).tolist(),
        },
    }
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(content))
    rig = read_rig(path)
    assert rig.ids == (7, 31, 100)
    np.testing.assert_array_equal(np.diagonal(rig.covariance), np.repeat([1.0, 2.0, 3.0], 6))


def test_single_covariances_and_sigmas_are_read(tmp_path: Path) -> None:
    pose = {"width_m": 0.2, "translation_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}
    own = some_covariance(6, 3)
    content = {
        "dictionary": "rawseeds",
        "markers": {
            "1": {**pose, "sigmas": [0.001, 0.001, 0.002, 0.01, 0.01, 0.02]},
            "2": {**pose, "covariance": own.tolist()},
            "3": pose,
        },
    }
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(content))
    covariance = read_rig(path).covariance
    np.testing.assert_allclose(
        np.diagonal(covariance)[:6], np.square([0.001, 0.001, 0.002, 0.01, 0.01, 0.02])
    )
    np.testing.assert_allclose(covariance[6:12, 6:12], own)
    assert not covariance[12:].any()
    assert not covariance[:6, 6:].any()


GOOD: dict[str, Any] = {
    "dictionary": "rawseeds",
    "markers": {
        "31": {"width_m": 0.24, "translation_m": [0, 0, 1], "quaternion_xyzw": [0, 0, 0, 1]}
    },
}


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [
        (["dictionary"], 5, "dictionary is 5: expected its name"),
        (["markers"], {}, "markers is {}: expected an object with at least one entry"),
        (["markers"], {"x": {}}, "expected whole numbers as keys"),
        (["markers"], {"-1": {}}, "IDs of 0 or more"),
        (["markers", "31"], 3, "31: expected an object"),
        (["markers", "31", "width_m"], 0, "marker 31: width_m is 0: expected metres above 0"),
        (["markers", "31", "width_m"], True, "width_m is True"),
        (["markers", "31", "translation_m"], [0, 0], "translation_m is \\[0, 0\\]: expected 3"),
        (["markers", "31", "quaternion_xyzw"], [0, 0, 0, 2], "has length 2: expected a unit"),
        (["markers", "31", "quaternion_xyzw"], None, "expected 4 finite numbers"),
        (["markers", "31", "sigmas"], [1, 1, 1, 1, 1, -1], "sigmas: expected 0 or more"),
        (["markers", "31", "covariance"], [[1]], "expected 6 x 6 finite numbers"),
        (["covariance"], {"markers": ["1"], "matrix": []}, "markers are \\['1'\\]: expected"),
        (["covariance"], 5, "expected an object with markers and matrix"),
    ],
)
def test_rigs_that_cannot_be_are_refused(
    tmp_path: Path, place: list[str], value: object, problem: str
) -> None:
    content = copy.deepcopy(GOOD)
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(content))
    with pytest.raises(GroundTruthError, match=problem) as caught:
        read_rig(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("matrix", "problem"),
    [
        (np.diag([1.0, 1, 1, 1, 1, -1]), "negative eigenvalue"),
        (np.eye(6) + np.eye(6, k=1), "expected a symmetric matrix"),
    ],
)
def test_matrices_that_are_no_covariances_are_refused(
    tmp_path: Path, matrix: FloatArray, problem: str
) -> None:
    content = copy.deepcopy(GOOD)
    content["markers"]["31"]["covariance"] = matrix.tolist()
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(content))
    with pytest.raises(GroundTruthError, match=problem):
        read_rig(path)


@pytest.mark.parametrize(
    ("text", "problem"),
    [("{", "invalid JSON"), ("[]", "expected a JSON object"), ("[" * 100000, "nested too deep")],
)
def test_files_that_are_no_json_are_refused(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "rig.json"
    path.write_text(text)
    with pytest.raises(GroundTruthError, match=problem):
        read_rig(path)
    with pytest.raises(GroundTruthError, match="no such file"):
        read_network(tmp_path / "absent.json")
