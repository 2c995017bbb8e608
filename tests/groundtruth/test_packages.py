"""Packages of the room import only from those below them."""

from __future__ import annotations

import ast
from pathlib import Path

BELOW = {
    "geometry": set[str](),
    "trajectories": {"geometry"},
    "markers": {"geometry", "trajectories"},
    "lasers": {"geometry", "trajectories"},
    "fusion": {"geometry", "trajectories"},
    "clocks": {"trajectories", "fusion"},
    "validation": {"geometry", "trajectories", "lasers", "clocks"},
    "report": {"trajectories", "lasers", "clocks", "validation"},
    "commands": {
        "geometry", "trajectories", "markers", "lasers", "fusion", "clocks", "validation", "report",
    },
}  # fmt: skip
FOR_ALL = {"errors", "json_file", "text_file"}


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
    for name in ("json_file", "text_file"):
        assert imported(room / f"{name}.py") == {"errors"}
    assert imported(room / "cli.py") == {"commands"}
