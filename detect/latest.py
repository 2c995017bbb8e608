"""What was made of an object is kept for when it is asked for again."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def kept_for_latest(make: Callable[[T], R]) -> Callable[[T], R]:
    """Keep a function's result as long as it is asked about the very same object.

    In a run it is, frame after frame; to tell whether cameras or plans are equal, or their hash,
    takes longer than most of what is done with the result.

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
