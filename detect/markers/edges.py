"""The edges of a rough quadrangle: phase 3, first part.

Grey values are sampled in rows across each edge, and the median of the rows is taken in each part
of the edge. The edge is the line through the steps of all parts; the edges meet in the corners. Two
parts are enough to start the fit of the whole marker. All positions are straight ones (see
`detect.markers.geometry`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from detect.markers.geometry import Picture, is_convex
from detect.settings import MarkerSettings
from redetect.array_types import ByteArray, FloatArray

#: Reasons for rejection, as reported.
NO_EDGE = "edge not found"
NO_WHITE = "edges without contrast"

#: Number of rows across each part of an edge (odd), and of samples in each row.
_ROWS, _SAMPLES = 9, 25
_ACROSS = np.linspace(0.0, 1.0, _SAMPLES)[:, None]
#: Number of samples before each possible split of a row, and its product with that after it.
_COUNT = np.arange(1.0, _SAMPLES)[:, None]
_PAIRS = _COUNT * _COUNT[::-1]
#: Slopes up to this share of a row's steepest are due to uneven light.
_GENTLE_SLOPE = 0.05
#: Signs of the rotation of u, v to v, -u; indices of the next, opposite and previous corners.
_QUARTER_TURN = np.array([1.0, -1.0])
_NEXT, _OPPOSITE, _LAST = np.array([[1, 2, 3, 0], [2, 3, 0, 1], [3, 0, 1, 2]])
#: In the second pass, edges are searched within this many blurs plus pixels, at least the last.
_REACH_BLURS, _REACH_PX, _LEAST_REACH_PX = 2.5, 0.8, 2.2
#: Corners that move farther than this (in capture ranges) have left their quadrangle.
_LARGEST_MOVE = 2.5
#: Standard deviations of an edge's blur, pixels.
_LEAST_BLUR_PX, _LARGEST_BLUR_PX = 0.3, 6.0


class RefinedQuadrangle(NamedTuple):
    """A quadrangle with measured edges; edge k goes from corner k to corner k + 1."""

    corners: FloatArray  # (4, 2) straight pixels, clockwise as seen in the image
    covariance: FloatArray  # (4, 2, 2) of each corner, pixels squared; zero with two parts
    dark: FloatArray  # (4,) grey level inside each edge
    light: FloatArray  # (4,) grey level outside
    blur_px: float  # standard deviation, including that of the pixel itself
    support: float  # least contrast of any part of an edge, relative to that of the whole edge


def refine_quadrangle(
    picture: Picture,
    rough: FloatArray,
    border: float,
    capture_px: float,
    settings: MarkerSettings,
    parts: int = 2,
) -> RefinedQuadrangle | str:
    """Find the edges of a quadrangle (4, 2), clockwise at straight pixels, in the image.

    `border` is the black border's thickness in widths of the marker; edges are within `capture_px`
    of the rough ones. Three or more parts per edge give the covariance from the residuals of the
    steps. Returns the reason for rejection if there are no edges.
    """
    reasons = []
    for seam in (False, True)[: 2 if parts == 2 else 1]:  # White may be a mere seam.
        found = _edges_near(picture, rough, border, capture_px, settings, parts, seam)
        if not isinstance(found, str):
            reach = max(_REACH_BLURS * found.blur_px + _REACH_PX, _LEAST_REACH_PX)
            found = _edges_near(picture, found.corners, border, reach, settings, parts, seam)
        if isinstance(found, str):
            reasons.append(found)
        elif np.abs(found.corners - rough).max() > _LARGEST_MOVE * capture_px:
            reasons.append(NO_EDGE)
        else:
            return found
    return reasons[0]


def _edges_near(
    picture: Picture,
    corners: FloatArray,
    border: float,
    reach: float,
    settings: MarkerSettings,
    parts: int,
    seam: bool,
) -> RefinedQuadrangle | str:
    """The edges within reach of a quadrangle's, or the reason for rejection.

    If what is white outside is a mere `seam` before a darker ground, that ground counts as white.
    """
    side = corners[_NEXT] - corners
    length = np.hypot(side[:, 0], side[:, 1])
    outwards = side[:, ::-1] * _QUARTER_TURN / length[:, None]
    # The border's thickness is proportional to the height above the edge.
    height = corners - 0.5 * (corners[_OPPOSITE] + corners[_LAST])
    thickness = border * (height * outwards).sum(axis=1)
    outside = np.minimum(reach, np.maximum(1.2, thickness))
    inside = np.minimum(outside, np.maximum(1.0, 0.85 * thickness))
    margin = np.minimum(np.maximum(0.7 * outside / length, 0.1), 0.2)
    used = 1.0 - 2.0 * margin
    along = margin + used * (np.arange(parts * _ROWS)[:, None] / (parts * _ROWS - 1.0))
    on_edge = corners + along[..., None] * side
    ends = on_edge - inside[:, None] * outwards, on_edge + outside[:, None] * outwards
    grey = _sampled(picture, *ends)
    if grey is None:
        return NO_EDGE
    grey = grey.reshape(parts, _ROWS, _SAMPLES, 4)
    rows = np.partition(grey, _ROWS // 2, axis=1)[:, _ROWS // 2].astype(np.float64)
    if seam:
        # From the darkest sample of the inner half outwards, rows never get darker.
        inner = rows[:, : _SAMPLES // 2]
        before = np.arange(_SAMPLES)[:, None] < np.argmin(inner, axis=1)[:, None]
        level = inner.min(axis=1, keepdims=True)
        rows = np.maximum.accumulate(np.where(before, level, rows), axis=1)
    place, dark, light = _steps(rows)
    if not np.all((light > dark) & np.isfinite(place)):
        return NO_EDGE
    contrast = (light - dark).mean(axis=0)
    least = max(settings.least_contrast * picture.noise, settings.edge_balance * contrast.max())
    if contrast.min() < least:
        return NO_WHITE
    apart_px = (inside + outside) / (_SAMPLES - 1)
    slope = (rows[:, 2:] - rows[:, :-2]).max(axis=1) / (2.0 * apart_px)
    blur_px = np.sort(((light - dark) / slope).ravel())[2 * parts] / math.sqrt(2.0 * math.pi)

    # The line through the steps in the middle of all parts: normal @ place = distance.
    off = apart_px * place - inside
    middle = np.mean(off, axis=0)
    lever = ((np.arange(parts) + 0.5) / parts - 0.5)[:, None] * used * length
    squares = (lever**2).sum(axis=0)
    turn = (lever * off).sum(axis=0) / squares
    normal = outwards - (turn / length)[:, None] * side
    distance = (normal * (corners + 0.5 * side)).sum(axis=1) + middle
    (ax, ay), (bx, by), before = normal[_LAST].T, normal.T, distance[_LAST]
    with np.errstate(divide="ignore", invalid="ignore"):
        meet = np.array([by * before - ay * distance, ax * distance - bx * before])
        found = np.ascontiguousarray((meet / (ax * by - ay * bx)).T)
    if not is_convex(found):
        return NO_EDGE
    covariance = np.zeros((4, 2, 2))
    if parts > 2:
        variance = np.mean((off - middle - turn * lever) ** 2) * parts / (parts - 2)
        at_end = variance * (1.0 / parts + (0.5 * length) ** 2 / squares)
        # If a line moves, the corner moves along the other line.
        for spread, moved in ((at_end[_LAST], (by, -bx)), (at_end, (-ay, ax))):
            to = np.array(moved) / (ax * by - ay * bx)
            covariance += (spread * to * to[:, None]).T
    return RefinedQuadrangle(
        found,
        covariance,
        dark=dark.mean(axis=0),
        light=light.mean(axis=0),
        blur_px=min(max(blur_px, _LEAST_BLUR_PX), _LARGEST_BLUR_PX),
        support=float(((light - dark) / contrast).min()),
    )


def _sampled(picture: Picture, first: FloatArray, last: FloatArray) -> ByteArray | None:
    """(R, S, 4) grey values between straight positions (R, 4, 2); None if outside the image.

    They are so close to each other that distortion between them is negligible.
    """
    ends = picture.distort(np.stack([first, last]).reshape(-1, 2)).T.reshape(2, 2, -1, 1, 4)
    height, width = picture.grey.shape
    inside = (ends >= -0.5) & (ends <= np.array([width, height])[:, None, None, None, None] - 0.5)
    if not inside.all():
        return None
    begin, end = ends[:, 0], ends[:, 1]
    u, v = (begin + _ACROSS * (end - begin)).astype(np.float32).reshape(2, -1)
    grey = cv2.remap(picture.grey, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(grey, np.uint8).reshape(-1, _SAMPLES, 4)


def _steps(rows: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions of steps in rows (P, S, 4), in samples, and grey levels on both sides, all (P, 4).

    A row is split where two means explain it best (Otsu's criterion); the levels are the means of
    the outer halves of both parts. The step is at the centroid of the slopes, each reduced by a
    share of the steepest; NaN if the row never rises.
    """
    total = np.cumsum(rows, axis=1)
    before, after = total[:, :-1], total[:, -1:] - total[:, :-1]
    between = np.maximum(after * _COUNT - before * _COUNT[::-1], 0.0) ** 2 / _PAIRS
    split = 3 + np.argmax(between[:, 2:-2], axis=1)
    inner, outer = split // 2, (split + _SAMPLES) // 2
    part, edge = np.arange(len(rows))[:, None], np.arange(4)
    dark = total[part, inner, edge] / (inner + 1)
    light = (total[:, -1] - total[part, outer - 1, edge]) / (_SAMPLES - outer)
    slope = rows[:, 2:] - rows[:, :-2]
    steeper = np.maximum(slope - _GENTLE_SLOPE * slope.max(axis=1, keepdims=True), 0.0)
    with np.errstate(invalid="ignore"):
        place = (steeper * _COUNT[:-1]).sum(axis=1) / steeper.sum(axis=1)
    return place, dark, light
