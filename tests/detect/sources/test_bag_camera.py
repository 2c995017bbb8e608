"""Calibrations of lenses that bags hold themselves: camera_info."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags", reason="the extra [bags] is not installed")

from camera import Camera
from camera.formats.conversion import convert_to_foreign
from camera.formats.models import ForeignCamera
from camera.formats.yaml_files import ROS_NAMES
from detect.errors import DetectError
from detect.sources.interface import Run
from detect.sources.opening import open_run, open_source
from tests.detect.recordings import images_of
from tools.ros_bags import BagKind, Ros, Said

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


def recorded(run: Path, ros: Ros, said: list[Said]) -> list[Said]:
    images = [
        Said("/front/image_raw", 10.0 + k, ros.image(image, "mono8", 10.0 + k))
        for k, image in enumerate(images_of(run))
    ]
    return [*said, *images]


def assert_sees(camera: Camera, k: Sequence[float], d: Sequence[float]) -> None:
    """The camera sees as OpenCV's with these numbers does."""
    pixels = np.random.default_rng(1).uniform([0, 0], [767, 287], size=(200, 2))
    rays = np.column_stack([camera.undistort(pixels), np.ones(len(pixels))])
    matrix = np.reshape(np.array(k, float), (3, 3))
    theirs = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(d, float))[0]
    np.testing.assert_allclose(theirs.reshape(-1, 2), pixels, atol=0.05)


@pytest.mark.parametrize(("kind", "lens"), [("mcap", "foreign"), ("ros1", "plumb_bob")])
def test_a_bags_own_calibration_is_for_markers(
    small_run: Path, tmp_path: Path, request: pytest.FixtureRequest, kind: BagKind, lens: str
) -> None:
    own: ForeignCamera = request.getfixturevalue(lens)
    ros = Ros(kind)
    (tmp_path / "bag").mkdir()
    said = [
        Said("/front/camera_info", 1.0, info(ros, own)),
        Said("/rear/camera_info", 1.0, info(ros, own, roi_width=5)),
    ]
    path = ros.write(tmp_path / "bag" / "s", recorded(small_run, ros, said))
    with pytest.raises(DetectError, match=r"no calibration: expected a \.cam file beside"):
        open_run(path)
    run = open_source(path)
    assert isinstance(run, Run)
    assert_sees(run.camera, [own.fx, 0, own.cx, 0, own.fy, own.cy, 0, 0, 1], own.distortion)
    assert isinstance(open_run(path, small_run / "s.cam"), Run)


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
    said = [Said("/front/camera_info", 1.0, ros.camera_info(768, 288, "plumb_bob", d, k, OPTICAL))]
    run = open_source(ros.write(tmp_path / "bag" / "s", recorded(small_run, ros, said)))
    assert isinstance(run, Run)
    camera = run.camera
    assert camera.tangential == pytest.approx((4e-3, -5e-3), abs=1e-4)
    assert_sees(camera, k, d)


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
