"""Calibrations in YAML: OpenCV's (also in XML), ROS's camera_info, Kalibr's camchain and EuRoC's.

YAML is read safely: plain values only, bounded, without aliases. OpenCV's own dialect begins with
``%YAML:1.0`` and tags its matrices; both are understood.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml  # type: ignore[import-untyped, unused-ignore]

from camera.errors import ConversionError
from camera.formats.models import COEFFICIENTS, ForeignCamera, Model
from redetect.bounds import number_in
from redetect.messages import excerpt, one_line

_MOST_CAMERAS = 1000
# Keys of OpenCV's files in use, and values that mean the fisheye model.
_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K")
_DISTORTION = (
    "distortion_coefficients",
    "dist_coeffs",
    "distCoeffs",
    "Distortion_Coefficients",
    "D",
)
_FISHEYE = ("1", "true", "fisheye", "equidistant")
#: Names of the models in ROS (sensor_msgs/distortion_models.h).
ROS_NAMES: dict[Model, str] = {
    "radtan": "plumb_bob",
    "rational": "rational_polynomial",
    "fisheye": "equidistant",
}
_ROS_MODELS: dict[str, Model] = {name: model for model, name in ROS_NAMES.items()} | {
    "fisheye": "fisheye"
}
_KALIBR_MODELS: dict[str, Model] = {
    "radtan": "radtan",
    "radial-tangential": "radtan",
    "equi": "fisheye",
    "equidistant": "fisheye",
}
_KALIBR_COEFFICIENTS = 4
_LONGEST_LIST = 100


def parse_yaml(text: str, name: str) -> dict[str, Any]:
    """The first document of a YAML text, which must be a mapping; or OpenCV's XML."""
    if text.lstrip().startswith("<"):
        return _parse_xml(text, name)

    class Loader(yaml.SafeLoader):  # type: ignore[misc, unused-ignore]
        def compose_node(self, parent: Any, index: Any) -> Any:
            # Nested aliases can grow exponentially, and calibrations have none.
            if self.check_event(yaml.events.AliasEvent):
                line = self.peek_event().start_mark.line + 1
                raise ConversionError(f"{name}:{line}: an alias: expected plain values")
            return super().compose_node(parent, index)

    def matrix(loader: Any, node: Any) -> Any:
        return loader.construct_mapping(node, deep=True)

    Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", matrix)
    lines = text.splitlines()
    if lines and lines[0].startswith("%YAML:"):
        text = "\n".join(["", *lines[1:]])
    try:
        # Only the first of several documents: `rostopic echo` writes one per message.
        content = next(iter(yaml.load_all(text, Loader)), None)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise ConversionError(f"{name}{where}: {problem}: expected YAML") from None
    except (ValueError, LookupError, AttributeError, RecursionError) as error:
        # A tag such as !!int on a value of another kind fails in whatever way reading that does.
        if isinstance(error, ConversionError):
            raise
        raise ConversionError(f"{name}: invalid YAML: {one_line(str(error), 100)}") from None
    if not isinstance(content, dict):
        raise ConversionError(f"{name}: expected YAML with keys and values")
    # Keys of calibrations are words, or cameras' numbers; others may be too long to be written.
    return {
        str(key): value
        for key, value in content.items()
        if isinstance(key, str) or (isinstance(key, int) and abs(key) < _MOST_CAMERAS)
    }


def _parse_xml(text: str, name: str) -> dict[str, Any]:
    """The values of an XML text of OpenCV's FileStorage."""
    if re.search("<!(?!--)", text):
        raise ConversionError(f"{name}: XML with declarations: expected plain values")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ConversionError(f"{name}:{error.position[0]}: {error}: expected XML") from None
    content: dict[str, Any] = {}
    for element in root:
        if element.tag in content:
            raise ConversionError(f"{name}: {excerpt(element.tag)} twice: expected it once")
        data, value = element.findtext("data"), (element.text or "").strip()
        whole = value.isascii() and value.isdecimal() and len(value) < _LONGEST_LIST
        single = int(value) if whole else value
        content[element.tag] = single if data is None else {"data": data.split()}
    return content


