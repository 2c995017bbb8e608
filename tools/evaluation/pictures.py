"""The pictures of the documentation, except the schematic ones, which are drawn by hand (SVG)."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np

from camera import Camera
from detect.circles import detect_circles, disc_shape, disc_table
from detect.drawing.frame import track_pixels
from detect.line_settings import LineSettings
from detect.lines import detect_lines
from detect.markers.candidates import closing, dark_pixels
from detect.markers.detect import detect_markers
from detect.projection import circle_on_floor, summed_steps
from detect.settings import CircleSettings, MarkerSettings
from detect.sources.grey_images import read_image
from detect.sources.opening import open_run
from lut import cached_disc_table, cached_vertical_table
from lut.outlines import floor_positions, row_step_m
from redetect.groundtruth.fusion.clock import read_clock
from redetect.groundtruth.lasers.building import read_building
from redetect.groundtruth.lasers.scanners import read_robot, read_scanners, read_scans
from redetect.groundtruth.trajectories.streams import read_planar_poses
from redetect.landmarks import read_frames, wrap_angle
from redetect.landmarks.map_file import read_path
from redetect.plane import apply
from redetect.reporting.page import figure_file
from tools.detector_maps import line_response, quality_of_centres
from tools.evaluation.figures import Figures, Study
from tools.evaluation.maps import read_truth

_INK, _EDGE, _RINGS, _LINE = "#444444", "#e67e22", "#2ecc71", "#e67e22"
_OWN, _OTHER = "#1f4e9c", "#e67e22"


def draw_discs(figure: Any, run: Path, frame: int) -> None:
    """Quality of every pixel; candidates; fitted discs."""
    camera, image = _frame(run, frame)
    settings = CircleSettings()
    table = disc_table(camera, settings)
    without_fit = CircleSettings(refine=False)
    every = cached_disc_table(camera, disc_shape(without_fit))
    quality, _ = quality_of_centres(image, every)
    found = detect_circles(image, camera, table, settings)
    loose = detect_circles(image, camera, every, without_fit)
    titles = (
        "quality of the outlines round every pixel: between-class over total variance",
        f"candidates: {len(loose)} local maxima above {settings.threshold:g}, one per "
        f"{settings.separation_m:g} m",
        f"fitted through the lens, and weighed: {len(found)} discs (edge, and the two outlines)",
    )
    panels = _panels(figure, (3, 1), image, titles)
    panels[0].imshow(np.where(quality > 0.0, quality, np.nan), cmap="magma", vmin=0, vmax=1)
    panels[1].plot(*loose.pixels.T, "+", color=_RINGS, markersize=7)
    radii = settings.radius_m, settings.inner_radius_m, settings.outer_radius_m
    for centre in found.floor_xy:
        for radius, colour in zip(radii, (_EDGE, _RINGS, _RINGS)):
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
    said = "" if tilt is None else (
        f"; pitch {np.degrees(tilt.pitch_rad):.2f}°, roll {np.degrees(tilt.roll_rad):.2f}°"
    )  # fmt: skip
    titles = (
        "response: how much a step of the grey value along the vertical explains, with its sign",
        f"{len(found.outcome)} tracks from the horizon (dashed) up and down",
        f"{len(found)} verticals{said}, on which {0 if tilt is None else tilt.lines} tracks agree",
    )
    panels = _panels(figure, (3, 1), image, titles)
    panels[0].imshow(response, cmap="RdBu", vmin=-0.7, vmax=0.7)
    for t, outcome in enumerate(found.outcome):
        place = track_pixels(found.tracks, table, t)
        panels[1].plot(*place.T, color=_LINE if outcome == "accepted" else "#3498db", lw=1.2)
        if outcome == "accepted":
            panels[2].plot(*place.T, color=_LINE, lw=1.4)
    panels[1].plot(np.arange(camera.width), table.anchor_row, "--", color="white", lw=0.7)


def draw_tables(figure: Any, run: Path) -> None:
    """The tables: outlines and verticals of some pixels."""
    camera, image = _frame(run, 0)
    settings = CircleSettings(refine=False)
    radii = settings.inner_radius_m, settings.outer_radius_m
    table = cached_disc_table(camera, disc_shape(settings))
    verticals = cached_vertical_table(camera)
    said = " and ".join(f"{radius:.3g}" for radius in radii)
    titles = (
        f"the two outlines (radius {said} m) about some pixels",
        "horizon, and the verticals through some of its columns",
    )
    panels = _panels(figure, (2, 1), image, titles)
    panels[0].imshow(np.where(table.usable, np.nan, 0.35), cmap="gray", vmin=0, vmax=1, alpha=0.5)
    for u in range(60, camera.width, 108):
        for v in (140, 180, 225, 265):
            if table.usable[v, u]:
                centre = table.floor_xy[v, u].astype(np.float64)
                for radius in radii:
                    outline = camera.project_floor(circle_on_floor(centre, radius))
                    panels[0].plot(*outline.T, color=_RINGS, lw=1)
                panels[0].plot(u, v, ".", color=_EDGE, markersize=4)
    rows = np.arange(camera.height)
    for column in range(0, camera.width, 48):
        panels[1].plot(verticals.column[:, column], rows, color=_LINE, lw=1)
    panels[1].plot(np.arange(camera.width), verticals.anchor_row, "--", color=_RINGS, lw=1)


def draw_field_of_view(figure: Any, run: Path) -> None:
    """The floor that the camera sees, from above: the length of a pixel on it, and the outline."""
    camera, _ = _frame(run, 0)
    left, ahead = np.meshgrid(np.linspace(-6.0, 6.0, 601), np.linspace(-0.5, 9.5, 501))
    floor_xy = np.stack([left, -ahead], axis=-1).reshape(-1, 2)
    seen = np.rint(np.nan_to_num(camera.project_floor(floor_xy), nan=-1.0)).astype(int)
    inside = np.all((seen >= 1) & (seen < [camera.width - 1, camera.height - 1]), axis=1)
    u, v = seen[inside].T
    size_m = row_step_m(floor_positions(camera))
    length_mm = np.full(len(seen), np.nan)
    length_mm[inside] = 1000.0 * size_m[v, u]
    axes = figure.subplots()
    levels = [2, 5, 10, 20, 50, 100, 200]
    drawn = axes.contourf(-left, ahead, length_mm.reshape(left.shape), levels, extend="both",
                          cmap="YlOrBr", norm=mpl.colors.LogNorm(2, 200))  # fmt: skip
    figure.colorbar(drawn, label="height of a pixel on the floor (mm)", ticks=levels,
                    format="%d", shrink=0.8)  # fmt: skip
    axes.plot(0, 0, "^", color=_OWN, markersize=9)
    axes.plot(-camera.centre[0], -camera.centre[1], "o", color=_OTHER, markersize=5)
    axes.set(xlabel="right (m)", ylabel="forward (m)", aspect="equal", xlim=(-6, 6))
    axes.set_title("robot (triangle), camera (dot), and the floor in its image", fontsize=9)
    axes.grid(color="#dddddd", lw=0.5)


def draw_markers(figure: Any, run: Path, frame: int) -> None:
    """The three phases: dark regions, corners and edges, identities."""
    camera, image = _frame(run, frame)
    settings = MarkerSettings()
    found = detect_markers(image, settings, camera)
    titles = (
        "1. dark against the closing (one of the thresholds)",
        f"2. corners of {len(found.candidates)} candidates",
        f"3. {len(found)} markers, fitted and identified",
    )
    panels = _panels(figure, (1, 3), image, titles)
    middles = found.corners.mean(axis=1)
    low, high = middles.min(axis=0) - 70, middles.max(axis=0) + 70
    for axes in panels:
        axes.set(
            xlim=(max(low[0], 0), min(high[0], camera.width)),
            ylim=(min(high[1], camera.height), max(low[1], 0)),
        )
    dark = dark_pixels(image, closing(image, 12), settings.thresholds[0], 0.0)
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


def _panels(figure: Any, shape: tuple[int, int], image: Any, titles: tuple[str, ...]) -> Any:
    """Axes that show an image, by their titles."""
    panels = figure.subplots(*shape)
    for axes, title in zip(panels, titles, strict=True):
        axes.imshow(image, cmap="gray", vmin=0, vmax=255)
        axes.autoscale(False)
        axes.set_title(title, fontsize=9)
        axes.axis("off")
    return panels


def draw_association(figure: Any, run: Path) -> None:
    """Rows of a run as placed by odometry and by the map, coloured by their identifiers."""
    frames = list(read_frames(run / "found.circles"))
    summed = summed_steps(frame.step for frame in frames)
    mapped = read_path(run / "slam" / "path.csv").poses
    titles = ("rows where odometry puts them", "rows where the map's path puts them")
    for axes, poses, title in zip(figure.subplots(1, 2), (summed, mapped), titles, strict=True):
        axes.plot(*poses[:, :2].T, color="#bbbbbb", lw=0.7)
        for pose, frame in zip(poses[1:], frames, strict=True):
            for row in frame.circles:
                # Neighbouring numbers in colours far from each other.
                colour = mpl.colormaps["hsv"]((row.ids[0] * 0.381966) % 1.0)
                axes.plot(*apply(pose, (row.px, row.py)), ".", markersize=2.5, color=colour)
        axes.set_title(title, fontsize=10)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=8)
        axes.set_xlabel("X / m")


def draw_filter(figure: Any, run: Path) -> None:
    """Errors of EKF-SLAM's poses at the time of each, and three standard deviations."""
    path = read_path(run / "ekf" / "path.csv")
    assert path.covariance is not None
    errors = path.poses - read_truth(run).poses
    errors[:, 2] = wrap_angle(errors[:, 2])
    bounds = 3.0 * np.sqrt(np.diagonal(path.covariance, axis1=1, axis2=2))
    names = ("x / m", "y / m", "heading / rad")
    for axes, name, error, bound in zip(figure.subplots(1, 3), names, errors.T, bounds.T):
        steps = np.arange(len(error))
        axes.fill_between(steps, -bound, bound, color="#d5e4f2")
        axes.plot(steps, error, color=_OWN, lw=0.9)
        within = 100.0 * np.mean(np.abs(error[1:]) <= bound[1:])
        axes.set_title(f"error of {name}, within 3 sigma: {within:.1f} %", fontsize=10)
        axes.set_xlabel("step")


