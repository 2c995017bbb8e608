"""One frame of a run: its image in, its verticals, its tilt, its discs and its markers out.

The way of one frame, top to bottom, is `detect_frame`.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.latest import kept_for_latest
from detect.run import RunFrame, read_image
from landmarks import FrameTilt, tilt_as_written

# Detectors and tables are imported when they are asked for: loading them all takes a tenth of a
# second each, and a process that has others do the work needs neither them nor a compiler.
if TYPE_CHECKING:
    from detect.circles import CircleDetections
    from detect.line_settings import LineSettings
    from detect.lines import LineDetections
    from detect.markers.detections import MarkerDetections
    from detect.markers.settings import MarkerSettings
    from detect.settings import CircleSettings, Levelling
    from lut import DiscShape, DiscTable, VerticalTable


@dataclass(frozen=True)
class FramePlan:
    """What is done with every frame of a run. Small: it travels with every task.

    Attributes
    ----------
    camera : Camera or None
        The calibrated camera; only markers can be looked for without one.
    lines : LineSettings or None
        Which verticals are looked for, if any.
    circles : CircleSettings or None
        Which discs are looked for, if any.
    markers : MarkerSettings or None
        Which square markers are looked for, if any.
    json : bool
        Whether the discs are wanted as JSON as well.
    drawing : {"discs", "lines", "tracks", "markers"} or None
        What is drawn into the image; "tracks" are all tracks of lines, with the reason of those
        that are no lines.
    draw_response : bool
        Whether the filter's response of the lines is drawn as well.
    levelling : {"none", "frame", "run"}
        By what the discs are corrected for the tilt: by nothing, by the frame's own, or, when all
        frames are done, by the run's (`detect.runs.level_run`).
    known_level : bool
        Whether the discs whose IDs are carried over are corrected for the tilt.
    id_slack_m : float
        Standard deviation of where a map and a path expect discs, besides the covariances, metres.
    working_folder : path or None
        What relative image paths are relative to, on whatever machine; by default a process's own.
    """

    camera: Camera | None
    lines: LineSettings | None = None
    circles: CircleSettings | None = None
    markers: MarkerSettings | None = None
    json: bool = False
    drawing: Literal["discs", "lines", "tracks", "markers"] | None = None
    draw_response: bool = False
    levelling: Levelling = "frame"
    known_level: bool = False
    id_slack_m: float = 0.1
    working_folder: Path | None = None


@dataclass(frozen=True)
class Tables:
    """What the calibration decides before the first image, as far as a plan needs it."""

    verticals: VerticalTable | None
    discs: DiscTable | None


@dataclass(frozen=True)
class FrameDetections:
    """What was found in one image; None is what was not looked for.

    Attributes
    ----------
    image : (H, W) uint8
    lines : LineDetections or None
    tilt : FrameTilt or None
        None also where too few lines tell.
    discs : CircleDetections or None
        Corrected for the tilt, where there is one.
    markers : MarkerDetections or None
    seen : CircleDetections or None
        The discs before that.
    """

    image: NDArray[np.uint8]
    lines: LineDetections | None
    tilt: FrameTilt | None
    discs: CircleDetections | None
    markers: MarkerDetections | None = None
    seen: CircleDetections | None = None


def detect_frame(
    frame: RunFrame, plan: FramePlan, tables: Tables, tilt: FrameTilt | None = None
) -> FrameDetections:
    """Find what a plan asks for in the image of a frame, which is decoded once.

    Parameters
    ----------
    frame : RunFrame
        The frame.
    plan : FramePlan
        What to look for.
    tables : Tables
        See `tables_of`.
    tilt : FrameTilt, optional
        The frame's tilt, where it is known and no lines are looked for.

    Returns
    -------
    FrameDetections

    Raises
    ------
    FrameError
        If there is no such image, or none of the calibration's size.
    """
    image = read_image(frame, plan.camera, plan.working_folder)
    lines = lines_in_image(image, plan, tables)
    tilt = tilt_of_frame(frame.step.prefix, lines, tilt)
    discs = discs_in_image(image, plan, tables, tilt)
    markers = markers_in_image(image, plan)
    return seen_together(image, plan, lines, tilt, discs, markers)


def lines_in_image(
    image: NDArray[np.uint8], plan: FramePlan, tables: Tables
) -> LineDetections | None:
    """The lines of an image, if a plan asks for lines."""
    if plan.lines is None:
        return None
    from detect.lines import detect_lines

    assert tables.verticals is not None
    return detect_lines(image, tables.verticals, plan.lines)


def tilt_of_frame(
    prefix: str, lines: LineDetections | None, known: FrameTilt | None
) -> FrameTilt | None:
    """The tilt of the frame of an image: what its lines show, or else what is known of it."""
    return known if lines is None else tilt_of_lines(prefix, lines)


def discs_in_image(
    image: NDArray[np.uint8], plan: FramePlan, tables: Tables, tilt: FrameTilt | None
) -> CircleDetections | None:
    """The discs of an image, if a plan asks for discs, where they would be on a level robot.

    If there is a tilt, `seen_together` corrects them for it and adds what it leaves in doubt.
    """
    if plan.circles is None:
        return None
    from detect.circles import detect_circles

    assert tables.discs is not None
    assert plan.camera is not None
    levelled_later = plan.levelling == "run" or (plan.levelling == "frame" and tilt is not None)
    settings = _without_tilt(plan.circles) if levelled_later else plan.circles
    return detect_circles(image, plan.camera, tables.discs, settings)


@kept_for_latest
def _without_tilt(settings: CircleSettings) -> CircleSettings:
    """The same, but the tilt adds nothing to covariances: levelling does."""
    return dataclasses.replace(settings, tilt_sigma_deg=0.0)


def markers_in_image(image: NDArray[np.uint8], plan: FramePlan) -> MarkerDetections | None:
    """The markers of an image, if a plan asks for markers."""
    if plan.markers is None:
        return None
    from detect.markers.detect import detect_markers

    return detect_markers(image, plan.markers, plan.camera)


def seen_together(
    image: NDArray[np.uint8],
    plan: FramePlan,
    lines: LineDetections | None,
    tilt: FrameTilt | None,
    discs: CircleDetections | None,
    markers: MarkerDetections | None,
) -> FrameDetections:
    """What was found in an image, its discs corrected for the tilt.

    Parameters
    ----------
    image : (H, W) uint8
        See `detect.run.read_image`.
    plan : FramePlan
        What was looked for.
    lines, tilt, discs, markers
        Of `lines_in_image`, `tilt_of_frame`, `discs_in_image` and `markers_in_image`.

    Returns
    -------
    FrameDetections
    """
    seen = discs
    if discs is not None and tilt is not None and plan.levelling == "frame":
        from detect.levelling import levelled, with_prior

        assert plan.camera is not None
        assert plan.circles is not None
        prior_rad = math.radians(plan.circles.tilt_sigma_deg)
        discs = levelled(discs, plan.camera, with_prior(tilt, prior_rad))
    return FrameDetections(image, lines, tilt, discs, markers, seen)


def tilt_of_lines(prefix: str, lines: LineDetections) -> FrameTilt | None:
    """The tilt that lines show, in the digits of its file: one pass finds what two passes do."""
    tilt = lines.tilt
    if tilt is None:
        return None
    (cpp, cpr), (_, crr) = tilt.covariance.tolist()
    return tilt_as_written(
        FrameTilt(prefix, tilt.pitch_rad, tilt.roll_rad, cpp, cpr, crr, tilt.lines)
    )


@kept_for_latest
def tables_of(plan: FramePlan) -> Tables:
    """The tables that a plan needs: a process makes them or takes them from the cache once.

    Raises
    ------
    lut.TableError
        If there can be none for the camera and the settings.
    """
    shape = None
    if plan.circles is not None:
        from detect.circles import disc_shape

        shape = disc_shape(plan.circles)
    return _tables(plan.camera, plan.lines is not None, shape)


@lru_cache(maxsize=4)
def _tables(camera: Camera | None, verticals: bool, shape: DiscShape | None) -> Tables:
    if camera is None:
        return Tables(None, None)
    from lut import cached_disc_table, cached_vertical_table

    return Tables(
        verticals=cached_vertical_table(camera) if verticals else None,
        discs=None if shape is None else cached_disc_table(camera, shape),
    )


def import_detectors(plan: FramePlan) -> None:
    """Import what a plan needs: what can be done while others make its tables."""
    if plan.lines is not None:
        import detect.lines
    if plan.circles is not None:
        import detect.circles
    if plan.markers is not None:
        import detect.markers.detect  # noqa: F401


def rehearse(plan: FramePlan) -> None:
    """Work on a made-up image, so that all tables and kernels that a plan needs are there."""
    tables = tables_of(plan)
    if plan.markers is not None:
        from detect.markers.detect import detect_markers
        from detect.markers.specimen import specimen_image

        detect_markers(specimen_image(plan.markers), plan.markers)
    if plan.camera is None:
        return
    from detect.runs.row_text import unknown_circles, unknown_lines

    column = np.arange(plan.camera.width)
    bars = np.where(column // 40 % 2, 180, 60).astype(np.uint8)
    image = np.repeat(bars[None, :], plan.camera.height, axis=0)
    if plan.circles is not None and tables.discs is not None:
        pitch = 6.0 * plan.circles.radius_m
        seen = tables.discs.floor_xy
        floor = np.isfinite(seen).all(axis=-1)
        off = np.hypot(*(np.mod(seen[floor], pitch) - 0.5 * pitch).T)
        image[floor] = np.where(off < plan.circles.radius_m, 200, 60)
        from detect.circles import detect_circles

        discs = detect_circles(image, plan.camera, tables.discs, plan.circles)
        unknown_circles(discs.floor_xy, discs.quality, discs.covariance)
        # Tilts may come from a file as well.
        from detect.levelling import levelled

        levelled(discs, plan.camera, FrameTilt("rehearsal", 0.0, 0.0, 1e-6, 0.0, 1e-6, 0))
    if plan.lines is not None and tables.verticals is not None:
        from detect.lines import detect_lines

        lines = detect_lines(image, tables.verticals, plan.lines)
        unknown_lines(lines.line_numbers)
