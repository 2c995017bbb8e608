"""When Python looks for garbage while a run lasts: frames leave none, and much is there to stay.

Without this each collection would look through all that was imported; and there would be one every
other frame, of which nothing is garbage.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

#: Garbage is looked for when there are so many more objects that can hold others.
_NEW_OBJECTS = 20_000

#: It is looked for everywhere after so many calls of `tidy_now_and_then`.
_TIDY_EVERY = 256


@contextmanager
def settled() -> Iterator[None]:
    """Have collections leave out what is there already, during a block."""
    if gc.get_freeze_count():  # somebody has done so, or wants other things left out
        yield
        return
    thresholds = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(_NEW_OBJECTS, *thresholds[1:])
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()


@contextmanager
def settling() -> Iterator[None]:
    """Have no collections during a block, whatever is there at its end left out for good.

    For a process that begins: a tenth of the time that it takes for that goes into collections.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.set_threshold(_NEW_OBJECTS, *gc.get_threshold()[1:])
        gc.enable()


def tidy_now_and_then() -> None:
    """Give back what Python keeps for later: its own collections leave it, and it grows slowly."""
    global _called
    _called += 1
    if _called % _TIDY_EVERY == 0:
        gc.collect()


_called = 0
