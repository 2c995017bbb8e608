"""The pictures of the documentation."""

# ruff: noqa: RUF001
# Letters of the field: alpha, beta, sigma, and the minus sign.

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from camera import Camera
from detect.circles import detect_circles, disc_shape
from detect.drawing.frame import track_pixels
from detect.line_settings import LineSettings
from detect.lines import detect_lines
from detect.seen import circle_on_floor
from detect.settings import CircleSettings
from detect.sources.interface import read_image
from detect.sources.opening import open_run
from detect.verticals.response import line_response
from lut import cached_disc_table, cached_vertical_table
from redetect.landmarks import read_frames
from tools.evaluation.tables import picture

_X, _Y, _Z, _INK = "#c0392b", "#1e8449", "#1f4e9c", "#444444"


def draw_frames(figure: Any) -> None:
    """Draw one panel for each frame into a matplotlib figure."""
    panels = figure.subplots(4, 2)
    draws = (_pixel, _camera, _robot, _bearing, _line, _map, _world, _board)
    for axes, draw in zip(panels.flat, draws, strict=True):
        axes.set_aspect("equal")
        axes.axis("off")
        draw(axes)


def _arrow(axes: Any, start: Any, end: Any, colour: str, label: str, away: Any = (0, 0)) -> None:
    axes.annotate(
        "", xy=end, xytext=start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2}
    )
    place = np.asarray(end, float) + np.asarray(away, float)
    axes.text(*place, label, color=colour, fontsize=11, ha="center", va="center")


def _pixel(axes: Any) -> None:
    axes.set_title("pixel (u, v)")
    for column in range(6):
        for row in range(4):
            shade = "#dfe6ee" if (column, row) == (0, 0) else "white"
            square = axes.fill(
                np.array([-0.5, 0.5, 0.5, -0.5]) + column,
                np.array([-0.5, -0.5, 0.5, 0.5]) + row,
                facecolor=shade,
                edgecolor="#999999",
            )
            square[0].set_linewidth(0.8)
            axes.plot(column, row, ".", color="#999999", markersize=3)
    axes.plot(0, 0, "o", color=_INK)
    axes.text(0.1, -0.95, "(0, 0) is the centre\nof the top-left pixel", fontsize=9, ha="center")
    _arrow(axes, (0, 0), (3, 0), _X, "u", (0.3, 0.0))
    _arrow(axes, (0, 0), (0, 3), _Y, "v", (-0.28, 0.0))
    axes.text(2.5, 3.95, "u to the right, v down; px", fontsize=9, ha="center")
    axes.set(xlim=(-1.6, 6), ylim=(4.3, -1.7))


def _camera(axes: Any) -> None:
    axes.set_title("camera (x, y, z)")
    # Seen obliquely from behind: z into the scene, x to the right, y down.
    axes.fill(
        [-0.5, 0.5, 0.5, -0.5], [-0.35, -0.35, 0.35, 0.35], facecolor="#eeeeee", edgecolor=_INK
    )
    _arrow(axes, (0, 0), (1.5, 0), _X, "x right", (0.1, -0.16))
    _arrow(axes, (0, 0), (0, -1.25), _Y, "y down", (0.0, -0.16))
    _arrow(axes, (0, 0), (0.95, 0.95), _Z, "z forward, along the optical axis", (0.1, 0.15))
    axes.text(0.2, -1.75, "u = scaleX · x/z · f(r) + offsetX", fontsize=9, ha="center")
    axes.text(0.2, -1.98, "v = scaleY · y/z · f(r) + offsetY", fontsize=9, ha="center")
    axes.set(xlim=(-1.4, 2.0), ylim=(-2.1, 1.4))


def _body(axes: Any, x: float, y: float, turn: float) -> None:
    """The robot from above: a box with its front marked. Drawn with X left and Y backward."""
    corners = np.array([[-0.3, 0.35], [0.3, 0.35], [0.3, -0.25], [0.0, -0.45], [-0.3, -0.25]])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    axes.fill(*(corners @ rotation.T + (x, y)).T, facecolor="#eeeeee", edgecolor=_INK)


