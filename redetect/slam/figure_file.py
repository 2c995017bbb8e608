"""Writes a figure to a PNG file, reproducibly, and shows it in a window on request."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from redetect.slam.errors import SlamError
from redetect.storage import OutputExistsError, write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 120
_WITHOUT_WINDOWS = ("agg", "cairo", "pdf", "pgf", "ps", "svg", "template")


@contextmanager
def picture(
    png: Path, size: tuple[float, float], *, overwrite: bool, interactive: bool
) -> Iterator[Figure]:
    """A figure to draw into; at the end it is written and, on request, shown."""
    if not overwrite and png.exists():  # before the work instead of after it
        raise OutputExistsError(png)
    with mpl.rc_context():
        mpl.rcdefaults()
        if interactive:
            if mpl.get_backend().lower() in _WITHOUT_WINDOWS:
                raise SlamError("no window can be opened here: expected a display for interactive")
            figure = pyplot.figure(figsize=size, dpi=DPI, layout="constrained")
        else:
            figure = Figure(figsize=size, dpi=DPI, layout="constrained")
            FigureCanvasAgg(figure)
        try:
            yield figure
            stream = io.BytesIO()
            # Without the name and version of the program that made it: the same bytes everywhere.
            figure.savefig(stream, format="png", dpi=DPI, metadata={"Software": None})
            with write_whole(png, overwrite=overwrite) as file:
                file.write(stream.getvalue())
            if interactive:
                pyplot.show()
        finally:
            if interactive:
                pyplot.close(figure)
