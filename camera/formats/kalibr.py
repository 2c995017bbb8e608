"""Kalibr's camchain YAML: pinhole cameras with radtan or equidistant distortion."""

from __future__ import annotations

import re
from typing import Any

from camera.errors import ConversionError
from camera.formats.models import ForeignCamera, Model
from camera.formats.opencv import foreign
from camera.formats.plain_yaml import first_of, numbers, parse_yaml, shortest, whole
from redetect.storage.messages import excerpt, one_line

_MODELS: dict[str, Model] = {"radtan": "radtan", "equi": "fisheye", "equidistant": "fisheye"}
_COEFFICIENTS = 4
_LONGEST_LIST = 100
_NAME = re.compile(r"cam\d+", re.ASCII)


def parse_kalibr(text: str, name: str = "<text>", camera_name: str = "") -> ForeignCamera:
    """A camera of the text of a camchain; `camera_name` says which, such as ``cam0``."""
    content = parse_yaml(text, name)
    cameras = {key: value for key, value in content.items() if isinstance(value, dict)}
    cameras = {key: value for key, value in cameras.items() if "intrinsics" in value}
    held = one_line(", ".join(cameras), _LONGEST_LIST)
    if camera_name:
        if camera_name not in cameras:
            raise ConversionError(f"{name}: no {camera_name}: it holds {held}")
    elif len(cameras) != 1:
        there = f"it holds {held}: give --camera-name" if cameras else "it holds none"
        raise ConversionError(f"{name}: expected one camera (cam0 with intrinsics), {there}")
    else:
        camera_name = next(iter(cameras))
    entry: dict[str, Any] = cameras[camera_name]
    where = f"{name}: {one_line(camera_name, _LONGEST_LIST)}"
    if entry.get("camera_model", "pinhole") != "pinhole":
        raise ConversionError(
            f"{where}: camera_model {excerpt(entry['camera_model'])}: expected pinhole"
        )
    model = entry.get("distortion_model", "none")
    label = model if isinstance(model, str) else excerpt(model)
    d = numbers(entry.get("distortion_coeffs", []), "distortion_coeffs", where)
    if label == "none":
        if any(d):
            raise ConversionError(
                f"{where}: distortion_coeffs without a distortion_model: expected one of "
                f"{', '.join(_MODELS)}"
            )
        label, d = "radtan", [0.0] * _COEFFICIENTS
    if label not in _MODELS:
        raise ConversionError(
            f"{where}: distortion_model {label[:40]!r}: expected {', '.join(_MODELS)} or none"
        )
    intrinsics = numbers(first_of(entry, ("intrinsics",), where), "intrinsics", where)
    resolution = first_of(entry, ("resolution",), where)
    if len(intrinsics) != 4 or len(d) != _COEFFICIENTS:
        raise ConversionError(
            f"{where}: {len(intrinsics)} intrinsics and {len(d)} distortion_coeffs: "
            "expected 4 and 4"
        )
    if not isinstance(resolution, list) or len(resolution) != 2:
        raise ConversionError(f"{where}: resolution is no pair: expected [width, height]")
    width, height = (whole(side, "resolution", where) for side in resolution)
    fx, fy, cx, cy = intrinsics
    return foreign(where, _MODELS[label], width, height, (fx, fy, cx, cy), d)


def format_kalibr(camera: ForeignCamera, camera_name: str = "cam0") -> str:
    """The text of a camchain of one camera: ``cam0``, unless `camera_name` is such a name."""
    if camera.model == "rational" or any(camera.distortion[_COEFFICIENTS:]):
        raise ConversionError("Kalibr has no rational model and no k3: expected radtan or fisheye")
    d = ", ".join(shortest(value) for value in camera.distortion[:_COEFFICIENTS])
    pinhole = ", ".join(shortest(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy))
    lines = [
        f"{camera_name if _NAME.fullmatch(camera_name) else 'cam0'}:",
        "  camera_model: pinhole",
        f"  intrinsics: [{pinhole}]",
        f"  distortion_model: {'equi' if camera.model == 'fisheye' else 'radtan'}",
        f"  distortion_coeffs: [{d}]",
        f"  resolution: [{camera.width}, {camera.height}]",
    ]
    return "\n".join([*lines, ""])
