"""The calibration that a bag holds itself: camera_info, and where tf_static puts the camera.

The intrinsics are converted to the project's model, and refused where that cannot follow them. The
pose is the chain of static transforms from the robot's base *on the floor* to the camera's optical
frame (x right, y down, z forward), brought to the data set's axes. Without one, only what needs no
floor can be detected.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from camera import Camera
from camera.calibration.floor import with_pose
from camera.formats.conversion import convert_to_camera
from camera.formats.ros import camera_from_message
from detect.errors import DetectError
from detect.sources.bag_messages import LONGEST_NAME, messages, opened_bag, understood
from detect.sources.interface import Calibration
from detect.sources.poses import DATASET_FROM_ROBOTICS
from storage.messages import one_line

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

#: What ROS calls the robot's base on the floor (REP 105, REP 120).
BASE_FRAME = "base_footprint"

#: Largest deviation of a conversion from the camera_info, anywhere in the image.
LIMIT_PX = 0.05

_INFO, _TRANSFORMS = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
_STATIC = "/tf_static"

Matrix = NDArray[np.float64]


def recorded_calibration(path: Path, image_topic: str, base: str) -> Calibration | None:
    """The calibration that a bag holds of the camera of a topic of images; None if there is none.

    Parameters
    ----------
    path : path
        The bag.
    image_topic : str
    base : str
        The frame of the robot's base, on the floor.

    Raises
    ------
    DetectError
        If the bag cannot be read, the message is for part of the image only, or the model cannot
        approximate the lens.
    camera.CameraError
        If there can be no such camera.
    """
    with opened_bag(path) as reader:
        topic = _info_topic(reader, image_topic)
        if topic is None:
            return None
        name = f"{path}: {one_line(topic, LONGEST_NAME)}"
        found = next(messages(reader, path, topic), None)
        with understood(name):
            # Drivers that are not calibrated publish a matrix of zeros.
            if found is None or not np.any(_field(found[2], "k")):
                return None
            message = found[2]
            optical = str(message.header.frame_id)
        transforms = static_transforms(reader, path)
    pose = pose_in_dataset(transforms, base, optical)
    why_not = (
        f"{name} says nothing of the camera's pose above the floor, and no static "
        f"transforms lead from {base!r} to {optical!r}: name a .cam file by --camera (`camera "
        "convert` and `camera floor` make one), or the robot's base on the floor by --base-frame"
    )
    with understood(name):
        camera = _camera_of_info(message, name)
        if pose is None:
            return Calibration(camera, why_not)
        return Calibration(with_pose(camera, pose))


def _info_topic(reader: AnyReader, image_topic: str) -> str | None:
    """The camera_info of an image topic: that of its namespace, or the only one."""
    topics = sorted({c.topic for c in reader.connections if c.msgtype == _INFO})
    raw = image_topic.removesuffix("/compressed")
    own = raw.rpartition("/")[0] + "/camera_info"
    if own in topics:
        return own
    return topics[0] if len(topics) == 1 else None


def _camera_of_info(message: Any, name: str) -> Camera:
    """The camera of a whole image's camera_info, without its pose, in the project's model."""
    part = message.roi.width or message.roi.height
    if part or max(message.binning_x, message.binning_y) > 1:
        raise DetectError(f"{name}: binning or roi is set: name a calibration by --camera")
    d, k = (_field(message, letter).tolist() for letter in "dk")
    foreign = camera_from_message(
        message.width, message.height, message.distortion_model, d, k, name
    )
    converted = convert_to_camera(foreign)
    if not converted.deviation_px <= LIMIT_PX:
        raise DetectError(
            f"{name}: this project's model differs from it by up to {converted.deviation_px:.3g} "
            f"px, more than {LIMIT_PX:g}: name a calibration by --camera (`camera convert` makes "
            "one with a wider --limit-px)"
        )
    assert isinstance(converted.camera, Camera)
    return converted.camera


def static_transforms(reader: AnyReader, path: Path) -> dict[str, tuple[str, Matrix]]:
    """Parent and 4x4 parent_from_child of each child frame, of a bag's ``/tf_static``.

    Raises
    ------
    DetectError
        If one is none.
    """
    found: dict[str, tuple[str, Matrix]] = {}
    if all((c.topic, c.msgtype) != (_STATIC, _TRANSFORMS) for c in reader.connections):
        return found
    with understood(f"{path}: {_STATIC}"):
        for _, _, message in messages(reader, path, _STATIC):
            for item in message.transforms:
                t, q = item.transform.translation, item.transform.rotation
                placed = np.eye(4)
                placed[:3, :3] = rotation_of(q.x, q.y, q.z, q.w)
                placed[:3, 3] = (t.x, t.y, t.z)
                found[item.child_frame_id.lstrip("/")] = (item.header.frame_id.lstrip("/"), placed)
    return found


def pose_in_dataset(
    transforms: dict[str, tuple[str, Matrix]], base: str, optical: str
) -> Matrix | None:
    """The (3, 4) `robot_from_camera` of an optical frame; None if no chain leads to the base."""
    placed, frame = np.eye(4), optical.lstrip("/")
    for _ in range(len(transforms) + 1):
        if frame == base:
            return np.asarray(DATASET_FROM_ROBOTICS @ placed[:3], dtype=np.float64)
        if frame not in transforms:
            return None
        frame, parent_from_child = transforms[frame]
        with np.errstate(over="ignore", invalid="ignore"):  # no camera is so far away
            placed = parent_from_child @ placed
    return None  # a circle


def rotation_of(qx: float, qy: float, qz: float, qw: float) -> Matrix:
    """The rotation matrix of a quaternion of any length but zero; else a ValueError."""
    q = np.array([qx, qy, qz, qw], dtype=np.float64)
    largest = np.abs(q).max()
    if not 0.0 < largest < np.inf:
        raise ValueError(f"a rotation of {qx:g}, {qy:g}, {qz:g}, {qw:g}")
    # Squares of very large or small numbers overflow or underflow.
    return np.asarray(Rotation.from_quat(q / largest).as_matrix())


def _field(message: Any, letter: str) -> NDArray[np.float64]:
    """The numbers of a field of camera_info, which ROS 1 calls by a capital letter."""
    name = letter.upper() if hasattr(message, letter.upper()) else letter
    return np.array(getattr(message, name), dtype=np.float64)
