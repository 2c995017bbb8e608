"""Bounds of settings; other values are rejected with name, value and expectation.

    demand(self, DetectError, radius_m=ABOVE_0, samples=whole(3, 128))

A dataclass with many settings annotates its fields instead: `Bounded`, or `demand_fields`. NaN is
always rejected; infinity is rejected unless it means "no limit".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from math import inf
from numbers import Integral
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, ClassVar, Literal, Optional, get_args, get_origin, get_type_hints

from tyro.conf import arg

from redetect.messages import excerpt

# Types of flags; for `X | None` tyro imports another library that takes a tenth of a second.
MaybePath = Annotated[Optional[Path], arg(metavar="PATH")]  # noqa: UP045
MaybeInt = Annotated[Optional[int], arg(metavar="INT")]  # noqa: UP045
MaybeFloat = Annotated[Optional[float], arg(metavar="FLOAT")]  # noqa: UP045
MaybeStr = Annotated[Optional[str], arg(metavar="STR")]  # noqa: UP045
MaybePixel = Annotated[Optional[tuple[float, float]], arg(metavar="U V")]  # noqa: UP045

_IN_WORDS: dict[Any, str] = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    NoneType: "none",
    Path: "a path",
}


@dataclass(frozen=True)
class Bounds:
    """The allowed numbers of a setting: in words, as a test, and whether they must be whole."""

    expected: str
    include: Callable[[float], bool] = field(repr=False)
    whole: bool = False

    def contain(self, value: Any) -> bool:
        """Whether a value is allowed."""
        if isinstance(value, bool) or (self.whole and not isinstance(value, Integral)):
            return False
        try:
            return bool(self.include(value))
        except (TypeError, ValueError):  # the latter for arrays
            return False


#: A number in a text, stricter than `float`, which also reads nan, infinity, 1_000 and digits of
#: other scripts. Possessive, so that a long word that is no number is not tried again and again.
NUMBER = r"[+-]?(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++)(?:[eE][+-]?[0-9]++)?"


def number_in(word: str) -> float:
    """The number that a word of a file is; a ValueError if it is none."""
    return float(word.replace("_", "?"))  # in Python, 1_000 is a number


def whole_number_in(word: str) -> int:
    """The whole number that a word of a file is; a ValueError if it is none."""
    return int(word.replace("_", "?"))


def from_to(least: float, most: float) -> Bounds:
    """Numbers of a closed interval."""
    return Bounds(f"{least:g} to {most:g}", lambda x: least <= x <= most)


def inside(least: float, most: float) -> Bounds:
    """Numbers of an open interval."""
    return Bounds(f"above {least:g}, below {most:g}", lambda x: least < x < most)


def whole(least: int, most: int | None = None) -> Bounds:
    """Whole numbers, both ends included."""
    last = inf if most is None else most
    words = f"{least} or more" if most is None else f"{least} to {most}"
    return Bounds(f"a whole number, {words}", lambda x: least <= x <= last, whole=True)


#: Largest magnitude of numbers in files and settings: products of some of them are finite.
LARGEST_NUMBER = 1e24
FINITE = Bounds(f"a finite number, within +-{LARGEST_NUMBER:g}", lambda x: abs(x) <= LARGEST_NUMBER)
ABOVE_0 = Bounds(f"above 0, at most {LARGEST_NUMBER:g}", lambda x: 0.0 < x <= LARGEST_NUMBER)
NOT_0 = Bounds("a finite number but 0", lambda x: 0.0 < abs(x) <= LARGEST_NUMBER)
NOT_NEGATIVE = Bounds(f"0 or more, at most {LARGEST_NUMBER:g}", lambda x: 0 <= x <= LARGEST_NUMBER)
SHARE = from_to(0.0, 1.0)
PROBABILITY = inside(0.0, 1.0)

#: Types of fields for `demand_fields`.
Positive = Annotated[float, ABOVE_0]
NotNegative = Annotated[float, NOT_NEGATIVE]
#: Infinity means "no limit".
Limit = Annotated[float, Bounds("above 0", lambda x: x > 0.0)]
LimitOr0 = Annotated[float, Bounds("0 or more", lambda x: x >= 0.0)]
ShareAbove0 = Annotated[float, Bounds("above 0, at most 1", lambda x: 0.0 < x <= 1.0)]
Share = Annotated[float, SHARE]


def demand(settings: object, error: type[Exception], /, **bounds: Bounds) -> None:
    """Reject settings with a number out of its bounds, which are given by attribute name.

    Each number of a tuple, but None. The error states the setting, its value, what is allowed.
    """
    for name, allowed in bounds.items():
        value = getattr(settings, name)
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None and not allowed.contain(number):
                shown = f"{number:g}" if isinstance(number, float) else excerpt(number)
                raise error(f"{name} is {shown}: expected {allowed.expected}")


def demand_fields(settings: object, error: type[Exception]) -> None:
    """Reject a dataclass of settings with a number out of the bounds that annotate its field, or
    a word that is none of a field's.

    Numbers become Python's of the field's type, for which kernels are compiled.
    """
    kind: Any = type(settings)
    demand(settings, error, **_annotated(kind))
    for name, bounds in _annotated(kind).items():
        value = getattr(settings, name)
        if value is not None and not isinstance(value, str | tuple):
            number = round(value) if bounds.whole else float(value)
            object.__setattr__(settings, name, number)


def expectation(hint: Any) -> str:
    """Which values a setting or flag of some type may have, in words."""
    marks = getattr(hint, "__metadata__", ())
    bounds = next((mark.expected for mark in marks if isinstance(mark, Bounds)), "")
    hint = hint.__origin__ if marks else hint
    if bounds:
        several = get_origin(hint) is tuple and ... not in get_args(hint)
        return f"{len(get_args(hint))} numbers of {bounds}" if several else bounds
    kinds = get_args(hint)
    if get_origin(hint) is Literal:
        return f"one of {', '.join(map(str, kinds))}"
    if get_origin(hint) is tuple:
        return "a list of numbers, or of pairs of them" if ... in kinds else f"{len(kinds)} numbers"
    return " or ".join(map(expectation, kinds)) or _IN_WORDS.get(hint, "a word")


class Bounded:
    """Base class of settings that are checked by `demand_fields`; its subclasses name the error."""

    _error: ClassVar[type[Exception]]

    def __init_subclass__(cls, error: type[Exception] | None = None) -> None:
        cls._error = error or cls._error

    def __post_init__(self) -> None:
        demand_fields(self, self._error)


@cache
def _annotated(kind: type) -> dict[str, Bounds]:
    found: dict[str, Bounds] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if get_origin(hint) is Literal:
            known = get_args(hint)
            found[name] = Bounds(f"one of {', '.join(map(str, known))}", known.__contains__)
        for mark in getattr(hint, "__metadata__", ()):
            if isinstance(mark, Bounds):
                found[name] = mark
    return found