def draw_laser(figure: Any, session: Path, time_s: float) -> None:
    """One set of scans: background, new points, and the outline fitted to these."""
    laser = read_planar_poses(session / "laser.csv")
    nearest = np.argmin(np.abs(laser.times_s - laser.times_s[0] - time_s))
    at_s, pose = laser.times_s[nearest], laser.poses[nearest]
    panels = figure.subplots(1, 2)
    walls = read_building(session / "building.csv")
    for axes in panels:
        axes.plot(walls[:, ::2].T, walls[:, 1::2].T, color="#999999", lw=1)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=8)
    for scanner in read_scanners(session / "aligned.json"):
        scans = read_scans(session / f"{scanner.name}.scans.npz")
        now = scans.ranges_mm[np.argmin(np.abs(scans.times_s - at_s))]
        seen = read_scans(session / "empty" / f"{scanner.name}.scans.npz").ranges_mm
        background = np.min(np.where(seen > 0, seen, np.inf), axis=0)
        new = (now > 0) & (now < background - 50.0)
        places = apply(scanner.pose, scanner.points(now)).T
        for axes in panels:
            axes.plot(*places[:, ~new], ".", color="#88aadd", markersize=2)
            axes.plot(*places[:, new], ".", color=_OTHER, markersize=5)
            axes.plot(*scanner.pose[:2], "^", color=_INK, markersize=6)
    outline = read_robot(session / "robot.json").outline
    for axes in panels:
        axes.plot(*apply(pose, np.vstack([outline, outline[:1]])).T, color=_OWN, lw=1.4)
    panels[0].set_title("a set of four scans: background (blue), new (orange)", fontsize=10)
    panels[1].set_title("the outline fitted to what is new", fontsize=10)
    panels[0].set(xlim=(walls[:, ::2].min() - 0.5, 12.0), ylim=(-1.0, 9.0))
    panels[1].set(xlim=(pose[0] - 0.8, pose[0] + 0.8), ylim=(pose[1] - 0.8, pose[1] + 0.8))


