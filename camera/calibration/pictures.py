"""Pictures of a calibration: residuals as arrows, by picture, and what of the image was covered."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from camera.calibration.calibrate import Calibration
from camera.calibration.checks import coverage
from camera.calibration.projection import projection_sigma
from camera.model import Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]

_ARROW_SHARE = 0.05
_DPI = 110


def pictures(calibration: Calibration, camera: Camera) -> dict[str, bytes]:
    """PNG files by name: `residuals`, `views`, `coverage`."""
    return {
        "residuals": _png(_residuals(calibration)),
        "views": _png(_views(calibration)),
        "coverage": _png(_coverage(calibration, camera)),
    }


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    # Without a date, the same calibration gives the same bytes.
    figure.savefig(stream, format="png", dpi=_DPI, metadata={"Software": None})
    return stream.getvalue()


def _image_axes(figure: Figure, place: int, calibration: Calibration, columns: int) -> Axes:
    axes = figure.add_subplot(1, columns, place)
    axes.set_xlim(-0.5, calibration.points.width - 0.5)
    axes.set_ylim(calibration.points.height - 0.5, -0.5)
    # Half-height images are shown as the scene looks.
    axes.set_aspect(float(calibration.intrinsics[0] / calibration.intrinsics[1]))
    axes.set_xlabel("u (px)")
    axes.set_ylabel("v (px)")
    return axes


def _residuals(calibration: Calibration) -> Figure:
    points, residuals = calibration.points, calibration.adjusted.residuals
    figure = _figure(13.0, 5.0)
    axes = _image_axes(figure, 1, calibration, 2)
    typical = float(np.sqrt(np.median(np.sum(residuals**2, axis=1))))
    gain = _ARROW_SHARE * points.width / max(3.0 * typical, 1e-9)
    axes.quiver(
        points.pixels[:, 0], points.pixels[:, 1], residuals[:, 0], residuals[:, 1],
        np.minimum(calibration.adjusted.weights.min(axis=1), 1.0), cmap="viridis_r",
        angles="xy", scale_units="xy", scale=1.0 / gain, width=0.0015,
    )  # fmt: skip
    axes.set_title(f"Residuals, enlarged {gain:.0f} times; yellow: pulled less (robust loss)")
    flat = figure.add_subplot(1, 2, 2)
    reach = float(np.quantile(np.abs(residuals), 0.995)) * 1.3
    flat.scatter(residuals[:, 0], residuals[:, 1], s=4, alpha=0.4, linewidths=0)
    circle = np.linspace(0.0, 2.0 * np.pi, 100)
    for times in (1.0, 2.0):
        radius = times * calibration.adjusted.sigma_px
        flat.plot(radius * np.cos(circle), radius * np.sin(circle), color="0.3", lw=0.8)
    flat.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="du (px)", ylabel="dv (px)")
    flat.set_aspect("equal")
    flat.set_title(
        f"RMS {calibration.adjusted.rms_px:.3f} px; rings: 1 and 2 times "
        f"{calibration.adjusted.sigma_px:.3f} px"
    )
    return figure


def _views(calibration: Calibration) -> Figure:
    rms = calibration.view_rms_px
    shown = len(rms) + len(calibration.outliers)
    figure = _figure(max(6.0, 0.22 * shown + 2.0), 4.2)
    axes = figure.add_subplot()
    names = [*calibration.names, *(name for name, _ in calibration.outliers)]
    values = [*rms, *(value for _, value in calibration.outliers)]
    colours = ["tab:blue"] * len(rms) + ["tab:red"] * len(calibration.outliers)
    axes.bar(np.arange(shown), values, color=colours)
    axes.axhline(calibration.adjusted.rms_px, color="0.3", lw=0.8)
    axes.set_xticks(np.arange(shown), names, rotation=90, fontsize=6)
    axes.set_ylabel("RMS residual (px)")
    axes.set_title("Each picture; red: left out" if calibration.outliers else "Each picture")
    return figure


def _coverage(calibration: Calibration, camera: Camera) -> Figure:
    points = calibration.points
    figure = _figure(13.0, 4.6)
    axes = _image_axes(figure, 1, calibration, 2)
    counts = coverage(points)
    extent = (-0.5, points.width - 0.5, points.height - 0.5, -0.5)
    aspect = axes.get_aspect()
    shown = axes.imshow(np.sqrt(counts), cmap="Greens", extent=extent, aspect=aspect)
    bar = figure.colorbar(shown, ax=axes, shrink=0.8)
    bar.set_label("root of the number of points")
    axes.plot(points.pixels[:, 0], points.pixels[:, 1], ".", ms=1.5, color="0.2")
    for row, column in np.argwhere(counts == 0):
        axes.text(
            (column + 0.5) * points.width / 8, (row + 0.5) * points.height / 6, "none",
            ha="center", va="center", color="tab:red", fontsize=8,
        )  # fmt: skip
    axes.set_title("Points in the image")
    axes = _image_axes(figure, 2, calibration, 2)
    sigma = projection_sigma(camera, calibration.adjusted.covariance)
    shown = axes.imshow(sigma, cmap="magma_r", extent=extent, aspect=aspect, vmin=0.0)
    bar = figure.colorbar(shown, ax=axes, shrink=0.8)
    bar.set_label("px")
    axes.set_title("Standard deviation of the projection")
    return figure
