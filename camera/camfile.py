"""Reading and writing ``.cam`` files (``SmRadialDistortedCamera``).

The grammar is the data set's, read tolerantly: any white space, commas or none, keys in any order,
``#`` comments. Unknown keys are kept and written back. Three keys are specific to this project:
``tangential: { p1 p2 }`` and ``polynomial: { k1 k2 k3 }``, written only for a lens with such terms,
and ``covariance: { ... }``, the lower triangle of the parameters' one (`camera.uncertainty`).
"""

from __future__ import annotations

import math
import os
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from camera.errors import CameraError
from camera.model import PARAMETERS, Camera, Pose
from redetect.bounds import NUMBER
from redetect.messages import excerpt
from redetect.storage import write_bytes
from redetect.storage.bounded import read_text

CLASS_NAME = "SmRadialDistortedCamera"
#: More than any calibration has.
LARGEST_FILE_BYTES = 1 << 20

_TOKEN = re.compile(r"[{}\[\]:]|[^\s,{}\[\]:#]+")
_LINE_END = re.compile(r"\r\n|\r|\n")

_LENS = {"scale_x": "scaleX", "scale_y": "scaleY", "offset_x": "offsetX", "offset_y": "offsetY"}

# A key's value: its tokens, each with its line.
_Entries = dict[str, list[tuple[str, int]]]


def read_camera(path: str | os.PathLike[str]) -> Camera:
    """Read a ``.cam`` file.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    Camera
        The calibrated camera.

    Raises
    ------
    CameraError
        If the file cannot be read or does not describe a possible camera; the message names the
        file and, if a single line is wrong, the line.
    """
    text = read_text(path, LARGEST_FILE_BYTES, "calibration file", CameraError)
    return parse_camera(text, name=os.fspath(path))


def camera_file_in(folder: Path, stem: str = "", how: str = "by --camera") -> Path | None:
    """The ``.cam`` file of a stem in a folder, or the only one there; None if there is none.

    The stem is by default the folder's own name. Raises CameraError if there are several others,
    and says how to name one.
    """
    own = folder / f"{stem or folder.resolve().name}.cam"
    # Hidden files are skipped: some systems keep metadata in ones named ._ and the file.
    found = [own] if own.is_file() else sorted(folder.glob("[!.]*.cam"))
    if len(found) > 1:
        names = ", ".join(path.name for path in found[:4])
        raise CameraError(f"{folder}: several calibrations ({names}): name one {how}")
    return found[0] if found else None


def camera_in(folder: Path, stem: str = "") -> Camera | None:
    """The calibration in a folder, as `camera_file_in` finds it; None if there is none."""
    path = camera_file_in(folder, stem)
    return None if path is None else read_camera(path)


def parse_camera(text: str, name: str = "<text>") -> Camera:
    """Parse the text of a ``.cam`` file; `name` is the file's name in errors."""
    entries = _split(text, name)

    def numbers(key: str, count: int) -> list[float]:
        if key not in entries:
            raise CameraError(f"{name}: lacks {key}")
        return _numbers(entries.pop(key), key, count, name)

    def whole(key: str) -> int:
        line = entries[key][0][1] if entries.get(key) else 0
        value = numbers(key, 1)[0]
        if value != int(value):
            raise CameraError(f"{name}:{line}: {key} is {value}: expected a whole number")
        return int(value)

    fields: dict[str, Any] = {
        "robot_from_camera": np.reshape(numbers("sensor2World", 12), (3, 4)),
        **{key: whole(key) for key in ("width", "height")},
        **{name: numbers(key, 1)[0] for name, key in _LENS.items()},
        "coef": numbers("coef", 5),
    }
    if "sensor2Tcp" in entries:
        fields["sensor_to_tcp"] = np.reshape(numbers("sensor2Tcp", 12), (3, 4))
    if "mountIndex" in entries:
        fields["mount_index"] = whole("mountIndex")
    triangle = PARAMETERS * (PARAMETERS + 1) // 2
    for key, count in (("tangential", 2), ("polynomial", 3), ("covariance", triangle)):
        if key in entries:
            fields[key] = numbers(key, count)
    unknown = [(key, " ".join(token for token, _ in value)) for key, value in entries.items()]
    try:
        return Camera(**fields, unknown=tuple(unknown))
    except CameraError as error:
        raise CameraError(f"{name}: {error}") from None


