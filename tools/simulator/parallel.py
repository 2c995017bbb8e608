"""Frames worked on by several processes; what comes back is the same as from one."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, TypeVar

State = TypeVar("State")
Item = TypeVar("Item")
Result = TypeVar("Result")

_state: Any = None


def in_order(
    function: Callable[[State, Item], Result], state: State, items: Sequence[Item], jobs: int = 1
) -> Iterator[Result]:
    """Results of ``function(state, item)`` in the order of the items; `state` is sent once.

    On a terminal a bar shows how many there are already.
    """
    from rich.console import Console
    from rich.progress import track

    terminal = Console(stderr=True)
    yield from track(
        _results(function, state, items, jobs), "", len(items), console=terminal, transient=True,
        disable=not terminal.is_terminal,
    )  # fmt: skip


def _results(
    function: Callable[[State, Item], Result], state: State, items: Sequence[Item], jobs: int
) -> Iterator[Result]:
    if jobs <= 1:
        yield from (function(state, item) for item in items)
        return
    context = multiprocessing.get_context("spawn")
    with context.Pool(jobs, _begin, (state,)) as pool:
        yield from pool.imap(partial(_of_state, function), items, chunksize=4)


def _begin(state: Any) -> None:
    import cv2

    global _state
    _state = state
    cv2.setNumThreads(1)


def _of_state(function: Callable[[Any, Any], Any], item: Any) -> Any:
    return function(_state, item)
