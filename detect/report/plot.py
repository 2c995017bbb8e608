"""Figures as files, the same each time, whatever the user's own matplotlib settings are."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

#: Colours that stay apart in print and for the colour-blind; differences remain without them.
DATA, SECOND, REFERENCE, MARK, BAND = "#1f5f99", "#b8560f", "#777777", "#a8321e", "#2a78b5"
_DPI = 120


@contextmanager
def figure_file(
    size: tuple[float, float], kind: Literal["png", "svg"]
) -> Iterator[tuple[Figure, io.BytesIO]]:
    """An empty figure of a width and height (inches) to draw into, and its file afterwards."""
    with mpl.rc_context():
        mpl.rcdefaults()
        # Names of parts are hashes with a fixed salt; text remains text, in the viewer's own font.
        mpl.rcParams.update({"svg.hashsalt": "redetect", "svg.fonttype": "none"})
        mpl.rcParams.update({"axes.spines.top": False, "axes.spines.right": False})
        figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
        FigureCanvasAgg(figure)
        content = io.BytesIO()
        yield figure, content
        # Without date, name and version of the program: the same bytes each time.
        nameless = {"Software": None} if kind == "png" else {"Date": None, "Creator": None}
        figure.savefig(content, format=kind, dpi=_DPI, metadata=nameless)
