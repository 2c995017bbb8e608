"""Interrupts from the keyboard: never lost, and raised where they do no harm.

Python raises an interrupt as an exception wherever it is executing. While a kernel is compiled, the
exception may be swallowed: it is printed and ignored, or replaced by another one. So interrupts are
recorded, and the record is checked now and then. While processes are started or ended, an exception
could leave a process half started: there an interrupt is deferred until that is done.

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
from importlib import import_module
from types import FrameType
from typing import Any, NoReturn

Handler = Callable[[int, FrameType | None], Any]

#: Exit code of a program that was interrupted from the keyboard.
EXIT_INTERRUPTED = 130

#: Functions that compiled code calls to hand over its results, and the ends of their files' names:
#: Numba's own, and the one that makes a named tuple.
_HANDING_OVER = {("_numba_unpickle", "serialize.py"), ("<lambda>", "<string>")}

_received = threading.Event()
_waiting = threading.Event()


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
def interrupts_call(note: Handler) -> Iterator[None]:
    """In the main thread, have interrupts call something during a block, but not in kernels."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, outside_kernels(note))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def interrupts_noted() -> Iterator[None]:
    """Record interrupts during a block; any later exception in it becomes a KeyboardInterrupt."""
    _received.clear()

    def note(*_: object) -> NoReturn:
        _received.set()
        raise KeyboardInterrupt

    with interrupts_call(note):
        try:
            yield
        except BaseException:
            raise_if_interrupted()
            raise


@contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Defer interrupts to the end of a block, which should be short.

    Processes started meanwhile inherit the blocked signal. Blocking alone is not sufficient: a
    signal blocked in this thread is delivered to another one, and still raised in this one. Long
    blocks call `raise_if_interrupt_waits` now and then.
    """
    before = signal.getsignal(signal.SIGINT)
    handled = threading.current_thread() is threading.main_thread() and callable(before)
    if handled:
        signal.signal(signal.SIGINT, lambda *_: _waiting.set())
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if handled:
            signal.signal(signal.SIGINT, before)
        waiting = _waiting.is_set()
        _waiting.clear()
    if waiting:
        _received.set()
        raise KeyboardInterrupt


def raise_if_interrupted() -> None:
    """Raise an interrupt that was lost, if there was one."""
    if _received.is_set():
        raise KeyboardInterrupt


def raise_if_interrupt_waits() -> None:
    """Raise a deferred interrupt, if there is one."""
    if _waiting.is_set() or signal.SIGINT in signal.sigpending():
        raise KeyboardInterrupt


def say_interrupted() -> int:
    """Report an interrupt; returns the exit code."""
    print("interrupted", file=sys.stderr, flush=True)
    return EXIT_INTERRUPTED


def start(module: str) -> int:
    """Run the `main` of a module, whose import may be interrupted, too; returns the exit code."""
    try:
        command_line = import_module(module).main
    except KeyboardInterrupt:
        return say_interrupted()
    return int(command_line())