def _seen_from_above(axes: Any) -> None:
    # X to the left and Y backward, as somebody sees it who looks ahead: both axes are turned.
    axes.invert_xaxis()
    axes.invert_yaxis()


def _robot(axes: Any) -> None:
    axes.set_title("robot, and the floor (X, Y, Z)")
    _body(axes, 0, 0, 0)
    _arrow(axes, (0, 0), (1.1, 0), _X, "X left", (0.22, 0.14))
    _arrow(axes, (0, 0), (0, 1.1), _Y, "Y backward", (0, 0.14))
    axes.plot(0, 0, "o", color=_Z, markersize=9, markerfacecolor="white")
    axes.plot(0, 0, ".", color=_Z)
    axes.text(-0.45, 0.12, "Z up", color=_Z, fontsize=11, ha="center")
    axes.add_patch(_circle(-0.45, -1.15, 0.1))
    axes.plot([-0.45, 0, 0], [-1.15, -1.15, 0], ":", color="#888888", lw=1)
    axes.text(-0.45, -1.4, "disc (px, py) = (−0.45, −1.15)", fontsize=9, ha="center")
    axes.text(0.75, -0.65, "forward\nis −Y", fontsize=9, ha="center")
    axes.set(xlim=(-1.4, 1.5), ylim=(-1.6, 1.5))
    _seen_from_above(axes)


def _circle(x: float, y: float, radius: float) -> Any:
    from matplotlib.patches import Circle

    return Circle((x, y), radius, facecolor="white", edgecolor="#e67e22", lw=2)


def _bearing(axes: Any) -> None:
    from matplotlib.patches import Arc

    axes.set_title("bearing α = atan2(dX, −dY)")
    _body(axes, 0, 0, 0)
    axes.plot([0, 0], [0, -1.5], "--", color="#888888", lw=1)
    axes.text(0.0, -1.6, "α = 0: forward", fontsize=9, ha="center")
    direction = np.array([np.sin(0.6), -np.cos(0.6)])
    _arrow(axes, (0, 0), 1.4 * direction, _Z, "d", 0.1 * direction)
    axes.add_patch(
        Arc((0, 0), 1.8, 1.8, theta1=-90, theta2=-90 + np.degrees(0.6), color=_Z, lw=1.5)
    )
    axes.text(0.32, -1.02, "α > 0", color=_Z, fontsize=10, ha="center")
    axes.text(0.95, 0.2, "positive\nto the left (+X)", fontsize=9, ha="center")
    axes.text(-0.85, 0.2, "negative\nto the right", fontsize=9, ha="center")
    axes.text(0, 0.85, "−π … π, radians; a vertical's σ is that of α", fontsize=9, ha="center")
    axes.set(xlim=(-1.5, 1.5), ylim=(-1.8, 1.0))
    _seen_from_above(axes)


def _line(axes: Any) -> None:
    axes.set_title("vertical: plane, inclination β")
    axes.plot(-1.2, 0.0, "o", color=_INK)
    axes.text(-1.2, -0.2, "camera", fontsize=9, ha="center")
    axes.plot([0.9, 0.75], [-0.9, 1.1], color="#e67e22", lw=3)
    axes.text(0.95, 1.25, "edge in the building", fontsize=9, ha="center", color="#e67e22")
    axes.fill([-1.2, 0.9, 0.75], [0, -0.9, 1.1], facecolor="#e8eefb", edgecolor="none")
    axes.plot([-0.2, -0.26], [-0.43, 0.52], color=_Z, lw=2)
    axes.text(-0.28, 0.67, "(xtop, ytop)", fontsize=8, ha="center", color=_Z)
    axes.text(-0.2, -0.66, "(xbottom, ybottom)", fontsize=8, ha="center", color=_Z)
    _arrow(axes, (0.2, 0.0), (0.85, 0.55), _X, "n", (0.1, 0.08))
    axes.text(
        0, -1.35,
        "n: unit normal of the plane through camera and edge,\n"
        "in the robot frame; β = asin(n_Z), 0 where upright",
        fontsize=9, ha="center",
    )  # fmt: skip
    axes.set(xlim=(-1.7, 1.8), ylim=(-1.6, 1.5))


