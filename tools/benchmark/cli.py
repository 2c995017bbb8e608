"""Command line of the benchmark."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import tyro
from tyro.conf import OmitArgPrefixes

from redetect.storage.command_line import exit_code_of
from tools.benchmark.suite import Settings

_FILE_WIDTH = 110


@dataclass(frozen=True)
class Benchmark:
    """Time the detectors, their parts and peers side by side, in one process.

    Example: python -m tools.benchmark --photographs ../shared/data/discs --plot /tmp/speed.png

    Parameters
    ----------
    json : Path
        Write everything as JSON.
    plot : Path
        Draw the ratios and the growth curves into a PNG.
    markdown : Path
        Write the main tables as Markdown.
    readme : Path
        Put a short table between the two benchmark marks of this document.
    force : bool
        Replace existing files.
    """

    json: Path | None = None
    plot: Path | None = None
    markdown: Path | None = None
    readme: Path | None = None
    force: bool = False
    settings: OmitArgPrefixes[Settings] = field(default_factory=Settings)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    command = tyro.cli(Benchmark, prog="python -m tools.benchmark", args=arguments)
    return exit_code_of(lambda: _carry_out(command))


def _carry_out(command: Benchmark) -> int:
    from rich.console import Console

    from redetect.storage import OutputExistsError, write_whole
    from tools.benchmark.plot import plot_png
    from tools.benchmark.report import format_headline, format_markdown, result_tables, spliced
    from tools.benchmark.result import format_json
    from tools.benchmark.suite import benchmark

    for path in (command.json, command.plot, command.markdown):
        if path is not None and path.exists() and not command.force:
            raise OutputExistsError(path)
    if command.readme is not None:
        spliced(command.readme.read_text(), "")  # that there are marks is known before any work
    # No moving display: its thread would be measured as well.
    result = benchmark(command.settings, lambda stage: print(stage, file=sys.stderr, flush=True))
    # Where there is no terminal, tables need not fold.
    Console(width=None if sys.stdout.isatty() else _FILE_WIDTH).print(result_tables(result))
    for path, content in (
        (command.json, format_json(result).encode()),
        (command.markdown, format_markdown(result).encode()),
        (command.plot, None),
    ):
        if path is not None:
            with write_whole(path, overwrite=command.force) as stream:
                stream.write(plot_png(result) if content is None else content)
    if command.readme is not None:
        document = spliced(command.readme.read_text(), format_headline(result))
        with write_whole(command.readme, overwrite=True) as stream:
            stream.write(document.encode())
    return 0
