"""Frames of a run: their images in, their verticals, tilts, discs and markers out.

`STAGES` are the stages that a frame passes, in order; `detect_batch` runs them for any number of
frames, one by one or many together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.errors import FrameError
from detect.run import RunFrame, read_image
from detect.runs.known import NOTHING, KnownOfFrame
from landmarks import FrameTilt, Step, tilt_as_written

# Detectors and tables are imported on demand: loading them takes a tenth of a second each, and a
# process that delegates the work needs neither them nor a compiler.
if TYPE_CHECKING:
    from detect.circles import CircleDetections
    from detect.line_settings import LineSettings
    from detect.lines import LineDetections
    from detect.markers.detect import MarkerDetections
    from detect.markers.settings import MarkerSettings
    from detect.settings import CircleSettings, Levelling
    from lut import DiscShape, DiscTable, VerticalTable

Drawing = Literal["discs", "lines", "tracks", "markers"]

#: Errors of one frame, not of the run.
COSTS_THE_FRAME = (FrameError, ArithmeticError, np.linalg.LinAlgError, MemoryError)


@dataclass(frozen=True)
class FramePlan:
    """The plan for every frame of a run. Small: it is sent with every task.

    Attributes
    ----------
    camera : Camera or None
        The calibrated camera; without one, only markers can be detected.
    lines : LineSettings or None
        Which verticals are detected, if any.
    circles : CircleSettings or None
        Which discs are detected, if any.
    markers : MarkerSettings or None
        Which square markers are detected, if any.
    json : bool
        Whether the discs are wanted as JSON as well: `detect_run` sees to it.
    drawing : {"discs", "lines", "tracks", "markers"} or None
        What is drawn into the image; "tracks" are all tracks of lines, with the reason of those
        that are no lines.
    draw_response : bool
        Whether the filter's response of the lines is drawn as well.
    levelling : {"none", "frame", "run"}
        By what the discs are corrected for the tilt: by nothing, by the frame's own, or, when all
        frames are done, by the run's (`detect.runs.level_run`).
    working_folder : path or None
        What relative image paths are relative to, on whatever machine; by default a process's own.
    """

    camera: Camera | None
    lines: LineSettings | None = None
    circles: CircleSettings | None = None
    markers: MarkerSettings | None = None
    json: bool = False
    drawing: Drawing | None = None
    draw_response: bool = False
    levelling: Levelling = "frame"
    working_folder: Path | None = None


class FrameTask(NamedTuple):
    """A frame to be processed, with prior data on it. Small."""

    frame: RunFrame
    known: KnownOfFrame = NOTHING

    @property
    def name(self) -> object:
        """What messages call it."""
        return self.frame.image or self.frame.step.prefix


@dataclass
class FrameDetections:
    """Detections in one image; None for kinds that were not searched.

    Attributes
    ----------
    image : (H, W) uint8 or None
        None where it cannot be read.
    lines : LineDetections or None
    tilt : FrameTilt or None
        None also if too few lines determine it.
    seen : CircleDetections or None
        The discs where they would be on a level robot.
    discs : CircleDetections or None
        The same, corrected for the tilt where there is one and the plan says so.
    outline_tilt : FrameTilt or None
        The tilt by the outlines of the discs, if a run is levelled by all frames.
    markers : MarkerDetections or None
    error : str or None
        Why the frame cannot be worked on.
    """

    image: NDArray[np.uint8] | None = None
    lines: LineDetections | None = None
    tilt: FrameTilt | None = None
    seen: CircleDetections | None = None
    discs: CircleDetections | None = None
    outline_tilt: FrameTilt | None = None
    markers: MarkerDetections | None = None
    error: str | None = None

    @property
    def pixels(self) -> NDArray[np.uint8]:
        """The image, where there is one."""
        assert self.image is not None
        return self.image


@dataclass(frozen=True)
class Tables:
    """The tables by the calibration that a plan needs."""

    verticals: VerticalTable | None
    discs: DiscTable | None


def detect_batch(
    tasks: Sequence[FrameTask], plan: FramePlan, tables: Tables
) -> list[FrameDetections]:
    """Detect the landmarks of a plan in the images of some frames.

    Every stage is done with all frames before the next one: a decoder, the detectors and Python
    drive each other's instructions and tables out of the processor's caches. A frame that cannot be
    worked on costs itself only.

    Parameters
    ----------
    tasks : sequence of FrameTask
        The frames; as many images are in memory at once.
    plan : FramePlan
        The landmarks to detect.
    tables : Tables
        See `tables_of`.

    Returns
    -------
    list of FrameDetections
        One for each.
    """
    batch = [FrameDetections() for _ in tasks]
    for stage in STAGES:
        for task, found in zip(tasks, batch):
            if found.error is None:
                try:
                    stage(task, found, plan, tables)
                except COSTS_THE_FRAME as error:
                    found.error = reason_of(error, task)
    return batch


def reason_of(error: Exception, task: FrameTask) -> str:
    """Why a frame cannot be worked on, in words."""
    if isinstance(error, FrameError):
        return str(error)
    return f"{task.name}: {type(error).__name__}: {error}"


def _decode(task: FrameTask, found: FrameDetections, plan: FramePlan, _: Tables) -> None:
    found.image = read_image(task.frame, plan.camera, plan.working_folder)


def _find_lines(_: FrameTask, found: FrameDetections, plan: FramePlan, tables: Tables) -> None:
    if plan.lines is not None:
        from detect.lines import detect_lines

        assert tables.verticals is not None
        found.lines = detect_lines(found.pixels, tables.verticals, plan.lines)


def _tell_tilt(task: FrameTask, found: FrameDetections, _: FramePlan, __: Tables) -> None:
    found.tilt = task.known.tilt
    if found.lines is not None:
        found.tilt = tilt_of_lines(task.frame.step.prefix, found.lines)


def _find_discs(_: FrameTask, found: FrameDetections, plan: FramePlan, tables: Tables) -> None:
    if plan.circles is not None:
        from detect.circles import detect_circles

        assert tables.discs is not None
        assert plan.camera is not None
        levelled = plan.levelling == "run" or (plan.levelling == "frame" and found.tilt is not None)
        settings = _without_tilt(plan.circles) if levelled else plan.circles
        found.seen = detect_circles(found.pixels, plan.camera, tables.discs, settings)


def _level_discs(_: FrameTask, found: FrameDetections, plan: FramePlan, __: Tables) -> None:
    found.discs = found.seen
    if found.seen is not None and found.tilt is not None and plan.levelling == "frame":
        from detect.levelling import levelled

        assert plan.camera is not None
        found.discs = levelled(found.seen, plan.camera, found.tilt)


def _tell_tilt_by_outlines(
    task: FrameTask, found: FrameDetections, plan: FramePlan, _: Tables
) -> None:
    if found.seen is not None and plan.levelling == "run":
        from detect.discs.outline_tilt import tilt_of_outlines

        assert plan.camera is not None
        assert plan.circles is not None
        tilt = tilt_of_outlines(
            found.pixels, plan.camera, found.seen.floor_xy, plan.circles.radius_m
        )
        if tilt is not None:
            found.outline_tilt = FrameTilt(task.frame.step.prefix, *tilt)


def _find_markers(_: FrameTask, found: FrameDetections, plan: FramePlan, __: Tables) -> None:
    if plan.markers is not None:
        from detect.markers.detect import detect_markers

        found.markers = detect_markers(found.pixels, plan.markers, plan.camera)


#: The stages that a frame passes: each can use the results of those before it.
STAGES: tuple[Callable[[FrameTask, FrameDetections, FramePlan, Tables], None], ...] = (
    _decode,
    _find_lines,
    _tell_tilt,
    _find_discs,
    _level_discs,
    _tell_tilt_by_outlines,
    _find_markers,
)


@lru_cache(maxsize=4)
def _without_tilt(settings: CircleSettings) -> CircleSettings:
    """The same, but the tilt adds nothing to covariances: levelling does."""
    return dataclasses.replace(settings, tilt_sigma_deg=0.0)


def tilt_of_lines(prefix: str, lines: LineDetections) -> FrameTilt | None:
    """The tilt that lines show, in the digits of its file: one pass finds what two passes do."""
    tilt = lines.tilt
    if tilt is None:
        return None
    (cpp, cpr), (_, crr) = tilt.covariance.tolist()
    return tilt_as_written(
        FrameTilt(prefix, tilt.pitch_rad, tilt.roll_rad, cpp, cpr, crr, tilt.lines)
    )


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
    """Import the modules that a plan needs, while other processes compute its tables."""
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
        from detect.markers.dictionaries import specimen_image

        detect_markers(specimen_image(plan.markers), plan.markers)
    if plan.camera is None:
        return
    column = np.arange(plan.camera.width)
    bars = np.where(column // 40 % 2, 180, 60).astype(np.uint8)
    image = np.repeat(bars[None, :], plan.camera.height, axis=0)
    if plan.circles is not None and tables.discs is not None:
        pitch = 6.0 * plan.circles.radius_m
        seen = tables.discs.floor_xy
        floor = np.isfinite(seen).all(axis=-1)
        off = np.hypot(*(np.mod(seen[floor], pitch) - 0.5 * pitch).T)
        image[floor] = np.where(off < plan.circles.radius_m, 200, 60)
    step = Step("rehearsal", *[0.0] * 9)
    task = FrameTask(RunFrame(step, None, content=image))
    (found,) = detect_batch([task], dataclasses.replace(plan, markers=None), tables)
    if found.discs is not None:  # tilts may come from a file as well
        found.tilt = FrameTilt("rehearsal", 0.0, 0.0, 1e-6, 0.0, 1e-6, 0)
        _level_discs(task, found, dataclasses.replace(plan, levelling="frame"), tables)