def _map(axes: Any) -> None:
    axes.set_title("map: the robot's frame at the start")
    _arrow(axes, (0, 0), (0.8, 0), _X, "X", (0.14, 0))
    _arrow(axes, (0, 0), (0, 0.8), _Y, "Y", (0, 0.14))
    path = np.array([[0, 0], [0.1, -0.5], [0.0, -1.05], [-0.4, -1.5]])
    axes.plot(*path.T, color="#888888", lw=1)
    for (x, y), turn in zip(path, (0, 0.15, -0.1, -0.75), strict=True):
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        corners = np.array([[-0.12, 0.12], [0.12, 0.12], [0.12, -0.1], [0.0, -0.18], [-0.12, -0.1]])
        axes.fill(*(corners @ rotation.T + (x, y)).T, facecolor="#eeeeee", edgecolor=_INK)
    axes.add_patch(_circle(-0.9, -0.7, 0.07))
    axes.text(
        0.0, 1.35,
        "pose (x, y, θ), θ counterclockwise from above;\n"
        "STEP (dx, dy, dφ): in the robot's frame before it",
        fontsize=9, ha="center",
    )  # fmt: skip
    axes.set(xlim=(-1.5, 1.5), ylim=(-1.8, 1.5))
    _seen_from_above(axes)


def _world(axes: Any) -> None:
    axes.set_title("ground truth: world and robot")
    _arrow(axes, (-1.2, -1.2), (-0.4, -1.2), _X, "x", (0.12, 0))
    _arrow(axes, (-1.2, -1.2), (-1.2, -0.4), _Y, "y", (0, 0.12))
    axes.text(-0.75, -1.42, "world, z up", fontsize=9, ha="center")
    turn = 0.5
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    # X left and Y backward of the box become x forward and y left.
    box = np.array([[-0.35, 0.3], [-0.35, -0.3], [0.25, -0.3], [0.45, 0.0], [0.25, 0.3]])
    axes.fill(*(box @ rotation.T + (0.3, 0.2)).T, facecolor="#eeeeee", edgecolor=_INK)
    for axis, colour, label in ((0, _X, "x forward"), (1, _Y, "y left")):
        end = rotation[:, axis] * 0.95 + (0.3, 0.2)
        _arrow(axes, (0.3, 0.2), end, colour, label, 0.2 * rotation[:, axis])
    axes.plot([0.3, 1.5], [0.2, 0.2], "--", color="#888888", lw=1)
    axes.text(1.05, 0.33, "θ", fontsize=11, color=_Z)
    axes.text(0.2, -1.7, "RAWSEEDS' frame, not that of the discs", fontsize=9, ha="center")
    axes.set(xlim=(-1.6, 1.9), ylim=(-1.8, 1.5))


def _board(axes: Any) -> None:
    axes.set_title("marker and board (x, y, z)")
    axes.fill([-1, 1, 1, -1], [-1, -1, 1, 1], facecolor="#333333", edgecolor=_INK)
    axes.fill([-0.6, 0.6, 0.6, -0.6], [-0.6, -0.6, 0.6, 0.6], facecolor="white", edgecolor=_INK)
    _arrow(axes, (0, 0), (1.5, 0), _X, "x right", (0.1, -0.16))
    _arrow(axes, (0, 0), (0, 1.35), _Y, "y up", (0.25, 0.05))
    axes.plot(0, 0, "o", color=_Z, markersize=9, markerfacecolor="white")
    axes.plot(0, 0, ".", color=_Z)
    axes.text(-0.3, -0.25, "z out of\nthe print", color=_Z, fontsize=10, ha="center")
    for x, y, number in ((-1, 1, 1), (1, 1, 2), (1, -1, 3), (-1, -1, 4)):
        axes.text(1.13 * x, 1.13 * y, str(number), fontsize=10, ha="center", va="center")
    axes.text(0, -1.55, "corners of a marker: 1, 2, 3, 4 as printed", fontsize=9, ha="center")
    axes.set(xlim=(-1.5, 1.8), ylim=(-1.75, 1.6))


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
    from detect.settings import MarkerSettings

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
        axes.set(
            xlim=(max(low[0], 0), min(high[0], camera.width)),
            ylim=(min(high[1], camera.height), max(low[1], 0)),
        )
    dark = dark_pixels(image, closing(image, 12), 0.5, 0.0)
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


