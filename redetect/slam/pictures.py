"""Pictures of maps and of errors along a path, as PNG files or in windows.

Maps are drawn in their own axes, X to the right and Y up, with equal scales. The same input gives
the same bytes; a user's own matplotlib settings have no effect.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from scipy.special import chdtri

from redetect import plane
from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import is_positive_definite, squared_mahalanobis
from redetect.landmarks.map_file import LandmarkMap, MapLandmarks, Path2D
from redetect.reporting.page import figure_file
from redetect.slam.errors import SlamError
from redetect.storage import IMAGE_SUFFIXES
from redetect.storage.images import read_grey

if TYPE_CHECKING:
    from matplotlib.axes import Axes


#: Central 95 % of chi squared with 3 degrees of freedom.
NEES_BAND = tuple(chdtri(3, [0.975, 0.025]).tolist())

_WITHOUT_WINDOWS = ("agg", "cairo", "pdf", "pgf", "ps", "svg", "template")
_PATH, _REFERENCE, _DISC, _LINE, _BAND = "#1f5f99", "#777777", "#c8501e", "#3a8f4c", "#2a78b5"
_SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
_ELLIPSE_POINTS = 40
# Number of crops in a row, and their half width.
_CROPS_ABREAST, _CROP_PX = 8, 48.0
# Largest number of discs that are labelled with their numbers.
_MOST_NUMBERED = 40
# Largest number of landmarks whose ellipses are drawn.
_MOST_ELLIPSES = 700
# In larger maps, landmarks with fewer rows than this are pale, but not paler than this share.
_MANY_ROWS, _PALEST = 10, 0.15
# Margin around path and discs within which verticals are drawn.
_MARGIN_M, _MARGIN_SHARE = 6.0, 0.25
_Extent = tuple[FloatArray, FloatArray]  # low and high corner (m)


def demand_windows() -> None:
    """Raise `SlamError` if no window can be opened."""
    if mpl.get_backend().lower() in _WITHOUT_WINDOWS:
        raise SlamError("no window can be opened here: expected a display for interactive")


@contextmanager
def picture(size: tuple[float, float], *, interactive: bool) -> Iterator[tuple[Figure, io.BytesIO]]:
    """A figure to draw into (size in inches), and its file; on request, it is shown at the end."""
    if interactive:
        demand_windows()
    new = pyplot.figure if interactive else Figure
    with figure_file(size, "png", framed=True, new=new) as (figure, content):
        try:
            yield figure, content
            if interactive:
                pyplot.show()
        finally:
            if interactive:
                pyplot.close(figure)


def pose_errors(path: Path2D, reference: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors of a path's poses, their standard deviations, and the normalised error squared.

    Takes a path with covariances and `reference` (N, 3); returns `error` (N, 3), `sigma` (N, 3),
    `nees` (N,), NaN where a pose is given exactly.
    """
    assert path.covariance is not None
    error = plane.pose_differences(path.poses, reference)
    nees = np.full(len(error), np.nan)
    usable = is_positive_definite(path.covariance)
    nees[usable] = squared_mahalanobis(error[usable], path.covariance[usable])
    return error, np.sqrt(np.clip(np.diagonal(path.covariance, axis1=1, axis2=2), 0.0, None)), nees


def draw_map(
    landmark_map: LandmarkMap,
    path: Path2D,
    *,
    before: tuple[LandmarkMap, Path2D] | None = None,
    reference: Path2D | None = None,
    title: str = "",
    interactive: bool = False,
) -> bytes:
    """Draw a map: path, landmarks and their 3-sigma ellipses; returns a PNG's bytes.

    Verticals far outside are counted in the legend, not drawn. Map and path `before` loops were
    closed are drawn in a separate panel, to the same scale; the `reference`, a path to compare
    with, is dashed. `interactive` shows a window as well, and waits until it is closed;
    `SlamError` if none can be opened.
    """
    panels = [("", landmark_map, path)]
    if before is not None:
        panels = [("before closing loops", *before), ("after closing loops", landmark_map, path)]
    low, high = _extent([(m, p) for _, m, p in panels], reference)
    width, height = (8.0 * (high - low) / np.max(high - low)).tolist()
    rows, columns = (len(panels), 1) if width > 1.5 * height else (1, len(panels))
    size = max(columns * width, 6.0) + 1.2, rows * height + 1.8
    with picture(size, interactive=interactive) as (figure, content):
        all_axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
        for axes, (name, some, poses) in zip(all_axes, panels):
            _draw_panel(axes, some, poses, reference, (low, high))
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
            axes.set(xlabel="x / m", ylabel="y / m")
            axes.set_title(name, fontsize=11)
            axes.label_outer()
            axes.grid(alpha=0.25, lw=0.6)
        handles, labels = all_axes[-1].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=min(len(labels), 4), fontsize=9
        )
        if title:
            figure.suptitle(title, fontsize=12)
    return content.getvalue()


