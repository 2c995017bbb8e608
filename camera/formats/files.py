"""Calibrations in other programs' files: which format they are in, and conversion to another."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from camera.camfile import LARGEST_FILE_BYTES, format_camera, parse_camera, read_camera
from camera.errors import ConversionError
from camera.formats import conversion, yaml_files
from camera.formats.colmap import format_colmap, parse_colmap
from camera.formats.conversion import AnyCamera, Converted
from camera.formats.models import ForeignCamera, Model
from camera.options import Convert, Format
from redetect.storage import bounded


class FileFormat(NamedTuple):
    """The text of a format, and what it can hold."""

    parse: Callable[..., AnyCamera]
    format: Callable[[Any], str]
    #: Models, the simplest first, and their numbers of coefficients: some lack k3
    coefficients: dict[Model, int]
    several: bool = False  #: Whether a file may have several cameras


_WITH_K3: dict[Model, int] = {"radtan": 5, "rational": 8, "fisheye": 4}
_WITHOUT_K3: dict[Model, int] = {"radtan": 4, "fisheye": 4}
FORMATS: dict[Format, FileFormat] = {
    "cam": FileFormat(parse_camera, format_camera, {}),
    "opencv": FileFormat(yaml_files.parse_opencv, yaml_files.format_opencv, _WITH_K3),
    "ros": FileFormat(yaml_files.parse_ros, yaml_files.format_ros, _WITH_K3),
    "kalibr": FileFormat(yaml_files.parse_kalibr, yaml_files.format_kalibr, _WITHOUT_K3, True),
    "colmap": FileFormat(parse_colmap, format_colmap, {**_WITH_K3, "radtan": 4}, True),
}
# Formats by parts of a YAML file's name.
_YAML_NAMES: dict[str, Format] = {
    "opencv": "opencv",
    ".ros.": "ros",
    "camera_info": "ros",
    "kalibr": "kalibr",
    "camchain": "kalibr",
}


def read_text(path: Path) -> str:
    """The text of a calibration file."""
    return bounded.read_text(path, LARGEST_FILE_BYTES, "calibration file", ConversionError)


def format_of_name(path: Path) -> Format:
    """The format that a file's name implies."""
    name = path.name.lower()
    if name.endswith(".cam"):
        return "cam"
    if name.endswith(".txt") and "cameras" in name:
        return "colmap"
    if name.endswith((".yaml", ".yml")):
        for part, found in _YAML_NAMES.items():
            if part in name:
                return found
    raise ConversionError(
        f"{path}: the name does not say which format: end it in .cam, .opencv.yaml, .ros.yaml, "
        ".kalibr.yaml or cameras.txt"
    )


def format_of_text(path: Path, text: str) -> Format:
    """The format of a file, by its content."""
    if text.lstrip().startswith("{ SmRadial") or path.suffix.lower() == ".cam":
        return "cam"
    if path.suffix.lower() == ".txt":
        return "colmap"
    if "!!opencv-matrix" in text or text.lstrip().startswith("<"):
        return "opencv"
    content, opencv = yaml_files.parse_yaml(text, str(path)), text.startswith("%YAML:")
    if yaml_files.kalibr_cameras(content):
        return "kalibr"
    if "distortion_model" in content and not opencv:
        return "ros"
    if opencv or "fisheye_model" in content or "image_width" in content:
        return "opencv"
    raise ConversionError(
        f"{path}: neither a .cam file nor a camera in OpenCV's, ROS's, Kalibr's or COLMAP's format "
        "that is recognised (they have image_width, distortion_model, cam0 with intrinsics, or are "
        "a cameras.txt)"
    )


def parse(text: str, from_format: Format, name: str, camera_name: str = "") -> AnyCamera:
    """A camera of the text of a file."""
    if camera_name and not FORMATS[from_format].several:
        raise ConversionError(f"{name}: has one camera: expected no --camera-name")
    return FORMATS[from_format].parse(text, name, *([camera_name] if camera_name else []))


def convert(source: AnyCamera, to_format: Format, options: Convert) -> Converted:
    """Convert to a model of a format that represents the camera exactly, if there is one.

    Otherwise to the first one within the limit, or the closest one.
    """
    if to_format == "cam":
        if options.model != "auto":
            raise ConversionError(".cam files have a model of their own: expected no --model")
        pose = read_camera(options.pose_from) if options.pose_from is not None else None
        return conversion.convert_to_camera(source, options.rows, pose)
    if options.pose_from is not None:
        raise ConversionError(f"{to_format} has no pose: expected no --pose-from")
    models = FORMATS[to_format].coefficients
    if options.model != "auto":
        if options.model not in models:
            raise ConversionError(
                f"{to_format} has no {options.model} model: expected {' or '.join(models)}"
            )
        models = {options.model: models[options.model]}
    own = source.model if isinstance(source, ForeignCamera) else None
    found: list[Converted] = []
    exact = [model for model in models if conversion.contained(source, model, models[model])]
    for model in sorted(models, key=lambda each: (each not in exact, each != own)):
        found.append(conversion.convert_to_foreign(source, model, options.rows, free=models[model]))
        if found[-1].deviation_px <= options.limit_px:
            break
    return conversion.nearer(*found)
