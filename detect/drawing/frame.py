"""Rows of one frame drawn into its image: discs, verticals, markers, tilt, and their residuals.

Everything drawn comes from files; nothing is detected again. Outlines of discs go through the
tilt of the frame, where the rows are corrected for it, and through the lens; verticals through the
lens, with a bar of one standard deviation to each side where they cross the horizon (the report's
figures 5, 6 and 8). Where there are reference rows, those that are missing are drawn as well, and
rows that fit none have another colour.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.comparison.circles import pair_discs
from detect.comparison.lines import joined_lines, pair_lines
from detect.comparison.result import CompareOptions, LineCompareOptions
from detect.drawing.inputs import SeenRows
from detect.drawing.strokes import Colour, canvas_of, draw_bar, draw_curve, draw_text, enlargement
from detect.markers.drawing import mark_marker
from detect.seen import FrameView, circle_on_floor, image_positions
from detect.settings import CircleSettings
from landmarks import (
    CircleLandmark,
    LineLandmark,
    MarkerLandmark,
    circle_arrays,
    wrap_angle,
)

if TYPE_CHECKING:
    from detect.circles import CircleDetections

FloatArray = NDArray[np.float64]

_POINTS = 33
_LEGEND_PX = 16
_LINE_COLOUR: Colour = (60, 220, 60)
_SIGMA_COLOUR: Colour = (0, 170, 255)
_EDGE_COLOUR: Colour = (0, 170, 255)
_OUTLINE_COLOUR: Colour = (60, 200, 60)
_TEXT_COLOUR: Colour = (0, 230, 255)
_EXTRA_COLOUR: Colour = (255, 60, 255)
_MISSED_COLOUR: Colour = (60, 60, 255)
_WORDS_COLOUR: Colour = (230, 230, 230)


def draw_rows(
    image: NDArray[np.uint8],
    camera: Camera | None,
    rows: SeenRows,
    settings: CircleSettings,
    gate: CompareOptions,
    line_gate: LineCompareOptions,
    title: str = "",
) -> NDArray[np.uint8]:
    """Draw what files say of a frame into its image, with a line of words below.

    Parameters
    ----------
    image : (H, W) uint8
        The grey image.
    camera : Camera or None
        The calibrated camera; without one, only markers are drawn.
    rows : SeenRows
        The rows of the files.
    settings : CircleSettings
        The radii of the discs' outlines.
    gate, line_gate : CompareOptions, LineCompareOptions
        What counts as the same disc or vertical as one of the reference.
    title : str
        Beginning of the line below the picture.

    Returns
    -------
    (H + h, W, 3) uint8
        In OpenCV's order blue, green, red; h is the height of the line of words.
    """
    canvas = canvas_of(image, camera)
    words = [title] if title else []
    if camera is not None:
        if rows.lines is not None:
            words.append(_draw_lines(canvas, camera, rows.lines, rows.reference_lines, line_gate))
        if rows.circles is not None:
            view = FrameView(camera, settings.radius_m, rows.reference_by, rows.levelled_by)
            words.append(
                _draw_discs(canvas, view, rows.circles, rows.reference_circles, settings, gate)
            )
    if rows.markers is not None:
        words.append(_draw_markers(canvas, rows.markers))
    if rows.tilt is not None:
        pitch, roll = np.degrees([rows.tilt.pitch, rows.tilt.roll])
        words.append(f"pitch {pitch:.2f} roll {roll:.2f} deg")
    times = enlargement(canvas)
    legend = np.zeros((_LEGEND_PX * times, image.shape[1], 3), np.uint8)
    at = (4 * times, (_LEGEND_PX - 5) * times)
    draw_text(legend, "   ".join(words), at, _WORDS_COLOUR, 0.38)
    return np.concatenate([canvas, legend])


def line_curves(camera: Camera, ends: FloatArray) -> FloatArray:
    """Lines as they are seen through the lens.

    Parameters
    ----------
    camera : Camera
    ends : (N, 4) float64
        xtop, ytop, xbottom, ybottom: undistorted normalised coordinates.

    Returns
    -------
    (N, P, 2) float64
        Pixels from top to bottom.
    """
    share = np.linspace(0.0, 1.0, _POINTS)[:, None]
    return camera.distort((1.0 - share) * ends[:, None, :2] + share * ends[:, None, 2:])


def sigma_bars(camera: Camera, ends: FloatArray, sigma_rad: FloatArray) -> FloatArray:
    """Bars of one standard deviation of the bearing to each side of where lines cross the horizon.

    Parameters
    ----------
    camera : Camera
        Gives the horizon, that of the level robot.
    ends : (N, 4) float64
        As for `line_curves`; a line that ends before the horizon is made longer.
    sigma_rad : (N,) float64
        Standard deviations of the bearings.

    Returns
    -------
    (N, 2, 2) float64
        Pixels of the bars' ends; NaN for lines that do not cross the horizon before the camera.
    """
    one = np.ones((len(ends), 1))
    rotation = camera.rotation
    top, bottom = (np.hstack([e, one]) @ rotation.T for e in (ends[:, :2], ends[:, 2:]))
    fall = top[:, 2] - bottom[:, 2]
    share = np.divide(top[:, 2], fall, out=np.full(len(ends), np.nan), where=np.abs(fall) > 1e-12)
    crossing = top + share[:, None] * (bottom - top)
    sine, cosine = np.sin(sigma_rad), np.cos(sigma_rad)
    bars = []
    # Bearings grow to the left, from -Y towards X: turned about Z.
    for sign in (1.0, -1.0):
        x = cosine * crossing[:, 0] - sign * sine * crossing[:, 1]
        y = sign * sine * crossing[:, 0] + cosine * crossing[:, 1]
        seen = np.column_stack([x, y, np.zeros(len(ends))]) @ rotation
        ahead = np.where(seen[:, 2:] > 1e-6, seen[:, 2:], np.nan)
        bars.append(camera.distort(seen[:, :2] / ahead))
    return np.stack(bars, axis=1)


def ends_of(rows: Sequence[LineLandmark]) -> FloatArray:
    """(N, 4) xtop, ytop, xbottom, ybottom of rows."""
    ends = [(r.xtop, r.ytop, r.xbottom, r.ybottom) for r in rows]
    return np.array(ends, dtype=np.float64).reshape(-1, 4)


def _draw_discs(
    canvas: NDArray[np.uint8],
    view: FrameView,
    found: Sequence[CircleLandmark],
    wanted: Sequence[CircleLandmark] | None,
    settings: CircleSettings,
    gate: CompareOptions,
) -> str:
    camera = view.camera
    project = partial(image_positions, camera, levelled_by=view.detected_by)
    places = circle_arrays(found)
    colours = [_EDGE_COLOUR if wanted is None else _EXTRA_COLOUR] * len(found)
    texts = [f"{row.quality:.2f}" for row in found]
    words = f"{len(found)} discs"
    if wanted is not None:
        pairs = pair_discs(wanted, found, gate, view)
        reference_xy = circle_arrays(wanted).xy
        at = partial(image_positions, camera, levelled_by=view.reference_by)
        apart = project(places.xy[pairs.second]) - at(reference_xy[pairs.first])
        for j, size in zip(pairs.second, np.hypot(*apart.T)):
            colours[j] = _EDGE_COLOUR
            texts[j] += f" {size:.1f}px"
        for i in pairs.first_alone:
            edge = at(circle_on_floor(reference_xy[i], settings.radius_m))
            draw_curve(canvas, edge, _MISSED_COLOUR, closed=True)
        words += _fate(len(pairs.second_alone), len(pairs.first_alone))
    for centre, text, colour in zip(places.xy, texts, colours):
        _outline_disc(canvas, project, centre, settings, text, edge_colour=colour)
    return words


def _draw_lines(
    canvas: NDArray[np.uint8],
    camera: Camera,
    found: Sequence[LineLandmark],
    wanted: Sequence[LineLandmark] | None,
    gate: LineCompareOptions,
) -> str:
    colours = [_LINE_COLOUR if wanted is None else _EXTRA_COLOUR] * len(found)
    texts = [""] * len(found)
    words = f"{len(found)} verticals"
    if wanted is not None:
        pairs = pair_lines(wanted, found, gate)
        for i, j in zip(pairs.first, pairs.second):
            colours[j] = _LINE_COLOUR
            if found[j].sigma > 0.0:
                error = float(wrap_angle(found[j].alpha - wanted[i].alpha)) / found[j].sigma
                texts[j] = f"{error:+.1f}"
        left = [wanted[i] for i in pairs.first_alone]
        joined = joined_lines(left, [found[j] for j in pairs.second], gate)
        missed = [row for row, with_another in zip(left, joined) if not with_another]
        for curve in line_curves(camera, ends_of(missed)):
            draw_curve(canvas, curve, _MISSED_COLOUR)
        words += _fate(len(pairs.second_alone), len(missed))
    ends = ends_of(found)
    bars = sigma_bars(camera, ends, np.array([row.sigma for row in found], dtype=np.float64))
    times = enlargement(canvas)
    for curve, bar, colour, text in zip(line_curves(camera, ends), bars, colours, texts):
        draw_curve(canvas, curve, colour)
        draw_bar(canvas, bar, _SIGMA_COLOUR)
        if text and np.all(np.isfinite(curve[-1])):
            at = (round(float(curve[-1, 0])) - 8 * times, round(float(curve[-1, 1])) + 9 * times)
            draw_text(canvas, text, at, _SIGMA_COLOUR, 0.3)
    return words


def _draw_markers(canvas: NDArray[np.uint8], found: Sequence[MarkerLandmark]) -> str:
    for row in found:
        corners = np.array([(c.u, c.v) for c in row.corners])
        covariance = np.array([[(c.cuu, c.cuv), (c.cuv, c.cvv)] for c in row.corners])
        mark_marker(canvas, row.id, corners, covariance)
    return f"{len(found)} markers"


def _fate(extra: int, missed: int) -> str:
    return f" ({extra} extra, {missed} missed)"


def draw_circles(
    image: NDArray[np.uint8],
    camera: Camera,
    found: CircleDetections,
    settings: CircleSettings,
) -> NDArray[np.uint8]:
    """Draw the outlines of detected discs and their quality (the report's figure 8).

    Parameters
    ----------
    image : (H, W) uint8
        The grey image.
    camera : Camera
        The calibrated camera, through which the outlines are drawn.
    found : CircleDetections
        The discs.
    settings : CircleSettings
        The radii of the outlines.

    Returns
    -------
    (H, W, 3) uint8
        In OpenCV's order blue, green, red.
    """
    canvas = canvas_of(image, camera)
    for centre, quality in zip(found.floor_xy, found.quality):
        _outline_disc(canvas, camera.project_floor, centre, settings, f"{quality:.2f}")
    return canvas


def _outline_disc(
    canvas: NDArray[np.uint8],
    project: Callable[[FloatArray], FloatArray],
    centre_xy: FloatArray,
    settings: CircleSettings,
    text: str,
    *,
    edge_colour: Colour = _EDGE_COLOUR,
) -> None:
    """Draw a disc's edge and its two outlines, and a word above.

    `project` takes (N, 2) places on the floor (m) to (N, 2) pixels, NaN where they are not seen.
    """
    for radius, colour in (
        (settings.inner_radius_m, _OUTLINE_COLOUR),
        (settings.radius_m, edge_colour),
        (settings.outer_radius_m, _OUTLINE_COLOUR),
    ):
        draw_curve(canvas, project(circle_on_floor(centre_xy, radius)), colour, closed=True)
    u, v = project(centre_xy + np.array([0.0, -settings.outer_radius_m]))
    if np.isfinite(u) and np.isfinite(v):
        times = enlargement(canvas)
        at = (round(float(u)) - 14 * times, max(10 * times, round(float(v)) - 3 * times))
        draw_text(canvas, text, at, _TEXT_COLOUR)
