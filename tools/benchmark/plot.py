"""The result as a picture: what things cost, and how that grows."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

from tools.benchmark.report import number
from tools.benchmark.result import GrowthPoint, Result, RunTimes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {
    "decoding": "0.45",
    "circles": "tab:orange",
    "lines": "tab:blue",
    "all": "tab:green",
    "peer": "tab:red",
}


def plot_png(result: Result) -> bytes:
    """Draw the demo's ratios and the growth curves.

    Parameters
    ----------
    result : Result

    Returns
    -------
    bytes
        A PNG.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 8.5), layout="constrained")
    axes = figure.subplot_mosaic([["ratios", "size", "frames"], ["ratios", "discs", "verticals"]])
    _ratios(axes["ratios"], result)
    _curves(axes["size"], result.by_megapixels, "size of the image / Mpixel", logarithmic=True)
    _curves(axes["discs"], result.by_discs, "discs in the image")
    _curves(axes["verticals"], result.by_verticals, "verticals in the image")
    _frames(axes["frames"], result.by_frames)
    figure.suptitle(
        f"{result.machine.cpu}: processor time in one process, medians and quartiles", fontsize=11
    )
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=100)
    return stream.getvalue()


def _ratios(axes: Axes, result: Result) -> None:
    """What each function takes on the first kind of pictures, in decodings."""
    kind = result.kinds[0]
    for position, times in enumerate(kind.functions):
        ratio = times.decodings
        colour = _COLOURS[times.group]
        quartiles = [ratio.lower_quartile, ratio.upper_quartile]
        axes.plot(quartiles, [position] * 2, "-", color=colour, linewidth=3)
        axes.plot(ratio.median, position, "o", color=colour, markersize=8)
        axes.annotate(
            number(ratio.median),
            (max(ratio.median, ratio.upper_quartile), position),
            xytext=(8, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
        )
    axes.set_yticks(range(len(kind.functions)), [times.name for times in kind.functions])
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(alpha=0.3)
    axes.margins(x=0.15)
    axes.set_xlabel("time / time of decoding the same image")
    axes.set_title(f"{kind.kind} images", fontsize=10)


def _curves(
    axes: Axes, points: Sequence[GrowthPoint], quantity: str, *, logarithmic: bool = False
) -> None:
    """Median times over a growing quantity, quartiles as a band."""
    from matplotlib.ticker import FixedLocator, NullLocator

    names = [times.name for times in points[0].functions] if points else []
    amounts = [point.amount for point in points]
    seen: dict[str, int] = {}
    for index, name in enumerate(names):
        group = points[0].functions[index].group
        spreads = [point.functions[index].ms for point in points]
        style = ["-", "--"][seen.get(group, 0) % 2]
        seen[group] = seen.get(group, 0) + 1
        axes.plot(
            amounts,
            [s.median for s in spreads],
            f"o{style}",
            color=_COLOURS[group],
            label=name,
            markersize=4,
        )
        axes.fill_between(
            amounts,
            [s.lower_quartile for s in spreads],
            [s.upper_quartile for s in spreads],
            color=_COLOURS[group],
            alpha=0.2,
            linewidth=0,
        )
    if logarithmic:
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.xaxis.set_major_locator(FixedLocator(amounts))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter("{x:.2g}")
        axes.yaxis.set_major_formatter("{x:g}")
    else:
        axes.set_ylim(bottom=0.0)
    axes.set_xlabel(quantity)
    axes.set_ylabel("ms per image")
    axes.grid(alpha=0.3)
    if names:
        axes.legend(fontsize=8)


def _frames(axes: Axes, runs: Sequence[RunTimes]) -> None:
    """Images per second of whole runs over their length."""
    for jobs in sorted({times.jobs for times in runs}):
        own = [times for times in runs if times.jobs == jobs]
        axes.plot(
            [times.frames for times in own],
            [times.images_per_s.median for times in own],
            "o-" if jobs == 1 else "o--",
            color=_COLOURS["all"],
            label=f"{own[0].command}, {jobs} job{'s' if jobs > 1 else ''}",
            markersize=4,
        )
    axes.set_xscale("log")
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("frames of the run")
    axes.set_ylabel("images per second, files in, files out")
    axes.grid(alpha=0.3)
    if runs:
        axes.legend(fontsize=8)
