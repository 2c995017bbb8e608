"""Drawings of the report: map, paths, ellipses and errors over time, as SVG elements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.trajectories.streams import PlanarPoses

FloatArray = NDArray[np.float64]

_WIDTH = 760.0
_TALLEST = 760.0
_MOST_POINTS = 1500
_BREAK_S = 1.0


@dataclass(frozen=True, eq=False)
class Track:
    """A stream as it is drawn.

    Attributes
    ----------
    label : str
    colour : str
        As CSS has it.
    dashes : str
        Of SVG; empty for a full line. Paper may be black and white.
    poses : PlanarPoses
    """

    label: str
    colour: str
    dashes: str
    poses: PlanarPoses


@dataclass(frozen=True, eq=False)
class Series:
    """Values over time, all above 0.

    Attributes
    ----------
    label, colour, dashes : str
    times_s : (N,) float64
    values : (N,) float64
    """

    label: str
    colour: str
    dashes: str
    times_s: FloatArray
    values: FloatArray


def draw_map(
    title: str,
    tracks: Sequence[Track],
    building: FloatArray | None,
    *,
    width: float = _WIDTH,
    ellipses: int = 0,
) -> tuple[Element, float]:
    """Walls, paths, and `ellipses` 3 sigma ellipses for each track.

    Returns
    -------
    Element
        The drawing.
    float
        By how much the ellipses are magnified, so that they can be seen; 1 without.
    """
    low, high = _bounds(tracks, building)
    scale = min(width / (high[0] - low[0]), _TALLEST / (high[1] - low[1]))
    size = (high - low) * scale
    drawing = _drawing(title, float(size[0]), float(size[1]) + 22.0)

    def place(points: FloatArray) -> FloatArray:
        return np.column_stack([(points[:, 0] - low[0]) * scale, (high[1] - points[:, 1]) * scale])

    frame = SubElement(
        drawing, "svg", x="0", y="0", width=_number(size[0]), height=_number(size[1])
    )
    SubElement(frame, "rect", {"width": "100%", "height": "100%", "fill": "#fbfbfa"})
    step = _round_step(float((high - low).max()) / 8.0)
    for axis in (0, 1):
        for value in np.arange(math.ceil(low[axis] / step) * step, high[axis], step):
            ends = np.array([[value, low[1]], [value, high[1]]])
            if axis == 1:
                ends = np.array([[low[0], value], [high[0], value]])
            _line(frame, place(ends), "#e6e4e0", 0.7)
    if building is not None:
        a, b = place(building[:, :2]), place(building[:, 2:])
        path = "".join(f"M{_xy(p)}L{_xy(q)}" for p, q in zip(a, b))
        stroke = {"fill": "none", "stroke": "#55524d", "stroke-width": "1.4"}
        SubElement(frame, "path", {"d": path, **stroke})
    factor = 1.0
    for track in tracks:
        _path(frame, track, place)
        if ellipses and track.poses.covariances is not None and len(track.poses):
            factor = _ellipses(frame, track, place, scale, ellipses)
    bar = _round_step(float(high[0] - low[0]) / 6.0)
    y = float(size[1]) + 13.0
    _line(drawing, np.array([[2.0, y], [2.0 + bar * scale, y]]), "#333", 2.0)
    _text(drawing, 8.0 + bar * scale, y + 4.0, f"{bar:g} m; x to the right, y up")
    return drawing, factor


def draw_series(
    title: str,
    unit: str,
    series: Sequence[Series],
    visits: Sequence[tuple[float, float]],
    *,
    width: float = _WIDTH,
    height: float = 250.0,
) -> Element:
    """Values on a logarithmic scale over the visits' times, the pauses between them cut out."""
    left, bottom, top = 76.0, 34.0, 8.0
    drawing = _drawing(title, width, height)
    values = np.concatenate([s.values[s.values > 0.0] for s in series] or [np.zeros(0)])
    if not len(values) or not visits:
        _text(drawing, left, height / 2.0, "nothing to show")
        return drawing
    floor, ceiling = (float(v) for v in (np.quantile(values, 0.05), values.max()))
    least = math.floor(math.log10(max(floor, 1e-9)))
    most = max(math.ceil(math.log10(ceiling)), least + 1)

    def level(value: FloatArray) -> FloatArray:
        share = (np.log10(np.maximum(value, 10.0**least)) - least) / (most - least)
        return np.asarray(height - bottom - share * (height - bottom - top))

    total = sum(max(b - a, 1e-3) for a, b in visits)
    pause = min(14.0, 0.3 * (width - left) / len(visits))
    available = width - left - 6.0 - pause * (len(visits) - 1)
    for power in range(least, most + 1):
        y = float(level(np.array([10.0**power]))[0])
        _line(drawing, np.array([[left, y], [width - 6.0, y]]), "#dddad5", 0.8)
        _text(drawing, left - 6.0, y + 4.0, f"{10.0**power:g} {unit}", anchor="end")
    x = left
    for number, (first, last) in enumerate(visits, 1):
        span = max(last - first, 1e-3)
        wide = available * span / total
        edges = np.array([[x, top], [x, height - bottom], [x + wide, height - bottom]])
        _line(drawing, edges, "#888", 0.8)
        if wide > 60.0:
            words = f"visit {number}: {span:.0f} s"
            _text(drawing, x + 0.5 * wide, height - bottom + 16.0, words, anchor="middle")
        for s in series:
            inside = (s.times_s >= first) & (s.times_s <= last)
            bins = max(int(wide / 2.0), 2)
            times, largest = _largest(s.times_s[inside] - first, s.values[inside], span, bins)
            if len(times):
                points = np.column_stack([x + wide * times / span, level(largest)])
                breaks = np.flatnonzero(np.diff(times) > max(3.0 * span / bins, _BREAK_S)) + 1
                for piece in np.split(points, breaks):
                    _line(drawing, piece, s.colour, 1.3, s.dashes)
        x += wide + pause
    return drawing


