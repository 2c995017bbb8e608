"""Figures of the report, and pictures that accompany results.

The former (SVG) are the map with paths and ellipses, and errors over time; the latter (PNG) are a
rig, the scanners' alignment, and errors at reference poses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from redetect import plane
from redetect.array_types import FloatArray
from redetect.groundtruth.fusion.clock import ClockModel, PtpdLog
from redetect.groundtruth.lasers.alignment import Alignment
from redetect.groundtruth.lasers.icp import nearest_on_segments
from redetect.groundtruth.lasers.scanners import Scanner
from redetect.groundtruth.markers.rig_estimation import RigEstimate
from redetect.groundtruth.markers.session import Rig, marker_corners
from redetect.groundtruth.trajectories import se3
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.groundtruth.validation.onboard import OF_A_WALL_M
from redetect.groundtruth.validation.scoring import PUBLISHED, PoseScore, ReferenceErrors
from redetect.reporting.page import Part, figure_file, image_part

_WIDE_IN, _TALLEST_IN, _SERIES_HIGH_IN = 7.9, 7.9, 2.9
_MOST_POINTS, _MOST_STAGE_POINTS = 1500, 400
_BREAK_S = 1.0
_MOST_VISITS = 12
_PLANES = ((0, 1, "from above"), (0, 2, "from the right"), (1, 2, "from the front"))
_AXES = ("x", "y", "z")
_AGREES, _DIFFERS = "#2a78b5", "#d9822b"
_COLOURS = ("#2a78b5", "#d9822b", "#3a9150", "#8e5bb0", "#b03a48", "#6b6b6b")
_BLUE, _ORANGE, _GREY = "#1f5f99", "#c8641e", "0.55"


class Track(NamedTuple):
    """A stream with its style; dashes (on, off, ... in points) distinguish it without colour."""

    label: str
    colour: str
    dashes: tuple[float, ...]
    poses: PlanarPoses


class Series(NamedTuple):
    """Positive values over time."""

    label: str
    colour: str
    dashes: tuple[float, ...]
    times_s: FloatArray
    values: FloatArray


def map_figure(
    words: str,
    tracks: Sequence[Track],
    building: FloatArray | None,
    outlines: Sequence[FloatArray] | FloatArray = (),
) -> Part:
    """Walls, paths, and outlines (P, 2) in the first path's colour."""
    low, high, scale = _area(tracks, building)
    width, height = np.maximum(scale * (high - low), (3.0, 2.0)).tolist()
    with figure_file((width, height), "svg") as (figure, content):
        axes = figure.subplots()
        _draw_paths(axes, tracks, building)
        for outline in outlines:
            axes.fill(*outline.T, fc=tracks[0].colour, ec=tracks[0].colour, lw=0.8, alpha=0.3)
        _frame(axes, low, high)
        axes.grid(alpha=0.25, lw=0.6)
        if len(tracks) > 1:
            axes.legend(fontsize=8)
    return image_part(words, content.getvalue(), "svg+xml", 96.0 * width, 96.0 * height)


def ellipse_figure(track: Track, building: FloatArray | None, count: int) -> Part:
    """Walls, a path, and 3 sigma ellipses of some of its poses, magnified to be visible."""
    outlines, factor = ellipses(track.poses, _area([track], building)[2], count)
    size = f"magnified {factor:g} times" if factor > 1.0 else "to scale"
    words = f"{track.label}: path and 3\N{GREEK SMALL LETTER SIGMA} ellipses, {size}."
    return map_figure(words, [track], building, outlines)


