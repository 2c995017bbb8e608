"""Compilation of kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def kernel(**options: Any) -> Callable[[Kernel], Kernel]:
    """Decorator of kernels, with options of `numba.njit`.

    They are cached on disk, divide like NumPy, and release the GIL. The entry point for C code,
    which is not used here, is omitted: it makes compilation a tenth slower.
    """
    decorator: Any = njit(  # type: ignore[call-overload]  # the stub lacks an option
        cache=True, error_model="numpy", nogil=True, no_cfunc_wrapper=True, **options
    )
    return decorator  # type: ignore[no-any-return]
