"""The parts of a report, of which ``page.html`` makes a page, and figures as files.

Figures are the same each time, whatever the user's own matplotlib settings are.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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


FloatArray = NDArray[np.float64]

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


def draw_rates(
    axes: Axes, recall: FloatArray, precision: FloatArray, names: Sequence[str], most_named: int
) -> None:
    """Draw precision over recall (N,): all settings, their front with some names, and the knee."""
    front, best = pareto_front(recall, precision), knee(recall, precision)
    axes.plot(recall, precision, "o", color=DATA, ms=4, label="tried")
    axes.plot(
        recall[front], precision[front], "--", color=DATA, lw=1.2, label="none is better in both"
    )
    if best is not None:
        axes.plot(
            recall[best], precision[best], "o", mfc="none", mec=MARK, mew=2.0, ms=12,
            label=f"knee: {names[best]}",
        )  # fmt: skip
    for k in front[:: max(1, -(-(len(front) - 1) // (most_named - 1)))]:
        axes.annotate(
            names[k], (recall[k], precision[k]), xytext=(-7, -9), textcoords="offset points",
            ha="right", fontsize=7,
        )  # fmt: skip
    axes.set(xlabel="recall", ylabel="precision")
    axes.grid(alpha=0.25, lw=0.6)


def f1_score(recall: ArrayLike, precision: ArrayLike) -> FloatArray:
    """Harmonic mean of recall and precision; 0 where both are, NaN where one is."""
    r, p = np.asarray(recall, np.float64), np.asarray(precision, np.float64)
    return np.asarray(2.0 * r * p / np.where(r + p == 0.0, 1.0, r + p))


def pareto_front(recall: ArrayLike, precision: ArrayLike) -> NDArray[np.intp]:
    """(M,) indices of settings that none beats in recall or precision without losing in the other.

    By rising recall; of equals the first. Recalls and precisions (N,) are NaN where there are none.
    """
    r, p = np.asarray(recall, np.float64), np.asarray(precision, np.float64)
    known = np.flatnonzero(np.isfinite(r) & np.isfinite(p))
    # By falling recall, then falling precision: points no better than before are dominated.
    order = known[np.lexsort((known, -p[known], -r[known]))]
    before = np.maximum.accumulate(np.concatenate([[-np.inf], p[order]]))[:-1]
    return order[p[order] > before][::-1]


def knee(recall: ArrayLike, precision: ArrayLike) -> int | None:
    """The setting at the knee of the curve of precision over recall; None without any.

    That is the point of the front farthest beyond the chord between the front's ends, both axes
    scaled to the front's extent (Satopää, Albrecht, Irwin, Raghavan: Finding a "Kneedle" in a
    Haystack, 2011). Where no point is beyond it, there is no knee, and the point with the greatest
    harmonic mean of recall and precision is used instead.
    """
    r, p = np.asarray(recall, np.float64), np.asarray(precision, np.float64)
    front = pareto_front(r, p)
    if not len(front):
        return None
    if len(front) > 2:
        x = (r[front] - r[front[0]]) / (r[front[-1]] - r[front[0]])
        y = (p[front] - p[front[-1]]) / (p[front[0]] - p[front[-1]])
        beyond = x + y - 1.0
        if beyond.max() > 1e-9:
            return int(front[np.argmax(beyond)])
    return int(front[np.argmax(f1_score(r[front], p[front]))])
