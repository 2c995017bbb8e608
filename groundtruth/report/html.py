"""HTML as a tree of elements, whose serialiser escapes all text and attributes: pages, tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from xml.etree.ElementTree import Element, tostring

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.45 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #1b1a18;
  background: #fff; max-width: 50rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; margin: .4rem 0; } h2 { font-size: 1.2rem; margin: 2rem 0 .4rem;
  border-bottom: 1px solid #bbb; }
a { color: #14508a; } a:focus, [tabindex]:focus { outline: 3px solid #14508a; outline-offset: 2px; }
.skip { position: absolute; left: -99rem; } .skip:focus { position: static; }
nav ul { padding: 0; margin: .5rem 0; } nav li { display: inline-block; margin-right: 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .86rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; padding: .3rem 0; color: #444; }
th, td { padding: .15rem .6rem .15rem 0; text-align: right; border-bottom: 1px solid #e3e1dd;
  vertical-align: top; }
th[scope=row], td.text, th.text { text-align: left; overflow-wrap: break-word; }
svg, img { max-width: 100%; height: auto; display: block; } figure { margin: .6rem 0; }
figcaption { font-size: .86rem; color: #444; }
.problem { border-left: 4px solid #a8321e; padding-left: .7rem; }
.note { color: #444; font-size: .9rem; }
@media print { @page { margin: 14mm; } body { font-size: 10pt; max-width: none; padding: 0; }
  nav, .skip { display: none; } figure, tr { break-inside: avoid; }
  h2, caption, thead { break-after: avoid; }
  .wide { overflow: visible; } a { color: inherit; text-decoration: none; } }
"""


def page(title: str, sections: Sequence[tuple[str, str, Sequence[Element]]]) -> bytes:
    """A whole page, UTF-8.

    Parameters
    ----------
    title : str
    sections : sequence of (str, str, sequence of Element)
        Each one's id, heading and content.
    """
    head = element(
        "head",
        element("meta", charset="utf-8"),
        # Were anything to slip through, it could load and run nothing.
        element(
            "meta",
            content="default-src 'none'; style-src 'unsafe-inline'; img-src data:",
            **{"http-equiv": "Content-Security-Policy"},
        ),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", title),
        element("style", _STYLE),
    )
    links = (element("li", element("a", name, href=f"#{key}")) for key, name, _ in sections)
    parts = (
        element(
            "section",
            element("h2", name, id=f"{key}-head"),
            *content,
            id=key,
            **{"aria-labelledby": f"{key}-head"},
        )
        for key, name, content in sections
    )
    body = element(
        "body",
        element("a", "To the contents", href="#main", **{"class": "skip"}),
        element(
            "header",
            element("h1", title),
            element("nav", element("ul", *links), **{"aria-label": "Sections"}),
        ),
        element("main", *parts, id="main"),
    )
    tree = element("html", head, body, lang="en")
    text = "<!DOCTYPE html>\n" + tostring(tree, encoding="unicode", method="html") + "\n"
    return text.encode("utf-8")


def element(tag: str, *content: Element | str, **attributes: str) -> Element:
    """An element; text may stand between elements."""
    made = Element(tag, {name: _clean(value) for name, value in attributes.items()})
    last: Element | None = None
    for part in content:
        if isinstance(part, Element):
            made.append(part)
            last = part
        elif last is None:
            made.text = (made.text or "") + _clean(part)
        else:
            last.tail = (last.tail or "") + _clean(part)
    return made


def _clean(text: str) -> str:
    """Without characters that no page may hold."""
    return "".join(
        c
        if (c >= " " or c in "\n\t") and not "\ud800" <= c <= "\udfff" and c != "\x7f"
        else "\ufffd"
        for c in text
    )


def paragraph(*content: Element | str, kind: str = "") -> Element:
    """A paragraph, perhaps of the class `note` or `problem`."""
    return element("p", *content, **({"class": kind} if kind else {}))


def table(
    caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], text: Sequence[int] = ()
) -> Element:
    """A table whose first column names the row; the columns in `text` are words, not numbers."""
    columns = [
        element("th", name, scope="col", **({"class": "text"} if k == 0 or k in text else {}))
        for k, name in enumerate(head)
    ]
    lines = []
    for row in rows:
        cells = [element("th", row[0], scope="row")]
        cells += [
            element("td", word, **({"class": "text"} if k in text else {}))
            for k, word in enumerate(row[1:], 1)
        ]
        lines.append(element("tr", *cells))
    whole = element(
        "table",
        element("caption", caption),
        element("thead", element("tr", *columns)),
        element("tbody", *lines),
    )
    # Wide tables scroll by themselves, by keyboard too.
    return element(
        "div", whole, tabindex="0", role="region",
        **{"class": "wide", "aria-label": caption},
    )  # fmt: skip


def figure(caption: str, *drawings: Element) -> Element:
    """Drawings over their caption."""
    return element("figure", *drawings, element("figcaption", caption))
