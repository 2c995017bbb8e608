"""Figures of the report: the map with paths and ellipses, and errors over time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.reporting.page import Part, figure_file, image_part

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_WIDE_IN, _TALLEST_IN, _SERIES_HIGH_IN = 7.9, 7.9, 2.9
_MOST_POINTS = 1500
_BREAK_S = 1.0
# Stretches of time of which the largest value is drawn, over all visits.
_BINS = 340
# Pauses between visits, as a share of all time that is shown.
_PAUSE = 0.02


class Track(NamedTuple):
    """A stream as it is drawn; dashes (on, off, ... in points) show without colour."""

    label: str
    colour: str
    dashes: tuple[float, ...]
    poses: PlanarPoses


class Series(NamedTuple):
    """Values above 0 over time."""

    label: str
    colour: str
    dashes: tuple[float, ...]
    times_s: FloatArray
    values: FloatArray


def map_figure(words: str, tracks: Sequence[Track], building: FloatArray | None) -> Part:
    """Walls and paths."""
    return _map(words, tracks, building, np.zeros((0, 1, 2)))


def ellipse_figure(track: Track, building: FloatArray | None, count: int) -> Part:
    """Walls, a path, and 3 sigma ellipses of some of its poses, magnified to be seen."""
    outlines, factor = ellipses(track.poses, _scale([track], building), count)
    size = f"drawn {factor:g} times as large" if factor > 1.0 else "true to scale"
    words = f"{track.label}: path and 3\N{GREEK SMALL LETTER SIGMA} ellipses, {size}."
    return _map(words, [track], building, outlines)


def series_figure(
    words: str, unit: str, series: Sequence[Series], visits: Sequence[tuple[float, float]]
) -> Part:
    """Values on a logarithmic scale over the visits' times, the pauses between them cut out."""
    with figure_file((_WIDE_IN, _SERIES_HIGH_IN), "svg") as (figure, content):
        axes = figure.subplots()
        positive = np.concatenate([s.values[s.values > 0.0] for s in series] or [np.zeros(0)])
        if len(positive) and visits:
            _draw_series(axes, series, visits)
            least = 10.0 ** math.floor(math.log10(max(float(np.quantile(positive, 0.05)), 1e-9)))
            axes.set_yscale("log")
            axes.set_ylim(least, max(1.3 * float(positive.max()), 10.0 * least))
            axes.legend(loc="upper right", ncols=4, fontsize=8)
        else:
            axes.text(0.5, 0.5, "nothing to show", ha="center", transform=axes.transAxes)
        axes.set_ylabel(unit)
        axes.grid(axis="y", alpha=0.25, lw=0.6)
    return image_part(words, content.getvalue(), "svg+xml", 96.0 * _WIDE_IN, 96.0 * _SERIES_HIGH_IN)


def ellipses(poses: PlanarPoses, inches_per_m: float, count: int) -> tuple[FloatArray, float]:
    """(count, P, 2) outlines of 3 sigma ellipses evenly apart, and how much they are magnified."""
    assert poses.covariances is not None
    chosen = np.unique(np.linspace(0, len(poses) - 1, count).astype(np.int64))
    values, vectors = np.linalg.eigh(poses.covariances[chosen][:, :2, :2])
    axes = 3.0 * np.sqrt(np.maximum(values, 0.0))
    typical = float(np.median(axes[:, 1])) * inches_per_m
    factors = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
    # About a centimetre on the page.
    factor = max((f for f in factors if typical > 0.0 and f * typical <= 0.19), default=1.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 33)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    outlines = np.einsum("nij,pj->npi", vectors * (factor * axes)[:, None, :], circle)
    return poses.poses[chosen, None, :2] + outlines, factor


def largest_per_bin(
    times: FloatArray, values: FloatArray, span: float, bins: int
) -> tuple[FloatArray, FloatArray]:
    """The largest value of each bin of time, and its time."""
    if len(times) <= bins:
        return times, values
    bin_of = np.minimum((times / span * bins).astype(np.int64), bins - 1)
    order = np.lexsort((-values, bin_of))
    _, first = np.unique(bin_of[order], return_index=True)
    return times[order[first]], values[order[first]]


