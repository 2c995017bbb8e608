"""The camera model and its calibration files.

>>> from camera import read_camera
>>> camera = read_camera("images/e/e.cam")          # doctest: +SKIP
>>> camera.floor_from_pixel([384, 200])             # doctest: +SKIP
"""

from camera.camfile import camera_file_in as camera_file_in
from camera.camfile import camera_in as camera_in
from camera.camfile import format_camera as format_camera
from camera.camfile import parse_camera as parse_camera
from camera.camfile import read_camera as read_camera
from camera.camfile import write_camera as write_camera
from camera.errors import CameraError as CameraError
from camera.model import Camera as Camera
