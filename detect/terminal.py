"""Messages and progress of long work on the terminal.

Compilation of kernels and computation of tables are announced through the logger ``redetect``,
which other programs can configure; the command line shows it on stderr.
"""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache

from detect.errors import EXIT_FRAMES_FAILED
from redetect.interrupts import raise_if_interrupted
from redetect.messages import counted, is_quiet

_log = logging.getLogger("redetect")

_SHOWN_FAILURES = 10


def show_announcements() -> None:
    """Show announcements on stderr."""
    _log.setLevel(logging.INFO)
    _log.handlers = [logging.StreamHandler()]


@cache
def say_compiling() -> None:
    """Announce, once, that kernels are compiled."""
    _log.info("compiling kernels, once: up to a minute")


def on_compilation(call: Callable[[], object]) -> Callable[[], None]:
    """Call a function before this process compiles a kernel; the result of this ends that.

    If it raises, the kernel is not compiled. Garbage collection is off meanwhile: the compiler
    keeps most of the many objects that it creates, and it would take a tenth of the time.
    """
    from numba.core import event

    class Compilation(event.Listener):
        depth = 0  # of kernels that are compiled because others call them

        def on_start(self, _: object) -> None:
            self.depth += 1  # the compilation ends even if the call raises
            gc.disable()
            call()

        def on_end(self, _: object) -> None:
            self.depth -= 1
            if not self.depth:
                gc.enable()

    compilation = Compilation()
    event.register("numba:compile", compilation)
    return lambda: event.unregister("numba:compile", compilation)


@contextmanager
def progress_bar(label: str, total: int | None) -> Iterator[Callable[[], None]]:
    """A progress bar with the rate, on a terminal; yields a function to call after every frame.

    That function raises an interrupt that was lost. The bar appears with the first frame, since
    workers may print messages until then.
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
    print(f"{counted(count, 'frame')} could not be processed:", *shown, sep="\n", file=sys.stderr)
    return EXIT_FRAMES_FAILED