def draw_clock(figure: Any, session: Path) -> None:
    """Rates of turn by both clocks, and the fused path with its standard deviations."""
    odometry, laser, fused = (
        read_planar_poses(session / f"{name}.csv") for name in ("odometry", "laser", "fused")
    )
    clock = read_clock(session / "clock.json")
    segment = clock.segments[0]
    panels = figure.subplots(1, 3, width_ratios=(1, 1, 1.2))
    shown = (laser.times_s >= segment.from_s) & (laser.times_s <= segment.to_s)
    for axes, times, title in (
        (panels[0], odometry.times_s, "turning, by each stream's own clock"),
        (
            panels[1],
            clock.groundtruth_times(odometry.times_s),
            f"by one clock: {segment.offset_s * 1000:.0f} ms taken off",
        ),
    ):
        time, rate = _turning(times, odometry.poses[:, 2])
        axes.plot(time - segment.from_s, rate, color=_INK, lw=0.8, label="odometry")
        time, rate = _turning(laser.times_s[shown], laser.poses[shown, 2])
        axes.plot(time - segment.from_s, rate, ".-", color=_OTHER, lw=1, label="laser")
        axes.set(xlim=(0, 4), xlabel="s", ylabel="°/s")
        axes.set_title(title, fontsize=10)
    panels[0].legend(fontsize=8)
    assert fused.covariances is not None
    sigma = np.sqrt(fused.covariances[:, 0, 0] + fused.covariances[:, 1, 1])
    axes, (x, y) = panels[2], fused.poses[:, :2].T
    dots = axes.scatter(x, y, c=np.log10(1000 * sigma), s=2, cmap="viridis")
    axes.plot(*laser.poses[:, :2].T, ".", color=_OTHER, markersize=2)
    figure.colorbar(dots, ax=axes, label="log10 of sigma / mm")
    axes.set_aspect("equal")
    axes.set_title("fused path; poses of the laser in orange", fontsize=10)