_OWN, _OTHER = "#1f4e9c", "#e67e22"


def draw_association(figure: Any, run: Path) -> None:
    """Rows of a run where odometry and where the map puts them, coloured by what was found."""
    rows = _table(run / "slam" / "path.csv")
    path = np.array([[float(row[c]) for c in ("x_m", "y_m", "theta_rad")] for row in rows])
    summed = [np.zeros(3)]
    frames: list[Any] = []
    for frame in read_frames(run / "found.circles"):
        step = frame.step
        x, y, theta = summed[-1]
        c, s = np.cos(theta), np.sin(theta)
        summed.append(
            np.array(
                [x + c * step.dx - s * step.dy, y + s * step.dx + c * step.dy, theta + step.dphi]
            )
        )
        frames.append(frame.circles)
    panels = figure.subplots(1, 2)
    titles = ("rows where odometry puts them", "rows where the map's path puts them")
    for axes, poses, title in zip(panels, (np.array(summed), path), titles, strict=True):
        axes.plot(*poses[:, :2].T, color="#bbbbbb", lw=0.7)
        for pose, circles in zip(poses[1:], frames, strict=True):
            c, s = np.cos(pose[2]), np.sin(pose[2])
            for row in circles:
                x = pose[0] + c * row.px - s * row.py
                y = pose[1] + s * row.px + c * row.py
                axes.plot(x, y, ".", markersize=2.5, color=_colour(row.ids[0]))
        axes.set_title(title, fontsize=10)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=8)
        axes.set_xlabel("X / m")


def _colour(number: int) -> Any:
    import matplotlib as mpl

    # Neighbouring numbers in colours far from each other.
    return mpl.colormaps["hsv"]((number * 0.381966) % 1.0)


def draw_filter(figure: Any, run: Path) -> None:
    """Errors of EKF-SLAM's poses, as they were at the time, within three standard deviations."""
    truth = json.loads((run / "truth.json").read_text())
    x, y, heading = truth["start"]
    poses = np.array([truth["start"], *(frame["pose"] for frame in truth["frames"])])
    c, s = np.cos(heading), np.sin(heading)
    moved = poses - (x, y, heading)
    exact = np.column_stack(
        [c * moved[:, 0] + s * moved[:, 1], c * moved[:, 1] - s * moved[:, 0], moved[:, 2]]
    )
    rows = _table(run / "ekf" / "path.csv")
    panels = figure.subplots(1, 3)
    for axes, number, name, variance, unit in zip(
        panels,
        range(3),
        ("x_m", "y_m", "theta_rad"),
        ("cxx", "cyy", "cthetatheta"),
        ("x / m", "y / m", "heading / rad"),
        strict=True,
    ):
        error = np.array([float(row[name]) for row in rows]) - exact[:, number]
        if number == 2:
            error = (error + np.pi) % (2.0 * np.pi) - np.pi
        bound = 3.0 * np.sqrt([float(row[variance]) for row in rows])
        steps = np.arange(len(error))
        axes.fill_between(steps, -bound, bound, color="#d5e4f2")
        axes.plot(steps, error, color=_OWN, lw=0.9)
        within = 100.0 * np.mean(np.abs(error[1:]) <= bound[1:])
        axes.set_title(f"error of {unit}, within 3 sigma: {within:.1f} %", fontsize=10)
        axes.set_xlabel("step")


def _table(file: Path) -> list[dict[str, str]]:
    with file.open() as opened:
        return list(csv.DictReader(line for line in opened if not line.startswith("#")))


