"""The picture of all frames of reference: pixel, camera, robot, floor, bearing, world."""

# ruff: noqa: RUF001
# Letters of the field: alpha, beta, sigma, and the minus sign.

from __future__ import annotations

from typing import Any

import numpy as np

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
    axes.set_xlim(-1.6, 6)
    axes.set_ylim(4.3, -1.7)


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
    axes.set_xlim(-1.4, 2.0)
    axes.set_ylim(-2.1, 1.4)


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
    axes.set_xlim(-1.4, 1.5)
    axes.set_ylim(-1.6, 1.5)
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
    axes.set_xlim(-1.5, 1.5)
    axes.set_ylim(-1.8, 1.0)
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
    axes.set_xlim(-1.7, 1.8)
    axes.set_ylim(-1.6, 1.5)


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
    axes.set_xlim(-1.5, 1.5)
    axes.set_ylim(-1.8, 1.5)
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
    axes.set_xlim(-1.6, 1.9)
    axes.set_ylim(-1.8, 1.5)


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
    axes.set_xlim(-1.5, 1.8)
    axes.set_ylim(-1.75, 1.6)