def _turning(times_s: Any, theta_rad: Any) -> tuple[Any, Any]:
    """Times and rates of turn over a fifth of a second (degrees per second)."""
    grid = np.arange(times_s[0], times_s[-1], 0.05)
    heading = np.interp(grid, times_s, np.unwrap(theta_rad))
    return grid[2:-2], np.degrees((heading[4:] - heading[:-4]) / 0.2)


@dataclass(frozen=True)
class Pictures(Study):
    """Draw the pictures of the documentation whose inputs are given.

    The run of `--rows` R and the session of `--session` S are made by

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

    def measure(self) -> Figures:
        self.output.mkdir(parents=True, exist_ok=True)
        run, markers = Path("images/e"), Path("images/m/a")
        self._save("discs", (8, 9.4), lambda f: draw_discs(f, run, 4), 72)
        self._save("verticals", (8, 9.4), lambda f: draw_verticals(f, run, 15), 72)
        self._save("tables", (8, 6.4), lambda f: draw_tables(f, run), 72)
        self._save("field-of-view", (6.4, 5.2), lambda f: draw_field_of_view(f, run), 72)
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
        return {}

    def _save(
        self, name: str, size_inches: tuple[float, float], draw: Callable[[Any], None], dpi: int
    ) -> None:
        with figure_file(size_inches, "png", framed=True, dpi=dpi) as (figure, content):
            draw(figure)
        (self.output / f"{name}.png").write_bytes(content.getvalue())


def _photographs(figure: Any, folder: Path) -> None:
    files = [*sorted((folder / "boards").glob("*.png"))[1:3], folder / "floor.png"]
    for axes, file in zip(figure.subplots(1, 3), files, strict=True):
        axes.imshow(np.asarray(cv2.imread(str(file), 0)), cmap="gray", vmin=0, vmax=255)
        axes.axis("off")
