"""ROS's camera_info: the YAML of camera_calibration, an echoed message, and a message's numbers."""

from __future__ import annotations

from collections.abc import Sequence

from camera.conversion_models import ForeignCamera, Model
from camera.convert_yaml import first_of, numbers, parse_yaml, pinhole_matrix, shortest, whole
from camera.errors import ConversionError
from camera.opencv_yaml import foreign
from storage.messages import excerpt

#: What ROS calls the models (sensor_msgs/distortion_models.h).
ROS_NAMES: dict[Model, str] = {
    "radtan": "plumb_bob",
    "rational": "rational_polynomial",
    "fisheye": "equidistant",
}
_MODELS: dict[str, Model] = {name: model for model, name in ROS_NAMES.items()} | {
    "fisheye": "fisheye"
}
_RATIONAL_PRINTED = 8


def camera_from_message(
    width: int,
    height: int,
    distortion_model: str,
    d: Sequence[float],
    k: Sequence[float],
    name: str = "camera_info",
) -> ForeignCamera:
    """A camera of the numbers of a ``sensor_msgs/CameraInfo`` message.

    Parameters
    ----------
    width, height : int
        Pixels.
    distortion_model : str
        `plumb_bob`, `rational_polynomial` or `equidistant`; empty with no coefficients.
    d : sequence of float
        The coefficients, in OpenCV's order.
    k : 9 floats
        The camera matrix of the raw image, row by row.
    name : str
        Stands for the message in errors.

    Raises
    ------
    ConversionError
        If there can be no such camera; an uncalibrated one has a matrix of zeros.
    """
    if not any(k):
        raise ConversionError(f"{name}: the camera matrix is 0: the camera is not calibrated")
    pinhole = pinhole_matrix(list(k), "camera matrix", name)
    d = [float(value) for value in d]
    label = distortion_model or ("plumb_bob" if not any(d) else "")
    if label not in _MODELS:
        raise ConversionError(
            f"{name}: distortion model {excerpt(distortion_model)}: expected {', '.join(_MODELS)}"
        )
    model = _MODELS[label]
    allowed = {"radtan": (0, 4, 5), "rational": (8, 12, 14), "fisheye": (4,)}[model]
    if len(d) not in allowed or any(d[12:]):
        raise ConversionError(
            f"{name}: {len(d)} coefficients of {label}: expected "
            f"{' or '.join(str(count) for count in allowed)}, without tilt"
        )
    return foreign(name, model, width, height, pinhole, d)


def parse_ros(text: str, name: str = "<text>") -> ForeignCamera:
    """A camera of the text of a camera_info YAML file, or of an echoed message.

    Raises
    ------
    ConversionError
        If it lacks something or cannot be read.
    """
    content = parse_yaml(text, name)
    for key in ("roi", "binning_x", "binning_y"):
        value = content.get(key)
        part = value.get("width", 0) if isinstance(value, dict) else value
        if isinstance(part, int) and part > (0 if key == "roi" else 1):
            raise ConversionError(
                f"{name}: {key} is set: only whole, unbinned images are converted"
            )
    matrix = first_of(content, ("camera_matrix", "k", "K"), name)
    coefficients = first_of(content, ("distortion_coefficients", "d", "D"), name)
    return camera_from_message(
        whole(first_of(content, ("image_width", "width"), name), "image_width", name),
        whole(first_of(content, ("image_height", "height"), name), "image_height", name),
        _word(content.get("distortion_model", "plumb_bob")),
        numbers(coefficients, "distortion_coefficients", name),
        numbers(matrix, "camera_matrix", name),
        name,
    )


def _word(value: object) -> str:
    return value if isinstance(value, str) else excerpt(value)


def format_ros(camera: ForeignCamera, camera_name: str = "camera") -> str:
    """The text of a camera_info YAML file, as camera_calibration writes it."""
    d = list(camera.distortion)
    if camera.model == "rational" and not any(d[_RATIONAL_PRINTED:]):
        d = d[:_RATIONAL_PRINTED]
    matrix = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    projection = [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0]
    identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    lines = [
        f"image_width: {camera.width}",
        f"image_height: {camera.height}",
        f"camera_name: {camera_name}",
        *_matrix("camera_matrix", 3, 3, matrix),
        f"distortion_model: {ROS_NAMES[camera.model]}",
        *_matrix("distortion_coefficients", 1, len(d), d),
        *_matrix("rectification_matrix", 3, 3, identity),
        *_matrix("projection_matrix", 3, 4, projection),
    ]
    return "\n".join([*lines, ""])


def _matrix(key: str, rows: int, columns: int, values: list[float]) -> list[str]:
    data = ", ".join(shortest(value) for value in values)
    return [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{data}]"]
