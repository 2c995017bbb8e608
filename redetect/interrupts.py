"""Interrupts from the keyboard, kept from where Numba hands over the results of a kernel.

Python calls the handler of a signal between two of its own instructions. While a kernel runs there
are none; the first ones after it are often those by which Numba makes its results. An exception
there is not seen by the compiled code round it: the process crashes, or ends with an error of the
interpreter. So a handler waits for the next line of the function that called the kernel.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

Handler = Callable[[int, FrameType | None], Any]

#: Functions that compiled code calls to hand over its results, and the ends of their files' names:
#: Numba's own, and the one that makes a named tuple.
_HANDING_OVER = {("_numba_unpickle", "serialize.py"), ("<lambda>", "<string>")}


def outside_kernels(handler: Handler) -> Handler:
    """A handler of signals that is not called while Numba hands over the results of a kernel."""

    def handle(number: int, frame: FrameType | None) -> None:
        inner = frame
        while inner is not None and _hands_over(inner):
            inner = inner.f_back
        if inner is frame or inner is None:
            handler(number, frame)
            return
        caller, tracing, traced = inner, sys.gettrace(), inner.f_trace

        def at_next_line(*_: object) -> None:
            caller.f_trace = traced
            sys.settrace(tracing)
            handler(number, caller)

        caller.f_trace = at_next_line
        sys.settrace(tracing or (lambda *_: None))

    return handle


def _hands_over(frame: FrameType) -> bool:
    code = frame.f_code
    return any(code.co_name == n and code.co_filename.endswith(f) for n, f in _HANDING_OVER)


@contextmanager
def interrupts_outside_kernels() -> Iterator[None]:
    """Raise interrupts during a block as always, but outside kernels.

    Nothing changes in threads but the main one, and where interrupts are handled otherwise or
    ignored.
    """
    before = signal.getsignal(signal.SIGINT)
    usual = before is signal.default_int_handler
    if not usual or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, outside_kernels(signal.default_int_handler))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
