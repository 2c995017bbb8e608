"""YAML of calibrations, read safely: plain values only, bounded, without aliases.

OpenCV's own dialect begins with ``%YAML:1.0`` and tags its matrices; both are understood.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml  # type: ignore[import-untyped, unused-ignore]

from camera.errors import ConversionError
from redetect.storage.bounded import read_bounded
from redetect.storage.messages import excerpt, one_line

_LARGEST_FILE_BYTES = 1 << 20
_MOST_CAMERAS = 1000


def read_content(path: Path) -> bytes:
    """The content of a calibration file."""
    try:
        return read_bounded(path, _LARGEST_FILE_BYTES)
    except FileNotFoundError:
        raise ConversionError(f"{path}: no such calibration file") from None
    except OSError as error:
        raise ConversionError(
            f"{path}: cannot be read as a calibration: {error.strerror}"
        ) from None


def text_of(content: bytes, name: str) -> str:
    """The content of a calibration file as text."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ConversionError(f"{name}: is no text: expected a calibration") from None


def parse_yaml(text: str, name: str) -> dict[str, Any]:
    """The first document of a YAML text, which must be a mapping."""

    class Loader(yaml.SafeLoader):  # type: ignore[misc, unused-ignore]
        def compose_node(self, parent: Any, index: Any) -> Any:
            # Aliases of aliases grow without end, and no calibration has any.
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
        problem = getattr(error, "problem", None) or "no YAML"
        raise ConversionError(f"{name}{where}: {problem}: expected YAML") from None
    except (ValueError, RecursionError) as error:
        if isinstance(error, ConversionError):
            raise
        raise ConversionError(
            f"{name}: not YAML that can be read: {one_line(str(error), 100)}"
        ) from None
    if not isinstance(content, dict):
        raise ConversionError(f"{name}: expected YAML with keys and values")
    # Keys of calibrations are words, or cameras' numbers; others may be too long to be written.
    return {
        str(key): value
        for key, value in content.items()
        if isinstance(key, str) or (isinstance(key, int) and abs(key) < _MOST_CAMERAS)
    }


def numbers(value: Any, key: str, name: str) -> list[float]:
    """The numbers of a list, of nested lists, or of a mapping with `data`, flat."""
    if isinstance(value, dict):
        value = value.get("data")
    flat: list[Any] = []
    pending = [value]
    while pending:
        item = pending.pop()
        if isinstance(item, list):
            pending += reversed(item)
        else:
            flat.append(item)
    result = []
    for item in flat:
        # YAML 1.1 takes 1e-3 for text, because it lacks the dot.
        try:
            number = float(item) if not isinstance(item, bool) else float("nan")
        except (OverflowError, TypeError, ValueError):
            number = float("nan")
        if not np.isfinite(number):
            raise ConversionError(f"{name}: {key} has {excerpt(item)}: expected numbers")
        result.append(number)
    return result


def first_of(content: dict[str, Any], keys: tuple[str, ...], name: str) -> Any:
    """The value of the first key that is there."""
    for key in keys:
        if key in content:
            return content[key]
    raise ConversionError(f"{name}: lacks {' or '.join(keys)}")


def whole(value: Any, key: str, name: str) -> int:
    """A whole number."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise ConversionError(f"{name}: {key} is {excerpt(value)}: expected a whole number")
    return value


def pinhole_matrix(value: Any, key: str, name: str) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a 3 x 3 camera matrix without skew."""
    m = numbers(value, key, name)
    if len(m) != 9 or m[3:4] + m[6:] != [0.0, 0.0, 0.0, 1.0]:
        raise ConversionError(
            f"{name}: {key} is {excerpt(m)}: expected the 9 numbers fx 0 cx 0 fy cy 0 0 1"
        )
    if m[1] != 0.0:
        raise ConversionError(f"{name}: {key} has a skew of {m[1]:g}: only 0 can be converted")
    return m[0], m[4], m[2], m[5]


def shortest(value: float) -> str:
    """The shortest text that reads back as the same float, with the dot that YAML 1.1 wants."""
    text = repr(float(value) + 0.0)
    if "e" in text and "." not in text:
        return text.replace("e", ".0e")
    return text