def _draw_series(
    axes: Axes, series: Sequence[Series], visits: Sequence[tuple[float, float]]
) -> None:
    spans = np.array([max(b - a, 1e-3) for a, b in visits])
    total = float(spans.sum())
    begins = np.concatenate([[0.0], np.cumsum(spans + min(_PAUSE, 0.3 / len(visits)) * total)[:-1]])
    ticks = []
    for number, ((first, last), span, begin) in enumerate(zip(visits, spans, begins), 1):
        axes.axvline(begin, color="0.6", lw=0.8)
        if span > 0.08 * total:
            ticks.append((begin + 0.5 * span, f"visit {number}: {span:.0f} s"))
        bins = max(int(_BINS * span / total), 2)
        for s in series:
            inside = (s.times_s >= first) & (s.times_s <= last)
            times, values = largest_per_bin(s.times_s[inside] - first, s.values[inside], span, bins)
            breaks = np.flatnonzero(np.diff(times) > max(3.0 * span / bins, _BREAK_S)) + 1
            axes.plot(
                begin + np.insert(times, breaks, np.nan), np.insert(values, breaks, np.nan),
                color=s.colour, lw=1.1, dashes=s.dashes, label=s.label if number == 1 else None,
            )  # fmt: skip
    axes.set_xlim(0.0, begins[-1] + spans[-1])
    axes.set_xticks([at for at, _ in ticks], [words for _, words in ticks], fontsize=8)


def _bounds(tracks: Sequence[Track], building: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Corners of the drawn area: the paths with a margin, or the whole building."""
    places = [track.poses.poses[:, :2] for track in tracks if len(track.poses)]
    if not places:
        places = [np.array([[0.0, 0.0]]) if building is None else building.reshape(-1, 2)]
    everything = np.concatenate(places)
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = max(1.0, 0.08 * float((high - low).max()))
    return low - margin, high + margin


def _scale(tracks: Sequence[Track], building: FloatArray | None) -> float:
    """Inches on the page per metre."""
    low, high = _bounds(tracks, building)
    return float(min(_WIDE_IN / (high[0] - low[0]), _TALLEST_IN / (high[1] - low[1])))


def _map(
    words: str, tracks: Sequence[Track], building: FloatArray | None, outlines: FloatArray
) -> Part:
    low, high = _bounds(tracks, building)
    size = np.maximum(_scale(tracks, building) * (high - low), (3.0, 2.0))
    with figure_file((float(size[0]), float(size[1])), "svg") as (figure, content):
        axes = figure.subplots()
        if building is not None:
            draw_walls(axes, building)
        for track in tracks:
            breaks = np.flatnonzero(np.diff(track.poses.times_s) > _BREAK_S) + 1
            thin = max(1, len(track.poses) // _MOST_POINTS)
            pieces = [piece[::thin] for piece in np.split(track.poses.poses[:, :2], breaks)]
            x, y = np.concatenate([np.vstack([p, (np.nan, np.nan)]) for p in pieces]).T
            axes.plot(x, y, color=track.colour, lw=1.3, dashes=track.dashes, label=track.label)
        for outline in outlines:
            axes.fill(*outline.T, fc=tracks[0].colour, ec=tracks[0].colour, lw=0.8, alpha=0.3)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal")
        axes.set(xlabel="x / m", ylabel="y / m")
        axes.grid(alpha=0.25, lw=0.6)
        if len(tracks) > 1:
            axes.legend(fontsize=8)
    return image_part(words, content.getvalue(), "svg+xml", 96.0 * size[0], 96.0 * size[1])


def draw_walls(axes: Axes, building: FloatArray) -> None:
    """Draw (S, 4) pieces of wall."""
    ends = np.concatenate([building.reshape(-1, 2, 2), np.full((len(building), 1, 2), np.nan)], 1)
    axes.plot(*ends.reshape(-1, 2).T, color="0.4", lw=1.0, zorder=1)