def draw_laser(figure: Any, session: Path, time_s: float) -> None:
    """One set of scans: background, what is new, and the outline fitted to it."""
    scanners = json.loads((session / "aligned.json").read_text())["scanners"]
    outline = np.array(json.loads((session / "robot.json").read_text())["outline"])
    poses = _rows(session / "laser.csv")
    pose = poses[np.argmin(np.abs(poses[:, 0] - poses[0, 0] - time_s))]
    panels = figure.subplots(1, 2)
    walls = np.loadtxt(session / "building.csv", delimiter=",", skiprows=1)
    for axes in panels:
        axes.plot(walls[:, ::2].T, walls[:, 1::2].T, color="#999999", lw=1)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=8)
    for scanner in scanners:
        x, y, theta = scanner["pose"]
        angles = theta + scanner["first_angle_rad"]
        angles = angles + scanner["angle_step_rad"] * np.arange(scanner["readings"])
        scans = np.load(session / f"{scanner['name']}.scans.npz")
        now = scans["ranges_mm"][np.argmin(np.abs(scans["times_s"] - pose[0]))] / 1000.0
        seen = np.load(session / "empty" / f"{scanner['name']}.scans.npz")["ranges_mm"] / 1000.0
        nearest = np.min(np.where(seen > 0.0, seen, np.inf), axis=0)
        new = (now > 0.0) & (now < nearest - 0.05)
        places = np.array([x, y])[:, None] + now * np.array([np.cos(angles), np.sin(angles)])
        for axes in panels:
            axes.plot(*places[:, (now > 0) & ~new], ".", color="#88aadd", markersize=2)
            axes.plot(*places[:, new], ".", color=_OTHER, markersize=5)
            axes.plot(x, y, "^", color=_INK, markersize=6)
    c, s = np.cos(pose[3]), np.sin(pose[3])
    fitted = outline @ np.array([[c, s], [-s, c]]) + pose[1:3]
    for axes in panels:
        axes.plot(*np.vstack([fitted, fitted[:1]]).T, color=_OWN, lw=1.4)
    panels[0].set_title("a set of four scans: background (blue), new (orange)", fontsize=10)
    panels[1].set_title("the outline fitted to what is new", fontsize=10)
    panels[0].set(xlim=(walls[:, ::2].min() - 0.5, 12.0), ylim=(-1.0, 9.0))
    panels[1].set(xlim=(pose[1] - 0.8, pose[1] + 0.8), ylim=(pose[2] - 0.8, pose[2] + 0.8))


def draw_clock(figure: Any, session: Path) -> None:
    """Rates of turn by both clocks, and the fused path with what it is sure of."""
    odometry, laser = _rows(session / "odometry.csv"), _rows(session / "laser.csv")
    segment = json.loads((session / "clock.json").read_text())["segments"][0]
    panels = figure.subplots(1, 3, width_ratios=(1, 1, 1.2))
    begin, end = segment["from_s"], segment["to_s"]
    shown = laser[(laser[:, 0] >= begin) & (laser[:, 0] <= end)]
    unaligned = odometry[:, 0]
    aligned = (unaligned - segment["offset_s"] - segment["reference_s"]) / segment[
        "rate"
    ] + segment["reference_s"]
    for axes, times, title in (
        (panels[0], unaligned, "turning, by each stream's own clock"),
        (panels[1], aligned, f"by one clock: {segment['offset_s'] * 1000:.0f} ms taken off"),
    ):
        time, rate = _turning(np.column_stack([times, odometry[:, 3]]))
        axes.plot(time - begin, np.degrees(rate), color=_INK, lw=0.8, label="odometry")
        time, rate = _turning(shown[:, [0, 3]])
        axes.plot(time - begin, np.degrees(rate), ".-", color=_OTHER, lw=1, label="laser")
        axes.set(xlim=(0, 4), xlabel="s", ylabel="°/s")
        axes.set_title(title, fontsize=10)
    panels[0].legend(fontsize=8)
    fused = np.loadtxt(session / "fused.csv", delimiter=",")
    axes = panels[2]
    sigma = np.sqrt(fused[:, 4] + fused[:, 8])
    dots = axes.scatter(fused[:, 1], fused[:, 2], c=np.log10(1000 * sigma), s=2, cmap="viridis")
    axes.plot(*laser[:, 1:3].T, ".", color=_OTHER, markersize=2)
    figure.colorbar(dots, ax=axes, label="log10 of sigma / mm")
    axes.set_aspect("equal")
    axes.set_title("fused path; poses of the laser in orange", fontsize=10)


