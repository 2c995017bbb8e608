"""OpenCV's YAML of a calibration, as its FileStorage and its calibration sample write it.

A fisheye camera has ``fisheye_model: 1``, as in the sample. The size of the image is given by
``image_width`` and ``image_height``.
"""

from __future__ import annotations

from collections.abc import Sequence

from camera.errors import ConversionError
from camera.formats.models import COEFFICIENTS, ForeignCamera, Model
from camera.formats.plain_yaml import first_of, numbers, parse_yaml, pinhole_matrix, shortest, whole
from redetect.storage.messages import excerpt

_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K")
_DISTORTION = (
    "distortion_coefficients",
    "dist_coeffs",
    "distCoeffs",
    "Distortion_Coefficients",
    "D",
)
_TILT = 12
_FISHEYE = ("1", "true", "fisheye", "equidistant")


def parse_opencv(text: str, name: str = "<text>") -> ForeignCamera:
    """A camera of the text of an OpenCV YAML file."""
    content = parse_yaml(text, name)
    sides = []
    for key, other in (("image_width", "image_Width"), ("image_height", "image_Height")):
        if key not in content and other not in content:
            # OpenCV itself does not require the size; its stereo sample writes none.
            raise ConversionError(
                f"{name}: lacks {key}: add the images' size, a line such as '{key}: 640'"
            )
        sides.append(whole(first_of(content, (key, other), name), key, name))
    width, height = sides
    fx, fy, cx, cy = pinhole_matrix(first_of(content, _MATRIX, name), "camera_matrix", name)
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
    if any(coefficients[_TILT:]):
        raise ConversionError(
            f"{name}: a tilted sensor (tau {excerpt(coefficients[_TILT:])}) can't be converted"
        )
    return "radtan" if count <= 5 else "rational"


def foreign(
    name: str,
    model: Model,
    width: int,
    height: int,
    pinhole: tuple[float, float, float, float],
    coefficients: list[float],
) -> ForeignCamera:
    """Make a camera; coefficients of the model that the file does not give are 0."""
    count = COEFFICIENTS[model]
    padded = (*coefficients, *(0.0,) * count)[:count]
    try:
        return ForeignCamera(model, width, height, *pinhole, padded)
    except ConversionError as error:
        raise ConversionError(f"{name}: {error}") from None


def format_opencv(camera: ForeignCamera) -> str:
    """The text of an OpenCV YAML file; OpenCV's FileStorage reads it."""
    d = camera.printed_distortion
    lines = ["%YAML:1.0", "---", f"image_width: {camera.width}", f"image_height: {camera.height}"]
    lines += _matrix("camera_matrix", 3, 3, camera.matrix)
    lines += _matrix("distortion_coefficients", len(d), 1, d)
    lines.append(f"fisheye_model: {int(camera.model == 'fisheye')}")
    return "\n".join([*lines, ""])


def _matrix(key: str, rows: int, columns: int, values: Sequence[float]) -> list[str]:
    data = ", ".join(shortest(value) for value in values)
    return [
        f"{key}: !!opencv-matrix",
        f"   rows: {rows}",
        f"   cols: {columns}",
        "   dt: d",
        f"   data: [ {data} ]",
    ]
