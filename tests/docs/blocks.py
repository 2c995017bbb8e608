"""What documents show as code: fenced and indented blocks, and the command lines in them.

A fenced block with ``<!-- runs -->`` on the line above is run by `test_examples.py`.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from redetect.cli import PROGRAMS

RUNS = "<!-- runs -->"
#: What stands for something else, and is no word of a command line: `RUN…`, `...`.
_OPEN = re.compile(r"…|\.\.\.")


@dataclass(frozen=True)
class Block:
    """A block of code: where it begins (line, from 1), its language, its lines, whether it runs."""

    document: Path
    line: int
    language: str
    lines: tuple[str, ...]
    runs: bool

    @property
    def name(self) -> str:
        return f"{self.document.name}:{self.line}"


def documents(root: Path) -> list[Path]:
    """Every document of the project that people read."""
    single = (
        "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "examples/README.md",
        "images/README.md", "requirements/README.md", "ros/redetect_ros/README.md",
    )  # fmt: skip
    pages = sorted((root / "docs").rglob("*.md"))
    return [*(root / name for name in single), *pages]


def blocks_of(document: Path) -> Iterator[Block]:
    """The blocks of code of a document, fenced and indented."""
    lines = document.read_text("utf-8").splitlines()
    at = 0
    while at < len(lines):
        fence = re.match(r"( *)```([^`]*)$", lines[at])
        if fence:
            end = lines.index(f"{fence[1]}```", at + 1)
            inner = tuple(line.removeprefix(fence[1]) for line in lines[at + 1 : end])
            marked = at > 0 and lines[at - 1].strip() == RUNS
            yield Block(document, at + 2, fence[2].strip(), inner, marked)
            at = end + 1
        elif lines[at].startswith("    ") and (at == 0 or not lines[at - 1].strip()):
            end = at
            while end < len(lines) and (lines[end].startswith("    ") or not lines[end].strip()):
                end += 1
            yield Block(document, at + 1, "", tuple(line.strip() for line in lines[at:end]), False)
            at = end
        else:
            at += 1


def shell_lines(block: Block) -> Iterator[tuple[int, str]]:
    """The command lines of a block, with their line in the document; continued ones joined.

    Where lines begin with `$ `, the others are what is printed.
    """
    prompted = any(line.lstrip().startswith("$ ") for line in block.lines)
    joined, begun = "", 0
    for number, line in enumerate(block.lines, start=block.line):
        text = line.strip()
        if not joined:
            if prompted and not text.startswith("$ "):
                continue
            text, begun = text.removeprefix("$ "), number
        joined += text.removesuffix("\\")
        if text.endswith("\\"):
            continue
        yield begun, joined
        joined = ""


def commands_in(block: Block) -> Iterator[tuple[int, list[str]]]:
    """The words of the project's own commands in a block, with their line in the document.

    A loop's variable has the first of its values, and any other variable the value 1.
    """
    values: dict[str, str] = {}
    for number, text in shell_lines(block):
        for name, first in re.findall(r"\bfor (\w+) in ([\w./-]+)", text):
            values[name] = first
        text = re.sub(r"\$(\w+)", lambda found: values.get(found[1], "1"), text)
        # Loops, lists, and what follows them.
        for piece in re.split(r"&&|;|\|", re.sub(r"\bdo\b|\bdone\b", ";", text)):
            try:
                words = shlex.split(piece, comments=True)
            except ValueError:
                continue
            if words[:2] == ["python", "-m"] and len(words) > 2 and words[2].startswith("tools."):
                words = words[2:]
            elif not words or words[0] not in (*PROGRAMS, "redetect"):
                continue
            if len(words) > 1 and not any(_OPEN.search(word) for word in words):
                yield number, words
