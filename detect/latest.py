"""Caches the result of a function for its latest argument."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def kept_for_latest(make: Callable[[T], R]) -> Callable[[T], R]:
    """Cache a function's result as long as it is called with the identical object.

    In a run this is the case frame after frame. Comparing or hashing cameras or plans would take
    longer than most of what is done with the result.

    Parameters
    ----------
    make : callable
        A function of one object that does not change; what it returns is not changed either.

    Returns
    -------
    callable
        The same function.
    """
    latest: tuple[T, R] | None = None

    @wraps(make)
    def made_of(value: T) -> R:
        nonlocal latest
        kept = latest  # another thread may replace it meanwhile
        if kept is None or kept[0] is not value:
            kept = latest = value, make(value)
        return kept[1]

    return made_of