def _rows(file: Path) -> Any:
    return np.loadtxt(file, delimiter=",", usecols=range(4))


def _turning(poses: Any) -> tuple[Any, Any]:
    """Times and rates of turn over a fifth of a second, of rows t, theta."""
    grid = np.arange(poses[0, 0], poses[-1, 0], 0.05)
    heading = np.interp(grid, poses[:, 0], np.unwrap(poses[:, 1]))
    return grid[2:-2], (heading[4:] - heading[:-4]) / 0.2


@dataclass(frozen=True)
class Pictures:
    """Draw the pictures of the documentation anew, as far as there is input for them.

    The run of `--rows` R and the session of `--session` S come from

        python -m tools.simulator rows R --frames 900 --seed 1
        slam associate R -o R/found.circles
        slam map R --stem found -o R/slam
        slam ekf R -o R/ekf
        python -m tools.simulator laser-session S --visits 2 --visit-s 15 --references 3
            --rate-hz 25 --onboard-hz 25 --seed 1
        groundtruth lasers S
        groundtruth laser S
        groundtruth sync S/odometry.csv S/laser.csv -o S/clock.json
        groundtruth fuse S/odometry.csv --laser S/laser.csv --camera S/camera.csv
            --clock S/clock.json -o S/fused.csv
    """

    output: Path = Path("docs/images")  # Folder for the pictures.
    tutorial: Path | None = None  # Where the tutorial's commands were run (it has `mine`).
    rows: Path | None = None  # A simulated run, associated and mapped.
    session: Path | None = None  # A simulated session, evaluated.

    def __call__(self) -> int:
        self.output.mkdir(parents=True, exist_ok=True)
        run, markers = Path("images/e"), Path("images/m/a")
        self._save("frames", (9.5, 15.5), draw_frames, 75)
        self._save("discs", (8, 9.4), lambda f: draw_discs(f, run, 4), 72)
        self._save("verticals", (8, 9.4), lambda f: draw_verticals(f, run, 15), 72)
        self._save("tables", (8, 6.4), lambda f: draw_tables(f, run), 72)
        self._save("marker-phases", (13, 4), lambda f: draw_markers(f, markers, 6), 80)
        if self.tutorial is not None:
            mine = self.tutorial / "mine"
            self._save("tutorial-photographs", (12, 1.9), lambda f: _photographs(f, mine), 75)
            shutil.copyfile(mine / "map" / "map.png", self.output / "tutorial-map.png")
        if (rows := self.rows) is not None:
            self._save("association", (12, 5.5), lambda f: draw_association(f, rows), 80)
            self._save("ekf-errors", (13, 3.6), lambda f: draw_filter(f, rows), 80)
        if (session := self.session) is not None:
            self._save("laser", (11, 4.6), lambda f: draw_laser(f, session, 8.0), 80)
            self._save("clocks-and-fusion", (13, 4), lambda f: draw_clock(f, session), 80)
        return 0

    def _save(
        self, name: str, size_inches: tuple[float, float], draw: Callable[[Any], None], dpi: int
    ) -> None:
        (self.output / f"{name}.png").write_bytes(picture(size_inches, draw, dpi))


def _photographs(figure: Any, folder: Path) -> None:
    import cv2

    files = [*sorted((folder / "boards").glob("*.png"))[1:3], folder / "floor.png"]
    for axes, file in zip(figure.subplots(1, 3), files, strict=True):
        axes.imshow(np.asarray(cv2.imread(str(file), 0)), cmap="gray", vmin=0, vmax=255)
        axes.axis("off")
