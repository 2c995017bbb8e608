"""Pictures of a calibration: residuals, coverage, corners, and the floor."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import cv2
import numpy as np

from camera.calibration.adjustment import project_estimate, rms
from camera.calibration.calibrate import Calibration, coverage
from camera.model import Camera
from camera.uncertainty import projection_sigma
from redetect.array_types import ByteArray, FloatArray, GreyImage
from redetect.reporting.page import figure_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ARROW_SHARE = 0.05
#: Blue, green, red.
_FOUND, _PROJECTED, _GRID, _HORIZON = (0, 200, 0), (0, 0, 255), (0, 200, 255), (255, 120, 0)
#: Width to which small pictures are enlarged, and of the rectified floor (px).
_LEAST_WIDTH_PX, _RECTIFIED_PX = 900, 800
#: Extent of the drawn floor to the left and right, and ahead, and spacing of the grid (m).
_ASIDE_M, _AHEAD_M, _GRID_M = 3.0, 6.0, 0.5
_POINTS_PER_LINE = 400


def pictures(calibration: Calibration, camera: Camera) -> dict[str, bytes]:
    """PNG files by name: `residuals`, `coverage`."""
    contents = {}
    for name, size, draw in (
        ("residuals", (13.0, 5.0), _draw_residuals),
        ("coverage", (13.0, 4.6), partial(_draw_coverage, camera)),
    ):
        with figure_file(size, "png") as (figure, content):
            draw(calibration, figure)
        contents[name] = content.getvalue()
    return contents


def _image_axes(figure: Figure, place: int, calibration: Calibration) -> Axes:
    axes = figure.add_subplot(1, 2, place)
    width, height = calibration.points.width, calibration.points.height
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    # Half-height images are shown with the proportions of the scene.
    axes.set_aspect(float(calibration.intrinsics[0] / calibration.intrinsics[1]))
    axes.set(xlabel="u (px)", ylabel="v (px)")
    return axes


def _draw_residuals(calibration: Calibration, figure: Figure) -> None:
    points, residuals = calibration.points, calibration.adjusted.residuals
    axes = _image_axes(figure, 1, calibration)
    typical = float(np.sqrt(np.median(np.sum(residuals**2, axis=1))))
    gain = _ARROW_SHARE * points.width / max(3.0 * typical, 1e-9)
    axes.quiver(
        points.pixels[:, 0], points.pixels[:, 1], residuals[:, 0], residuals[:, 1],
        np.minimum(calibration.adjusted.weights.min(axis=1), 1.0), cmap="viridis_r",
        angles="xy", scale_units="xy", scale=1.0 / gain, width=0.0015,
    )  # fmt: skip
    axes.set_title(f"Residuals, enlarged {gain:.0f} times; yellow: down-weighted (robust loss)")
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


def _draw_coverage(camera: Camera, calibration: Calibration, figure: Figure) -> None:
    points = calibration.points
    axes = _image_axes(figure, 1, calibration)
    counts = coverage(points)
    extent = (-0.5, points.width - 0.5, points.height - 0.5, -0.5)
    aspect = axes.get_aspect()
    shown = axes.imshow(np.sqrt(counts), cmap="Greens", extent=extent, aspect=aspect)
    figure.colorbar(shown, ax=axes, shrink=0.8, label="root of the number of points")
    axes.plot(points.pixels[:, 0], points.pixels[:, 1], ".", ms=1.5, color="0.2")
    for row, column in np.argwhere(counts == 0):
        axes.text(
            (column + 0.5) * points.width / 8, (row + 0.5) * points.height / 6, "none",
            ha="center", va="center", color="tab:red", fontsize=8,
        )  # fmt: skip
    axes.set_title("Points in the image")
    axes = _image_axes(figure, 2, calibration)
    sigma = projection_sigma(camera, calibration.adjusted.covariance)
    shown = axes.imshow(sigma, cmap="magma_r", extent=extent, aspect=aspect, vmin=0.0)
    figure.colorbar(shown, ax=axes, shrink=0.8, label="px")
    axes.set_title("Standard deviation of the projection")


def drawn_corners(image: GreyImage, calibration: Calibration, view: int) -> ByteArray:
    """A board's detected points (circles) and projected points (crosses)."""
    points, estimate = calibration.points, calibration.adjusted.estimate
    rows = points.views == view
    found = points.pixels[rows]
    projected = project_estimate(estimate, points)[0][rows]
    picture, scale = _enlarged(image)
    for place in found:
        cv2.circle(picture, _place(place, scale, 8), 7 * 8, _FOUND, 1, cv2.LINE_AA, 3)
    for place in projected:
        cv2.drawMarker(
            picture, _place(place, scale), _PROJECTED, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA
        )
    size = f"RMS {rms(found - projected):.2f} px"
    return _captioned(picture, f"{calibration.names[view]}: found (o), projected (+), {size}")


