"""Interrupts from the keyboard, also those that get lost.

Python turns an interrupt into an exception wherever it happens to be. While a kernel is compiled,
that may be where nobody lets the exception through: it is printed and forgotten, or comes out as
another one. So it is noted that there was one, and looked at after every frame.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

_received = threading.Event()


@contextmanager
def interrupts_noted() -> Iterator[threading.Event]:
    """Note interrupts for the time of a block; yields what is set by one."""
    _received.clear()
    if threading.current_thread() is not threading.main_thread():
        yield _received
        return

    def note(_: int, __: FrameType | None) -> NoReturn:
        _received.set()
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield _received
    finally:
        signal.signal(signal.SIGINT, before)


def raise_if_interrupted() -> None:
    """Raise the interrupt again that got lost, if there was one."""
    if _received.is_set():
        raise KeyboardInterrupt
