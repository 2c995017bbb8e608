"""Calibrations that bags hold themselves: camera_info, and the camera's place by tf_static."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("rosbags", reason="the extra [bags] is not installed")

from camera import Camera
from camera.formats.conversion import convert_to_foreign
from camera.formats.models import ForeignCamera
from camera.formats.yaml_files import ROS_NAMES
from detect.cli import main
from detect.errors import DetectError
from detect.options import SourceOptions
from detect.sources.bag import pose_in_dataset, rotation_of
from detect.sources.interface import Run
from detect.sources.opening import open_run, open_source
from redetect.landmarks import read_frames
from tests.detect.recordings import BagKind, Ros, Said

OPTICAL = "front_optical"


@pytest.fixture(scope="module")
def foreign(published_camera: Camera) -> ForeignCamera:
    """The published camera as OpenCV's rational model sees it."""
    found = convert_to_foreign(published_camera, "rational").camera
    assert isinstance(found, ForeignCamera)
    return found


@pytest.fixture(scope="module")
def plumb_bob(published_camera: Camera) -> ForeignCamera:
    """A lens that the model contains, so that nothing is fitted, at the published camera's size."""
    c = published_camera
    pinhole = c.scale_x, c.scale_y, c.offset_x, c.offset_y
    return ForeignCamera("radtan", c.width, c.height, *pinhole, (-0.1, 0.0, 0.0, 0.0, 0.0))


def info(ros: Ros, camera: ForeignCamera, **changed: Any) -> Any:
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    model = ROS_NAMES[camera.model]
    return ros.camera_info(
        camera.width, camera.height, model, camera.distortion[:8], k, OPTICAL, **changed
    )


def in_ros_axes(camera: Camera) -> NDArray[np.float64]:
    """(3, 4) base_from_optical, X forward and Y left, of a camera in the data set's axes."""
    left_backward_up = np.array(camera.robot_from_camera)
    return np.stack([-left_backward_up[1], left_backward_up[0], left_backward_up[2]])


def recorded(run: Path, ros: Ros, said: list[Said]) -> list[Said]:
    images = []
    for k in range(3):
        image = cv2.imread(str(run / "images" / f"s.{k:04d}.png"), cv2.IMREAD_GRAYSCALE)
        message = ros.image(np.asarray(image), "mono8", 10.0 + k)
        images.append(Said("/front/image_raw", 10.0 + k, message))
    return [*said, *images]


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_a_bag_that_needs_nothing_else(
    small_run: Path, tmp_path: Path, published_camera: Camera, foreign: ForeignCamera, kind: BagKind
) -> None:
    """Calibration and pose as ROS has them: the same discs at the same places."""
    ros = Ros(kind)
    (tmp_path / "bag").mkdir()
    lifted = np.eye(4)[:3]
    lifted[2, 3] = 0.2
    optical = in_ros_axes(published_camera)
    optical[2, 3] -= 0.2
    transforms = ros.static_transforms(
        ("base_link", OPTICAL, optical),
        ("base_footprint", "base_link", lifted),
        ("base_link", "lidar", lifted),
    )
    said = [
        Said("/tf_static", 1.0, transforms),
        Said("/front/camera_info", 1.0, info(ros, foreign)),
        Said("/rear/camera_info", 1.0, info(ros, foreign, roi_width=5)),
    ]
    path = ros.write(tmp_path / "bag" / "s", recorded(small_run, ros, said))
    camera = open_run(path).camera
    np.testing.assert_allclose(
        camera.robot_from_camera, published_camera.robot_from_camera, atol=1e-4
    )
    if kind == "ros1":
        return  # images of all kinds of bags: test_bag.py
    expected, found = tmp_path / "expected.circles", tmp_path / "found.circles"
    assert main(["circles", str(small_run), "-o", str(expected)]) == 0
    assert main(["circles", str(path), "-o", str(found)]) == 0
    for first, second in zip(read_frames(expected), read_frames(found), strict=True):
        assert len(first.circles) == len(second.circles)
        for a, b in zip(first.circles, second.circles):
            assert (a.px, a.py) == pytest.approx((b.px, b.py), abs=1e-3)


