"""Reads and writes settings of detectors, to repeat a run or to change it.

The JSON file beside every result (`detected.log.json`) contains its settings under ``settings``,
one object for each kind: ``circles``, ``lines``, ``markers``. Settings files have the same form
without other content; missing kinds and settings have their defaults.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from detect.errors import DetectError
from detect.line_settings import LineSettings
from detect.settings import CircleSettings, MarkerSettings
from redetect.bounds import expectation, number_in, whole_number_in
from redetect.json_text import json_text
from redetect.messages import excerpt
from redetect.storage.bounded import read_text

_LONGEST_BYTES = 1 << 24
Settings = TypeVar("Settings", CircleSettings, LineSettings, MarkerSettings)


@dataclass(frozen=True)
class SettingsFile:
    """Settings of all detectors."""

    circles: CircleSettings = field(default_factory=CircleSettings)
    lines: LineSettings = field(default_factory=LineSettings)
    markers: MarkerSettings = field(default_factory=MarkerSettings)


def read_settings(path: Path) -> SettingsFile:
    """Read settings from a JSON file: a log of detections, or the output of `settings_text`.

    Raises
    ------
    DetectError
        If it cannot be read, has no settings, or an unknown or invalid one.
    """
    text = read_text(path, _LONGEST_BYTES, "settings file", DetectError)
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):  # the latter if it is nested very deeply
        raise DetectError(f"{path}: not JSON: expected settings, as in a .log.json") from None
    given = document.get("settings") if isinstance(document, dict) else None
    if not isinstance(given, dict):
        raise DetectError(f'{path}: no "settings": expected those of circles, lines or markers')
    kinds = get_type_hints(SettingsFile)
    for unknown in sorted(given.keys() - kinds.keys())[:1]:
        expected = f"those of {', '.join(kinds)}"
        raise DetectError(f"{path}: settings of {excerpt(unknown)}: expected {expected}")
    try:
        return SettingsFile(**{n: checked_settings(n, v, kinds[n]) for n, v in given.items()})
    except DetectError as error:
        raise DetectError(f"{path}: {error}") from None


def checked_settings(name: str, values: Any, kind: type[Settings]) -> Settings:
    """Settings from JSON values; a DetectError if one is unknown or invalid."""
    if not isinstance(values, Mapping):
        raise DetectError(f"settings of {name}: expected names and values")
    return kind(**{key: setting_value(kind, key, value) for key, value in values.items()})


def setting_value(kind: type, name: str, value: Any) -> Any:
    """Convert a JSON value to that of a setting, a field of a dataclass.

    Raises DetectError if there is no such field, or the value has another type.
    """
    hints = _types(kind)
    if name not in hints:
        raise DetectError(
            f"{name} is not a parameter of {kind.__name__}: expected {', '.join(sorted(hints))}"
        )
    try:
        return _of_type(hints[name], value)
    except (TypeError, OverflowError):
        expected = expectation(hints[name])
        raise DetectError(f"{name} is {excerpt(value)}: expected {expected}") from None


@cache
def _types(kind: type) -> dict[str, Any]:
    """Types of the fields of a dataclass by their names."""
    hints = get_type_hints(kind)
    return {each.name: hints[each.name] for each in fields(kind)}


def _of_type(hint: Any, value: Any) -> Any:
    """Convert a JSON value to a type; a TypeError if it has another one."""
    if get_origin(hint) is tuple and isinstance(value, list):
        inner = get_args(hint)
        each = [inner[0]] * len(value) if inner[-1] is Ellipsis else inner
        if len(each) == len(value):
            return tuple(_of_type(kind, one) for kind, one in zip(each, value))
    if get_origin(hint) is Union:
        for kind in get_args(hint):
            with suppress(TypeError):
                return _of_type(kind, value)
    if hint is float and type(value) in (int, float):
        return float(value)
    if type(value) is hint or (get_origin(hint) is Literal and value in get_args(hint)):
        return value
    raise TypeError


def word_value(kind: type, name: str, word: str) -> Any:
    """Convert a word of a command line or of a file's head to the value of a setting.

    Raises DetectError if that fails, or there is no such setting.
    """
    value: Any = {"true": True, "false": False, "none": None}.get(word.lower(), word)
    for read in (number_in, whole_number_in):  # a float setting accepts whole numbers
        with suppress(ValueError):
            value = read(word)
    return setting_value(kind, name, value)


def settings_text(**settings: CircleSettings | LineSettings | MarkerSettings) -> str:
    """Content of a settings file, by kind: circles, lines, markers."""
    return f"{json_text({'settings': settings}, limits=True)}\n"
