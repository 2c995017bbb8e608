"""A picture of a rig: the clouds of pairwise estimates, and where the markers came out."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from redetect.groundtruth.geometry.transforms import apply, inverse
from redetect.groundtruth.markers.calibration import Rig
from redetect.groundtruth.markers.rig_estimation import RigEstimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FloatArray = NDArray[np.float64]

_PLANES = ((0, 1, "from above"), (0, 2, "from the right"), (1, 2, "from the front"))
_AXES = ("x", "y", "z")
_AGREES, _DIFFERS = "#2a78b5", "#d9822b"


def draw_rig(estimate: RigEstimate) -> bytes:
    """Draw a rig's estimate.

    Parameters
    ----------
    estimate : RigEstimate
        Its pairwise estimates are drawn where they would put a marker, seen from the other one.

    Returns
    -------
    bytes
        A PNG of three views along the axes; the same input gives the same bytes.
    """
    rig = estimate.rig
    agreeing, differing = _clouds(estimate, rig)
    figure = Figure(figsize=(13.5, 5.0), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    centre = rig.robot_from_marker[:, :3, 3]
    middle = 0.5 * (centre.min(axis=0) + centre.max(axis=0))
    reach = 0.5 * float(np.ptp(centre, axis=0).max()) + float(rig.widths_m.max())
    for axes, (across, up, title) in zip(figure.subplots(1, 3), _PLANES):
        # Wrong estimates are far away: only those inside the picture are drawn.
        axes.scatter(
            differing[:, across], differing[:, up], s=14, marker="x", color=_DIFFERS, lw=0.8,
            label=f"pairwise, differs ({len(differing)})", zorder=1,
        )  # fmt: skip
        axes.scatter(
            agreeing[:, across], agreeing[:, up], s=9, color=_AGREES, alpha=0.35, lw=0,
            label=f"pairwise, agrees ({len(agreeing)})", zorder=2,
        )  # fmt: skip
        _draw_markers(axes, rig, across, up)
        axes.set_xlim(middle[across] - reach, middle[across] + reach)
        axes.set_ylim(middle[up] - reach, middle[up] + reach)
        axes.set_aspect("equal")
        axes.set_xlabel(f"{_AXES[across]} / m")
        axes.set_ylabel(f"{_AXES[up]} / m")
        axes.set_title(title)
        axes.grid(alpha=0.25)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _clouds(estimate: RigEstimate, rig: Rig) -> tuple[FloatArray, FloatArray]:
    """Markers' centres by the pairwise estimates that agree, and by those that do not."""
    agreeing, differing = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for (a, b), pair in sorted(estimate.pairs.items()):
        poses = rig.robot_from_marker
        places = np.concatenate(
            [
                (poses[a] @ pair.estimates)[:, :3, 3],
                (poses[b] @ inverse(pair.estimates))[:, :3, 3],
            ]
        )
        agrees = np.tile(pair.agrees, 2)
        agreeing.append(places[agrees])
        differing.append(places[~agrees])
    return np.concatenate(agreeing), np.concatenate(differing)


def _draw_markers(axes: Axes, rig: Rig, across: int, up: int) -> None:
    for marker, width, pose in zip(rig.ids, rig.widths_m, rig.robot_from_marker):
        half = 0.5 * width
        square = np.array(
            [
                [-half, half, 0],
                [half, half, 0],
                [half, -half, 0],
                [-half, -half, 0],
                [-half, half, 0],
            ]
        )
        outline = apply(pose, square)
        label = "adjusted markers" if marker == rig.ids[0] else None
        axes.plot(outline[:, across], outline[:, up], color="black", lw=1.4, label=label, zorder=3)
        normal = apply(pose, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.6 * width]]))
        axes.plot(normal[:, across], normal[:, up], color="black", lw=0.8, zorder=3)
        axes.annotate(
            str(marker), (float(normal[1, across]), float(normal[1, up])), ha="center",
            va="center", fontsize=10,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
            zorder=4, annotation_clip=True,
        )  # fmt: skip
