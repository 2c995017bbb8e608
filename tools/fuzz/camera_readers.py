"""Readers of calibrations: the data set's, other programs', and the inputs of a calibration."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from camera import CameraError, format_camera, parse_camera, read_camera
from camera.calibration.floor import read_floor_points
from camera.formats.colmap import format_colmap, parse_colmap
from camera.formats.files import format_of_text, read_text
from camera.formats.models import ForeignCamera
from camera.formats.yaml_files import (
    format_kalibr,
    format_opencv,
    format_ros,
    parse_kalibr,
    parse_opencv,
    parse_ros,
)
from tools.fuzz.reader import CAMERA_TEXT, NUMBERS, Reader


def _camera(path: Path) -> object:
    camera = read_camera(path)
    again = parse_camera(format_camera(camera))
    assert again == camera, "a camera changes when it is written and read"
    return camera


def _foreign(
    parse: Callable[[str, str], ForeignCamera], write: Callable[[ForeignCamera], str], path: Path
) -> object:
    """A camera of another program, as `camera convert` reads it; writing and reading keep it.

    Except for COLMAP's half pixel, which rounds, and models that are written as a larger one.
    """
    camera = parse(read_text(path), str(path))
    try:
        text = write(camera)
    except CameraError:  # this format can be read but not written
        return camera
    again = parse(text, str(path))
    assert (again.width, again.height) == (camera.width, camera.height), "another size"
    assert again == camera or parse is parse_colmap, "a camera changes when it is written and read"
    return camera


_DECENTRED_TEXT = CAMERA_TEXT.removesuffix(b"}\n") + b"tangential: { 0.002 -0.003 }\n}\n"
_POLYNOMIAL_TEXT = _DECENTRED_TEXT.removesuffix(b"}\n") + b"polynomial: { -0.02 0.01 0 }\n}\n"
_OPENCV = ForeignCamera("radtan", 64, 48, 50.0, 51.0, 31.5, 23.5, (-0.1, 0.01, 0.001, 0.002, 0.0))
_RATIONAL = ForeignCamera("rational", 64, 48, 50.0, 51.0, 31.5, 23.5, (0.1,) * 8)
_FISHEYE = ForeignCamera("fisheye", 64, 48, 50.0, 51.0, 31.5, 23.5, (0.1, 0.01, 0.0, 0.0))
_YAML_WORDS = (
    b"&a", b"*a", b"!!python/object/apply:os.system", b"!!opencv-matrix", b"<<: ", b"---\n",
    b"data: ", b"[", b"]", b"{", b"}", b"- ", b"? ", b": ", b"|", b"1" * 400, b"0x1f", b"1:30",
    b"2001-13-45", b"!!binary ", b"!!set ", b"!!int ''", b"!!timestamp ", b"!!bool ", b"~",
    b".nan", b".inf", b"%YAML:1.0\n", *NUMBERS,
)  # fmt: skip


def _texts(*cameras: ForeignCamera, write: Callable[[ForeignCamera], str]) -> tuple[bytes, ...]:
    return tuple(write(camera).encode() for camera in cameras)


_CAMERA = (CameraError,)
_ANY = (
    CAMERA_TEXT,
    *_texts(_OPENCV, write=format_opencv),
    *_texts(_OPENCV, write=format_ros),
    *_texts(_OPENCV, write=format_kalibr),
)

CAMERA_READERS: tuple[Reader, ...] = (
    Reader("camera", "e.cam", _camera, _CAMERA, (CAMERA_TEXT, _DECENTRED_TEXT, _POLYNOMIAL_TEXT),
           (b"sensor2World:", b"coef:", b"tangential: { 1e-3 -2e-3 }",
            b"polynomial: { -0.01 1e-3 1e-4 }", b"width:", b"{", b"}", b"[", b"]", b"key: value",
            *NUMBERS)),
    Reader("opencv", "a.opencv.yaml", partial(_foreign, parse_opencv, format_opencv), _CAMERA,
           _texts(_OPENCV, _RATIONAL, _FISHEYE, write=format_opencv),
           (b"camera_matrix: ", b"fisheye_model: ", b"image_width: ", *_YAML_WORDS), files=40),
    Reader("camera info", "a.ros.yaml", partial(_foreign, parse_ros, format_ros), _CAMERA,
           _texts(_OPENCV, _RATIONAL, _FISHEYE, write=format_ros),
           (b"distortion_model: ", b"roi: ", b"binning_x: ", b"plumb_bob", *_YAML_WORDS), files=40),
    Reader("kalibr", "camchain.yaml", partial(_foreign, parse_kalibr, format_kalibr), _CAMERA,
           _texts(_OPENCV, _FISHEYE, write=format_kalibr),
           (b"cam1:\n  ", b"intrinsics: ", b"resolution: ", b"equi", b"none", *_YAML_WORDS),
           files=40),
    Reader("colmap", "cameras.txt", partial(_foreign, parse_colmap, format_colmap), _CAMERA,
           (*_texts(_OPENCV, _RATIONAL, _FISHEYE, write=format_colmap),
            b"2 SIMPLE_RADIAL 640 480 500 320 240 0.1\n"),
           (b"PINHOLE", b"SIMPLE_PINHOLE", b"RADIAL_FISHEYE", b"FULL_OPENCV", *NUMBERS)),
    Reader("any calibration", "calibration.yaml", lambda p: format_of_text(p, read_text(p)),
           _CAMERA, _ANY, _YAML_WORDS, files=40),
    Reader("floor points", "floor.csv", read_floor_points, _CAMERA,
           (b"u,v,x,y\n10,20.5,1,-2\n\n11,20.5,1.5,-2\n",), (b'"', b"u,v,x,y", *NUMBERS)),
)  # fmt: skip
