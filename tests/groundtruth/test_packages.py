"""Packages of the room import only from those below them."""

from __future__ import annotations

import ast
from pathlib import Path

BELOW = {
    "trajectories": set[str](),
    "markers": {"trajectories"},
    "lasers": {"trajectories"},
    "fusion": {"trajectories"},
    "validation": {"trajectories", "lasers", "fusion"},
    "report": {"trajectories", "markers", "lasers", "fusion", "validation"},
    "commands": {"trajectories", "markers", "lasers", "fusion", "validation", "report", "options"},
}
FOR_ALL = {"errors", "files", "settings"}


def imported(module: Path) -> set[str]:
    """Third parts of the names of the room's modules that a module imports, late ones too."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(module.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    parts = (name.split(".") for name in names)
    return {part[2] for part in parts if part[:2] == ["redetect", "groundtruth"]}


def test_arrows_point_downwards(project_root: Path) -> None:
    room = project_root / "redetect" / "groundtruth"
    assert {path.parent.name for path in room.glob("*/__init__.py")} == set(BELOW)
    for package, below in BELOW.items():
        modules = sorted((room / package).glob("*.py"))
        assert len(modules) > 1
        for module in modules:
            allowed = below | FOR_ALL | {package, "__version__"}
            assert imported(module) <= allowed, module
    assert imported(room / "errors.py") == set()
    assert imported(room / "files.py") == {"errors"}
    assert imported(room / "cli.py") == {"options"}
