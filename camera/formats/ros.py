"""ROS's camera_info: the YAML of camera_calibration, an echoed message, and a message's numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence

from camera.errors import ConversionError
from camera.formats.models import ForeignCamera, Model
from camera.formats.opencv import foreign
from camera.formats.plain_yaml import first_of, numbers, parse_yaml, pinhole_matrix, shortest, whole
from redetect.storage.messages import excerpt

#: Names of the models in ROS (sensor_msgs/distortion_models.h).
ROS_NAMES: dict[Model, str] = {
    "radtan": "plumb_bob",
    "rational": "rational_polynomial",
    "fisheye": "equidistant",
}
_MODELS: dict[str, Model] = {name: model for model, name in ROS_NAMES.items()} | {
    "fisheye": "fisheye"
}
_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)


def camera_from_message(
    width: int,
    height: int,
    distortion_model: str,
    d: Sequence[float],
    k: Sequence[float],
    name: str = "camera_info",
) -> ForeignCamera:
    """A camera of the numbers of a ``sensor_msgs/CameraInfo`` message."""
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
    """A camera of the text of a camera_info YAML file, or of an echoed message."""
    content = parse_yaml(text, name)
    width = whole(first_of(content, ("image_width", "width"), name), "image_width", name)
    height = whole(first_of(content, ("image_height", "height"), name), "image_height", name)
    for key in ("binning_x", "binning_y"):
        binning = content.get(key)
        if isinstance(binning, int) and binning > 1:
            raise ConversionError(f"{name}: {key} is {binning}: only unbinned images are converted")
    _demand_whole_image(content.get("roi"), width, height, name)
    matrix = first_of(content, ("camera_matrix", "k", "K"), name)
    coefficients = first_of(content, ("distortion_coefficients", "d", "D"), name)
    label = content.get("distortion_model", "plumb_bob")
    return camera_from_message(
        width,
        height,
        label if isinstance(label, str) else excerpt(label),
        numbers(coefficients, "distortion_coefficients", name),
        numbers(matrix, "camera_matrix", name),
        name,
    )


def _demand_whole_image(roi: object, width: int, height: int, name: str) -> None:
    """Refuse a region of interest other than none (all 0) or the whole image."""
    if not isinstance(roi, dict):
        return
    found = tuple(roi.get(key, 0) for key in ("x_offset", "y_offset", "width", "height"))
    if found not in ((0, 0, 0, 0), (0, 0, width, height)):
        raise ConversionError(
            f"{name}: roi is {excerpt(found)} (x_offset, y_offset, width, height): only whole "
            f"images, here {width} x {height}, are converted"
        )


def format_ros(camera: ForeignCamera, camera_name: str = "camera") -> str:
    """The text of a camera_info YAML file, as camera_calibration writes it.

    A name that is no word, such as a number, is left out for ``camera``.
    """
    d, matrix = camera.printed_distortion, camera.matrix
    projection = [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0]
    identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    lines = [
        f"image_width: {camera.width}",
        f"image_height: {camera.height}",
        f"camera_name: {camera_name if _NAME.fullmatch(camera_name) else 'camera'}",
        *_matrix("camera_matrix", 3, 3, matrix),
        f"distortion_model: {ROS_NAMES[camera.model]}",
        *_matrix("distortion_coefficients", 1, len(d), d),
        *_matrix("rectification_matrix", 3, 3, identity),
        *_matrix("projection_matrix", 3, 4, projection),
    ]
    return "\n".join([*lines, ""])


def _matrix(key: str, rows: int, columns: int, values: Sequence[float]) -> list[str]:
    data = ", ".join(shortest(value) for value in values)
    return [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{data}]"]
