"""Grids of parameters: converts a command line to settings to be tried."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import fields, replace
from decimal import Decimal, InvalidOperation
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from detect.errors import DetectError
from storage.messages import excerpt

SettingsType = TypeVar("SettingsType")

Combination = tuple[tuple[str, Any], ...]


def parameter_value(kind: type, name: str, text: str) -> Any:
    """Convert a word to the value of a parameter.

    Parameters
    ----------
    kind : type
        `CircleSettings`, `LineSettings` or another dataclass of parameters.
    name : str
        One of its fields.
    text : str
        The word.

    Returns
    -------
    bool, int, float or str
        Whatever the field is.

    Raises
    ------
    DetectError
        If there is no such field, it is no single value, or the word is none of its values.
    """
    known = {field.name for field in fields(kind)}
    if name not in known:
        raise DetectError(
            f"{name} is no parameter of {kind.__name__}: expected one of {', '.join(sorted(known))}"
        )
    wanted = get_type_hints(kind)[name]
    if get_origin(wanted) is Literal:
        if text in get_args(wanted):
            return text
        allowed = ", ".join(get_args(wanted))
        raise DetectError(f"{name} is {excerpt(text)}: expected one of {allowed}")
    if wanted is bool:
        if text.lower() in ("true", "false"):
            return text.lower() == "true"
        raise DetectError(f"{name} is {excerpt(text)}: expected True or False")
    if wanted not in (int, float):
        raise DetectError(f"{name} is no single number or word: it cannot be varied")
    try:
        return wanted(text)
    except ValueError:
        whole = "a whole number" if wanted is int else "a number"
        raise DetectError(f"{name} is {excerpt(text)}: expected {whole}") from None


def parameter_values(kind: type, name: str, text: str) -> tuple[Any, ...]:
    """The values of a parameter that are to be tried.

    Parameters
    ----------
    kind, name
        As for `parameter_value`.
    text : str
        FROM:TO:STEP, both ends included, or values with commas between them.

    Returns
    -------
    tuple
        The values, each once, in the order given.

    Raises
    ------
    DetectError
        As `parameter_value` does, and for a range that is none.
    """
    if ":" not in text:
        words = text.split(",")
    else:
        parts = text.split(":")
        expected = f"{name} is {text!r}: expected FROM:TO:STEP with a step above 0, TO not below"
        if len(parts) != 3:
            raise DetectError(expected)
        try:
            # Decimal numbers: 0.3 and twice 0.1 are 0.5, and its digits are those of a file.
            first, last, step = (Decimal(part.strip()) for part in parts)
        except InvalidOperation:
            raise DetectError(expected) from None
        if not (first.is_finite() and last.is_finite() and step.is_finite()):
            raise DetectError(expected)
        if step <= 0 or last < first or (last - first) / step > 100_000:
            raise DetectError(expected)
        words = [str(first + k * step) for k in range(int((last - first) / step) + 1)]
    return tuple(dict.fromkeys(parameter_value(kind, name, word.strip()) for word in words))


def combinations(kind: type, varied: Mapping[str, str], most: int) -> tuple[Combination, ...]:
    """All combinations of the parameters' values.

    Parameters
    ----------
    kind : type
        As for `parameter_value`.
    varied : mapping of str
        The values of each parameter, as for `parameter_values`.
    most : int
        Largest number of combinations; more are refused.

    Returns
    -------
    tuple of combinations
        Each the names and values in the order of `varied`; the last varies fastest.

    Raises
    ------
    DetectError
        If nothing is varied, there are too many, or as `parameter_values` does.
    """
    if not varied:
        raise DetectError(
            "nothing is varied: expected a parameter with its values, as --threshold 0.3:0.7:0.1"
        )
    values = {name: parameter_values(kind, name, text) for name, text in varied.items()}
    count = math.prod(len(v) for v in values.values())
    if count > most:
        raise DetectError(f"the grid has {count} combinations: expected at most {most} (--most)")
    return tuple(
        tuple(zip(values, combination)) for combination in itertools.product(*values.values())
    )


def settings_with(base: SettingsType, combination: Combination) -> SettingsType:
    """Settings with a combination's values.

    Raises
    ------
    DetectError
        If the detector cannot have them; the message names parameter, value and what was expected.
    """
    return replace(base, **dict(combination))  # type: ignore[type-var]
