"""Handles keyboard interrupts, including those that Python would lose.

Python raises an interrupt as an exception wherever it is executing. While a kernel is compiled, the
exception may be swallowed: it is printed and ignored, or replaced by another one. So interrupts are
recorded, and the record is checked after every frame.

While processes are started or ended, an exception could leave a process half started: there an
interrupt is deferred until that is done.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

_received = threading.Event()


@contextmanager
def interrupts_noted() -> Iterator[None]:
    """Record interrupts during a block; whatever it raises after one becomes an interrupt."""
    _received.clear()
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def note(*_: object) -> NoReturn:
        _received.set()
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield
    except BaseException:
        raise_if_interrupted()
        raise
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Let interrupts wait until the end of a block, which is short, and raise them there.

    Processes started meanwhile inherit a blocked interrupt. That alone would not do: an interrupt
    that this thread blocks is taken by another one, and raised in this one all the same.
    """
    deferred = threading.Event()
    before = signal.getsignal(signal.SIGINT)
    handled = threading.current_thread() is threading.main_thread() and callable(before)
    if handled:
        signal.signal(signal.SIGINT, lambda *_: deferred.set())
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if handled:
            signal.signal(signal.SIGINT, before)
    if deferred.is_set():
        _received.set()
        raise KeyboardInterrupt


def raise_if_interrupted() -> None:
    """Raise an interrupt that was lost, if there was one."""
    if _received.is_set():
        raise KeyboardInterrupt
