"""Announces slow one-time work: compilation of kernels and computation of tables.

Said through the logger ``redetect``, so that a program that uses the detectors decides who hears
it; the command line shows it on stderr.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache

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


def on_compilation(call: Callable[[], object]) -> None:
    """Have something called before this process compiles a kernel."""
    from numba.core import event

    class Compilation(event.Listener):
        def on_start(self, _: object) -> None:
            call()

        def on_end(self, _: object) -> None:
            pass

    event.register("numba:compile", Compilation())
