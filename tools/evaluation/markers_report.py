"""Statistics of detected markers as tables for a terminal and as a picture."""

from __future__ import annotations

from io import BytesIO

import numpy as np

from tools.evaluation.markers_detectors import OURS
from tools.evaluation.markers_scoring import Table
from tools.evaluation.markers_statistics import BINS, TITLES, Bin, misidentified

# Of the colour-blind-safe set of Okabe and Ito.
_COLOURS = ("#000000", "#999999", "#56B4E9", "#009E73", "#E69F00", "#D55E00")
_LEAST_PX, _LARGEST_PX = 0.005, 3.0


def counts_lines(table: Table) -> list[str]:
    """What each detector found, took for another and saw where there is nothing."""
    markers = len(table.columns["clear"])
    clear = int(table.columns["clear"].sum())
    lines = [f"{table.frames} frames, {markers} markers, {clear} of them clearly in view"]
    lines += [
        f"{name:>15}: misidentified {misidentified(table, name)}, "
        f"where there is no marker {table.false[name]}, twice {table.repeated[name]}"
        for name in table.status
    ]
    return lines


def bins_lines(bins: list[Bin]) -> list[str]:
    """Detection rate and corner errors by bins, and whether this project's detector is ahead.

    Errors over the markers that each detector found itself; then our median and the peer's over
    those that both found.
    """
    names = list(bins[0].own)
    lines = [
        "".join(
            [
                f"{'':32}{'markers':>8}",
                *(f"  {name:>29}" for name in names),
                "   error^2/dof  shared: ours peer ...",
            ]
        ),
        "".join([" " * 40, *(f"  {'found  median    rms    95 %':>29}" for _ in names)]),
    ]
    for b in bins:
        if not b.own[names[0]].markers:
            continue
        label = "all"
        if b.quantity:
            label = f"{TITLES[b.quantity]} {b.low:g}-{b.high:g}"
        cells = [f"{label:32.32}{b.own[names[0]].markers:8d}"]
        cells += [
            f"  {b.own[n].rate:8.3f} {b.own[n].median_px:6.3f} {b.own[n].rms_px:6.3f} "
            f"{b.own[n].q95_px:6.3f}"
            for n in names
        ]
        cells.append(f"  {b.own[names[0]].normalised:10.2f}  ")
        cells += [f" {ours.median_px:.3f}<{peer.median_px:.3f}" for ours, peer in b.shared.values()]
        if b.shared:
            error = {True: "ahead", False: "BEHIND", None: "-"}[b.ahead_in_error]
            cells.append(f"  error {error}, rate {'ahead' if b.ahead_in_rate else 'BEHIND'}")
        lines.append("".join(cells))
    return lines


def statistics_picture(bins: list[Bin], title: str) -> bytes:
    """A PNG: corner error above, detection rate below, over each quantity.

    Parameters
    ----------
    bins : list of Bin
        From `markers_statistics.binned`.
    title : str
        Above the picture.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    names = list(bins[0].own)
    figure, axes = plt.subplots(2, len(BINS), figsize=(15, 6.5), sharey="row", squeeze=False)
    for column, quantity in enumerate(BINS):
        chosen = [b for b in bins if b.quantity == quantity]
        middle = [
            np.sqrt(b.low * b.high) if b.low > 0.0 else 0.5 * (b.low + b.high) for b in chosen
        ]
        if quantity == "slant_deg":
            middle = [0.5 * (b.low + b.high) for b in chosen]
        for name, colour in zip(names, _COLOURS):
            own = [b.own[name] for b in chosen]
            width = 2.2 if name == OURS else 1.2
            axes[0, column].plot(
                middle, [f.median_px for f in own], "o-", color=colour, lw=width, ms=3, label=name
            )
            axes[0, column].plot(middle, [f.q95_px for f in own], ":", color=colour, lw=width)
            axes[1, column].plot(
                middle, [f.rate for f in own], "o-", color=colour, lw=width, ms=3, label=name
            )
        for row in axes[:, column]:
            row.grid(alpha=0.3)
            if quantity != "slant_deg":
                row.set_xscale("log")
                ticks = BINS[quantity]
                row.set_xticks(ticks, [f"{t:g}" for t in ticks])
                row.minorticks_off()
        axes[0, column].set_yscale("log")
        axes[0, column].set_ylim(_LEAST_PX, _LARGEST_PX)
        axes[1, column].set_ylim(0.0, 1.02)
        axes[1, column].set_xlabel(TITLES[quantity])
    axes[0, 0].set_ylabel("corner error / px\nmedian, dotted 95 %")
    axes[1, 0].set_ylabel("share of clear markers found")
    axes[1, 0].legend(fontsize=8, loc="lower right")
    figure.suptitle(title, fontsize=10)
    figure.tight_layout()
    stream = BytesIO()
    # No date or version in it: the same figures give the same bytes.
    figure.savefig(stream, format="png", dpi=80, metadata={"Software": None})
    plt.close(figure)
    return stream.getvalue()
