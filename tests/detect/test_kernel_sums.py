"""Kernels that may sum in any order are inlined up to the kernel that Python calls.

Otherwise the compiler optimises them once by themselves and once within their caller. A process
that has just compiled both calls the former, one that loads them from the cache the latter, and
their last digits differ.
"""

from __future__ import annotations

import ast
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


def _imports(path: Path) -> set[tuple[str, str]]:
    """Modules and names that a file imports."""
    return {
        (node.module.split(".")[-1], name.name)
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module
        for name in node.names
    }


def test_sums_in_any_order_are_inlined_up_to_the_kernel_that_python_calls(
    project_root: Path,
) -> None:
    kernels = _kernels(project_root / "detect")
    imported = {path: _imports(path) for path in {kernel.path for kernel in kernels}}
    #: Of each kernel those that it calls: of its own file, and those that this imports.
    called = {
        own: [
            other
            for other in kernels
            if other.name in own.calls
            and (other.path == own.path or (other.path.stem, other.name) in imported[own.path])
        ]
        for own in kernels
    }
    # With what is inlined, their code sums in any order.
    free = {kernel for kernel in kernels if kernel.any_order}
    while more := {k for k in kernels if any(c.inlined and c in free for c in called[k])} - free:
        free |= more
    assert {"fit_discs", "_fit_disc", "gather", "edge_shares"} <= {each.name for each in free}
    called_ones = {other for others in called.values() for other in others}
    assert {str(kernel) for kernel in free & called_ones if not kernel.inlined} == set()
