"""COLMAP's cameras.txt, and ``pycolmap.Camera``.

COLMAP counts pixels from the image's corner: the top left pixel's centre is (0.5, 0.5). So the
principal point is shifted by half a pixel in either direction. For programs that use pycolmap,
`camera_from_pycolmap` and `pycolmap_from_camera` need no file.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from camera.errors import ConversionError
from camera.formats.models import ForeignCamera, Model
from camera.formats.yaml_files import foreign, name_of_one
from redetect.bounds import number_in, whole_number_in
from redetect.messages import excerpt, one_line

if TYPE_CHECKING:
    import pycolmap

_HALF_PIXEL = 0.5
_LONGEST_LIST = 100

#: COLMAP's models with the corresponding ones here, and their numbers of focal lengths and of
#: coefficients. Between these is the principal point; coefficients are the first ones of ours.
MODELS: dict[str, tuple[Model, int, int]] = {
    "SIMPLE_PINHOLE": ("radtan", 1, 0),
    "PINHOLE": ("radtan", 2, 0),
    "SIMPLE_RADIAL": ("radtan", 1, 1),
    "RADIAL": ("radtan", 1, 2),
    "OPENCV": ("radtan", 2, 4),
    "FULL_OPENCV": ("rational", 2, 8),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 1, 1),
    "RADIAL_FISHEYE": ("fisheye", 1, 2),
    "OPENCV_FISHEYE": ("fisheye", 2, 4),
}
_WRITTEN: dict[Model, str] = {
    "radtan": "OPENCV",
    "rational": "FULL_OPENCV",
    "fisheye": "OPENCV_FISHEYE",
}


def parse_colmap(text: str, name: str = "<text>", camera_name: str = "") -> ForeignCamera:
    """A camera of the text of a cameras.txt; `camera_name` is its number."""
    rows: dict[str, tuple[int, list[str]]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split()
        if fields and not line.lstrip().startswith("#"):
            if len(fields) < 5:
                raise ConversionError(
                    f"{name}:{number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."
                )
            if fields[0] in rows:
                raise ConversionError(
                    f"{name}:{number}: camera {one_line(fields[0], _LONGEST_LIST)} a second time, "
                    f"after line {rows[fields[0]][0]}: expected different numbers"
                )
            rows[fields[0]] = (number, fields)
    number, fields = rows[name_of_one(list(rows), camera_name, name)]
    where = f"{name}:{number}"
    try:
        width, height = map(whole_number_in, fields[2:4])
        parameters = [number_in(field) for field in fields[4:]]
    except ValueError:
        raise ConversionError(f"{where}: a size or parameter is not a number") from None
    return _from_parameters(where, fields[1], width, height, parameters)


def camera_from_pycolmap(camera: pycolmap.Camera) -> ForeignCamera:
    """A camera of a ``pycolmap.Camera``."""
    parameters = [float(value) for value in camera.params]
    model = camera.model.name
    return _from_parameters("pycolmap.Camera", model, camera.width, camera.height, parameters)


def _from_parameters(
    where: str, model_name: str, width: int, height: int, parameters: list[float]
) -> ForeignCamera:
    if model_name not in MODELS:
        raise ConversionError(f"{where}: model {excerpt(model_name)}: expected {', '.join(MODELS)}")
    model, focals, coefficient_count = MODELS[model_name]
    count = focals + 2 + coefficient_count
    if len(parameters) != count:
        raise ConversionError(
            f"{where}: {len(parameters)} parameters of {model_name}: expected {count}"
        )
    fx, fy = parameters[0], parameters[focals - 1]
    cx, cy = (value - _HALF_PIXEL for value in parameters[focals : focals + 2])
    return foreign(where, model, width, height, (fx, fy, cx, cy), parameters[focals + 2 :])


def colmap_parameters(camera: ForeignCamera) -> tuple[str, list[float]]:
    """COLMAP's name of the model, and its parameters."""
    model, d = camera.model, camera.distortion
    if model == "radtan" and d[4] != 0.0:
        model, d = "rational", (*d, *(0.0,) * 3)
    name = _WRITTEN[model]
    pinhole = [camera.fx, camera.fy, camera.cx + _HALF_PIXEL, camera.cy + _HALF_PIXEL]
    return name, [*pinhole, *d[: MODELS[name][2]]]


def format_colmap(camera: ForeignCamera) -> str:
    """The text of a cameras.txt of one camera, number 1."""
    name, parameters = colmap_parameters(camera)
    values = " ".join(map(repr, parameters))
    return (
        "# Camera list with one line of data per camera:\n"
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        "# Number of cameras: 1\n"
        f"1 {name} {camera.width} {camera.height} {values}\n"
    )


def pycolmap_from_camera(camera: ForeignCamera) -> pycolmap.Camera:
    """A ``pycolmap.Camera`` of a camera."""
    import pycolmap

    name, parameters = colmap_parameters(camera)
    return pycolmap.Camera(model=name, width=camera.width, height=camera.height, params=parameters)