def series_figure(
    words: str, unit: str, series: Sequence[Series], visits: Sequence[tuple[float, float]]
) -> Part:
    """Values on a logarithmic scale over time, the longest visits side by side."""
    positive = np.concatenate([s.values[s.values > 0.0] for s in series] or [np.zeros(0)])
    if not (len(positive) and visits):
        return Part("note", f"{words} No values to show.")
    longest = sorted(sorted(visits, key=lambda visit: visit[0] - visit[1])[:_MOST_VISITS])
    spans = [max(last - first, 1e-3) for first, last in longest]
    with figure_file((_WIDE_IN, _SERIES_HIGH_IN), "svg") as (figure, content):
        grid = figure.subplots(1, len(spans), sharey=True, squeeze=False, width_ratios=spans)
        for axes, (first, last), span in zip(grid[0], longest, spans):
            for s in series:
                inside = (s.times_s >= first) & (s.times_s <= last)
                times, values = s.times_s[inside] - first, s.values[inside]
                breaks = np.flatnonzero(np.diff(times) > _BREAK_S) + 1
                axes.plot(
                    np.insert(times, breaks, np.nan), np.insert(values, breaks, np.nan),
                    color=s.colour, lw=1.1, dashes=s.dashes, label=s.label,
                )  # fmt: skip
            axes.set(xlim=(0.0, span), yscale="log")
            axes.grid(axis="y", alpha=0.25, lw=0.6)
            if span > 0.08 * sum(spans):
                number = visits.index((first, last)) + 1
                axes.set_xlabel(f"visit {number}: {span:.0f} s", fontsize=8)
            else:
                axes.set_xticks([])
        least = 10.0 ** math.floor(math.log10(max(float(np.quantile(positive, 0.05)), 1e-9)))
        grid[0, 0].set_ylim(least, max(1.3 * float(positive.max()), 10.0 * least))
        grid[0, 0].set_ylabel(unit)
        grid[0, -1].legend(loc="upper right", ncols=4, fontsize=8).set_in_layout(False)
    return image_part(words, content.getvalue(), "svg+xml", 96.0 * _WIDE_IN, 96.0 * _SERIES_HIGH_IN)


def ellipses(poses: PlanarPoses, inches_per_m: float, count: int) -> tuple[FloatArray, float]:
    """(count, P, 2) outlines of evenly spaced 3 sigma ellipses, and their magnification."""
    assert poses.covariances is not None
    chosen = np.unique(np.linspace(0, len(poses) - 1, count).astype(np.int64))
    covariances = poses.covariances[chosen][:, :2, :2]
    largest = np.maximum(np.linalg.eigvalsh(covariances)[:, 1], 0.0)
    typical = 3.0 * float(np.median(np.sqrt(largest))) * inches_per_m
    factors = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
    # About a centimetre on the page.
    factor = max((f for f in factors if typical > 0.0 and f * typical <= 0.19), default=1.0)
    return plane.ellipses(poses.poses[chosen, :2], covariances, 3.0 * factor, 32), factor


def _area(
    tracks: Sequence[Track], building: FloatArray | None
) -> tuple[FloatArray, FloatArray, float]:
    """Corners of the drawn area: the paths with a margin, or else the whole building; and inches
    on the page per metre.
    """
    places = [track.poses.poses[:, :2] for track in tracks if len(track.poses)]
    if not places:
        places = [np.array([[0.0, 0.0]]) if building is None else building.reshape(-1, 2)]
    everything = np.concatenate(places)
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = max(1.0, 0.08 * float((high - low).max()))
    low, high = low - margin, high + margin
    return low, high, float(np.min((_WIDE_IN, _TALLEST_IN) / (high - low)))


