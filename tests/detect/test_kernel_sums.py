"""Kernels that may sum in any order are inlined up to the kernel that Python calls.

Otherwise the compiler optimises them once by themselves and once within their caller. A process
that has just compiled both calls the former, one that loads them from the cache the latter, and
their last digits differ.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
from typing import NamedTuple


class _Kernel(NamedTuple):
    path: Path
    name: str
    calls: frozenset[str]
    any_order: bool  # its own sums
    inlined: bool


def _kernels(root: Path) -> tuple[_Kernel, ...]:
    found = []
    for path in sorted(root.rglob("*.py")):
        for function in ast.walk(ast.parse(path.read_text("utf-8"))):
            if not isinstance(function, ast.FunctionDef):
                continue
            names = {node.id for node in ast.walk(function) if isinstance(node, ast.Name)}
            for decorator in function.decorator_list:
                if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "kernel":
                    options = {word.arg: ast.unparse(word.value) for word in decorator.keywords}
                    any_order = options.get("fastmath", "{'contract'}") != "{'contract'}"
                    inlined = "forceinline" in options or options.get("inline") == "'always'"
                    names -= {function.name}
                    kernel = _Kernel(path, function.name, frozenset(names), any_order, inlined)
                    found.append(kernel)
    return tuple(found)


@cache
def _called(kernel: _Kernel, kernels: tuple[_Kernel, ...]) -> list[_Kernel]:
    """The kernels that one calls: those of its own file, and those that this imports."""
    imported = {
        (node.module.split(".")[-1], name.name)
        for node in ast.walk(ast.parse(kernel.path.read_text("utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module
        for name in node.names
    }
    return [
        other
        for other in kernels
        if other.name in kernel.calls
        and (other.path == kernel.path or (other.path.stem, other.name) in imported)
    ]


def _sums_in_any_order(kernel: _Kernel, kernels: tuple[_Kernel, ...]) -> bool:
    """Whether the code of a kernel, with what is inlined, sums in any order."""
    return kernel.any_order or any(
        other.inlined and _sums_in_any_order(other, kernels) for other in _called(kernel, kernels)
    )


def test_sums_in_any_order_are_inlined_up_to_the_kernel_that_python_calls(
    project_root: Path,
) -> None:
    kernels = _kernels(project_root / "detect")
    free = {kernel for kernel in kernels if _sums_in_any_order(kernel, kernels)}
    assert {"place_discs", "fit_disc", "gather", "edge_shares"} <= {each.name for each in free}
    called = {other for kernel in kernels for other in _called(kernel, kernels)}
    assert {str(kernel) for kernel in free & called if not kernel.inlined} == set()