def numbers(value: Any, key: str, name: str) -> list[float]:
    """The numbers of a list, of nested lists, or of a mapping with `data`, flat."""
    if isinstance(value, dict):
        value = value.get("data")
    result = []
    for item in np.array(value, dtype=object).ravel():
        # YAML 1.1 parses 1e-3 as text, because it lacks the dot.
        try:
            number = number_in(str(item))
        except ValueError:
            number = float("nan")
        if not np.isfinite(number):
            raise ConversionError(f"{name}: {key} has {excerpt(item)}: expected numbers")
        result.append(number)
    return result


def first_of(content: dict[str, Any], keys: tuple[str, ...], name: str) -> Any:
    """The value of the first key that exists."""
    for key in keys:
        if key in content:
            return content[key]
    raise ConversionError(f"{name}: lacks {' or '.join(keys)}")


def whole(value: Any, key: str, name: str) -> int:
    """A whole number."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise ConversionError(f"{name}: {key} is {excerpt(value)}: expected a whole number")
    return value


def image_size(content: dict[str, Any], name: str) -> tuple[int, int]:
    """Width and height of the images, by the keys of OpenCV or ROS."""
    sides = []
    for side in ("width", "height"):
        key = f"image_{side}"
        found = [content[k] for k in (key, f"image_{side.title()}", side) if k in content]
        if not found:
            # OpenCV itself does not require the size; its stereo sample writes none.
            raise ConversionError(
                f"{name}: lacks {key}: add the images' size, a line such as '{key}: 640'"
            )
        sides.append(whole(found[0], key, name))
    return sides[0], sides[1]


def pinhole_matrix(value: Any, name: str) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a 3 x 3 camera matrix without skew."""
    m = numbers(value, "camera_matrix", name)
    if len(m) != 9 or m[3:4] + m[6:] != [0.0, 0.0, 0.0, 1.0]:
        raise ConversionError(
            f"{name}: camera_matrix is {excerpt(m)}: expected the 9 numbers fx 0 cx 0 fy cy 0 0 1"
        )
    if m[1] != 0.0:
        raise ConversionError(
            f"{name}: camera_matrix has a skew of {m[1]:g}: only 0 can be converted"
        )
    return m[0], m[4], m[2], m[5]


def parse_opencv(text: str, name: str = "<text>") -> ForeignCamera:
    """A camera of the text of an OpenCV YAML file."""
    content = parse_yaml(text, name)
    width, height = image_size(content, name)
    fx, fy, cx, cy = pinhole_matrix(first_of(content, _MATRIX, name), name)
    d = numbers(first_of(content, _DISTORTION, name), "distortion_coefficients", name)
    kind = content.get("fisheye_model", content.get("distortion_model", 0))
    fisheye = kind.lower() in _FISHEYE if isinstance(kind, str) else kind == 1
    model = opencv_model(d, fisheye=fisheye, name=name)
    return foreign(name, model, width, height, (fx, fy, cx, cy), d)


def opencv_model(coefficients: list[float], *, fisheye: bool, name: str) -> Model:
    """The model that OpenCV uses for this number of coefficients."""
    count = len(coefficients)
    if fisheye:
        if count != COEFFICIENTS["fisheye"]:
            raise ConversionError(
                f"{name}: {count} coefficients of a fisheye lens: expected k1 k2 k3 k4"
            )
        return "fisheye"
    if count not in (0, 4, 5, 8, 12, 14):
        raise ConversionError(
            f"{name}: {count} distortion coefficients: expected 4, 5, 8, 12 or 14"
        )
    if any(beyond := coefficients[COEFFICIENTS["rational"] :]):
        raise ConversionError(
            f"{name}: a thin prism or a tilted sensor ({excerpt(beyond)}) can't be converted"
        )
    return "radtan" if count <= 5 else "rational"