def _draw_paths(axes: Axes, tracks: Sequence[Track], building: FloatArray | None) -> None:
    """Walls, and paths with gaps at times without measurements."""
    if building is not None:
        draw_walls(axes, building)
    for track in tracks:
        breaks = np.flatnonzero(np.diff(track.poses.times_s) > _BREAK_S) + 1
        thin = max(1, len(track.poses) // _MOST_POINTS)
        pieces = [piece[::thin] for piece in np.split(track.poses.poses[:, :2], breaks)]
        x, y = np.concatenate([np.vstack([p, (np.nan, np.nan)]) for p in pieces]).T
        axes.plot(x, y, color=track.colour, lw=1.3, dashes=track.dashes, label=track.label)


def stages_figure(words: str, stages: Sequence[Track], building: FloatArray | None) -> Part:
    """A map of each stage of one visit; the last stage's path is drawn beneath the others."""
    low, high, _ = _area(stages, building)
    rows = math.ceil(len(stages) / 2)
    tall = float((high - low)[1] / (high - low)[0])
    height = min(rows * (0.5 * _WIDE_IN * tall + 0.5), 11.0)
    last = stages[-1]._replace(colour="0.8", dashes=())
    with figure_file((_WIDE_IN, height), "svg") as (figure, content):
        grid = figure.subplots(rows, 2, squeeze=False, sharex=True, sharey=True).ravel()
        for axes, stage in zip(grid, stages):
            _draw_paths(axes, [last], building)
            xy = stage.poses.poses[:, :2]
            few = xy[:: max(1, len(xy) // _MOST_STAGE_POINTS)]
            axes.plot(few[:, 0], few[:, 1], ".", color=stage.colour, ms=2.5, mew=0)
            _frame(axes, low, high, f"{stage.label}: {len(xy)} poses", fontsize=9)
        for axes in grid[len(stages) :]:
            axes.set_axis_off()
    return image_part(words, content.getvalue(), "svg+xml", 96.0 * _WIDE_IN, 96.0 * height)


def clock_figure(words: str, clock: ClockModel, ptpd: PtpdLog | None) -> Part:
    """Offsets of the robot's clock from each segment, and from ptpd, minus one straight line."""
    known = [s for s in clock.segments if math.isfinite(s.sigma_offset_s)]
    times = np.array([s.reference_s for s in known])
    offsets = np.array([s.offset_s if s.own_offset_s is None else s.own_offset_s for s in known])
    sigma = np.array([s.sigma_offset_s if s.own_sigma_s is None else s.own_sigma_s for s in known])
    begin, drift = times[0], np.mean([s.rate - 1.0 for s in known])
    if len(known) > 1:
        drift = np.polyfit(times - begin, offsets, 1, w=1.0 / np.maximum(sigma, 1e-9))[0]
    level = np.average(offsets - drift * (times - begin), weights=np.maximum(sigma, 1e-9) ** -2.0)

    def beyond(at: FloatArray, offset_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        return (at - begin) / 60.0, 1e3 * (offset_s - level - drift * (at - begin))

    with figure_file((_WIDE_IN, _SERIES_HIGH_IN), "svg") as (figure, content):
        axes = figure.subplots()
        if ptpd is not None:
            timed = np.isfinite(ptpd.times_s)
            there = ptpd.times_s[timed] - ptpd.offset_s[timed]
            axes.plot(*beyond(there, ptpd.offset_s[timed]), ".", color=_ORANGE, ms=3, label="ptpd")
        axes.errorbar(
            *beyond(times, offsets), yerr=1.96e3 * sigma, fmt="o", color=_BLUE, capsize=3, ms=5,
            label="segments, 95 %",
        )  # fmt: skip
        axes.axhline(0.0, color=_GREY, lw=0.8, label=f"line: drift {1e6 * drift:+.1f} ppm")
        axes.set(xlabel="time / min", ylabel="offset minus line / ms")
        axes.legend(fontsize=8)
        axes.grid(alpha=0.25)
    return image_part(words, content.getvalue(), "svg+xml", 96.0 * _WIDE_IN, 96.0 * _SERIES_HIGH_IN)


def _frame(axes: Axes, low: FloatArray, high: FloatArray, title: str = "", **words: Any) -> None:
    """The frame of a map between two corners."""
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x / m", ylabel="y / m")
    axes.set_aspect("equal")
    axes.grid(alpha=0.25)
    if title:
        axes.set_title(title, **words)


def draw_walls(axes: Axes, building: FloatArray) -> None:
    """Draw (S, 4) wall segments."""
    ends = np.concatenate([building.reshape(-1, 2, 2), np.full((len(building), 1, 2), np.nan)], 1)
    axes.plot(*ends.reshape(-1, 2).T, color="0.4", lw=1.0, zorder=1)


def draw_rig(estimate: RigEstimate) -> bytes:
    """Draw a rig from three sides; returns a PNG's bytes, the same for the same input.

    Pairwise estimates are drawn as the position of one marker relative to the other.
    """
    rig = estimate.rig
    agreeing, differing = _clouds(estimate)
    with figure_file((13.5, 5.0), "png") as (figure, content):
        centre = rig.robot_from_marker[:, :3, 3]
        middle = 0.5 * (centre.min(axis=0) + centre.max(axis=0))
        reach = 0.5 * float(np.ptp(centre, axis=0).max()) + float(rig.widths_m.max())
        for axes, (across, up, title) in zip(figure.subplots(1, 3), _PLANES):
            # Wrong estimates may be far away: only those inside the picture are drawn.
            axes.scatter(
                differing[:, across], differing[:, up], s=14, marker="x", color=_DIFFERS, lw=0.8,
                label=f"pairwise, differs ({len(differing)})", zorder=1,
            )  # fmt: skip
            axes.scatter(
                agreeing[:, across], agreeing[:, up], s=9, color=_AGREES, alpha=0.35, lw=0,
                label=f"pairwise, agrees ({len(agreeing)})", zorder=2,
            )  # fmt: skip
            _draw_markers(axes, rig, across, up)
            of = [across, up]
            _frame(axes, middle[of] - reach, middle[of] + reach, title)
            axes.set(xlabel=f"{_AXES[across]} / m", ylabel=f"{_AXES[up]} / m")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return content.getvalue()


def _clouds(estimate: RigEstimate) -> tuple[FloatArray, FloatArray]:
    """Markers' centres from the pairwise estimates that agree, and from those that differ."""
    poses, pairs = estimate.rig.robot_from_marker, sorted(estimate.pairs.items())
    estimates = [np.zeros((0, 4, 4))]
    for (a, b), pair in pairs:
        estimates += [poses[a] @ pair.estimates, poses[b] @ se3.inverse(pair.estimates)]
    places = np.concatenate(estimates)[:, :3, 3]
    agrees = np.array([one for _, pair in pairs for one in (*pair.agrees, *pair.agrees)], bool)
    return places[agrees], places[~agrees]


def _draw_markers(axes: Axes, rig: Rig, across: int, up: int) -> None:
    for marker, width, pose in zip(rig.ids, rig.widths_m, rig.robot_from_marker):
        outline = se3.apply(pose, marker_corners(width)[[0, 1, 2, 3, 0]])
        label = "adjusted markers" if marker == rig.ids[0] else None
        axes.plot(outline[:, across], outline[:, up], color="black", lw=1.4, label=label, zorder=3)
        normal = se3.apply(pose, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.6 * width]]))
        axes.plot(normal[:, across], normal[:, up], color="black", lw=0.8, zorder=3)
        axes.annotate(
            str(marker), (float(normal[1, across]), float(normal[1, up])), ha="center",
            va="center", fontsize=10,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
            zorder=4, annotation_clip=True,
        )  # fmt: skip


def draw_alignment(
    measured: tuple[Scanner, ...], alignment: Alignment, clouds: list[FloatArray],
    building: FloatArray, icp_rms_m: list[FloatArray],
) -> bytes:  # fmt: skip
    """Draw scanners' points on the map for measured and aligned poses; returns a PNG's bytes.

    Beside them, `icp_rms_m`: for each scanner, the distances from the map (m) after each step of an
    ICP from its measured pose.
    """
    with figure_file((17.0, 5.4), "png") as (figure, content):
        after = [scanner.pose for scanner in alignment.scanners]
        before = [scanner.pose for scanner in measured]
        everything = np.concatenate([plane.apply(p, cloud) for p, cloud in zip(after, clouds)])
        low, high = everything.min(axis=0) - 0.5, everything.max(axis=0) + 0.5
        *maps, steps = figure.subplots(1, 3)
        for axes, poses, title in zip(maps, (before, after), ("measured by hand", "aligned")):
            draw_walls(axes, building)
            for k, (pose, cloud) in enumerate(zip(poses, clouds)):
                colour = _COLOURS[k % len(_COLOURS)]
                points = plane.apply(pose, cloud)
                axes.scatter(points[:, 0], points[:, 1], s=7, color=colour, lw=0, zorder=2)
                ahead = plane.apply(pose, np.array([[0.0, 0.0], [0.5, 0.0]]))
                axes.plot(ahead[:, 0], ahead[:, 1], color=colour, lw=2.0, zorder=3)
                axes.plot(
                    *pose[:2], "o", color=colour, ms=7, zorder=3, label=alignment.scanners[k].name
                )
            _frame(axes, low, high, title)
        axes.legend(loc="upper right", framealpha=0.9)
        for k, rms_m in enumerate(icp_rms_m):
            steps.plot(1e3 * rms_m, ".-", color=_COLOURS[k % len(_COLOURS)], lw=1.2)
        steps.set(yscale="log", xlabel="step", ylabel="rms distance from the map / mm")
        steps.set_title("ICP of each scanner to the map, from its measured pose")
        steps.grid(alpha=0.25)
    return content.getvalue()


def draw_errors(errors: ReferenceErrors, score: PoseScore) -> bytes:
    """Draw errors, at least one, with bounds from their covariances; returns a PNG's bytes.

    `score`: of these errors. The same input gives the same bytes.
    """
    with figure_file((13.5, 6.4), "png") as (figure, content):
        linear, angular = figure.subplots(2, 1)
        names = [str(reference.index) for reference in errors.references]
        at = np.arange(len(names))
        x, y, theta = errors.error.T
        linear.bar(at, 1e3 * np.hypot(x, y), color=_BLUE, width=0.6, label="error")
        # The root mean square distance, which is comparable to errors.
        expected = 1e3 * errors.sigma[:, 0]
        if np.isfinite(expected).any():
            linear.plot(at, expected, "_", color=_ORANGE, ms=11, mew=2, label="expected (rms)")
        linear.axhline(1e3 * score.position_mean_m, color=_BLUE, lw=1.0, ls="--", label="mean")
        height = 1e3 * PUBLISHED[0].position_mean_m
        label = f"mean of {PUBLISHED[0].name}: {height:g} mm"
        if PUBLISHED[0].position_mean_m < 2.0 * score.position_max_m:
            linear.axhline(height, color=_GREY, lw=1.0, ls=":", label=label)
        else:
            linear.plot([], [], " ", label=f"{label}, above the plot")
        linear.set_ylabel("linear error / mm")
        linear.set_title(
            f"linear: mean {1e3 * score.position_mean_m:.2f} mm, sigma "
            f"{1e3 * score.position_sigma_m:.2f} mm, worst {1e3 * score.position_max_m:.2f} mm",
            fontsize=10,
        )
        turns, sigma = np.degrees(theta), np.degrees(errors.sigma[:, 1])
        angular.axhline(0.0, color=_GREY, lw=0.8)
        angular.errorbar(
            at, turns, yerr=np.where(np.isfinite(sigma), sigma, 0.0), fmt="o", color=_BLUE,
            ecolor=_ORANGE, ms=4.5, capsize=2.5, label="error, one sigma expected",
        )  # fmt: skip
        angular.set_ylabel("angular error / deg")
        angular.set_xlabel("reference pose")
        angular.set_title(
            f"angular: mean {math.degrees(score.angle_mean_rad):+.3f} deg, sigma "
            f"{math.degrees(score.angle_sigma_rad):.3f} deg, worst "
            f"{math.degrees(score.angle_max_rad):.3f} deg",
            fontsize=10,
        )
        for axes in (linear, angular):
            axes.set_xticks(at, names, fontsize=8, rotation=90 if len(at) > 40 else 0)
            axes.set_xlim(-0.7, len(at) - 0.3)
            axes.grid(axis="y", alpha=0.25)
            low, high = axes.get_ylim()
            axes.set_ylim(low, high + 0.22 * (high - low))  # space for the legend
            axes.legend(loc="upper center", ncols=4, fontsize=8, framealpha=0.9)
    return content.getvalue()


def draw_scans(errors: ReferenceErrors, building: FloatArray) -> bytes:
    """Draw the scans on board on the map, for each set of poses; returns a PNG's bytes.

    The sets are the reference poses from distances alone, those refined by scans, and the ground
    truth. The same input gives the same bytes.
    """
    kept = [i for i, r in enumerate(errors.references) if r.averaged is not None]
    refined = np.stack([errors.references[i].pose for i in kept])
    distances = np.stack([errors.references[i].distances.pose for i in kept])
    clouds = [one.robot_points() for i in kept if (one := errors.references[i].averaged)]
    sets = {
        "poses by distances": distances,
        "refined by the scans": refined,
        "by the ground truth": refined + errors.error[kept],
    }
    with figure_file((13.5, 3.7), "png") as (figure, content):
        maps = figure.subplots(1, 3, sharex=True, sharey=True)
        for axes, (title, poses) in zip(maps, sets.items()):
            points = np.concatenate([plane.apply(p, cloud) for p, cloud in zip(poses, clouds)])
            squared = nearest_on_segments(points, building)[2]
            near = np.sqrt(squared[squared < OF_A_WALL_M**2])
            draw_walls(axes, building)
            axes.plot(points[:, 0], points[:, 1], ".", color=_BLUE, ms=1.5, alpha=0.4, mew=0)
            axes.plot(poses[:, 0], poses[:, 1], "x", color=_ORANGE, ms=4)
            low, high = np.quantile(points, (0.01, 0.99), axis=0)
            rms = 1e3 * float(np.sqrt(np.mean(near**2))) if len(near) else math.nan
            title += f": {rms:.1f} mm rms from the walls"
            _frame(axes, low - 0.5, high + 0.5, title, fontsize=10)
    return content.getvalue()
