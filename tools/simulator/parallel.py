"""Frames processed by several processes, with the same results as from one."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TypeVar

import cv2
from rich.console import Console
from rich.progress import track

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_order(
    function: Callable[[Item], Result], items: Sequence[Item], jobs: int = 1
) -> Iterator[Result]:
    """Results of a function that can be pickled, in the order of the items.

    On a terminal a bar shows how many there are already.
    """
    terminal = Console(stderr=True)
    bar = partial(track, description="", total=len(items), console=terminal, transient=True,
                  disable=not terminal.is_terminal)  # fmt: skip
    if jobs <= 1:
        yield from bar(map(function, items))
        return
    context = multiprocessing.get_context("spawn")
    with context.Pool(jobs, cv2.setNumThreads, (1,)) as pool:
        yield from bar(pool.imap(function, items, chunksize=8))