def name_of_one(held: Sequence[str], camera_name: str, name: str, what: str = "camera") -> str:
    """The name of the requested camera in a file, or of the only one."""
    listed = one_line(", ".join(held), _LONGEST_LIST) or "none"
    if camera_name and camera_name not in held:
        raise ConversionError(f"{name}: no camera {camera_name}: it holds {listed}")
    if not camera_name and len(held) != 1:
        advice = ": give --camera-name" if held else ""
        raise ConversionError(f"{name}: expected one {what}: it holds {listed}{advice}")
    return camera_name or held[0]


def foreign(
    name: str,
    model: Model,
    width: int,
    height: int,
    pinhole: tuple[float, float, float, float],
    coefficients: list[float],
) -> ForeignCamera:
    """Make a camera; coefficients of the model that are not in the file are 0."""
    count = COEFFICIENTS[model]
    padded = (*coefficients, *(0.0,) * count)[:count]
    try:
        return ForeignCamera(model, width, height, *pinhole, padded)
    except ConversionError as error:
        raise ConversionError(f"{name}: {error}") from None


def format_opencv(camera: ForeignCamera) -> str:
    """The text of an OpenCV YAML file; OpenCV's FileStorage reads it."""
    d = camera.distortion
    lines = ["%YAML:1.0", "---", f"image_width: {camera.width}", f"image_height: {camera.height}"]
    lines += _opencv_matrix("camera_matrix", 3, 3, camera.matrix)
    lines += _opencv_matrix("distortion_coefficients", len(d), 1, d)
    lines.append(f"fisheye_model: {int(camera.model == 'fisheye')}")
    return "\n".join([*lines, ""])


def _opencv_matrix(key: str, rows: int, columns: int, values: Sequence[float]) -> list[str]:
    return [
        f"{key}: !!opencv-matrix",
        f"   rows: {rows}",
        f"   cols: {columns}",
        "   dt: d",
        f"   data: {_yaml_of(list(values)).strip()}",
    ]


def _yaml_of(content: object) -> str:
    """YAML with keys in their order and lists of numbers on one line."""
    text: str = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=math.inf)
    return text


def parse_ros(text: str, name: str = "<text>") -> ForeignCamera:
    """A camera of the text of a camera_info YAML file, or of an echoed message."""
    return camera_of_info(parse_yaml(text, name), name)


def camera_of_info(content: dict[str, Any], name: str) -> ForeignCamera:
    """A camera of the fields of a ``sensor_msgs/CameraInfo``, from a message or a file."""
    width, height = image_size(content, name)
    for key in ("binning_x", "binning_y"):
        binning = content.get(key)
        if isinstance(binning, int) and binning > 1:
            raise ConversionError(f"{name}: {key} is {binning}: only unbinned images are converted")
    _demand_whole_image(content.get("roi"), width, height, name)
    matrix = first_of(content, ("camera_matrix", "k", "K"), name)
    if not any(numbers(matrix, "camera_matrix", name)):
        raise ConversionError(f"{name}: the camera matrix is 0: the camera is not calibrated")
    pinhole = pinhole_matrix(matrix, name)
    coefficients = first_of(content, ("distortion_coefficients", "d", "D"), name)
    d = numbers(coefficients, "distortion_coefficients", name)
    label = content.get("distortion_model", "plumb_bob")
    if label == "" and not any(d):
        label = "plumb_bob"
    if not isinstance(label, str) or label not in _ROS_MODELS:
        raise ConversionError(
            f"{name}: distortion model {excerpt(label)}: expected {', '.join(_ROS_MODELS)}"
        )
    model = _ROS_MODELS[label]
    if opencv_model(d, fisheye=model == "fisheye", name=name) != model:
        raise ConversionError(f"{name}: {len(d)} coefficients, which are not of {label}")
    return foreign(name, model, width, height, pinhole, d)


def _demand_whole_image(roi: object, width: int, height: int, name: str) -> None:
    """Reject a region of interest other than none (all 0) or the whole image."""
    if not isinstance(roi, dict):
        return
    found = tuple(roi.get(key, 0) for key in ("x_offset", "y_offset", "width", "height"))
    if found not in ((0, 0, 0, 0), (0, 0, width, height)):
        raise ConversionError(
            f"{name}: roi is {excerpt(found)} (x_offset, y_offset, width, height): only whole "
            f"images, here {width} x {height}, are converted"
        )


