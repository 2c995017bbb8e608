"""Pictures of what the detectors do: discs, verticals, tables, markers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from camera import Camera
from detect.circles import detect_circles, disc_shape
from detect.drawing.frame import track_pixels
from detect.line_settings import LineSettings
from detect.lines import detect_lines
from detect.run import open_run, read_image
from detect.seen import circle_on_floor
from detect.settings import CircleSettings
from detect.verticals.response import line_response
from lut import cached_disc_table, cached_vertical_table

_EDGE, _RINGS, _LINE = "#e67e22", "#2ecc71", "#e67e22"


def draw_discs(figure: Any, run: Path, frame: int) -> None:
    """Quality of every pixel; candidates; what the fit makes of them."""
    camera, image = _frame(run, frame)
    settings = CircleSettings()
    table = cached_disc_table(camera, disc_shape(settings))
    from detect.discs.quality import quality_of_centres

    without_fit = CircleSettings(verify=False, refine=False)
    every = cached_disc_table(camera, disc_shape(without_fit))
    quality, _ = quality_of_centres(image, every)
    found = detect_circles(image, camera, table, settings)
    loose = detect_circles(image, camera, every, without_fit)
    panels = figure.subplots(3, 1)
    titles = (
        "quality of the outlines round every pixel: between-class over total variance",
        f"candidates: {len(loose)} local maxima above {settings.threshold:g}, one per 0.14 m",
        f"fitted through the lens, and weighed: {len(found)} discs (edge, and the two outlines)",
    )
    for axes, title in zip(panels, titles, strict=True):
        _image(axes, image, title)
    panels[0].imshow(np.where(quality > 0.0, quality, np.nan), cmap="magma", vmin=0, vmax=1)
    panels[1].plot(*loose.pixels.T, "+", color=_RINGS, markersize=7)
    for centre in found.floor_xy:
        for radius, colour in ((0.1, _EDGE), (0.06, _RINGS), (0.14, _RINGS)):
            outline = camera.project_floor(circle_on_floor(centre, radius))
            panels[2].plot(*outline.T, color=colour, lw=0.9)


def draw_verticals(figure: Any, run: Path, frame: int) -> None:
    """The filter's response, all tracks, and the lines that agree on one tilt."""
    camera, image = _frame(run, frame)
    table = cached_vertical_table(camera)
    settings = LineSettings()
    response = line_response(image, table, settings)
    found = detect_lines(image, table, settings)
    tilt = found.tilt
    panels = figure.subplots(3, 1)
    said = "" if tilt is None else (
        f"; pitch {np.degrees(tilt.pitch_rad):.2f}°, roll {np.degrees(tilt.roll_rad):.2f}°"
    )  # fmt: skip
    titles = (
        "response: how much a step of the grey value along the vertical explains, with its sign",
        f"{len(found.fate)} tracks from the horizon (dashed) up and down",
        f"{len(found)} verticals{said}, on which {0 if tilt is None else tilt.lines} tracks agree",
    )
    for axes, title in zip(panels, titles, strict=True):
        _image(axes, image, title)
    panels[0].imshow(response, cmap="RdBu", vmin=-0.7, vmax=0.7)
    for t, fate in enumerate(found.fate):
        place = track_pixels(found.tracks, table, t)
        panels[1].plot(*place.T, color=_LINE if fate == "accepted" else "#3498db", lw=1.2)
        if fate == "accepted":
            panels[2].plot(*place.T, color=_LINE, lw=1.4)
    panels[1].plot(np.arange(camera.width), table.anchor_row, "--", color="white", lw=0.7)


def draw_tables(figure: Any, run: Path) -> None:
    """What is known of every pixel before the first image."""
    camera, image = _frame(run, 0)
    table = cached_disc_table(camera, disc_shape(CircleSettings(rows_apart=0.0)))
    verticals = cached_vertical_table(camera)
    panels = figure.subplots(2, 1)
    _image(panels[0], image, "the two outlines (radius 0.06 and 0.14 m) about some pixels")
    _image(panels[1], image, "horizon, and the verticals through some of its columns")
    panels[0].imshow(np.where(table.usable, np.nan, 0.35), cmap="gray", vmin=0, vmax=1, alpha=0.5)
    for u in range(60, camera.width, 108):
        for v in (140, 180, 225, 265):
            if table.usable[v, u]:
                centre = table.floor_xy[v, u].astype(np.float64)
                for radius in (0.06, 0.14):
                    outline = camera.project_floor(circle_on_floor(centre, radius))
                    panels[0].plot(*outline.T, color=_RINGS, lw=1)
                panels[0].plot(u, v, ".", color=_EDGE, markersize=4)
    rows = np.arange(camera.height)
    for column in range(0, camera.width, 48):
        panels[1].plot(verticals.column[:, column], rows, color=_LINE, lw=1)
    panels[1].plot(np.arange(camera.width), verticals.anchor_row, "--", color=_RINGS, lw=1)


def draw_markers(figure: Any, run: Path, frame: int) -> None:
    """The three phases: dark regions, corners and edges, identities."""
    from detect.markers.candidates import closing, dark_pixels
    from detect.markers.detect import detect_markers
    from detect.markers.settings import MarkerSettings

    camera, image = _frame(run, frame)
    found = detect_markers(image, MarkerSettings(), camera)
    panels = figure.subplots(1, 3)
    middles = found.corners.mean(axis=1)
    low, high = middles.min(axis=0) - 70, middles.max(axis=0) + 70
    for axes, title in zip(
        panels,
        (
            "1. dark against the closing (one of the thresholds)",
            f"2. corners of {len(found.candidates)} candidates",
            f"3. {len(found)} markers, fitted and identified",
        ),
        strict=True,
    ):
        _image(axes, image, title)
        axes.set_xlim(max(low[0], 0), min(high[0], camera.width))
        axes.set_ylim(min(high[1], camera.height), max(low[1], 0))
    dark = dark_pixels(image, closing(image, 12), 0.5, 0.0, "ratio")
    panels[0].imshow(np.where(dark > 0, 1.0, np.nan), cmap="autumn", vmin=0, vmax=1, alpha=0.6)
    for candidate in found.candidates:
        _polygon(panels[1], candidate.outline, "#3498db")
    for number, corners in zip(found.ids, found.corners, strict=True):
        _polygon(panels[2], corners, _EDGE)
        panels[2].text(*corners.mean(axis=0), str(number), color=_RINGS, ha="center", va="center")
        panels[2].plot(*corners[0], "o", color=_RINGS, markersize=3)


def _polygon(axes: Any, corners: Any, colour: str) -> None:
    axes.plot(*np.vstack([corners, corners[:1]]).T, color=colour, lw=1.2)


def _frame(run: Path, number: int) -> tuple[Camera, Any]:
    opened = open_run(run)
    frame = next(frame for i, frame in enumerate(opened.frames) if i == number)
    return opened.camera, read_image(frame, opened.camera)


def _image(axes: Any, image: Any, title: str) -> None:
    axes.imshow(image, cmap="gray", vmin=0, vmax=255)
    axes.autoscale(False)
    axes.set_title(title, fontsize=9)
    axes.axis("off")
