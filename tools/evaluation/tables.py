"""Output of all studies: tables in Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any


class Table:
    """A table in Markdown that is printed row by row, and whose figures are kept.
    `columns` maps headings to formats (`7.2f`, `<22`); a column is as wide as either says. The
    first `keys` columns name a row: `figures` has a level for each, then values by heading.
    """

    def __init__(self, columns: Mapping[str, str], keys: int = 1) -> None:
        self.figures: dict[str, Any] = {}
        self._keys, self._headings = keys, list(columns)
        self._formats = list(columns.values())
        stated = [re.sub(r"\D.*", "", form.lstrip("<")) for form in self._formats]
        self._widths = [max(3, len(name), int(width or 0)) for name, width in zip(columns, stated)]
        self._print(columns)
        self._print("-" * width for width in self._widths)

    def row(self, *values: object) -> None:
        """Print a row; its values are in the order of the columns, None where one is not known."""
        pairs = zip(values, self._formats, strict=True)
        cells = ["-" if value is None else format(value, form) for value, form in pairs]
        self._print(cells)
        place = self.figures
        for cell in cells[: self._keys]:
            place = place.setdefault(cell.strip(), {})
        place.update(zip(self._headings[self._keys :], values[self._keys :]))

    def _print(self, cells: Iterable[str]) -> None:
        aligned = (
            cell.ljust(width) if form.startswith("<") else cell.rjust(width)
            for cell, width, form in zip(cells, self._widths, self._formats)
        )
        print(f"| {' | '.join(aligned)} |", flush=True)
