"""The node of ROS 2: what it publishes about an image is what `rd.detect` finds in it."""

from __future__ import annotations

import array
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import redetect as rd

pytest.importorskip("rosbags", reason="the extra [bags] is not installed")

from tests.ros.ros_stand_ins import Ros, get_message

STAMP_S, STAMP_NS = 1_700_000_000, 123_456_789
IMAGE_FRAME = "front_optical"


class Running:
    """The node, started with some parameters beside those that every test gives."""

    def __init__(self, module: ModuleType, ros: Ros) -> None:
        self.module, self.ros = module, ros

    def send(self, topic: str, **fields: Any) -> None:
        """Send it an image with the time and the frame of these tests."""
        stamp = get_message("builtin_interfaces/msg/Time")(sec=STAMP_S, nanosec=STAMP_NS)
        header = get_message("std_msgs/msg/Header")(stamp=stamp, frame_id=IMAGE_FRAME)
        self.ros.send(topic, header=header, **fields)


Start = Callable[..., Running]


@pytest.fixture
def prepared(project_root: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """Gives the module of the node beside a ROS with parameters; nothing of either stays."""

    def prepare(remapped: dict[str, str] | None = None, **parameters: object) -> Running:
        camera = str(project_root / "images" / "e" / "e.cam")
        ros = Ros({"camera": camera, "radius_m": 0.1, **parameters}, remapped or {})
        ros.install(monkeypatch)
        monkeypatch.syspath_prepend(project_root / "ros" / "redetect_ros")
        return Running(import_module("redetect_ros.node"), ros)

    yield prepare
    for name in ("redetect_ros", "redetect_ros.node"):
        sys.modules.pop(name, None)


@pytest.fixture
def start(prepared: Start) -> Start:
    """Starts the node."""

    def started(remapped: dict[str, str] | None = None, **parameters: object) -> Running:
        running = prepared(remapped, **parameters)
        running.module.Redetect()
        return running

    return started


@pytest.fixture(scope="module")
def image_file(project_root: Path) -> Path:
    return project_root / "images" / "e" / "images" / "e.0000.jpg"


@pytest.fixture(scope="module")
def found(project_root: Path, image_file: Path) -> rd.Detection:
    """What is in the image, in the axes of ROS."""
    camera = project_root / "images" / "e" / "e.cam"
    return rd.detect(image_file, camera, radius_m=0.1, axes="robotics")


def raw(pixels: Any, encoding: str) -> dict[str, Any]:
    """The fields of `sensor_msgs/Image`."""
    height, width = pixels.shape[:2]
    return {
        "height": height,
        "width": width,
        "encoding": encoding,
        "step": pixels.nbytes // height,
        "data": array.array("B", pixels.tobytes()),
    }


def rotation_vector(quaternion: Any) -> Any:
    numbers = [quaternion.x, quaternion.y, quaternion.z, quaternion.w]
    return Rotation.from_quat(numbers).as_rotvec()


def demand_found(ros: Ros, found: rd.Detection, prefix: str = "") -> None:
    """Compare all that was published with what was found, times and frames included."""
    assert len(found.discs) > 5
    assert len(found.verticals) > 5
    assert found.tilt is not None
    headers = []

    poses = ros.of_topic("/redetect/circles/poses")
    headers += [(message.header, "base_link") for message in poses]
    places = [message.pose.pose.position for message in poses]
    np.testing.assert_allclose([(p.x, p.y) for p in places], found.discs.xy, atol=1e-9)
    assert {p.z for p in places} == {0.0}
    covariances = np.array([message.pose.covariance for message in poses]).reshape(-1, 6, 6)
    np.testing.assert_allclose(covariances[:, :2, :2], found.discs.covariance, rtol=1e-9)
    assert np.count_nonzero(covariances) == 4 * len(found.discs)

    verticals = ros.of_topic("/redetect/lines/poses")
    headers += [(message.header, "base_link") for message in verticals]
    turns = np.array([rotation_vector(message.pose.pose.orientation) for message in verticals])
    np.testing.assert_allclose(turns[:, 2], found.verticals.bearing_rad, atol=1e-9)
    assert not turns[:, :2].any()
    variances = np.array([message.pose.covariance for message in verticals])
    np.testing.assert_allclose(variances[:, 35], found.verticals.sigma_rad**2, rtol=1e-9)
    assert np.count_nonzero(variances) == len(found.verticals)

    (tilt,) = ros.of_topic("/redetect/tilts/poses")
    headers.append((tilt.header, "base_footprint"))
    expected = [found.tilt.roll_rad, found.tilt.pitch_rad, 0.0]  # about X forward, about Y left
    np.testing.assert_allclose(rotation_vector(tilt.pose.pose.orientation), expected, atol=1e-12)
    covariance = tilt.pose.covariance.reshape(6, 6)[3:5, 3:5]
    np.testing.assert_allclose(covariance, found.tilt.covariance[::-1, ::-1], rtol=1e-9)

    for topic, one_by_one in (("circles", poses), ("lines", verticals)):
        (shapes,) = ros.of_topic(f"/redetect/{topic}")
        clear, *markers = shapes.markers
        assert clear.action == 3  # Marker.DELETEALL
        assert [(m.ns, m.id, m.action) for m in markers] == [
            (topic, number, 0) for number in range(len(one_by_one))
        ]
        assert [marker.pose for marker in markers] == [pose.pose.pose for pose in one_by_one]
        headers += [(marker.header, "base_link") for marker in shapes.markers]

    for header, frame in headers:
        assert header.frame_id == prefix + frame
        assert (header.stamp.sec, header.stamp.nanosec) == (STAMP_S, STAMP_NS)


def test_a_compressed_image_of_a_remapped_topic(
    start: Start, image_file: Path, found: rd.Detection
) -> None:
    node = start({"image": "/front/image_raw"}, image_transport="compressed", frame_prefix="r1/")
    content = array.array("B", image_file.read_bytes())
    node.send("/front/image_raw/compressed", format="jpeg", data=content)
    demand_found(node.ros, found, "r1/")
    assert node.ros.of_topic("/tf_static") == []


def test_raw_images(start: Start, image_file: Path, found: rd.Detection) -> None:
    node = start()
    gray = cv2.imread(str(image_file), cv2.IMREAD_GRAYSCALE)
    colours = np.repeat(np.asarray(gray)[:, :, None], 3, axis=2)
    for pixels, encoding in ((gray, "mono8"), (colours, "bgr8"), (colours, "rgb8")):
        node.ros.published.clear()
        node.send("/image", **raw(pixels, encoding))
        demand_found(node.ros, found)


def test_where_the_camera_is(start: Start, image_file: Path, published_camera: rd.Camera) -> None:
    node = start(publish_tf=True)
    pixels = np.zeros((published_camera.height, published_camera.width), np.uint8)
    node.send("/image", **raw(pixels, "mono8"))
    node.send("/image", **raw(pixels, "mono8"))
    (message,) = node.ros.of_topic("/tf_static")
    (transform,) = message.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("base_link", IMAGE_FRAME)
    ((_, _, qos),) = [one for one in node.ros.published if one[0] == "/tf_static"]
    assert qos.durability == "transient local"
    # A point in front of the camera is where the camera says, X forward and Y left.
    camera = rd.Camera.read(node.ros.parameters["camera"])  # type: ignore[arg-type]
    in_camera = np.array([0.3, 0.2, 1.5])
    left, backward, up = camera.rotation @ in_camera + camera.centre
    moved = transform.transform.translation
    turn = Rotation.from_rotvec(rotation_vector(transform.transform.rotation))
    in_robot = turn.apply(in_camera) + np.array([moved.x, moved.y, moved.z])
    np.testing.assert_allclose(in_robot, [-backward, left, up], atol=1e-4)
    # Nothing is in a black image: what was shown goes.
    assert [len(shapes.markers) for shapes in node.ros.of_topic("/redetect/circles")] == [1, 1]


def test_settings(start: Start, image_file: Path, project_root: Path, tmp_path: Path) -> None:
    file = tmp_path / "settings.json"
    file.write_text('{"settings": {"circles": {"radius_m": 0.1, "evidence": 3.0}}}')
    node = start(settings=str(file), radius_m=0.0, polarity="light", image_transport="compressed")
    content = array.array("B", image_file.read_bytes())
    node.send("/image/compressed", format="jpeg", data=content)
    settings = rd.CircleSettings(radius_m=0.1, evidence=3.0)
    camera = project_root / "images" / "e" / "e.cam"
    certain = rd.detect(image_file, camera, polarity="light", settings=settings)
    usual = rd.detect(image_file, camera, polarity="light", radius_m=0.1)
    assert 0 < len(certain.discs) < len(usual.discs)
    assert len(node.ros.of_topic("/redetect/circles/poses")) == len(certain.discs)


def test_an_image_that_cannot_be_read_costs_itself(
    start: Start, image_file: Path, found: rd.Detection
) -> None:
    node = start(image_transport="compressed")
    content = image_file.read_bytes()
    node.send("/image/compressed", format="jpeg", data=array.array("B", content[:1000]))
    assert node.ros.published == []
    assert node.ros.node is not None
    (warning,) = node.ros.node.warnings
    assert "the JPEG is truncated" in warning
    node.send("/image/compressed", format="jpeg", data=array.array("B", content))
    demand_found(node.ros, found)


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"camera": ""}, "parameters camera and image_transport: expected a .cam file"),
        ({"camera": "gone.cam"}, "gone.cam"),
        ({"image_transport": "theora"}, "raw or compressed"),
        ({"settings": "gone.json"}, "gone.json: no such settings file"),
        ({"radius_m": -1.0}, "radius_m is -1"),
    ],
)
def test_wrong_parameters_end_it(prepared: Start, parameters: dict[str, object], said: str) -> None:
    node = prepared(**parameters)
    with pytest.raises(SystemExit) as ended:
        node.module.main()
    assert str(ended.value).startswith("error: ")
    assert said in str(ended.value)
    assert node.ros.events == ["init", "shutdown"]


def test_it_runs_until_it_is_stopped(prepared: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    node = prepared()

    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(node.module.rclpy, "spin", interrupted)
    node.module.main()
    assert node.ros.events == ["init", "shutdown"]