def legend(entries: Sequence[tuple[str, str, str]]) -> Element:
    """A line with label, colour and dashes of each entry."""
    drawing = _drawing("Legend", _WIDTH, 22.0)
    x = 4.0
    for label, colour, dashes in entries:
        _line(drawing, np.array([[x, 11.0], [x + 30.0, 11.0]]), colour, 2.4, dashes)
        _text(drawing, x + 36.0, 15.0, label)
        x += 56.0 + 7.2 * len(label)
    return drawing


def _path(frame: Element, track: Track, place: object) -> None:
    assert callable(place)
    if not len(track.poses):
        return
    breaks = np.flatnonzero(np.diff(track.poses.times_s) > _BREAK_S) + 1
    thin = max(1, len(track.poses) // _MOST_POINTS)
    for piece in np.split(track.poses.poses[:, :2], breaks):
        kept = piece[::thin] if len(piece) > thin else piece
        _line(frame, place(kept), track.colour, 1.5, track.dashes)


def _ellipses(frame: Element, track: Track, place: object, scale: float, wanted: int) -> float:
    """Draw 3 sigma ellipses at poses evenly apart; returns by how much they are magnified."""
    assert callable(place)
    assert track.poses.covariances is not None
    chosen = np.unique(np.linspace(0, len(track.poses) - 1, wanted).astype(np.int64))
    matrices = track.poses.covariances[chosen][:, :2, :2]
    values, vectors = np.linalg.eigh(0.5 * (matrices + np.swapaxes(matrices, 1, 2)))
    axes = 3.0 * np.sqrt(np.maximum(values, 0.0))
    typical = float(np.median(axes[:, 1])) * scale
    factor = 1.0
    # About a centimetre on the page.
    for step in (2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0):
        if typical > 0.0 and step * typical <= 18.0:
            factor = step
    for centre, length, vector in zip(place(track.poses.poses[chosen, :2]), axes, vectors):
        turn = -math.degrees(math.atan2(vector[1, 1], vector[0, 1]))
        SubElement(
            frame,
            "ellipse",
            {
                "cx": _number(centre[0]),
                "cy": _number(centre[1]),
                "rx": _number(max(factor * length[1] * scale, 0.4)),
                "ry": _number(max(factor * length[0] * scale, 0.4)),
                "transform": f"rotate({_number(turn)} {_number(centre[0])} {_number(centre[1])})",
                "fill": track.colour,
                "fill-opacity": "0.15",
                "stroke": track.colour,
                "stroke-width": "1",
            },
        )
    return factor


def _largest(
    times: FloatArray, values: FloatArray, span: float, bins: int
) -> tuple[FloatArray, FloatArray]:
    """The largest value of each bin of time, and its time."""
    if len(times) <= bins:
        return times, values
    bin_of = np.minimum((times / span * bins).astype(np.int64), bins - 1)
    order = np.lexsort((-values, bin_of))
    _, first = np.unique(bin_of[order], return_index=True)
    kept = order[first]
    return times[kept], values[kept]


def _bounds(tracks: Sequence[Track], building: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Corners of the drawn area: the paths with a margin, or the whole building without one."""
    places = [track.poses.poses[:, :2] for track in tracks if len(track.poses)]
    if not places and building is not None:
        places = [building.reshape(-1, 2)]
    if not places:
        return np.zeros(2), np.ones(2)
    everything = np.concatenate(places)
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = max(1.0, 0.08 * float((high - low).max()))
    return low - margin, high + margin


def _drawing(title: str, width: float, height: float) -> Element:
    drawing = Element(
        "svg",
        {
            "viewBox": f"0 0 {_number(width)} {_number(height)}",
            "width": _number(width),
            "height": _number(height),
            "role": "img",
            "aria-label": title,
        },
    )
    SubElement(drawing, "title").text = title
    return drawing


def _line(parent: Element, points: FloatArray, colour: str, width: float, dashes: str = "") -> None:
    attributes = {
        "points": " ".join(_xy(point) for point in points),
        "fill": "none",
        "stroke": colour,
        "stroke-width": f"{width:g}",
        "stroke-linejoin": "round",
    }
    if dashes:
        attributes["stroke-dasharray"] = dashes
    SubElement(parent, "polyline", attributes)


def _text(parent: Element, x: float, y: float, words: str, anchor: str = "start") -> None:
    attributes = {"x": _number(x), "y": _number(y), "text-anchor": anchor, "font-size": "12"}
    SubElement(parent, "text", attributes).text = words


def _xy(point: FloatArray) -> str:
    return f"{_number(point[0])},{_number(point[1])}"


def _number(value: float) -> str:
    return f"{float(value):.1f}"


def _round_step(wanted: float) -> float:
    """The smallest of ..., 0.5, 1, 2, 5, 10, ... that is at least `wanted`."""
    power = 10.0 ** math.floor(math.log10(max(wanted, 1e-9)))
    return power * min(step for step in (1.0, 2.0, 5.0, 10.0) if step * power >= wanted * 0.999)
