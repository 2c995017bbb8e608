"""A picture of the scanners' alignment: before, from hand-measured poses, and after."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from redetect.groundtruth.geometry.plane import apply
from redetect.groundtruth.lasers.alignment import Alignment, StillScan
from redetect.groundtruth.lasers.scanners import Scanner

FloatArray = NDArray[np.float64]

_COLOURS = ("#2a78b5", "#d9822b", "#3a9150", "#8e5bb0", "#b03a48", "#6b6b6b")


def draw_alignment(
    measured: tuple[Scanner, ...],
    alignment: Alignment,
    scans: list[StillScan],
    building: FloatArray,
) -> bytes:
    """Draw the scans on the map by the measured poses and by those found; a PNG's bytes.

    The same input gives the same bytes.
    """
    figure = Figure(figsize=(13.5, 6.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    after = [scanner.pose for scanner in alignment.scanners]
    before = [scanner.pose for scanner in measured]
    everything = np.concatenate([apply(p, s.points) for p, s in zip(after, scans)])
    low, high = everything.min(axis=0) - 0.5, everything.max(axis=0) + 0.5
    panels = zip(figure.subplots(1, 2), (before, after), ("measured by hand", "aligned"))
    for axes, poses, title in panels:
        for x1, y1, x2, y2 in building:
            axes.plot([x1, x2], [y1, y2], color="0.55", lw=1.0, zorder=1)
        for k, (pose, scan) in enumerate(zip(poses, scans)):
            colour = _COLOURS[k % len(_COLOURS)]
            points = apply(pose, scan.points)
            axes.scatter(points[:, 0], points[:, 1], s=7, color=colour, lw=0, zorder=2)
            ahead = apply(pose, np.array([[0.0, 0.0], [0.5, 0.0]]))
            axes.plot(ahead[:, 0], ahead[:, 1], color=colour, lw=2.0, zorder=3)
            axes.plot(
                *pose[:2], "o", color=colour, ms=7, zorder=3, label=alignment.scanners[k].name
            )
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal")
        axes.set_xlabel("x / m")
        axes.set_ylabel("y / m")
        axes.set_title(title)
        axes.grid(alpha=0.25)
    axes.legend(loc="upper right", framealpha=0.9)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
