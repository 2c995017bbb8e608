"""Examples in documents run: those marked so, page by page, beside a copy of the demo run."""

from __future__ import annotations

import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from importlib import import_module
from pathlib import Path

import pytest

from redetect.cli import PROGRAMS
from tests.docs.blocks import Block, blocks_of, documents, shell_lines

ROOT = Path(__file__).resolve().parents[2]
BLOCKS = [block for document in documents(ROOT) for block in blocks_of(document)]
PAGES = sorted({block.document for block in BLOCKS if block.runs})


@pytest.mark.long
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_examples_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All blocks of a page one after the other, in a folder with the demo runs in it."""
    shutil.copytree(
        ROOT / "images", tmp_path / "images", ignore=shutil.ignore_patterns("detected*")
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    for block in BLOCKS:
        if block.document == page and block.runs:
            run(block)


def run(block: Block) -> None:
    """Do what a block says; the project's own programs in this process, which saves their start.

    A comment of Python that begins with an arrow, `# -> 5 discs`, is what is printed there.
    """
    if block.language == "python":
        text = "\n".join(block.lines)
        with redirect_stdout(io.StringIO()) as printed:
            exec(compile(text, block.name, "exec"), {"__name__": "__main__"})
        for words in re.findall(r"# -> (.*)", text):
            assert words in printed.getvalue().splitlines(), block.name
        return
    assert block.language in ("console", "bash"), f"{block.name}: {block.language} does not run"
    for line, text in shell_lines(block):
        program, *arguments = shlex.split(text, comments=True)
        if program in PROGRAMS:
            code = import_module(PROGRAMS[program]).main(arguments)
        elif text.startswith("python -m tools."):
            code = import_module(f"{arguments[1]}.__main__").main(arguments[2:])
        else:
            code = subprocess.run(["bash", "-euc", text], check=False).returncode
        assert code == 0, f"{block.document.name}:{line}: {text}"