def test_without_a_pose_only_markers(
    small_run: Path, tmp_path: Path, published_camera: Camera, plumb_bob: ForeignCamera
) -> None:
    ros = Ros()
    (tmp_path / "bag").mkdir()
    transforms = ros.static_transforms(("map", OPTICAL, in_ros_axes(published_camera)))
    said = [
        Said("/tf_static", 1.0, transforms),
        Said("/front/camera_info", 1.0, info(ros, plumb_bob)),
    ]
    path = ros.write(tmp_path / "bag" / "s", recorded(small_run, ros, said))
    told = r"no static transforms lead from 'base_footprint' to 'front_optical': name a \.cam file"
    with pytest.raises(DetectError, match=told):
        open_run(path)
    assert isinstance(open_source(path), Run)
    assert isinstance(open_run(path, small_run / "s.cam"), Run)
    named = open_run(path, None, SourceOptions(base_frame="map"))
    np.testing.assert_allclose(
        named.camera.robot_from_camera, published_camera.robot_from_camera, atol=1e-4
    )


def test_camera_infos_that_say_nothing_or_too_little(
    small_run: Path, tmp_path: Path, plumb_bob: ForeignCamera
) -> None:
    ros = Ros()
    blank = ros.camera_info(768, 288, "plumb_bob", [], [0.0] * 9, OPTICAL)
    path = ros.write(
        tmp_path / "blank", recorded(small_run, ros, [Said("/front/camera_info", 1.0, blank)])
    )
    assert not isinstance(open_source(path), Run)
    with pytest.raises(DetectError, match=r"no calibration: expected a \.cam file beside"):
        open_run(path)
    for name, changed in (("binned", {"binning_x": 2}), ("cut", {"roi_width": 100})):
        said = [Said("/front/camera_info", 1.0, info(ros, plumb_bob, **changed))]
        path = ros.write(tmp_path / name, recorded(small_run, ros, said))
        with pytest.raises(DetectError, match="are converted: name a calibration"):
            open_source(path)


def test_a_decentred_lens_is_taken_over(small_run: Path, tmp_path: Path) -> None:
    ros = Ros()
    (tmp_path / "bag").mkdir()
    k = [460.0, 0, 384, 0, 230, 144, 0, 0, 1]
    d = [-0.05, 0.01, 4e-3, -5e-3, 0.0]
    said = [
        Said("/tf_static", 1.0, ros.static_transforms(("base_footprint", OPTICAL, np.eye(4)[:3]))),
        Said("/front/camera_info", 1.0, ros.camera_info(768, 288, "plumb_bob", d, k, OPTICAL)),
    ]
    camera = open_run(ros.write(tmp_path / "bag" / "s", recorded(small_run, ros, said))).camera
    assert camera.tangential == pytest.approx((4e-3, -5e-3), abs=1e-4)
    pixels = np.random.default_rng(1).uniform([0, 0], [767, 287], size=(200, 2))
    rays = np.column_stack([camera.undistort(pixels), np.ones(len(pixels))])
    K = np.reshape(np.array(k), (3, 3))
    theirs = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(d))[0].reshape(-1, 2)
    np.testing.assert_allclose(theirs, pixels, atol=0.05)


def test_a_lens_that_the_model_cannot_follow(small_run: Path, tmp_path: Path) -> None:
    """A fisheye that sees nearly to its side: refused, with the deviation."""
    ros = Ros()
    k = [270.0, 0, 384, 0, 270, 144, 0, 0, 1]
    wide = [-0.01, 0.02, -0.005, 1e-3]
    bent = ros.camera_info(768, 288, "equidistant", wide, k, OPTICAL)
    said = [Said("/front/camera_info", 1.0, bent)]
    path = ros.write(tmp_path / "bent", recorded(small_run, ros, said))
    with pytest.raises(DetectError, match=r"differs from it by up to [0-9.]+ px, more than 0\.05"):
        open_source(path)


def test_chains_of_transforms() -> None:
    turned = np.eye(4)
    turned[:3, :3] = rotation_of(0.0, 0.0, np.sin(0.5), np.cos(0.5))
    turned[:3, 3] = (1.0, 2.0, 3.0)
    tree = {"a": ("base", turned), "b": ("a", turned), "x": ("y", turned), "y": ("x", turned)}
    found = pose_in_dataset(tree, "base", "/b")
    assert found is not None
    forward, left, up = (turned @ turned)[:3]
    np.testing.assert_allclose(found, [left, -forward, up])
    assert pose_in_dataset(tree, "base", "x") is None  # they lead in a circle
    assert pose_in_dataset(tree, "base", "unheard of") is None
    for none in (0.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="a rotation of"):
            rotation_of(none, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(
        rotation_of(0.0, 0.0, 1e-200, 1e-200), rotation_of(0.0, 0.0, 1.0, 1.0)
    )
