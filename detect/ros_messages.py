"""Rows as standard messages of ROS 2, in the axes of REP 103: X forward, Y left, Z up.

Discs, verticals and tilts are `geometry_msgs/PoseWithCovarianceStamped`, a message for each, and
discs and verticals a `visualization_msgs/MarkerArray` for each image besides, in the same order,
with their identifiers as text. Square markers are `visualization_msgs/ImageMarker`, and odometry is
the transform from `odom` to `base_link` (REP 105). RViz and Foxglove show these as they are.
"""

from __future__ import annotations

import cmath
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from redetect.array_types import FloatArray
from redetect.landmarks.axes import covariance_from_dataset, from_dataset
from redetect.landmarks.columns import TableName

_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_SHAPES = "visualization_msgs/msg/MarkerArray"
#: The topics of a table, with the types of their messages.
TOPICS: dict[TableName, dict[str, str]] = {
    "steps": {"/tf": "tf2_msgs/msg/TFMessage"},
    "circles": {"/redetect/circles": _SHAPES, "/redetect/circles/poses": _POSE},
    "lines": {"/redetect/lines": _SHAPES, "/redetect/lines/poses": _POSE},
    "markers": {"/redetect/markers": "visualization_msgs/msg/ImageMarker"},
    "tilts": {"/redetect/tilts/poses": _POSE},
}
#: Classes of messages, by their types.
Types = Mapping[str, Any]
#: The values of a row's columns behind those of its frame.
Values = Sequence[Any]

_DELETE_ALL = 3  # Action of a `Marker`: those shown before go.
# Kind of a `Marker` and its size (m), as a symbol of a disc, and of the bearing of a vertical.
_CYLINDER_OR_ARROW = {"circles": (3, (0.2, 0.2, 0.01)), "lines": (0, (5.0, 0.02, 0.02))}
_POLYGON = 3


def ros_messages(
    types: Types, frames: Iterable[tuple[int, Mapping[TableName, Sequence[Values]]]]
) -> Iterator[tuple[int, str, Any]]:
    """Time (ns), topic and content of the messages of the rows of frames.

    `types` has the messages' classes, as a store of `rosbags` does; `frames` the time of each frame
    (ns) and its rows by table, their values in the order of `redetect.landmarks.columns`.
    """
    place, heading = 0j, 0.0  # The robot in the frame `odom`: x + iy (m), rad
    for time_ns, tables in frames:
        stamp = types["builtin_interfaces/msg/Time"](*divmod(time_ns, 10**9))
        in_robot, in_odom, level = (
            types["std_msgs/msg/Header"](stamp, name)
            for name in ("base_link", "odom", "base_footprint")
        )
        for dx, dy, dphi, *_ in tables.get("steps", ()):
            place += cmath.exp(1j * heading) * 1j * complex(dx, dy)
            heading += dphi
            yield time_ns, "/tf", _transform(types, in_odom, place, heading)
        for table in ("circles", "lines"):
            if table in tables:
                poses = [_pose(types, table, row) for row in tables[table]]
                identifiers = [row[-1] for row in tables[table]]
                shapes = _shapes(types, in_robot, table, poses, identifiers)
                yield time_ns, f"/redetect/{table}", shapes
                for pose in poses:
                    yield time_ns, f"/redetect/{table}/poses", types[_POSE](in_robot, pose)
        for row in tables.get("tilts", ()):
            yield time_ns, "/redetect/tilts/poses", types[_POSE](level, _pose(types, "tilts", row))
        for row in tables.get("markers", ()):
            yield time_ns, "/redetect/markers", _outline(types, in_robot, row)


def _pose(types: Types, table: TableName, row: Values) -> Any:
    """A disc's place on the floor, a vertical's bearing, or the turn of the robot to the level."""
    mean, covariance = np.zeros(6), np.zeros((6, 6))  # Place, rotation vector
    if table == "lines":
        *_, alpha, _, _, sigma, _ = row
        mean[5], covariance[5, 5] = alpha, sigma**2
    else:
        x, y, xx, xy, yy = *row[:2], *(row[3:6] if table == "circles" else row[2:5])
        part = slice(0, 2) if table == "circles" else slice(3, 5)
        mean[part] = from_dataset([x, y])
        covariance[part, part] = covariance_from_dataset([[xx, xy], [xy, yy]])
    point = types["geometry_msgs/msg/Point"](*mean[:3])
    pose = types["geometry_msgs/msg/Pose"](point, _quaternion(types, mean[3:]))
    return types["geometry_msgs/msg/PoseWithCovariance"](pose, covariance.ravel())


def _quaternion(types: Types, rotation_vector: FloatArray) -> Any:
    return types["geometry_msgs/msg/Quaternion"](*Rotation.from_rotvec(rotation_vector).as_quat())


def _transform(types: Types, header: Any, place: complex, heading: float) -> Any:
    moved = types["geometry_msgs/msg/Vector3"](place.real, place.imag, 0.0)
    turned = _quaternion(types, np.array([0.0, 0.0, heading]))
    transform = types["geometry_msgs/msg/Transform"](moved, turned)
    stamped = types["geometry_msgs/msg/TransformStamped"](header, "base_link", transform)
    return types["tf2_msgs/msg/TFMessage"]([stamped])


def _shapes(
    types: Types, header: Any, table: TableName, poses: Sequence[Any], identifiers: Sequence[Any]
) -> Any:
    """Symbols of the discs or verticals of an image, which replace those shown before."""
    kind, size = _CYLINDER_OR_ARROW[table]
    zero = types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0)
    nowhere = types["geometry_msgs/msg/Pose"](zero, _quaternion(types, np.zeros(3)))
    no_bytes = np.zeros(0, dtype=np.uint8)

    def shape(number: int, action: int, pose: Any, text: str) -> Any:
        return types["visualization_msgs/msg/Marker"](
            header=header,
            ns=table,
            id=number,
            type=kind,
            action=action,
            pose=pose,
            scale=types["geometry_msgs/msg/Vector3"](*size),
            color=types["std_msgs/msg/ColorRGBA"](1.0, 0.5, 0.0, 0.8),
            lifetime=types["builtin_interfaces/msg/Duration"](0, 0),
            frame_locked=False,
            points=[],
            colors=[],
            texture_resource="",
            texture=types["sensor_msgs/msg/CompressedImage"](header, "", no_bytes),
            uv_coordinates=[],
            text=text,
            mesh_resource="",
            mesh_file=types["visualization_msgs/msg/MeshFile"]("", no_bytes),
            mesh_use_embedded_materials=False,
        )

    found = [
        shape(number, 0, pose.pose, " ".join(map(str, ids)))
        for number, (pose, ids) in enumerate(zip(poses, identifiers))
    ]
    return types[_SHAPES]([shape(0, _DELETE_ALL, nowhere, ""), *found])


def _outline(types: Types, header: Any, row: Values) -> Any:
    """A square marker in the image: its dictionary as namespace, number and corners (px)."""
    dictionary, number, _, *corners = row
    point = types["geometry_msgs/msg/Point"]
    colour = types["std_msgs/msg/ColorRGBA"](1.0, 0.5, 0.0, 1.0)
    return types["visualization_msgs/msg/ImageMarker"](
        header=header,
        ns=dictionary,
        id=number,
        type=_POLYGON,
        action=0,
        position=point(0.0, 0.0, 0.0),
        scale=1.0,
        outline_color=colour,
        filled=0,
        fill_color=colour,
        lifetime=types["builtin_interfaces/msg/Duration"](0, 0),
        points=[point(u, v, 0.0) for u, v in zip(corners[::5], corners[1::5])],
        outline_colors=[],
    )