def format_camera(camera: Camera) -> str:
    """The text of a ``.cam`` file in the data set's layout; `parse_camera` gives it back."""
    lines = [f"{{ {CLASS_NAME}"]
    if camera.sensor_to_tcp is not None:
        lines += _pose_lines("sensor2Tcp", camera.sensor_to_tcp)
    lines += _pose_lines("sensor2World", camera.robot_from_camera)
    lines.append(f"mountIndex: {camera.mount_index}")
    pinhole = " ".join(f"{key}: {_shortest(x)}" for key, x in zip(_LENS.values(), camera.pinhole))
    lines.append(f"width: {camera.width} height: {camera.height} {pinhole}")
    for key in ("coef", "tangential", "polynomial"):
        terms = getattr(camera, key)
        if key == "coef" or any(terms):
            lines.append(f"{key}: {{ {' '.join(map(_shortest, terms))} }}")
    if camera.covariance is not None:
        ends = [row * (row + 1) // 2 for row in range(PARAMETERS + 1)]
        rows = [camera.covariance[first:last] for first, last in pairwise(ends)]
        lines += ["covariance: {", *(" ".join(map(_shortest, row)) for row in rows), "}"]
    lines += [f"{key}: {text}" for key, text in camera.unknown]
    return "\n".join([*lines, "}", ""])


def write_camera(camera: Camera, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write a ``.cam`` file, whole or not at all; an existing one only with `overwrite`."""
    write_bytes(path, format_camera(camera).encode(), overwrite=overwrite)


def _split(text: str, name: str) -> _Entries:
    """Split the text into keys and the tokens of their values, checking braces and brackets."""
    tokens = [
        (match.group(), number)
        for number, line in enumerate(_LINE_END.split(text), start=1)
        for match in _TOKEN.finditer(line.partition("#")[0])
    ]
    words = [token for token, _ in tokens]
    if words[:2] != ["{", CLASS_NAME]:
        found = excerpt(" ".join(words[:2])) if words else "nothing"
        raise CameraError(f"{name}: begins with {found}: expected {{ {CLASS_NAME}")
    entries: _Entries = {}
    closing = {"{": "}", "[": "]"}
    open_until: list[str] = []
    key = ""
    position = 2
    while position < len(tokens):
        token, line = tokens[position]
        is_key = not open_until and position + 1 < len(tokens) and words[position + 1] == ":"
        if is_key and token not in "{}[]:":
            if token in entries:
                raise CameraError(f"{name}:{line}: {excerpt(token)} is given twice")
            key = token
            entries[key] = []
            position += 2
            continue
        if token == "}" and not open_until:
            if position + 1 != len(tokens):
                raise CameraError(f"{name}:{tokens[position + 1][1]}: text after the closing brace")
            return entries
        if (token == ":" and not open_until) or not key:
            raise CameraError(f"{name}:{line}: unexpected {excerpt(token)}: expected 'key: value'")
        if token in closing:
            open_until.append(closing[token])
        elif token in closing.values() and (not open_until or open_until.pop() != token):
            raise CameraError(f"{name}:{line}: unexpected {token}")
        entries[key].append((token, line))
        position += 1
    raise CameraError(f"{name}: ends before its closing brace")


def _numbers(value: list[tuple[str, int]], key: str, count: int, name: str) -> list[float]:
    numbers: list[float] = []
    for token, line in value:
        if token in "{}[]":
            continue
        if not re.fullmatch(NUMBER, token) or math.isinf(float(token)):
            expected = "expected a number that fits a double"
            raise CameraError(f"{name}:{line}: {key} has {excerpt(token)}: {expected}")
        numbers.append(float(token))
    if len(numbers) != count:
        where = f":{value[0][1]}" if value else ""
        raise CameraError(f"{name}{where}: {key} has {len(numbers)} numbers: expected {count}")
    return numbers


def _pose_lines(key: str, pose: Pose) -> list[str]:
    rows = [f"[ {', '.join(_shortest(x) for x in row)} ]" for row in pose]
    return [f"{key}: {rows[0]}", *rows[1:]]


def _shortest(number: float) -> str:
    """The shortest text that reads back as the same float."""
    return repr(float(number)).removesuffix(".0")
