"""Compiled kernels loaded from Numba's cache without what only a compiler needs.

Before it reads its cache, Numba prepares to compile: it imports what it can compile of
Python, NumPy and SciPy, and registers all of it, which takes a third of the time that a command
has before its first landmark. Machine code needs none of that. So the cache is read first, and
Numba is initialised only if there is something to compile.

Compiled kernels are cached as Numba caches them, with one exception. Numba adds a file of machine
code to a kernel's index before it writes the file. If the process is killed in between, or the disk
is full, the index refers to a file of that name that an earlier version of the kernel left; another
process that reads the cache at that moment would load it. So such files are removed first. An index
that cannot be read, because it names classes of another version of the program, counts as empty.

Attributes of Numba that are not public are used for it; where they have changed, everything is done
as Numba does it.
"""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from typing import Any

#: Called before a kernel is compiled, if set: the kernel may be in the cache afterwards.
_before_compiling: Callable[[], object] | None = None


@contextmanager
def waiting_before_compiling(wait: Callable[[], object]) -> Iterator[bool]:
    """Have `wait` called, during a block, before a kernel is compiled; then read the cache again.

    Gives whether that can be done: else the caller waits before anything is loaded.
    """
    global _before_compiling
    _before_compiling = wait
    try:
        yield load_kernels_alone()
    finally:
        _before_compiling = None


@cache
def load_kernels_alone() -> bool:
    """Have this process load cached kernels without getting ready to compile.

    Returns whether it will.
    """
    try:
        caching: Any = import_module("numba.core.caching")
        cache_class, file_class = caching.Cache, caching.IndexDataCacheFile
        environment: Any = import_module("numba.core.environment")
        runtime: Any = import_module("numba.core.runtime").rtsys
        numbas_own = cache_class.load_overload
        numbas_load_index = file_class._load_index
        numbas_save_index = file_class._save_index
        for holder, name in (
            (cache_class, "_load_overload"),
            (cache_class, "_guard_against_spurious_io_errors"),
            (file_class, "_load_index"),
            (file_class, "_data_path"),
            (environment, "_rebuild_env"),
            (environment, "lookup_environment"),
            (environment.Environment, "_memo"),
            (runtime, "initialize"),
        ):
            getattr(holder, name)
    except (ImportError, AttributeError):
        return False

    def load_overload(self: Any, signature: Any, target_context: Any) -> Any:
        loaded = load_alone(self, signature, target_context)
        if loaded is None and _before_compiling is not None:
            _before_compiling()
            loaded = load_alone(self, signature, target_context)
        return numbas_own(self, signature, target_context) if loaded is None else loaded

    def load_alone(self: Any, signature: Any, target_context: Any) -> Any:
        try:
            runtime.initialize(target_context)  # what allocates arrays
            with _environments_alone(environment), self._guard_against_spurious_io_errors():
                return self._load_overload(signature, target_context)
        except Exception:
            return None  # Numba itself reports the error

    def save_index(self: Any, overloads: dict[Any, str]) -> None:
        for name in {*overloads.values()} - {*self._load_index().values()}:
            with suppress(OSError):
                os.unlink(self._data_path(name))  # noqa: PTH108 - a string, as Numba has it
        numbas_save_index(self, overloads)

    def load_index(self: Any) -> dict[Any, str]:
        try:
            indexed: dict[Any, str] = numbas_load_index(self)
        except (AttributeError, ImportError, pickle.UnpicklingError):
            return {}  # written by another version, whose classes are no longer there
        return indexed

    cache_class.load_overload = load_overload
    file_class._load_index = load_index
    file_class._save_index = save_index
    return True


@contextmanager
def _environments_alone(environment: Any) -> Iterator[None]:
    """Have the environments of Numba's own functions made without their modules, during a block.

    A kernel brings an environment of each function that was compiled into it: its constants, which
    compiled code uses, and the names of its module, for code that is interpreted.
    """
    numbas_own = environment._rebuild_env

    def rebuilt(module: str, constants: list[Any], name: str) -> Any:
        if module in sys.modules or not module.startswith("numba."):
            return numbas_own(module, constants, name)
        found = environment.lookup_environment(name)
        if found is None:
            found = environment.Environment({"__name__": module})
            found.consts[:] = constants
            found.env_name = name
            environment.Environment._memo[name] = found
        return found

    environment._rebuild_env = rebuilt
    try:
        yield
    finally:
        environment._rebuild_env = numbas_own
