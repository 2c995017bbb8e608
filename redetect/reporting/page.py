"""The parts of a report, which ``page.html`` combines to a page, and the files of its figures.

A page has no scripts and loads nothing: its figures are data: addresses. Pages and figures are
reproducible, whatever the user's matplotlib settings are.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
from jinja2 import Environment, StrictUndefined
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

_DPI = 120
_TEMPLATE = Path(__file__).with_name("page.html")
_FORBIDDEN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f\ud800-\udfff]")


class Part(NamedTuple):
    """A part of a section; the template renders it by its kind.

    `words` are the text or the caption. Rows of figures are names and values, those of a key
    colours and labels, those of a list its points. `left` are the columns of a table that contain
    text, `marked` rows and columns of cells out of their range. Details are a collapsed table.
    """

    kind: str
    words: str = ""
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    left: tuple[int, ...] = (0,)
    marked: tuple[tuple[int, int], ...] = ()
    address: str = ""
    width: int = 0
    height: int = 0


class Section(NamedTuple):
    """A section with its heading."""

    key: str
    name: str
    parts: Sequence[Part]


def image_part(words: str, content: bytes, kind: str, width: float, height: float) -> Part:
    """An image with its caption; `kind` is its subtype after ``image/``."""
    address = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    return Part("image", words, address=address, width=round(width), height=round(height))


def page_of(title: str, sections: Sequence[Section]) -> bytes:
    """The whole page, UTF-8; all text is escaped, sections without parts are left out."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, finalize=printable
    )
    template = environment.from_string(_TEMPLATE.read_text("utf-8"))
    return (template.render(title=title, sections=sections).rstrip("\n") + "\n").encode("utf-8")


def printable(value: Any) -> Any:
    """Text without characters that are not allowed in a page; other values unchanged."""
    return _FORBIDDEN.sub("\ufffd", value) if type(value) is str else value


@contextmanager
def figure_file(
    size: tuple[float, float],
    kind: Literal["png", "svg"],
    *,
    framed: bool = False,
    dpi: int = _DPI,
    new: Callable[..., Figure] = Figure,
) -> Iterator[tuple[Figure, io.BytesIO]]:
    """An empty figure of a given width and height (inches) to draw into, and its file afterwards.

    `framed` axes have a line on all four sides; `new` is `matplotlib.pyplot.figure` for a window.
    """
    with mpl.rc_context():
        mpl.rcdefaults()
        # Names of parts are hashes with a fixed salt; text remains text, in the viewer's own font.
        mpl.rcParams.update({"svg.hashsalt": "redetect", "svg.fonttype": "none"})
        mpl.rcParams.update({"axes.spines.top": framed, "axes.spines.right": framed})
        figure = new(figsize=size, dpi=dpi, layout="constrained")
        if new is Figure:
            FigureCanvasAgg(figure)
        content = io.BytesIO()
        yield figure, content
        engine = figure.get_layout_engine()
        if new is Figure and kind == "png" and engine is not None:
            # Otherwise everything is drawn once more just for the layout.
            engine.execute(figure)
            figure.set_layout_engine(None)
        # Without date, name and version of the program, for reproducible bytes.
        nameless = {"Software": None} if kind == "png" else {"Date": None, "Creator": None}
        figure.savefig(content, format=kind, dpi=dpi, metadata=nameless)
