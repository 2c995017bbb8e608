"""The parts of the reports of comparisons."""

from __future__ import annotations

import io
from collections.abc import Iterable

from rich import box
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from detect.comparison.result import NormalisedError

NONE = "-"


def summary_table(rows: Iterable[tuple[str, str]]) -> Table:
    """A table of names and values, which may wrap."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, Text(value))
    return table


def titled_table(title: str) -> Table:
    """Make a table without columns yet."""
    return Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0)


def plain_text(tables: RenderableType, width: int) -> str:
    """Render as plain text of at most `width` columns, without colour."""
    stream = io.StringIO()
    console = Console(file=stream, width=width, color_system=None, force_terminal=False)
    console.print(tables)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()) + "\n"


def frames_text(compared: int, only_reference: int, only_detected: int, *, counted: bool) -> str:
    """Say how many frames were compared, and what became of those that only one file has."""
    return (
        f"{compared} compared; {only_reference} only in the reference, "
        f"{only_detected} only detected ({'counted' if counted else 'not counted'})"
    )


def rows_text(reference: int, detected: int, set_aside: int, *, only_identified: bool) -> str:
    """Say how many rows count."""
    text = f"{reference} reference, {detected} detected"
    if only_identified:
        text += f" (with an ID only; {set_aside} on rows without one set aside)"
    elif set_aside:
        text += f" ({set_aside} more on what is in view but not listed: neither right nor wrong)"
    return text


def normalised_error_text(error: NormalisedError) -> str:
    """Say how large normalised errors are, and how large they should be."""
    if error.band is None:
        return NONE
    low, high = error.band
    return (
        f"{number(error.per_dof, 3)} squared per degree of freedom "
        f"(95 % band {low:.3f} to {high:.3f})"
    )


def number(value: float | None, decimals: int) -> str:
    """A figure, or a dash where there is none."""
    if value is None:
        return NONE
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # adding 0 makes -0 a 0


def printable(name: str) -> str:
    """A name from a file, with control characters escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in name)
