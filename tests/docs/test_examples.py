"""Examples in documents run: those marked so, page by page, beside a copy of the demo run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.blocks import Block, blocks_of, documents, shell_lines

ROOT = Path(__file__).resolve().parents[2]
BLOCKS = [block for document in documents(ROOT) for block in blocks_of(document)]
PAGES = sorted({block.document for block in BLOCKS if block.runs})


@pytest.mark.long
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_examples_run(page: Path, tmp_path: Path) -> None:
    """All blocks of a page one after the other, in a folder with the demo runs in it."""
    shutil.copytree(
        ROOT / "images", tmp_path / "images", ignore=shutil.ignore_patterns("detected*")
    )
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "OPENBLAS_NUM_THREADS": "1",
        "TMPDIR": str(tmp_path),
    }
    for block in BLOCKS:
        if block.document == page and block.runs:
            done = subprocess.run(
                command_for(block), cwd=tmp_path, env=environment, capture_output=True, text=True,
                check=False,
            )  # fmt: skip
            assert done.returncode == 0, f"{block.name}\n{done.stdout}\n{done.stderr}"


def command_for(block: Block) -> list[str]:
    if block.language == "python":
        return [sys.executable, "-W", "error", "-c", "\n".join(block.lines)]
    assert block.language in ("console", "bash"), f"{block.name}: {block.language} does not run"
    return ["bash", "-euc", "\n".join(text for _, text in shell_lines(block))]


def test_python_in_documents_is_python() -> None:
    found = [block for block in BLOCKS if block.language == "python"]
    assert len(found) >= 3
    for block in found:
        compile("\n".join(block.lines), block.name, "exec")


def test_the_tutorial_runs_all_the_way() -> None:
    (page,) = (page for page in PAGES if page.name == "tutorial.md")
    marked = [block for block in BLOCKS if block.document == page and block.runs]
    commands = "\n".join(text for block in marked for _, text in shell_lines(block))
    for command in ("camera calibrate", "camera floor", "detect all", "slam associate", "slam map"):
        assert command in commands
