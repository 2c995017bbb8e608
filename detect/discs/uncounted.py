"""Compiling kernels that work in given memory: without counting references to arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., object])

# What its types do not know, Numba does.
_njit: Any = njit


def uncounted(kernel: Kernel) -> Kernel:
    """Compile a kernel that takes arrays in tuples, allocates nothing and returns no array.

    Numba leaves out counting references by itself only where arrays are arguments of their own:
    else every part of a tuple that is looked at is counted, with locked additions, which took a
    tenth of the search for discs. Kernels that allocate are refused by the compiler.
    """
    compiled: Kernel = _njit(cache=True, error_model="numpy", forceinline=True, _nrt=False)(kernel)
    return compiled
