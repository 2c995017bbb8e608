"""The tables of a comparison, for a terminal or a page."""

from __future__ import annotations

from dataclasses import astuple
from typing import Any, NamedTuple

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from detect.comparison.result import WORST_FRAMES, Comparison, DiscComparison, in_mm, number
from redetect.messages import one_line


class FigureTable(NamedTuple):
    """A table of formatted figures, for a terminal or a page."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def comparison_tables(comparison: Comparison) -> Group:
    """Format a comparison for a rich console, which omits colour if there is no terminal.

    It has sentences, all figures, those over distance (of discs), and the worst frames.
    """
    summary = Table(box=None, show_header=False, pad_edge=False)
    summary.add_column(style="bold", no_wrap=True)
    summary.add_column(overflow="fold")
    for name, value in summary_rows(comparison).items():
        summary.add_row(name, Text(value))
    tables: list[Table | str] = [*comparison.sentences(), "", summary]
    if comparison.reference or comparison.detected:
        tables.append("")
        if isinstance(comparison, DiscComparison):
            tables.append(_rich_table(_over_distance(comparison)))
            if comparison.pairs.levelled_apart:
                tables.append(_rich_table(floor_table(comparison)))
        tables.append(_rich_table(worst_frames_table(comparison, WORST_FRAMES)))
    return Group(*tables)


def summary_rows(c: Comparison) -> dict[str, str]:
    """All figures that are numbers or words, by their names in the JSON, without options."""
    rows = {}
    for name, value in c.figures().items():
        if name == "options":
            continue
        inner = value if isinstance(value, dict) else {"": value}
        for part, figure in inner.items():
            if (shown := _shown(figure)) is not None:
                rows[f"{name} {part}".strip().replace("_", " ")] = shown
    return rows


def _shown(figure: Any) -> str | None:
    """A formatted figure, for a list of frames their number; None for a table."""
    if isinstance(figure, list):
        if figure and isinstance(figure[0], dict):
            return None
        is_band = figure and isinstance(figure[0], float)
        return " to ".join(f"{end:.3f}" for end in figure) if is_band else str(len(figure))
    if isinstance(figure, float):
        return f"{figure:.4g}"
    return "-" if figure is None else one_line(str(figure))


def _over_distance(c: DiscComparison) -> FigureTable:
    head = ("metres", "ref.", "missed", "recall", "det.", "extra", "prec.", "error mm")
    rows = []
    for part in c.bins:
        if part.reference or part.detected:
            recall, precision = (number(value, 3) for value in (part.recall, part.precision))
            wanted, found = (part.reference, part.missed), (part.detected, part.extra)
            rates = (*map(str, wanted), recall, *map(str, found), precision)
            rows.append((str(part), *rates, in_mm(part.error_median_m)))
    return FigureTable("By forward distance (position error: median)", head, tuple(rows))


def floor_table(c: DiscComparison) -> FigureTable:
    """Differences on the floor by forward distance, as the rows are and levelled alike."""
    rows = []
    for part in c.bins:
        if part.as_written.pairs and part.alike is not None:
            figures = [*astuple(part.as_written)[1:], *astuple(part.alike)[1:]]
            rows.append((str(part), str(part.as_written.pairs), *map(in_mm, figures)))
    caption = (
        "On the floor, mm: detected minus reference as they are written; the same levelled alike\n"
        "(along: farther away, across: to the left; medians)"
    )
    head = ("median", "95 %", "along", "across")
    return FigureTable(caption, ("metres", "pairs", *head, "alike", *head[1:]), tuple(rows))


def worst_frames_table(c: Comparison, most: int) -> FigureTable:
    """The frames with most missed and extra rows."""
    rows = []
    for match in c.worst_frames(most):
        largest = match.largest_error
        error = in_mm(largest) if c.unit == "m" else number(largest, 3)
        rows.append((match.name, *(str(len(getattr(match, n))) for n in c.counts), error))
    unit = "mm" if c.unit == "m" else c.unit
    return FigureTable("Worst frames", ("image", *c.counts, f"largest error {unit}"), tuple(rows))


def _rich_table(figures: FigureTable) -> Table:
    table = Table(title=figures.caption, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    for k, heading in enumerate(figures.head):
        table.add_column(heading, justify="right" if k else "left", overflow="fold")
    for row in figures.rows:
        table.add_row(*(Text(one_line(word)) for word in row))
    return table
