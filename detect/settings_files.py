"""Settings of detectors in files: what ran, to be run again or to be changed.

The JSON file beside every result (`detected.log.json`) has the settings that it was detected with
under ``settings``, one object for each kind: ``circles``, ``lines``, ``markers``. Files of settings
are the same with nothing else in them; a kind that they lack, or a setting, is as it is by default.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from detect.errors import DetectError
from detect.line_settings import LineSettings
from detect.settings import CircleSettings, MarkerSettings

_LONGEST_BYTES = 1 << 24
Kind = TypeVar("Kind", CircleSettings, LineSettings, MarkerSettings)


@dataclass(frozen=True)
class SettingsFile:
    """Settings of all detectors."""

    circles: CircleSettings = field(default_factory=CircleSettings)
    lines: LineSettings = field(default_factory=LineSettings)
    markers: MarkerSettings = field(default_factory=MarkerSettings)


def read_settings(path: Path) -> SettingsFile:
    """Read settings from a JSON file, a log of detections or what `settings_text` gives.

    Raises
    ------
    DetectError
        If it cannot be read, has no settings, or one that there is not or cannot be.
    """
    try:
        with path.open("rb") as stream:
            document = json.loads(stream.read(_LONGEST_BYTES))
    except OSError as error:
        raise DetectError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError:
        raise DetectError(f"{path}: no JSON: expected settings, as in a .log.json") from None
    given = document.get("settings") if isinstance(document, dict) else None
    if not isinstance(given, dict):
        raise DetectError(f'{path}: no "settings": expected those of circles, lines or markers')
    try:
        return SettingsFile(
            checked_settings("circles", given.get("circles", {}), CircleSettings),
            checked_settings("lines", given.get("lines", {}), LineSettings),
            checked_settings("markers", given.get("markers", {}), MarkerSettings),
        )
    except DetectError as error:
        raise DetectError(f"{path}: {error}") from None


def checked_settings(name: str, values: Any, kind: type[Kind]) -> Kind:
    """Settings from values of JSON; a DetectError if one is unknown, or cannot be."""
    if not isinstance(values, Mapping):
        raise DetectError(f"settings of {name}: expected names and values")
    for unknown in sorted(values.keys() - {each.name for each in fields(kind)}):
        raise DetectError(f"{name} have no setting {unknown!r}")
    default = kind()
    for key, value in values.items():
        if not _is_like(value, getattr(default, key)):
            raise DetectError(f"{key} of {name} is {value!r}: expected another type")
    return kind(**{key: _tuples(value) for key, value in values.items()})


def _is_like(value: Any, usual: Any) -> bool:
    """Whether a value of JSON is of the type of a setting."""
    if isinstance(usual, bool) or isinstance(value, bool):
        return isinstance(value, bool) and isinstance(usual, bool)
    if isinstance(usual, float):
        return isinstance(value, int | float)
    return isinstance(value, list if isinstance(usual, tuple) else type(usual))


def _tuples(value: Any) -> Any:
    return tuple(_tuples(each) for each in value) if isinstance(value, list) else value


def settings_text(**settings: CircleSettings | LineSettings | MarkerSettings) -> str:
    """Content of a file of settings, by their kinds: circles, lines, markers."""
    content = {"settings": {kind: asdict(each) for kind, each in settings.items()}}
    return f"{json.dumps(content, indent=1)}\n"
