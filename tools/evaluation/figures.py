"""What studies measure, kept in files, and put into the documents that quote it."""

from __future__ import annotations

import io
import json
import math
import shlex
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence, Sized
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jinja2 import Environment, StrictUndefined
from tyro.conf import Positional

from redetect import __version__
from redetect.cli import PROGRAMS
from redetect.command_line import exit_code_of
from redetect.groundtruth.files import write_json
from redetect.json_text import json_text
from redetect.storage import write_bytes
from tools.benchmark.timing import number

#: Figures by name, or further figures by theirs.
Figures = Mapping[str, Any]
#: A figure that a study has under this name counts what must not happen.
WRONG = "wrong"
_MADE = "<!-- Made of {} and docs/figures by `python -m tools.evaluation documents`. -->\n"


class StudyError(ValueError):
    """A study that cannot be carried out."""


def demand_some(things: Sized, what: str) -> None:
    """Raise a `StudyError` if there are none of what a study is about."""
    if not len(things):
        raise StudyError(f"{what}: there are none, expected at least one")


@dataclass(frozen=True, kw_only=True)
class Study:
    """Something that is measured."""

    figures: Path | None = None  # Also write the figures into this file, as JSON.

    def measure(self) -> Figures:
        """Measure, and print what comes out; returns the figures by name."""
        raise NotImplementedError

    def carry_out(self, command: Sequence[str]) -> int:
        """Measure, and write figures (9 digits) with the command line; returns the exit code."""
        found = self.measure()
        if self.figures is not None:
            head = {"command": shlex.join(command), "version": __version__}
            text = json_text(found)
            # Further digits differ from machine to machine.
            kept = json.loads(text, parse_float=lambda digits: float(f"{float(digits):.9g}"))
            write_json(self.figures, {**head, "figures": kept}, overwrite=True)
        return int(found.get(WRONG, 0) > 0)


def study_main(kind: type[Study], program: str, arguments: Sequence[str] | None = None) -> int:
    """Run the command line of a study, ``python -m tools...``; returns the exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    study = tyro.cli(kind, prog=program, args=words)
    at = words.index("--figures") if "--figures" in words else len(words)
    command = [*program.split(), *words[:at], *words[at + 2 :]]
    kept = [word for word in command if not word.startswith("--figures=")]
    return exit_code_of(lambda: study.carry_out(kept))


def print_figures(figures: Figures) -> None:
    """Print figures, a line for each: numbers, and lists of numbers."""
    for name, value in figures.items():
        print(f"{name:<28}", *(f"{number:.6g}" for number in np.atleast_1d(value)))


def run_program(program: str, *arguments: object) -> None:
    """Run a program of the project, or a script (`tools.simulator`), quietly in this process."""
    words = [str(argument) for argument in arguments]
    main = import_module(PROGRAMS.get(program, f"{program}.__main__")).main
    run_quietly(" ".join([program, *words]), lambda: main(words))


def run_quietly(what: str, work: Callable[[], int]) -> None:
    """Do something that prints and ends with an exit code; a `StudyError` unless that is 0."""
    said = io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        try:
            code: object = work()
        except SystemExit as end:  # of a wrong flag
            code = end.code
    if code != 0:
        raise StudyError(f"{what} ended with {code}: {' '.join(said.getvalue().split())[-500:]}")


def compared(run: Path, detected: Path, *flags: object) -> dict[str, Any]:
    """What `detect compare` finds of a run's rows."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "compared.json"
        run_program("detect", "compare", run, "--detected", detected, *flags, "--json", file)
        return dict(json.loads(file.read_text()))


@dataclass(frozen=True)
class Programs(Study):
    """Run command lines of the project one after the other; @ in them is an empty folder.

    The figures are the numbers in the JSON files that they write there, except logs.
    """

    commands: Positional[tuple[str, ...]]  # Each in quotes: `detect circles RUN -o @/x.circles`.

    def measure(self) -> Figures:
        demand_some(self.commands, "commands")
        with tempfile.TemporaryDirectory() as folder:
            for command in self.commands:
                print(command, flush=True)
                run_program(*shlex.split(command.replace("@", folder)))
            files = [path for path in sorted(Path(folder).glob("*.json")) if "." not in path.stem]
            return {path.stem: numbers_in(json.loads(path.read_text())) for path in files}


def numbers_in(content: Figures) -> dict[str, Any]:
    """The numbers of a JSON object and its nested objects, without texts and lists."""
    nested = {k: numbers_in(v) if isinstance(v, dict) else v for k, v in content.items()}
    return {k: v for k, v in nested.items() if isinstance(v, int | float | dict)}


def documents(root: Path) -> dict[Path, str]:
    """Every page that quotes figures, by its place: of the template beside it, `PAGE.jinja`."""
    environment = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters.update(to=_formatted, degrees=math.degrees, number=number)
    files = sorted((root / "docs/figures").glob("*.json"))
    figures = {f.stem.replace("-", "_"): json.loads(f.read_text("utf-8"))["figures"] for f in files}
    templates = [root / "README.md.jinja", *sorted((root / "docs").rglob("*.md.jinja"))]
    return {
        template.with_suffix(""): _MADE.format(template.relative_to(root).as_posix())
        + environment.from_string(template.read_text("utf-8")).render(figures)
        for template in templates
    }


def _formatted(value: float | None, form: str) -> str:
    """A figure as pages show it; none is a dash. The + raises where there is no such figure."""
    return "\N{EN DASH}" if value is None else format(+value, form).replace("-", "\N{MINUS SIGN}")


@dataclass(frozen=True)
class Documents(Study):
    """Insert the figures of docs/figures into the documents; run it from a checkout."""

    def measure(self) -> Figures:
        pages = documents(Path())
        for page, text in pages.items():
            write_bytes(page, text.encode(), overwrite=True)
        print(f"{len(pages)} pages: {', '.join(map(str, pages))}")
        return {}
