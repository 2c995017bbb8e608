"""Grids of parameters: converts a command line to settings to be tried."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import fields
from decimal import Decimal, InvalidOperation
from typing import Any, Literal, get_args, get_origin, get_type_hints

from detect.errors import DetectError
from redetect.storage.messages import excerpt

#: The value of each parameter that is varied.
Combination = dict[str, Any]


def parameter_value(kind: type, name: str, text: str) -> Any:
    """Convert a word to the value of a field of a dataclass of parameters.

    Raises DetectError if there is no such field, it is no single value, or this is none of its.
    """
    known = {field.name for field in fields(kind)}
    if name not in known:
        raise DetectError(
            f"{name} is no parameter of {kind.__name__}: expected one of {', '.join(sorted(known))}"
        )
    wanted = get_type_hints(kind)[name]
    if wanted in (int, float):
        try:
            return wanted(text)
        except ValueError:
            expected = "a whole number" if wanted is int else "a number"
    elif wanted is bool:
        if text.lower() in ("true", "false"):
            return text.lower() == "true"
        expected = "True or False"
    elif get_origin(wanted) is Literal:
        if text in get_args(wanted):
            return text
        expected = f"one of {', '.join(get_args(wanted))}"
    else:
        raise DetectError(f"{name} is no single number or word: it cannot be varied")
    raise DetectError(f"{name} is {excerpt(text)}: expected {expected}")


def parameter_values(kind: type, name: str, text: str) -> tuple[Any, ...]:
    """The values of a parameter that are to be tried, each once.

    `text` is FROM:TO:STEP, both ends included, or values with commas between them; errors as those
    of `parameter_value`.
    """
    words = text.split(",")
    if ":" in text:
        expected = f"{name} is {text!r}: expected FROM:TO:STEP with a step above 0, TO not below"
        try:
            # Decimal numbers: 0.3 and twice 0.1 are 0.5, and its digits are those of a file.
            first, last, step = (Decimal(part.strip()) for part in text.split(":"))
            if not (last - first).is_finite() or step <= 0 or not 0 <= (last - first) / step <= 1e5:
                raise ValueError
            words = [str(first + k * step) for k in range(int((last - first) / step) + 1)]
        except (InvalidOperation, ValueError):
            raise DetectError(expected) from None
    return tuple(dict.fromkeys(parameter_value(kind, name, word.strip()) for word in words))


def combinations(kind: type, varied: Mapping[str, str], most: int) -> tuple[Combination, ...]:
    """All combinations of the values of parameters, written as for `parameter_values`.

    Each has the names and values in the order of `varied`; the last varies fastest. Raises
    DetectError if nothing is varied, there are more than `most`, or as `parameter_values` does.
    """
    if not varied:
        raise DetectError(
            "nothing is varied: expected a parameter with its values, as --threshold 0.3:0.7:0.1"
        )
    values = {name: parameter_values(kind, name, text) for name, text in varied.items()}
    count = math.prod(len(v) for v in values.values())
    if count > most:
        raise DetectError(f"the grid has {count} combinations: expected at most {most} (--most)")
    return tuple(dict(zip(values, chosen)) for chosen in itertools.product(*values.values()))
