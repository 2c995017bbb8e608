"""The camera model and its calibration files.

>>> from camera import read_camera
>>> camera = read_camera("images/e/e.cam")          # doctest: +SKIP
>>> camera.floor_from_pixel([384, 200])             # doctest: +SKIP
"""

from camera.camfile import format_camera, parse_camera, read_camera, write_camera
from camera.errors import CameraError
from camera.model import Camera

__all__ = [
    "Camera",
    "CameraError",
    "format_camera",
    "parse_camera",
    "read_camera",
    "write_camera",
]
