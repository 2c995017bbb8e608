"""Compiles kernels that allocate nothing, without counting references to arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., object])

# Numba accepts options that its type hints do not have.
_njit: Any = njit


def uncounted(kernel: Kernel) -> Kernel:
    """Compile a kernel that takes arrays in tuples, allocates nothing and returns no array.

    By itself Numba omits reference counting only if arrays are separate arguments. For arrays in
    tuples every access is counted with atomic additions, which took a tenth of the search for
    discs, and with verticals longer than filtering a row. Kernels that allocate are refused by the
    compiler.
    """
    return _compiled(kernel)


def uncounted_contracting(kernel: Kernel) -> Kernel:
    """The same, and products may become parts of sums without being rounded."""
    return _compiled(kernel, fastmath={"contract"})


def _compiled(kernel: Kernel, **more: object) -> Kernel:
    options = {"cache": True, "error_model": "numpy", "forceinline": True, "_nrt": False}
    compiled: Kernel = _njit(**options, **more)(kernel)
    return compiled