def draw_errors(
    path: Path2D, reference: FloatArray, *, title: str = "", interactive: bool = False
) -> bytes:
    """Draw position and heading error over the steps, and the normalised error squared.

    Takes a path with covariances and `reference` (N, 3); returns a PNG's bytes.
    """
    error, sigma, nees = pose_errors(path, reference)
    step = np.arange(len(error))
    unit = np.array([1.0, 1.0, 180.0 / np.pi])
    names = ("x error / m", "y error / m", "heading error / °")
    with picture((10.0, 8.6), interactive=interactive) as (figure, content):
        all_axes = figure.subplots(4, 1, sharex=True)
        for i, (axes, name) in enumerate(zip(all_axes, names)):
            value = unit[i] * error[:, i]
            band = 3.0 * unit[i] * sigma[:, i]
            axes.fill_between(
                step, -band, band, color=_BAND, alpha=0.2, lw=0, label=f"±3 {_SIGMA}", zorder=1
            )
            share = float(np.mean(np.abs(value) <= band))
            axes.set_title(f"within 3 {_SIGMA}: {share:.1%}", fontsize=9, loc="right")
            axes.plot(step, value, color="black", lw=0.8, label="error", zorder=3)
            axes.axhline(0.0, color=_REFERENCE, lw=0.6, zorder=2)
            axes.set_ylabel(name)
            axes.grid(alpha=0.25, lw=0.6)
        all_axes[0].legend(loc="upper left", fontsize=8, ncols=2)
        _draw_nees(all_axes[3], step, nees)
        all_axes[-1].set(xlabel="step", xlim=(0, max(len(step) - 1, 1)))
        figure.align_ylabels(list(all_axes))
        if title:
            figure.suptitle(title, fontsize=12)
    return content.getvalue()


def _draw_nees(axes: Axes, step: IntArray, nees: FloatArray) -> None:
    known = np.isfinite(nees)
    axes.axhspan(*NEES_BAND, color=_BAND, alpha=0.2, lw=0, label="95 % band", zorder=1)
    axes.axhline(3.0, color=_REFERENCE, lw=0.6, label="expected: 3", zorder=2)
    if known.any():
        # A logarithm has no place for an error of exactly 0.
        axes.plot(step, np.maximum(nees, 1e-3), color="black", lw=0.8, label="NEES", zorder=3)
        inside = (nees[known] >= NEES_BAND[0]) & (nees[known] <= NEES_BAND[1])
        share = f"mean {np.mean(nees[known]):.3g}, in the band: {np.mean(inside):.1%}"
        axes.set_title(share, fontsize=9, loc="right")
        # Space above for the legend.
        highest = max(100.0, 5.0 * float(np.max(nees[known])))
        axes.set_ylim(min(0.05, max(1e-3, float(np.min(nees[known])) / 1.5)), highest)
    axes.set(yscale="log", ylabel="error², normalised")
    axes.grid(alpha=0.25, lw=0.6)
    axes.legend(loc="upper left", fontsize=8, ncols=3)


def _extent(drawn: list[tuple[LandmarkMap, Path2D]], reference: Path2D | None) -> _Extent:
    """Corners of the picture (m): all paths and discs, and a margin for verticals near them."""
    points = [xy for some, path in drawn for xy in (path.poses[:, :2], some.discs.xy)]
    if reference is not None:
        points.append(reference.poses[:, :2])
    inner = np.concatenate(points)
    low, high = inner.min(axis=0), inner.max(axis=0)
    span = float(np.max(high - low))
    margin = max(0.05 * span, 0.3)
    if any(len(some.lines) for some, _ in drawn):
        margin = min(_MARGIN_M, _MARGIN_SHARE * span + 1.0)
    # A straight drive has hardly any width, but needs a picture, too.
    middle, half = 0.5 * (low + high), 0.5 * (high - low) + margin
    half = np.maximum(half, 0.2 * float(half.max()))
    return middle - half, middle + half


