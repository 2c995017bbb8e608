"""Rows as standard messages of ROS 2, in the axes of REP 103: X forward, Y left, Z up.

Each disc, vertical and tilt is a `geometry_msgs/PoseWithCovarianceStamped`; discs and verticals of
an image also are a `visualization_msgs/MarkerArray`, in the same order, with their identifiers as
text. Square markers are `visualization_msgs/ImageMarker`, and odometry is the transform from `odom`
to `base_link` (REP 105). RViz and Foxglove display these directly.
"""

from __future__ import annotations

import cmath
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from redetect.landmarks.axes import covariance_from_dataset, from_dataset
from redetect.landmarks.columns import TableName

_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_SHAPE, _SHAPES = "visualization_msgs/msg/Marker", "visualization_msgs/msg/MarkerArray"
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
#: The topics of a table, with the types of their messages.
TOPICS: dict[TableName, dict[str, str]] = {
    "steps": {"/tf": _TRANSFORMS},
    "circles": {"/redetect/circles": _SHAPES, "/redetect/circles/poses": _POSE},
    "lines": {"/redetect/lines": _SHAPES, "/redetect/lines/poses": _POSE},
    "markers": {"/redetect/markers": "visualization_msgs/msg/ImageMarker"},
    "tilts": {"/redetect/tilts/poses": _POSE},
}
#: Makes a message of a type from its fields; missing ones are zero or empty.
Make = Callable[..., Any]
#: The values of a row's columns after those of its frame.
Values = Sequence[Any]

_DELETE_ALL = 3  # Action of a `Marker`: removes those shown before.
# Kind of a `Marker` and its size (m), as a symbol of a disc, and of the bearing of a vertical.
_CYLINDER_OR_ARROW = {"circles": (3, (0.2, 0.2, 0.01)), "lines": (0, (5.0, 0.02, 0.02))}
_POLYGON = 3


def ros_messages(
    make: Make,
    frames: Iterable[tuple[int, Mapping[TableName, Sequence[Values]]]],
    frame_prefix: str = "",
) -> Iterator[tuple[int, str, Any]]:
    """Time (ns), topic and content of the messages of the rows of frames.

    `make(type, **fields)` makes a message; `frames` are the time of each frame (ns) and its rows by
    table, with values in the order of `redetect.landmarks.columns`; `frame_prefix` precedes the
    names of all coordinate frames, as in `robot_state_publisher`.
    """
    place, heading = 0j, 0.0  # The robot in the frame `odom`: x + iy (m), rad
    for time_ns, tables in frames:
        in_robot, in_odom, level = (
            header_of(make, time_ns, frame_prefix + name)
            for name in ("base_link", "odom", "base_footprint")
        )
        for dx, dy, dphi, *_ in tables.get("steps", ()):
            place += cmath.exp(1j * heading) * 1j * complex(dx, dy)
            heading += dphi
            turn = Rotation.from_rotvec([0.0, 0.0, heading])
            to = [place.real, place.imag, 0.0]
            yield time_ns, "/tf", transform_of(make, in_odom, f"{frame_prefix}base_link", to, turn)
        for table in ("circles", "lines"):
            if table in tables:
                poses = [_pose(make, table, row) for row in tables[table]]
                shapes = _shapes(make, in_robot, table, poses, [row[-1] for row in tables[table]])
                yield time_ns, f"/redetect/{table}", shapes
                for pose in poses:
                    stamped = make(_POSE, header=in_robot, pose=pose)
                    yield time_ns, f"/redetect/{table}/poses", stamped
        for row in tables.get("tilts", ()):
            stamped = make(_POSE, header=level, pose=_pose(make, "tilts", row))
            yield time_ns, "/redetect/tilts/poses", stamped
        for row in tables.get("markers", ()):
            yield time_ns, "/redetect/markers", _outline(make, in_robot, row)


def header_of(make: Make, time_ns: int, frame_id: str) -> Any:
    """A `std_msgs/Header`."""
    seconds, nanoseconds = divmod(time_ns, 10**9)
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _pose(make: Make, table: TableName, row: Values) -> Any:
    """A disc's floor position, a vertical's bearing, or the rotation that levels the robot."""
    mean, covariance = np.zeros(6), np.zeros((6, 6))  # Position, rotation vector
    if table == "lines":
        *_, alpha, _, _, sigma, _ = row
        mean[5], covariance[5, 5] = alpha, sigma * sigma  # may be infinite
    else:
        x, y, xx, xy, yy = *row[:2], *(row[3:6] if table == "circles" else row[2:5])
        part = slice(0, 2) if table == "circles" else slice(3, 5)
        mean[part] = from_dataset([x, y])
        covariance[part, part] = covariance_from_dataset([[xx, xy], [xy, yy]])
    pose = make(
        "geometry_msgs/msg/Pose",
        position=_xyz(make, "Point", mean[:3]),
        orientation=_quaternion(make, Rotation.from_rotvec(mean[3:])),
    )
    return make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance.ravel())


def _xyz(make: Make, kind: str, values: ArrayLike) -> Any:
    x, y, z = np.asarray(values, np.float64).tolist()
    return make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def _quaternion(make: Make, turn: Rotation) -> Any:
    x, y, z, w = turn.as_quat().tolist()
    return make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def transform_of(make: Make, header: Any, child: str, place: ArrayLike, turn: Rotation) -> Any:
    """A `tf2_msgs/TFMessage`: a frame's position and rotation in the frame of the header."""
    transform = make(
        "geometry_msgs/msg/Transform",
        translation=_xyz(make, "Vector3", place),
        rotation=_quaternion(make, turn),
    )
    stamped = make(
        "geometry_msgs/msg/TransformStamped",
        header=header, child_frame_id=child, transform=transform,
    )  # fmt: skip
    return make(_TRANSFORMS, transforms=[stamped])


def _orange(make: Make, opacity: float) -> Any:
    return make("std_msgs/msg/ColorRGBA", r=1.0, g=0.5, b=0.0, a=opacity)


def _shapes(
    make: Make, header: Any, table: TableName, poses: Sequence[Any], identifiers: Sequence[Any]
) -> Any:
    """Symbols of the discs or verticals of an image, which replace those shown before."""
    kind, size = _CYLINDER_OR_ARROW[table]
    common = {
        "header": header,
        "ns": table,
        "type": kind,
        "scale": _xyz(make, "Vector3", size),
        "color": _orange(make, 0.8),
    }
    nowhere = make("geometry_msgs/msg/Pose", orientation=_quaternion(make, Rotation.identity()))
    clear = make(_SHAPE, action=_DELETE_ALL, pose=nowhere, **common)
    found = [
        make(_SHAPE, id=number, pose=pose.pose, text=" ".join(map(str, ids)), **common)
        for number, (pose, ids) in enumerate(zip(poses, identifiers))
    ]
    return make(_SHAPES, markers=[clear, *found])


def _outline(make: Make, header: Any, row: Values) -> Any:
    """A square marker in the image: its dictionary as namespace, number and corners (px)."""
    dictionary, number, _, *corners = row
    colour = _orange(make, 1.0)
    return make(
        "visualization_msgs/msg/ImageMarker",
        header=header,
        ns=dictionary,
        id=number,
        type=_POLYGON,
        scale=1.0,
        outline_color=colour,
        fill_color=colour,
        points=[_xyz(make, "Point", (u, v, 0.0)) for u, v in zip(corners[::5], corners[1::5])],
    )
