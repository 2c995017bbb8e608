"""Packages import only what the table in `CONTRIBUTING.md` allows."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

#: A row of the table: package or module, responsibility, what it imports.
_ROW = re.compile(r"\| `([\w/.]+)` \| (.*) \| (.*) \|")
_PRODUCT = ("camera", "detect", "lut", "redetect", "ros")


def package_of(name: str) -> str:
    """The package that the table names, of a module's full name."""
    parts = name.split(".")
    return ".".join(parts[: 2 if parts[0] == "redetect" else 1])


def imported(module: Path) -> Iterator[str]:
    """Modules of this project that a module imports, late ones too."""
    for node in ast.walk(ast.parse(module.read_text("utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module == "redetect":
            names = [f"redetect.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            names = [node.module or ""]
        yield from (name for name in names if name.split(".")[0] in (*_PRODUCT, "tools", "tests"))


@pytest.fixture(scope="module")
def text(project_root: Path) -> str:
    return (project_root / "CONTRIBUTING.md").read_text("utf-8").split("### A run")[0]


@pytest.fixture(scope="module")
def for_all(text: str) -> set[str]:
    """Modules that every package may import."""
    modules = re.findall(r"^- `(\w+)\.py`", text, re.MULTILINE)
    return {f"redetect.{name}" for name in (*modules, "__version__")}


@pytest.fixture(scope="module")
def allowed(text: str) -> dict[str, set[str]]:
    """What each package may import besides."""
    return {
        row[1].strip("/").removesuffix(".py").replace("/", "."): set(
            re.findall(r"`([\w.]+)`", row[3])
        )
        for row in _ROW.finditer(text)
        if row[3] not in ("anything", "all of these")
    }


def test_packages_import_what_the_table_allows(
    project_root: Path, allowed: dict[str, set[str]], for_all: set[str]
) -> None:
    checked = set()
    for folder in _PRODUCT:
        for module in sorted((project_root / folder).rglob("*.py")):
            name = ".".join(module.relative_to(project_root).with_suffix("").parts)
            package = package_of(name)
            found = set(map(package_of, imported(module))) - {package, "redetect"}
            assert not {name for name in found if name.startswith(("tools", "tests"))}, module
            if package in allowed:
                checked.add(package)
                assert found - for_all <= allowed[package], module
            elif package in for_all:
                assert found <= for_all, module
    assert {"camera", "detect", "lut", "redetect.landmarks", "redetect.slam"} <= checked


def test_only_commands_and_their_programs_import_commands(project_root: Path) -> None:
    """A command's module reads, calls, prints and writes; what others call is elsewhere."""
    for folder in (*_PRODUCT, "tools"):
        for module in (project_root / folder).rglob("*.py"):
            if "commands" in module.parts or module.name == "cli.py":
                continue
            assert not [name for name in imported(module) if ".commands" in name], module
            if folder != "tools":
                assert "\ndef perform" not in module.read_text("utf-8"), module


def test_tools_need_no_tests(project_root: Path) -> None:
    for module in (project_root / "tools").rglob("*.py"):
        assert not [name for name in imported(module) if name.split(".")[0] == "tests"], module


def test_no_two_packages_import_each_other(allowed: dict[str, set[str]]) -> None:
    assert len(allowed) >= 11
    for package, others in allowed.items():
        assert others - {"redetect"} <= allowed.keys(), package
        for other in others & allowed.keys():
            assert package not in allowed[other], (package, other)
