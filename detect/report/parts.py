"""The parts of a report, of which the template ``page.html`` makes a page."""

from __future__ import annotations

import base64
from typing import NamedTuple


class Part(NamedTuple):
    """A piece of a section; its kind says what the template makes of it.

    `words` are the text or the caption. Rows of figures are names and values, those of a key
    colours and words. `left` are the columns of a table that have text, `bold` the rows to point
    out.
    """

    kind: str
    words: str = ""
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    left: tuple[int, ...] = (0,)
    bold: tuple[int, ...] = ()
    address: str = ""
    width: int = 0
    height: int = 0


class Section(NamedTuple):
    """A section with its heading."""

    key: str
    name: str
    parts: list[Part]


def image_part(words: str, content: bytes, kind: str, width: float, height: float) -> Part:
    """An image with its caption; `kind` is its type behind ``image/``."""
    address = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    return Part("image", words, address=address, width=round(width), height=round(height))
