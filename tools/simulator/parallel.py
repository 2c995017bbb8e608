"""Frames worked on by several processes; what comes back is the same as from one."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TypeVar

State = TypeVar("State")
Item = TypeVar("Item")
Result = TypeVar("Result")


def in_order(
    function: Callable[[State, Item], Result], state: State, items: Sequence[Item], jobs: int = 1
) -> Iterator[Result]:
    """Results of ``function(state, item)`` in the order of the items.

    On a terminal a bar shows how many there are already.
    """
    import cv2
    from rich.console import Console
    from rich.progress import track

    terminal = Console(stderr=True)
    bar = partial(track, description="", total=len(items), console=terminal, transient=True,
                  disable=not terminal.is_terminal)  # fmt: skip
    of_state = partial(function, state)
    if jobs <= 1:
        yield from bar(map(of_state, items))
        return
    context = multiprocessing.get_context("spawn")
    with context.Pool(jobs, cv2.setNumThreads, (1,)) as pool:
        yield from bar(pool.imap(of_state, items, chunksize=8))
