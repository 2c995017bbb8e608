"""Drawing of a frame's rows into its image: discs, verticals, markers, tilt, and their residuals.

Outlines of discs are projected through the lens, and through the tilt by which rows are levelled;
verticals have error bars of one standard deviation at the horizon (the report's figures 5, 6, 8).
With reference rows, missed ones are drawn as well, and unmatched rows in another colour.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from typing import get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike

from camera import Camera
from detect.comparison.matching import error_px, match_frame, numbers
from detect.comparison.result import FrameMatch
from detect.explanation import DiscExplanation, Stage
from detect.lines import LineDetections
from detect.markers.detect import ACCEPTED as ACCEPTED_MARKER
from detect.markers.detect import SAME_MARKER, MarkerDetections
from detect.options import CompareOptions
from detect.projection import DiscProjection, circle_on_floor
from detect.row_files import KINDS, ImageRows
from detect.verticals.judgement import OUTCOMES
from detect.verticals.tracking import LineTracks
from lut.verticals import VerticalTable
from redetect.array_types import BoolArray, ByteArray, FloatArray, GreyImage
from redetect.landmarks import LineLandmark, MarkerLandmark, circle_arrays, wrap_angle
from redetect.plane import ellipses

_POINTS = 33
#: Size of the ellipses of markers' corners, in standard deviations.
_SIGMAS = 20.0
Colour = tuple[int, int, int]
#: Upper left and lower right corner, pixels.
Box = tuple[FloatArray, FloatArray]
LINE_COLOUR: Colour = (60, 220, 60)
SIGMA_COLOUR: Colour = (0, 170, 255)
_OUTLINE_COLOUR: Colour = (60, 200, 60)
_TEXT_COLOUR: Colour = (0, 230, 255)
EXTRA_COLOUR: Colour = (255, 60, 255)
MISSED_COLOUR: Colour = (60, 60, 255)
_WORDS_COLOUR: Colour = (230, 230, 230)

_SUBPIXEL_BITS = 4
# OpenCV's fixed-point coordinates have 32 bits; curves far outside are not drawn.
_FARTHEST_PX = 1e6
_COLUMNS = 750  # Text and strokes are enlarged in proportion to pictures of this width.
_LABELS_DOWN = 2  # A label is moved down by at most this many of its heights.
# Narrower images are drawn at double scale.
_SMALL_PX = 1200
_CANDIDATE_COLOUR: Colour = (255, 150, 40)


def draw_rows(
    image: GreyImage, projection: DiscProjection | None, rows: ImageRows, title: str = ""
) -> ByteArray:
    """Draw rows of a frame into its image (H, W), with a caption below it.

    Without a calibrated camera only markers are drawn. Channels of the picture (S H + h, S W, 3)
    are in OpenCV's order, blue, green, red; S is 2 for small images, to separate labels, else 1.
    """
    canvas = _Canvas(image, None if projection is None else projection.camera)
    words = [title] if title else []
    if not processed(rows):
        words.append("not processed")
    options = CompareOptions()
    if projection is not None and rows.lines is not None:
        match = match_frame("lines", title, rows.reference_lines, rows.lines, options)
        compared = rows.reference_lines is not None
        _draw_lines(canvas, projection.camera, match, compared)
        words.append(_count("verticals", match, compared))
    if projection is not None and rows.circles is not None:
        discs = rows.reference_circles, rows.circles
        of_frame = projection.for_frame(*discs)
        match = match_frame("circles", title, *discs, options, of_frame, rows.unlisted)
        compared = rows.reference_circles is not None
        _draw_discs(canvas, match, compared)
        words.append(_count("discs", match, compared))
    if rows.markers is not None:
        _draw_markers(canvas, rows.markers.markers)
        words.append(f"{len(rows.markers.markers)} markers")
    if rows.tilt is not None:
        pitch, roll = np.degrees([rows.tilt.pitch, rows.tilt.roll])
        words.append(f"pitch {pitch:.2f} roll {roll:.2f} deg")
    return with_legend(canvas.picture, [("   ".join(words), _WORDS_COLOUR)], image.shape[1], 0.38)


def processed(rows: ImageRows) -> bool:
    """Whether any file of detected rows has the image."""
    return any(getattr(rows, kind) is not None for kind in KINDS)


def _scaled(points: FloatArray, scale: int) -> FloatArray:
    """Positions (..., 2) in an image as those in its enlarged picture."""
    return scale * (points + 0.5) - 0.5


class _Canvas:
    """The picture of an image, twice as large if that is small, and what is drawn into it."""

    def __init__(self, image: GreyImage, camera: Camera | None) -> None:
        self.scale = 2 if image.shape[1] < _SMALL_PX else 1
        picture = canvas_of(image, camera)
        self.picture = np.repeat(np.repeat(picture, self.scale, axis=0), self.scale, axis=1)
        self.text_scale = enlargement(self.picture)  # of text and marks
        self._labels: list[Box] = []

    def scaled(self, points: FloatArray) -> FloatArray:
        """Positions (..., 2) in the image as those in the picture."""
        return _scaled(points, self.scale)

    def label(
        self, text: str, places: Sequence[tuple[FloatArray, float]], colour: Colour, size: float
    ) -> None:
        """Draw a label at the first place where it is on no other, or a little below the last one.

        A place is a point at half the label's height, and the share of its width to the left of it.
        If none is free, the label is left out: further away, it would seem to be another one's.
        """
        scale = self.text_scale
        extent = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size * scale, scale)[0]
        wide, high = np.array(extent) + 2.0 * scale
        corners = [place - np.array([share * wide, 0.5 * high]) for place, share in places]
        corners += [corners[-1] + [0.0, down * high] for down in range(1, _LABELS_DOWN + 1)]
        for least in corners:
            most = np.add(least, (wide, high))
            within = least[0] >= 0.0 and most[0] <= self.picture.shape[1]
            if within and not any(np.all((least < b) & (a < most)) for a, b in self._labels):
                self._labels.append((least, most))
                draw_text(self.picture, text, (least[0], most[1] - scale), colour, size)
                return


def line_curves(camera: Camera, ends: FloatArray) -> FloatArray:
    """Distorted curves of lines: (N, P, 2) pixels from top to bottom.

    `ends` (N, 4) are xtop, ytop, xbottom, ybottom in undistorted normalised coordinates.
    """
    share = np.linspace(0.0, 1.0, _POINTS)[:, None]
    return camera.distort((1.0 - share) * ends[:, None, :2] + share * ends[:, None, 2:])


def sigma_bars(camera: Camera, ends: FloatArray, sigma_rad: FloatArray) -> FloatArray:
    """Error bars of one standard deviation of the bearing, at the lines' crossings of the horizon.

    The horizon is that of the level robot; lines that end before it are extended. `ends`: (N, 4),
    as for `line_curves`; `sigma_rad`: (N,). Returns (N, 2, 2) pixels; NaN for lines that do not
    cross the horizon in front of the camera.
    """
    one = np.ones((len(ends), 1))
    top, bottom = (np.hstack([e, one]) @ camera.rotation.T for e in (ends[:, :2], ends[:, 2:]))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = top[:, 2] / (top[:, 2] - bottom[:, 2])
        x, y, _ = (top + share[:, None] * (bottom - top)).T
        bars = []
        # Bearings increase to the left, from -Y towards X: a rotation about Z.
        for angle in (sigma_rad, -sigma_rad):
            sine, cosine = np.sin(angle), np.cos(angle)
            turned = np.column_stack([cosine * x - sine * y, sine * x + cosine * y, 0.0 * x])
            bars.append(camera.project(turned @ camera.rotation))
    return np.stack(bars, axis=1)


def ends_of(rows: Sequence[LineLandmark]) -> FloatArray:
    """(N, 4) xtop, ytop, xbottom, ybottom of rows."""
    ends = [(r.xtop, r.ytop, r.xbottom, r.ybottom) for r in rows]
    return np.array(ends, dtype=np.float64).reshape(-1, 4)


def _draw_discs(canvas: _Canvas, match: FrameMatch, compared: bool) -> None:
    """Missed reference discs; detected ones with their two outlines and a label beside them."""
    projection = match.projection
    assert projection is not None
    settings = projection.settings
    rings = circle_on_floor(circle_arrays(match.missed).xy, settings.radius_m)
    for edge in projection.reference_px(rings):
        draw_curve(canvas.picture, canvas.scaled(edge), MISSED_COLOUR, closed=True)
    drawn = [(row, "", SIGMA_COLOUR) for row in match.set_aside]
    drawn += [(row, "", EXTRA_COLOUR if compared else SIGMA_COLOUR) for row in match.extra]
    matched = zip(match.matched, error_px(match))
    drawn += [(row, f" {px:.1f}px", SIGMA_COLOUR) for row, px in matched]
    radii = (settings.inner_radius_m, settings.radius_m, settings.outer_radius_m)
    rims = []
    for row, _, edge_colour in drawn:
        for radius_m, colour in zip(radii, (_OUTLINE_COLOUR, edge_colour, _OUTLINE_COLOUR)):
            outline = projection.detected_px(circle_on_floor((row.px, row.py), radius_m))
            rims.append(canvas.scaled(outline))
            draw_curve(canvas.picture, rims[-1], colour, closed=True)
    gap = np.array([3.0 * canvas.text_scale, 0.0])
    for (row, text, _), rim in zip(drawn, rims[2::3]):
        if np.all(np.abs(rim) < _FARTHEST_PX):
            (left, top), (right, bottom) = rim.min(axis=0), rim.max(axis=0)
            middle = 0.5 * (top + bottom)
            beside = [(np.array([right, middle]) + gap, 0.0), (np.array([left, middle]) - gap, 1.0)]
            canvas.label(f"{row.quality:.2f}{text}", beside, _TEXT_COLOUR, 0.35)


def _draw_lines(canvas: _Canvas, camera: Camera, match: FrameMatch, compared: bool) -> None:
    for curve in canvas.scaled(line_curves(camera, ends_of(match.missed))):
        draw_curve(canvas.picture, curve, MISSED_COLOUR)
    drawn = [(row, "", LINE_COLOUR) for row in match.set_aside]
    drawn += [(row, "", EXTRA_COLOUR if compared else LINE_COLOUR) for row in match.extra]
    for wanted, row in zip(match.matched_reference, match.matched):
        error = float(wrap_angle(row.alpha - wanted.alpha))
        text = f"{error / row.sigma:+.1f}" if row.sigma > 0.0 else ""
        drawn.append((row, text, LINE_COLOUR))
    rows = [row for row, _, _ in drawn]
    curves = canvas.scaled(line_curves(camera, ends_of(rows)))
    bars = canvas.scaled(sigma_bars(camera, ends_of(rows), numbers(rows, "sigma")))
    tick = canvas.text_scale * np.array([[0.0, -2.0], [0.0, 2.0]])
    for (_, text, colour), curve, bar in zip(drawn, curves, bars):
        draw_curve(canvas.picture, curve, colour)
        for points in (bar, bar[0] + tick, bar[1] + tick):
            draw_curve(canvas.picture, points, SIGMA_COLOUR)
        if text:
            below = curve[-1] + 2.5 * tick[1]
            places = [(below, 0.5), (below, 1.0), (below, 0.0)]
            canvas.label(text, places, SIGMA_COLOUR, 0.3)


def _draw_markers(canvas: _Canvas, found: Sequence[MarkerLandmark]) -> None:
    """Edges, a circle at the top left corner, and ellipses of 20 standard deviations."""
    circle = circle_on_floor((0.0, 0.0), 1.0, _POINTS)
    for row in found:
        corners = canvas.scaled(np.array([(c.u, c.v) for c in row.corners]))
        draw_curve(canvas.picture, corners, LINE_COLOUR, closed=True)
        spreads = [((c.cuu, c.cuv), (c.cuv, c.cvv)) for c in row.corners]
        for ellipse in ellipses(corners, spreads, canvas.scale * _SIGMAS, _POINTS):
            draw_curve(canvas.picture, ellipse, LINE_COLOUR, closed=True)
        first = corners[0] + 3.0 * canvas.text_scale * circle
        draw_curve(canvas.picture, first, MISSED_COLOUR, closed=True)
        draw_text(canvas.picture, f"{row.id}", corners.mean(axis=0), _TEXT_COLOUR, 0.45, (-8, 5))


def _count(what: str, match: FrameMatch, compared: bool) -> str:
    outcome = f" ({len(match.extra)} extra, {len(match.missed)} missed)" if compared else ""
    return f"{len(match.detected)} {what}{outcome}"


def canvas_of(image: GreyImage, camera: Camera | None = None) -> ByteArray:
    """A grey image (H, W) as a picture to draw into, (H, W, 3) in OpenCV's order blue, green, red.

    Pixels without a direction in the camera's calibration are dark red.
    """
    canvas = np.repeat(image[:, :, None], 3, axis=2)
    if camera is not None and camera.seen_share < 1.0:
        unseen = _unseen(camera)
        canvas[unseen] //= 3
        canvas[unseen] += np.array([0, 0, 80], np.uint8)
    return canvas


def png_of(picture: ByteArray) -> bytes:
    """A picture (blue, green, red) as a PNG file."""
    return cv2.imencode(".png", picture)[1].tobytes()


@lru_cache(maxsize=2)
def _unseen(camera: Camera) -> BoolArray:
    return np.isnan(camera.undistort(camera.pixel_grid())[..., 0])


def enlargement(canvas: ByteArray) -> int:
    """Factor on text and marks, so that they are visible when the whole picture is shown."""
    return max(1, round(int(canvas.shape[1]) / _COLUMNS))


def draw_curve(
    canvas: ByteArray, points: FloatArray, colour: Colour, *, closed: bool = False
) -> None:
    """Draw a curve through (N, 2) points u, v, unless one is not finite."""
    if np.all(np.abs(points) < _FARTHEST_PX):
        fixed = np.rint(points * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        width = max(1, enlargement(canvas) // 2)
        cv2.polylines(canvas, [fixed], closed, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def draw_text(
    canvas: ByteArray, text: str, at: ArrayLike, colour: Colour, size: float = 0.35,
    shift: tuple[int, int] = (0, 0),
) -> None:  # fmt: skip
    """Draw ASCII text with the left end of its base line at u, v, unless that is far outside.

    `shift` moves the text, by more in wide pictures.
    """
    place = np.asarray(at, dtype=np.float64)
    if np.all(np.abs(place) < _FARTHEST_PX):
        text_scale = enlargement(canvas)
        u, v = (np.rint(place) + text_scale * np.array(shift)).astype(int).tolist()
        cv2.putText(
            canvas, text.encode("ascii", "replace").decode(), (u, max(v, 10 * text_scale)),
            cv2.FONT_HERSHEY_SIMPLEX, text_scale * size, colour, text_scale, cv2.LINE_AA,
        )  # fmt: skip


def with_legend(
    canvas: ByteArray, words: Sequence[tuple[str, Colour]], column_px: int, size: float
) -> ByteArray:
    """The picture with text below it, in columns of a given width."""
    text_scale = enlargement(canvas)
    width = int(canvas.shape[1])
    per_row = max(1, width // (column_px * text_scale))
    rows = -(-len(words) // per_row)
    legend = np.zeros(((14 * rows + 4) * text_scale, width, 3), np.uint8)
    for k, (text, colour) in enumerate(words):
        shift = 4 + column_px * (k % per_row), 13 + 14 * (k // per_row)
        draw_text(legend, text, (0, 0), colour, size, shift)
    return np.concatenate([canvas, legend])


def _colours(names: Sequence[str]) -> dict[str, Colour]:
    """Distinct colours, always the same; the first is for accepted ones."""
    hues = np.linspace(128, 298, len(names)) % 256  # from cyan to yellow: no green
    colours = cv2.applyColorMap(hues.astype(np.uint8)[:, None], cv2.COLORMAP_HSV)[:, 0]
    pale = (75 + 0.7 * colours[1:]).astype(int).tolist()
    return dict(zip(names, [LINE_COLOUR, *map(tuple, pale)], strict=True))


_OUTCOME_COLOURS = _colours(OUTCOMES)
_STAGE_COLOURS = _colours(get_args(Stage))


def draw_tracks(image: GreyImage, table: VerticalTable, found: LineDetections) -> ByteArray:
    """Draw the points of tracks, coloured by their outcomes, with a legend below."""
    canvas = canvas_of(image)
    for t, outcome in enumerate(found.outcome):
        points = np.rint(track_pixels(found.tracks, table, t)).astype(np.intp)
        canvas[points[:, 1], np.clip(points[:, 0], 0, image.shape[1] - 1)] = _OUTCOME_COLOURS[
            outcome
        ]
    counts = sorted(Counter(found.outcome).items())
    words = [(f"{outcome}: {count}", _OUTCOME_COLOURS[outcome]) for outcome, count in counts]
    return with_legend(canvas, words, 190, 0.38)


def draw_candidates(picture: ByteArray, found: MarkerDetections, scale: int) -> ByteArray:
    """A picture with rejected candidates for markers, and the reasons for rejection below it."""
    for candidate in found.candidates:
        if candidate.outcome not in (ACCEPTED_MARKER, SAME_MARKER):
            draw_curve(picture, _scaled(candidate.outline, scale), _CANDIDATE_COLOUR, closed=True)
    causes = sorted(found.rejected.items())
    words = [(f"{cause}: {count}", _CANDIDATE_COLOUR) for cause, count in causes]
    return with_legend(picture, words, 210, 0.36)


def draw_explanation(found: DiscExplanation) -> ByteArray:
    """Draw numbered candidates for discs, coloured by their outcomes, with a legend."""
    canvas = canvas_of(found.image, found.camera)
    for number, candidate in enumerate(found.candidates, start=1):
        colour, place = _STAGE_COLOURS[candidate.stage], (candidate.x_m, candidate.y_m)
        rim = found.camera.project_floor(circle_on_floor(place, found.settings.radius_m))
        draw_curve(canvas, rim, colour, closed=True)
        beside = (float(rim[:, 0].max()), candidate.v)
        draw_text(canvas, f"{number}", beside, colour, shift=(2, 4))
    if found.at is not None:
        for arm in ([6.0, 0.0], [0.0, 6.0]):
            draw_curve(canvas, found.at + np.outer([-1.0, 1.0], arm), LINE_COLOUR)
    counts = Counter(candidate.stage for candidate in found.candidates)
    words = [(f"{stage}: {count}", _STAGE_COLOURS[stage]) for stage, count in counts.items()]
    return with_legend(canvas, words, 190, 0.38)


def track_pixels(tracks: LineTracks, table: VerticalTable, t: int) -> FloatArray:
    """(P, 2) image positions u, v of a track's points."""
    part = slice(tracks.bounds[t], tracks.bounds[t + 1])
    row, column = tracks.row[part], tracks.column[part]
    left = np.clip(column.astype(np.intp), 0, table.column.shape[1] - 2)
    share = column - left
    u = (1.0 - share) * table.column[row, left] + share * table.column[row, left + 1]
    u = np.where(np.isfinite(u), u, table.column[row, np.rint(column).astype(np.intp)])
    return np.stack([u, row.astype(np.float64)], axis=-1)
