"""Content of the report's page and its conversion to HTML."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal
from xml.etree.ElementTree import Element, tostring

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from redetect.groundtruth.report.template import PAGE, STYLE

Kind = Literal["paragraph", "note", "problem", "table", "figure", "picture"]


@dataclass(frozen=True)
class Part:
    """A part of a section.

    Attributes
    ----------
    kind : str
        `paragraph`, `note` and `problem` are `words` alone.
    words : str
        The text; of others the caption.
    head, rows : tuples of str
        Of a `table`, whose first column names the row.
    text : tuple of int
        Its columns that are words, not numbers.
    drawings : tuple of Markup
        Of a `figure`.
    address, instead : str
        Of a `picture`: data, and what says the same in words.
    """

    kind: Kind
    words: str
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    text: tuple[int, ...] = ()
    drawings: tuple[Any, ...] = ()
    address: str = ""
    instead: str = ""


@dataclass(frozen=True)
class Section:
    """A section of the page: its anchor, its heading and its content."""

    key: str
    name: str
    parts: Sequence[Part]


def paragraph(words: str, kind: Literal["paragraph", "note", "problem"] = "paragraph") -> Part:
    """A paragraph; a `note` is small, a `problem` marked."""
    return Part(kind, words)


def table(
    caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], text: Sequence[int] = ()
) -> Part:
    """A table whose first column names the row; the columns in `text` are words, not numbers."""
    return Part("table", caption, tuple(head), tuple(tuple(row) for row in rows), tuple(text))


def figure(caption: str, *drawings: Element) -> Part:
    """Drawings over their caption."""
    # The serialiser has escaped all text and attributes in them.
    texts = (_printable(tostring(d, encoding="unicode", method="html")) for d in drawings)
    return Part("figure", caption, drawings=tuple(Markup(text) for text in texts))


def picture(caption: str, address: str, instead: str) -> Part:
    """A picture (a ``data:`` address) over its caption; `instead` is its alternative text."""
    return Part("picture", caption, address=address, instead=instead)


def page(title: str, sections: Sequence[Section]) -> bytes:
    """A whole page, UTF-8; all text is escaped."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, finalize=_clean
    )
    text = environment.from_string(PAGE).render(
        title=title,
        # The page's own, with quotation marks that are no text.
        style=Markup(STYLE),
        sections=sections,
    )
    return (text.rstrip("\n") + "\n").encode("utf-8")


def _clean(value: Any) -> Any:
    return _printable(value) if type(value) is str else value


def _printable(text: str) -> str:
    """Text without characters that no page may hold."""
    return "".join(
        c
        if (c >= " " or c in "\n\t") and not "\ud800" <= c <= "\udfff" and c != "\x7f"
        else "\ufffd"
        for c in text
    )
