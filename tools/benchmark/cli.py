"""Command line of the benchmark."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import tyro
from tyro.conf import OmitArgPrefixes

from tools.benchmark.suite import Settings


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
    force : bool
        Replace existing files.
    """

    json: Path | None = None
    plot: Path | None = None
    markdown: Path | None = None
    force: bool = False
    settings: OmitArgPrefixes[Settings] = field(default_factory=Settings)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    command = tyro.cli(Benchmark, prog="python -m tools.benchmark", args=arguments)
    try:
        return _carry_out(command)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _carry_out(command: Benchmark) -> int:
    from rich.console import Console

    from storage import OutputExistsError, write_whole
    from tools.benchmark.plot import plot_png
    from tools.benchmark.report import format_markdown, result_tables
    from tools.benchmark.result import format_json
    from tools.benchmark.suite import benchmark

    for path in (command.json, command.plot, command.markdown):
        if path is not None and path.exists() and not command.force:
            raise OutputExistsError(path)
    with Console(stderr=True).status("") as status:
        result = benchmark(command.settings, status.update)
    Console().print(result_tables(result))
    for path, content in (
        (command.json, format_json(result).encode()),
        (command.markdown, format_markdown(result).encode()),
        (command.plot, None),
    ):
        if path is not None:
            with write_whole(path, overwrite=command.force) as stream:
                stream.write(plot_png(result) if content is None else content)
    return 0
