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
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import FrameType
from typing import Any, NoReturn

_received = threading.Event()


@contextmanager
def interrupts_noted() -> Iterator[threading.Event]:
    """Record interrupts during a block; yields an event that an interrupt sets."""
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


@contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Let interrupts wait until the end of a block, which is short, and raise them there.

    Processes started meanwhile inherit a blocked interrupt. That alone would not do: an interrupt
    that this thread blocks is taken by another one, and raised in this one all the same.

    Raises
    ------
    KeyboardInterrupt
        At the end of the block, if there was one during it.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        with _interrupts_blocked():
            yield
        return
    waiting = threading.Event()

    def note(_: int, __: FrameType | None) -> None:
        waiting.set()

    signal.signal(signal.SIGINT, note)
    try:
        with _interrupts_blocked():
            yield
    finally:
        signal.signal(signal.SIGINT, before)
    if waiting.is_set():
        _received.set()
        raise KeyboardInterrupt


def interrupts_deferred_in(kernel: Any) -> AbstractContextManager[None]:
    """Defer interrupts while a compiled kernel runs that returns named tuples.

    Numba makes these by Python code and does not check whether an interrupt ended it. A kernel that
    is not compiled yet may take a minute, which nobody should have to wait for: then an interrupt
    ends the compiling.
    """
    return interrupts_deferred() if kernel.signatures else nullcontext()


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def raise_if_interrupted() -> None:
    """Raise an interrupt that was lost, if there was one."""
    if _received.is_set():
        raise KeyboardInterrupt
