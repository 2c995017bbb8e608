"""What ``detect compare`` prints of a comparison, as plain text."""

from __future__ import annotations

import io

from rich.console import Console

from detect.comparison.report import comparison_tables
from detect.comparison.result import Comparison


def format_text(comparison: Comparison, width: int = 100) -> str:
    """The tables of a comparison in `width` columns, without colour."""
    stream = io.StringIO()
    Console(file=stream, width=width, color_system=None, force_terminal=False).print(
        comparison_tables(comparison)
    )
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()) + "\n"