def drawn_floor(image: GreyImage, camera: Camera) -> ByteArray:
    """The floor's grid and the horizon in a photograph."""
    picture, scale = _enlarged(image)
    along = np.linspace(-_ASIDE_M, _ASIDE_M, _POINTS_PER_LINE)
    ahead = -np.linspace(0.0, _AHEAD_M, _POINTS_PER_LINE)
    lines = [(y, (along, along * 0.0 + y)) for y in -np.arange(0.0, _AHEAD_M + 0.01, _GRID_M)]
    lines += [(x, (ahead * 0.0 + x, ahead)) for x in np.arange(-_ASIDE_M, _ASIDE_M + 0.01, _GRID_M)]
    for at, line in lines:
        seen = camera.project_floor(np.column_stack(line))
        _polyline(picture, seen, scale, _GRID, 2 if at % 1.0 == 0.0 else 1)
    for y in range(1, int(_AHEAD_M) + 1):
        place = camera.project_floor([0.0, -float(y)])
        if np.isfinite(place).all() and np.abs(place).max() < 1e4:
            u, v = _place(place, scale)
            cv2.putText(picture, f"{y} m", (u + 4, v - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _GRID, 1)
    bearing = np.linspace(-np.pi, np.pi, 4 * _POINTS_PER_LINE)
    level = np.column_stack([np.sin(bearing), -np.cos(bearing), np.zeros(4 * _POINTS_PER_LINE)])
    _polyline(picture, camera.project_robot(camera.centre + 1e6 * level), scale, _HORIZON, 2)
    return _captioned(
        picture, f"floor: a line every {_GRID_M:g} m, thick every metre; blue: the horizon"
    )


def rectified_floor(image: GreyImage, camera: Camera) -> ByteArray:
    """The floor from above, ahead is up: flat objects on it have their true shape."""
    per_metre = _RECTIFIED_PX / (2.0 * _ASIDE_M)
    height = round(_AHEAD_M * per_metre)
    u, v = np.meshgrid(np.arange(_RECTIFIED_PX), np.arange(height))
    # X is to the left, Y backward.
    xy = np.stack([_ASIDE_M - (u + 0.5) / per_metre, (v + 0.5) / per_metre - _AHEAD_M], axis=-1)
    pixels = np.nan_to_num(camera.project_floor(xy), nan=-1e4).astype(np.float32)
    seen = cv2.remap(image, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderValue=0)
    picture = np.asarray(cv2.cvtColor(seen, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for y in range(int(_AHEAD_M) + 1):
        row = round((_AHEAD_M - y) * per_metre)
        cv2.line(picture, (0, row), (_RECTIFIED_PX, row), _GRID, 1)
        cv2.putText(picture, f"{y} m", (4, row - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _GRID, 1)
    for x in np.arange(-_ASIDE_M, _ASIDE_M + 0.01):
        column = round((_ASIDE_M - float(x)) * per_metre)
        cv2.line(picture, (column, 0), (column, height), _GRID, 1)
    return _captioned(picture, "the floor from above; ahead is up, a line every metre")


def _enlarged(image: GreyImage) -> tuple[ByteArray, float]:
    """The image in colour, enlarged enough to draw into, and the factor."""
    scale = float(max(1, round(_LEAST_WIDTH_PX / image.shape[1])))
    size = int(scale * image.shape[1]), int(scale * image.shape[0])
    large = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(large, cv2.COLOR_GRAY2BGR), dtype=np.uint8), scale


def _place(place: FloatArray, scale: float, parts: int = 1) -> tuple[int, int]:
    """A position in the enlarged picture, in pixels or fractions of them."""
    u, v = np.rint(parts * ((place + 0.5) * scale - 0.5)).astype(int).tolist()
    return u, v


def _polyline(
    picture: ByteArray, line: FloatArray, scale: float, colour: tuple[int, int, int], width: int
) -> None:
    """Draw the visible pieces of a line."""
    reach = 2.0 * max(picture.shape)
    near = np.isfinite(line).all(axis=1) & (np.abs(np.nan_to_num(line)) < reach).all(axis=1)
    for first, last in zip(line[:-1][near[:-1] & near[1:]], line[1:][near[:-1] & near[1:]]):
        cv2.line(
            picture, _place(first, scale, 8), _place(last, scale, 8), colour, width, cv2.LINE_AA, 3
        )


def _captioned(picture: ByteArray, text: str) -> ByteArray:
    band = np.full((24, picture.shape[1], 3), 255, np.uint8)
    cv2.putText(band, text, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([picture, band])
