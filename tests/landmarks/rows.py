"""A record from the text of its row."""

from __future__ import annotations

import io

from redetect.landmarks import Record, parse_rows


def parse_record(text: str) -> Record | None:
    """The record of a row in a file after a STEP; None for a comment or a blank line."""
    rows = f"STEP start {' '.join('0' * 9)}\n{text}".encode("utf-8", "surrogateescape")
    _, *found = parse_rows(io.BytesIO(rows))
    return found[0].record if found else None
