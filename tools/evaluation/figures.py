"""What studies measure, kept in files, and put into the documents that quote it."""

from __future__ import annotations

import io
import json
import shlex
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined
from tyro.conf import Positional

from redetect.cli import PROGRAMS
from redetect.groundtruth.files import write_json
from redetect.interface.tables import plain
from redetect.storage import __version__, write_bytes

#: A figure that a study has under this name counts what must not happen.
WRONG = "wrong"
_MADE = "<!-- Made of {} and docs/figures by `python -m tools.evaluation documents`. -->\n"


class StudyError(ValueError):
    """A study that cannot be carried out."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """Something that is measured."""

    figures: Path | None = None  # Also write the figures into this file, as JSON.

    def measured(self) -> Mapping[str, Any]:
        """Measure, and print what comes out; returns the figures by name."""
        raise NotImplementedError

    def carried_out(self, command: Sequence[str]) -> int:
        """Measure, and write the figures with the command line; returns the exit code."""
        found = self.measured()
        if self.figures is not None:
            head = {"command": shlex.join(command), "version": __version__}
            write_json(self.figures, {**head, "figures": plain(found)}, overwrite=True)
        return int(found.get(WRONG, 0) > 0)


def run_program(program: str, *arguments: object) -> None:
    """Run a program of the project, or a script (`tools.simulator`), quietly in this process."""
    words, said = [str(argument) for argument in arguments], io.StringIO()
    with redirect_stdout(said):
        code = import_module(PROGRAMS.get(program, f"{program}.__main__")).main(words)
    if code != 0:
        text = " ".join([program, *words])
        raise StudyError(f"{text} ended with {code}: {said.getvalue().strip()[-500:]}")


@dataclass(frozen=True)
class Programs(Study):
    """Run command lines of the project one after the other, in which @ is an empty folder.

    The figures are the numbers of the JSON files that they write there, logs aside.
    """

    commands: Positional[tuple[str, ...]]  # Each in quotes: `detect circles RUN -o @/x.circles`.

    def measured(self) -> Mapping[str, Any]:
        with tempfile.TemporaryDirectory() as folder:
            for command in self.commands:
                print(command, flush=True)
                run_program(*shlex.split(command.replace("@", folder)))
            files = [path for path in sorted(Path(folder).glob("*.json")) if "." not in path.stem]
            return {path.stem: numbers_in(json.loads(path.read_text())) for path in files}


def numbers_in(content: Mapping[str, Any]) -> dict[str, Any]:
    """The numbers of a JSON object and of those in it; texts and lists are left out."""
    nested = {k: numbers_in(v) if isinstance(v, dict) else v for k, v in content.items()}
    return {k: v for k, v in nested.items() if isinstance(v, int | float | dict)}


def documents(root: Path) -> dict[Path, str]:
    """Every page that quotes figures, by its place: of the template beside it, `PAGE.jinja`."""
    environment = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters["to"] = _formatted
    files = sorted((root / "docs/figures").glob("*.json"))
    figures = {f.stem.replace("-", "_"): json.loads(f.read_text("utf-8"))["figures"] for f in files}
    templates = [root / "README.md.jinja", *sorted((root / "docs").rglob("*.md.jinja"))]
    return {
        template.with_suffix(""): _MADE.format(template.relative_to(root).as_posix())
        + environment.from_string(template.read_text("utf-8")).render(figures)
        for template in templates
    }


def _formatted(value: float | None, form: str) -> str:
    """A figure as pages show it; none is a dash."""
    return "\N{EN DASH}" if value is None else format(value, form).replace("-", "\N{MINUS SIGN}")


@dataclass(frozen=True)
class Documents(Study):
    """Put the figures of docs/figures into the documents: run from a checkout."""

    def measured(self) -> Mapping[str, Any]:
        pages = documents(Path())
        for page, text in pages.items():
            write_bytes(page, text.encode(), overwrite=True)
        print(f"{len(pages)} pages: {', '.join(map(str, pages))}")
        return {}
