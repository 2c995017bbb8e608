"""Plots of a validation: linear and angular errors pose by pose, and where on the map."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from redetect.groundtruth.validation.validate import PUBLISHED, Figures, PoseError, ReferencePose

FloatArray = NDArray[np.float64]

_BLUE, _ORANGE, _GREY = "#1f5f99", "#c8641e", "0.55"


def draw_errors(
    references: Sequence[ReferencePose],
    errors: Sequence[PoseError],
    figures: Figures,
    building: FloatArray | None = None,
) -> bytes:
    """Draw errors with bounds by their covariances; returns a PNG's bytes.

    The same input gives the same bytes.

    Parameters
    ----------
    references : sequence of ReferencePose
    errors : sequence of PoseError
        At least one.
    figures : Figures
        Of the errors.
    building : (S, 4) array, optional
        Walls to draw on the map (m).
    """
    figure = Figure(figsize=(13.5, 6.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.25, 1.0])
    linear, angular = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    names = [str(error.index) for error in errors]
    at = np.arange(len(errors))
    heights = 1e3 * np.array([error.linear_m for error in errors])
    linear.bar(at, heights, color=_BLUE, width=0.6, label="error")
    # Of two independent directions: the root of the mean square, so that it compares with errors.
    expected = 1e3 * np.array([error.sigma_linear_m for error in errors])
    if np.isfinite(expected).any():
        linear.plot(at, expected, "_", color=_ORANGE, ms=11, mew=2, label="expected (rms)")
    linear.axhline(1e3 * figures.linear_mean_m, color=_BLUE, lw=1.0, ls="--", label="mean")
    published = PUBLISHED[0]
    label = f"mean of {published.name}: {1e3 * published.position_mean_m:g} mm"
    if published.position_mean_m < 2.0 * figures.linear_worst_m:
        height = 1e3 * published.position_mean_m
        linear.axhline(height, color=_GREY, lw=1.0, ls=":", label=label)
    else:
        linear.plot([], [], " ", label=f"{label}, above the plot")
    linear.set_ylabel("linear error / mm")
    linear.set_title(
        f"linear: mean {1e3 * figures.linear_mean_m:.2f} mm, sigma "
        f"{1e3 * figures.linear_sigma_m:.2f} mm, worst {1e3 * figures.linear_worst_m:.2f} mm",
        fontsize=10,
    )
    turns = np.degrees([error.angular_rad for error in errors])
    sigma = np.degrees([error.sigma_angular_rad for error in errors])
    angular.axhline(0.0, color=_GREY, lw=0.8)
    angular.errorbar(
        at, turns, yerr=np.where(np.isfinite(sigma), sigma, 0.0), fmt="o", color=_BLUE,
        ecolor=_ORANGE, ms=4.5, capsize=2.5, label="error, one sigma expected",
    )  # fmt: skip
    angular.set_ylabel("angular error / deg")
    angular.set_xlabel("reference pose")
    angular.set_title(
        f"angular: mean {math.degrees(figures.angular_mean_rad):+.3f} deg, sigma "
        f"{math.degrees(figures.angular_sigma_rad):.3f} deg, worst "
        f"{math.degrees(figures.angular_worst_rad):.3f} deg",
        fontsize=10,
    )
    for axes in (linear, angular):
        axes.set_xticks(at, names, fontsize=8, rotation=90 if len(at) > 40 else 0)
        axes.set_xlim(-0.7, len(at) - 0.3)
        axes.grid(axis="y", alpha=0.25)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.22 * (high - low))  # space for the legend
        axes.legend(loc="upper center", ncols=4, fontsize=8, framealpha=0.9)

    where = figure.add_subplot(grid[:, 1])
    for x1, y1, x2, y2 in building if building is not None else ():
        where.plot([x1, x2], [y1, y2], color=_GREY, lw=0.8, zorder=1)
    by_index = {reference.index: reference for reference in references}
    poses = np.array([by_index[error.index].pose for error in errors])
    shown = np.array([[error.x_m, error.y_m] for error in errors])
    span = float(np.ptp(poses[:, :2], axis=0).max()) if len(errors) > 1 else 1.0
    factor = _round_factor(0.12 * max(span, 1.0) / max(figures.linear_worst_m, 1e-6))
    where.quiver(
        poses[:, 0], poses[:, 1], factor * shown[:, 0], factor * shown[:, 1], angles="xy",
        scale_units="xy", scale=1.0, color=_BLUE, width=0.004, zorder=3,
    )  # fmt: skip
    ahead = poses[:, :2] + 0.2 * np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    ends = np.stack([poses[:, :2], ahead])
    where.plot(ends[:, :, 0], ends[:, :, 1], color="0.2", lw=1.2, zorder=2)
    where.plot(poses[:, 0], poses[:, 1], "o", color="0.2", ms=3, zorder=2)
    for error, pose in zip(errors, poses):
        where.annotate(
            str(error.index), pose[:2], xytext=(4, 4), textcoords="offset points", fontsize=7
        )
    low, high = poses[:, :2].min(axis=0) - 1.5, poses[:, :2].max(axis=0) + 1.5
    where.set_xlim(low[0], high[0])
    where.set_ylim(low[1], high[1])
    where.set_aspect("equal")
    where.set_xlabel("x / m")
    where.set_ylabel("y / m")
    where.set_title(f"errors, drawn {factor:g} times as long", fontsize=10)
    where.grid(alpha=0.25)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _round_factor(wanted: float) -> float:
    """The largest of 1, 2, 5, 10, ... that is at most `wanted`; 1 if that is below 1."""
    power = 10.0 ** math.floor(math.log10(max(wanted, 1.0)))
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= max(wanted, 1.0))
