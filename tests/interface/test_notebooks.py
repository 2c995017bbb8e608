"""The notebooks of `examples/` run, cell by cell, and show what their cells end with."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import pytest


def run_cells(notebook: Path) -> list[Any]:
    """Run all cells of a notebook as Jupyter does; the values that it would show."""
    content = json.loads(notebook.read_text("utf-8"))
    assert content["nbformat"] == 4
    names: dict[str, Any] = {"__name__": "__main__"}
    shown = []
    for number, cell in enumerate(content["cells"]):
        if cell["cell_type"] != "code":
            continue
        assert cell["outputs"] == []
        assert cell["execution_count"] is None
        tree = ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        where = f"{notebook.name}:{number}"
        exec(compile(tree, where, "exec"), names)
        if isinstance(last, ast.Expr):
            shown.append(eval(compile(ast.Expression(last.value), where, "eval"), names))
    return [value for value in shown if value is not None]


@pytest.mark.long
def test_photographs_to_map(project_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(project_root)
    shown = run_cells(project_root / "examples" / "photographs_to_map.ipynb")
    assert len(shown) == 5
    for value in shown:
        assert "<p>" in value._repr_html_() or "<table>" in value._repr_html_()
    assert shown[3].recall > 0.95  # the comparison
    assert shown[4].chi_squared_factor < 2.0  # the map


@pytest.mark.long
def test_the_real_data_set(
    project_root: Path, shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = shared_data / "dlr" / "e"
    if not (run / "map.circles").is_file() or not list(run.glob("*.cam")):
        pytest.skip("run e of the DLR Spatial Cognition data set is not on this machine")
    monkeypatch.setenv("REDETECT_DLR_RUN", str(run))
    shown = run_cells(project_root / "examples" / "real_data_set.ipynb")
    assert len(shown) == 4
    assert shown[2].recall > 0.94
