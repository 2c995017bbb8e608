"""Messages and progress of long work on the terminal, and interrupts.

Compilation of kernels and computation of tables are announced through the logger ``redetect``,
which other programs can configure; the command line shows it on stderr.

Python raises an interrupt as an exception wherever it is executing. While a kernel is compiled, the
exception may be lost: it is printed and ignored, or replaced by another one. So interrupts are
recorded, and the record is checked after every frame. While processes are started or ended, an
exception could leave a process half started, so interrupts are deferred until that is done.
"""

from __future__ import annotations

import gc
import logging
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import NoReturn

from detect.errors import EXIT_FRAMES_FAILED
from redetect.interrupts import outside_kernels
from redetect.storage.messages import is_quiet

_received = threading.Event()
_waiting = threading.Event()


@contextmanager
def interrupts_call(note: Callable[..., object]) -> Iterator[None]:
    """Let interrupts call a function during a block; without effect outside the main thread."""
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


_log = logging.getLogger("redetect")


def show_announcements() -> None:
    """Show announcements on stderr."""
    _log.setLevel(logging.INFO)
    _log.handlers = [logging.StreamHandler()]


def announcements_are_shown() -> bool:
    """Whether announcements go to stderr."""
    return bool(_log.handlers)


@cache
def say_compiling() -> None:
    """Announce, once, that kernels are compiled."""
    _log.info("compiling kernels, once: about a minute")


def on_compilation(call: Callable[[], object]) -> Callable[[], None]:
    """Call a function before this process compiles a kernel; the result of this ends that.

    If the function raises, the kernel is not compiled.

    The compiler creates many objects and keeps most of them. Garbage collection is off meanwhile,
    since it would take a tenth of the time.
    """
    from numba.core import event

    class Compilation(event.Listener):
        depth = 0  # of kernels that are compiled because others call them

        def on_start(self, _: object) -> None:
            call()
            self.depth += 1
            gc.disable()

        def on_end(self, _: object) -> None:
            self.depth -= 1
            if not self.depth:
                gc.enable()

    compilation = Compilation()
    event.register("numba:compile", compilation)
    return lambda: event.unregister("numba:compile", compilation)


_SHOWN_FAILURES = 10


@contextmanager
def progress_bar(label: str, total: int | None) -> Iterator[Callable[[], None]]:
    """A progress bar with the rate, on a terminal; yields a function to call after every frame.

    That function raises an interrupt that was lost (see `detect.terminal`). The bar appears with
    the first frame, since workers may print messages until then.
    """
    if not sys.stderr.isatty() or is_quiet():
        yield raise_if_interrupted
        return
    from rich import console
    from rich import progress as bars

    columns = (
        *bars.Progress.get_default_columns(), bars.MofNCompleteColumn(), bars.TimeElapsedColumn(),
    )  # fmt: skip
    rate = bars.TextColumn("{task.fields[rate]}")
    progress = bars.Progress(*columns, rate, console=console.Console(stderr=True))
    task = progress.add_task(label, total=total, rate="")

    def advance() -> None:
        raise_if_interrupted()
        progress.start()  # no effect if already started
        speed = progress.tasks[0].finished_speed or progress.tasks[0].speed
        progress.update(task, advance=1, rate=f"{speed:.1f} images/s" if speed else "")

    try:
        yield advance
    finally:
        progress.stop()


def report_failures(count: int, first: Sequence[str]) -> int:
    """Print which frames could not be processed, as many as fit on a screen; the exit code."""
    if not count:
        return 0
    shown = [f"  {line}" for line in first[:_SHOWN_FAILURES]]
    if count > _SHOWN_FAILURES:
        shown.append(f"  and {count - _SHOWN_FAILURES} more")
    print(f"{count} frames could not be processed:", *shown, sep="\n", file=sys.stderr)
    return EXIT_FRAMES_FAILED