def format_ros(camera: ForeignCamera) -> str:
    """The text of a camera_info YAML file, as written by camera_calibration."""

    def matrix(rows: int, *values: float) -> dict[str, Any]:
        return {"rows": rows, "cols": len(values) // rows, "data": list(values)}

    m = camera.matrix
    return _yaml_of(
        {
            "image_width": camera.width,
            "image_height": camera.height,
            "camera_name": "camera",
            "camera_matrix": matrix(3, *m),
            "distortion_model": ROS_NAMES[camera.model],
            "distortion_coefficients": matrix(1, *camera.distortion),
            "rectification_matrix": matrix(3, *np.eye(3).ravel().tolist()),
            "projection_matrix": matrix(3, *m[:3], 0.0, *m[3:6], 0.0, *m[6:], 0.0),
        }
    )


def parse_kalibr(text: str, name: str = "<text>", camera_name: str = "") -> ForeignCamera:
    """A camera of the text of a camchain; `camera_name` selects it, such as ``cam0``."""
    cameras = kalibr_cameras(parse_yaml(text, name))
    camera_name = name_of_one(list(cameras), camera_name, name, "camera (cam0 with intrinsics)")
    entry: dict[str, Any] = cameras[camera_name]
    where = f"{name}: {one_line(camera_name, _LONGEST_LIST)}"
    if entry.get("camera_model", "pinhole") != "pinhole":
        raise ConversionError(
            f"{where}: camera_model {excerpt(entry['camera_model'])}: expected pinhole"
        )
    model = entry.get("distortion_model", "none")
    label = model if isinstance(model, str) else excerpt(model)
    coefficients = entry.get("distortion_coeffs", entry.get("distortion_coefficients", []))
    d = numbers(coefficients, "distortion_coeffs", where)
    if label == "none" and not any(d):
        label, d = "radtan", [0.0] * _KALIBR_COEFFICIENTS
    if label not in _KALIBR_MODELS:
        known = f"{', '.join(_KALIBR_MODELS)}, or none without distortion_coeffs"
        raise ConversionError(f"{where}: distortion_model {label[:40]!r}: expected {known}")
    intrinsics = numbers(first_of(entry, ("intrinsics",), where), "intrinsics", where)
    resolution = first_of(entry, ("resolution",), where)
    if len(intrinsics) != 4 or len(d) != _KALIBR_COEFFICIENTS:
        raise ConversionError(
            f"{where}: {len(intrinsics)} intrinsics and {len(d)} distortion_coeffs: "
            "expected 4 and 4"
        )
    if not isinstance(resolution, list) or len(resolution) != 2:
        raise ConversionError(f"{where}: resolution is not a pair: expected [width, height]")
    width, height = (whole(side, "resolution", where) for side in resolution)
    fx, fy, cx, cy = intrinsics
    return foreign(where, _KALIBR_MODELS[label], width, height, (fx, fy, cx, cy), d)


def kalibr_cameras(content: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The cameras of a camchain by name; the sensor.yaml of EuRoC's data set is one, cam0."""
    if "intrinsics" in content:
        return {"cam0": content}
    cameras = {key: value for key, value in content.items() if isinstance(value, dict)}
    return {key: value for key, value in cameras.items() if "intrinsics" in value}


def format_kalibr(camera: ForeignCamera) -> str:
    """The text of a camchain of one camera, ``cam0``."""
    if camera.model == "rational" or any(camera.distortion[_KALIBR_COEFFICIENTS:]):
        raise ConversionError("Kalibr has no rational model and no k3: expected radtan or fisheye")
    return _yaml_of(
        {
            "cam0": {
                "camera_model": "pinhole",
                "intrinsics": list(camera.pinhole),
                "distortion_model": "equi" if camera.model == "fisheye" else "radtan",
                "distortion_coeffs": list(camera.distortion[:_KALIBR_COEFFICIENTS]),
                "resolution": [camera.width, camera.height],
            }
        }
    )