def _draw_panel(
    axes: Axes, some: LandmarkMap, path: Path2D, reference: Path2D | None, extent: _Extent
) -> None:
    if reference is not None:
        axes.plot(
            reference.poses[:, 0], reference.poses[:, 1], color=_REFERENCE, lw=0.9, ls=(0, (4, 2)),
            label="reference", zorder=4,
        )  # fmt: skip
    # Of several runs each begins with a start.
    starts = [k for k, name in enumerate(path.prefixes) if k and name == path.prefixes[0]]
    runs = np.split(path.poses, starts)
    for k, poses in enumerate(runs):
        label = None if k else "path"
        axes.plot(poses[:, 0], poses[:, 1], color=_PATH, lw=0.9, label=label, zorder=3)
    ellipses = len(some.discs) + len(some.lines) <= _MOST_ELLIPSES
    _draw_landmarks(axes, some.lines, ("vertical", _LINE, "x"), extent, ellipses=ellipses)
    _draw_landmarks(axes, some.discs, ("disc", _DISC, "o"), extent, ellipses=ellipses)
    if len(some.discs) <= _MOST_NUMBERED:
        for number, (x, y) in zip(some.discs.ids.tolist(), some.discs.xy.tolist()):
            axes.annotate(
                str(number), (x, y), xytext=(3, 3), textcoords="offset points", fontsize=7,
                color=_DISC, zorder=6,
            )  # fmt: skip
    for index, name, marker in ((0, "start", "o"), (-1, "end", "s")):
        at = np.array([poses[index] for poses in runs if len(poses)]).reshape(-1, 3)
        axes.plot(
            at[:, 0], at[:, 1], ls="", marker=marker, ms=6, mfc="white", mec="black", mew=1.2,
            label=name, zorder=7,
        )  # fmt: skip


def _draw_landmarks(
    axes: Axes, some: MapLandmarks, look: tuple[str, str, str], extent: _Extent, *, ellipses: bool
) -> None:
    name, colour, marker = look
    low, high = extent
    if len(some) == 0:
        return
    shown = np.all((some.xy >= low) & (some.xy <= high), axis=1)
    outside = int(np.sum(~shown))
    label = f"{name} ({len(some)}{f', {outside} of them outside' if outside else ''})"
    # With hundreds of landmarks, only small dots show walls; what was hardly seen would hide them.
    size = 4.0 if len(some) <= 100 else 2.0
    opaque = np.ones(len(some)) if ellipses else np.clip(some.rows / _MANY_ROWS, _PALEST, 1.0)
    x, y = some.xy[shown].T
    axes.scatter(
        x, y, size**2, marker=marker, color=colour, lw=0.8 if marker == "x" else 0.0,
        alpha=opaque[shown] if shown.any() else None,  # type: ignore[arg-type]  # arrays, too
        label=label, zorder=5,
    )  # fmt: skip
    known = shown & np.any(some.covariance != 0.0, axis=(1, 2))
    if known.any() and ellipses:
        patches = PolyCollection(
            list(plane.ellipses(some.xy[known], some.covariance[known], 3.0, _ELLIPSE_POINTS)),
            facecolors=(*to_rgb(colour), 0.1),
            edgecolors=colour,
            linewidths=0.7,
            zorder=2,
            label=f"3 {_SIGMA} of {name}",
        )
        axes.add_collection(patches, autolim=False)


class Crop(NamedTuple):
    """A part of an image: its file, the pixel (u, v) in the middle, and its caption."""

    file: Path
    pixel: tuple[float, float]
    name: str


def picture_of_frame(folder: Path, prefix: str) -> Path | None:
    """The image of a frame in a folder or its subfolder ``images``; None if there is none."""
    for place in (folder, folder / "images"):
        for name in (prefix, *(f"{prefix}{suffix}" for suffix in IMAGE_SUFFIXES)):
            if Path(name).suffix.lower() in IMAGE_SUFFIXES and (place / name).is_file():
                return place / name
    return None


def draw_crops(crops: Sequence[Crop], title: str) -> bytes:
    """Draw parts of images side by side, a cross-hair with a gap in the middle of each."""
    rows = -(-len(crops) // _CROPS_ABREAST)
    with picture((1.6 * _CROPS_ABREAST, 0.4 + 1.5 * rows), interactive=False) as (figure, content):
        figure.suptitle(title)
        axes = figure.subplots(rows, _CROPS_ABREAST, squeeze=False)
        for some in axes.flat:
            some.set_axis_off()
        for some, crop in zip(axes.flat, crops):
            u, v = crop.pixel
            image = read_grey(crop.file, SlamError)
            some.imshow(image, cmap="gray", vmin=0, vmax=255, aspect="auto")
            some.plot([u - 14, u + 14], [v, v], "+", color=_DISC, markersize=5)
            some.set(xlim=(u - _CROP_PX, u + _CROP_PX), ylim=(v + _CROP_PX / 2, v - _CROP_PX / 2))
            some.set_title(crop.name, fontsize=8)
    return content.getvalue()
