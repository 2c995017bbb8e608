"""How kernels are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def kernel(**options: Any) -> Callable[[Kernel], Kernel]:
    """Decorator of kernels, with options of `numba.njit`.

    They are kept on the disk, divide as NumPy does, and let other threads go on. The entry for code
    in C, which nothing here uses, is left out: with it, compiling takes a tenth longer.
    """
    decorator: Any = njit(  # type: ignore[call-overload]  # the stub lacks an option
        cache=True, error_model="numpy", nogil=True, no_cfunc_wrapper=True, **options
    )
    return decorator  # type: ignore[no-any-return]
