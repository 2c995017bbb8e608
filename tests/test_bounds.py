"""Every number of every setting: what cannot be is refused by its name, with its value."""

from __future__ import annotations

import dataclasses
import importlib
import math
import pkgutil
from collections.abc import Iterator
from typing import Any

import pytest

ROOMS = ("camera", "detect", "lut", "redetect")

#: Dataclasses with a default for every field that are no settings: results, and flags that the
#: commands hand on to settings.
NO_SETTINGS = frozenset(
    {
        "DiscShape", "FileHead", "FrameRows", "Priors",
        "RowCount", "RowFiles", "RunSummary", "ImageRows", "VoteShape", "_Rows",
    }
)  # fmt: skip

#: Where infinity stands for "no limit".
ENDLESS = {
    "CircleSettings": {"far_limit"},
    "LineSettings": {
        "largest_horizon_gap_px", "largest_scatter_px", "largest_shift_px", "largest_noise_px",
        "largest_lean_deg", "largest_lean_px",
    },
}  # fmt: skip

#: Which may be negative.
SIGNED = {
    "CircleSettings": {"evidence"}  # log-odds
}


def settings_classes() -> Iterator[type[Any]]:
    """All dataclasses of the rooms that can be made without arguments, but for `NO_SETTINGS`."""
    found: dict[str, type[Any]] = {}
    for room in ROOMS:
        for module in pkgutil.walk_packages(importlib.import_module(room).__path__, f"{room}."):
            if module.name.endswith("__main__"):
                continue
            for value in vars(importlib.import_module(module.name)).values():
                if (
                    isinstance(value, type)
                    and dataclasses.is_dataclass(value)
                    and value.__module__ == module.name
                    and value.__name__ not in NO_SETTINGS
                    and all(has_default(field) for field in dataclasses.fields(value))
                ):
                    found[f"{module.name}.{value.__name__}"] = value
    yield from (found[name] for name in sorted(found))


def has_default(field: dataclasses.Field[Any]) -> bool:
    return (
        field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
    )


def numbers() -> Iterator[Any]:
    """Each number of each class: the class, the field's name, and whether it is in a tuple."""
    for settings in settings_classes():
        made = settings()
        for field in dataclasses.fields(settings):
            value = getattr(made, field.name)
            in_tuple = isinstance(value, tuple)
            number = value[0] if in_tuple and value else value
            if isinstance(number, int | float) and not isinstance(number, bool):
                yield pytest.param(
                    settings, field.name, in_tuple, id=f"{settings.__name__}-{field.name}"
                )


NUMBERS = list(numbers())


def test_there_are_settings_of_all_kinds() -> None:
    names = {parameter.values[0].__name__ for parameter in NUMBERS}
    assert {
        "CircleSettings", "LineSettings", "MarkerSettings", "PoseSettings",
        "LaserSettings", "FuseSettings", "SyncSettings", "AssociateSettings",
    } <= names  # fmt: skip
    assert len(NUMBERS) > 100


@pytest.mark.parametrize(("settings", "name", "in_tuple"), NUMBERS)
def test_impossible_numbers_are_refused_by_name(
    settings: type[Any], name: str, in_tuple: bool
) -> None:
    kind = settings.__name__
    for value in (math.nan, math.inf, -math.inf, -1.0, -1):
        changes: Any = {name: (value,) if in_tuple else value}
        if value == math.inf and name in ENDLESS.get(kind, ()):
            assert getattr(settings(**changes), name) == math.inf
        elif value == -1.0 and name in SIGNED.get(kind, ()):
            settings(**changes)
        else:
            with pytest.raises(ValueError, match=rf"(?s)^{name}\b.*expected") as refusal:
                settings(**changes)
            assert type(refusal.value) is not ValueError, "the error has a type of the project's"
            assert f"{value:g}" in str(refusal.value)
    value = getattr(settings(), name)
    if isinstance(value, int):
        changes = {name: value + 0.5}
        with pytest.raises(ValueError, match=name):
            settings(**changes)


def test_every_exception_to_the_rule_exists() -> None:
    known = {(p.values[0].__name__, p.values[1]) for p in NUMBERS}
    for table in (ENDLESS, SIGNED):
        assert {(kind, name) for kind, names in table.items() for name in names} <= known
