"""The path of one frame: its image in, its verticals, tilts, discs and markers out."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.errors import FrameError
from detect.run import RunFrame, read_image
from detect.runs.known import NOTHING, KnownOfFrame
from landmarks import FrameTilt, tilt_as_written

# Detectors and tables are imported on demand: loading them takes a tenth of a second each, and a
# process that delegates the work needs neither them nor a compiler.
if TYPE_CHECKING:
    from detect.circles import CircleDetections
    from detect.line_settings import LineSettings
    from detect.lines import LineDetections
    from detect.markers.detect import MarkerDetections
    from detect.markers.settings import MarkerSettings
    from detect.settings import CircleSettings, Levelling
    from lut import DiscTable, VerticalTable

Drawing = Literal["discs", "lines", "tracks", "markers"]

#: Errors of one frame, not of the run.
COSTS_THE_FRAME = (FrameError, ArithmeticError, np.linalg.LinAlgError, MemoryError)


@dataclass(frozen=True)
class FramePlan:
    """What is done with every frame of a run. Small: it is sent with every task.

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
        Whether the discs are written as JSON as well; set by `detect_run`.
    drawing : {"discs", "lines", "tracks", "markers"} or None
        What is drawn into the image; "tracks" are all tracks of lines, with the reason of those
        that are no lines.
    draw_response : bool
        Whether the filter's response of the lines is drawn as well.
    levelling : {"none", "frame", "run"}
        By what the discs are corrected for the tilt: by nothing, by the frame's own, or, when all
        frames are done, by the run's (`detect.runs.level_run`).
    working_folder : path or None
        Folder that relative image paths start from, on whatever machine; by default a process's
        own.
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
    tilt : FrameTilt or None
        By the lines, or known before; None also if too few lines determine it.
    seen, discs : CircleDetections or None
        The discs where they would be on a level robot, and corrected for the tilt where there is
        one and the plan says so.
    outline_tilt : FrameTilt or None
        The tilt by the outlines of the discs, if a run is levelled by all frames.
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

    verticals: VerticalTable | None = None
    discs: DiscTable | None = None


def detect_batch(
    tasks: Sequence[FrameTask], plan: FramePlan, tables: Tables
) -> list[FrameDetections]:
    """Detect the landmarks of a plan in the images of some frames.

    Every stage is done with all frames before the next one: a decoder and the detectors drive each
    other's instructions and tables out of the processor's caches. A frame that cannot be worked on
    costs itself only. As many images are in memory at once as there are tasks.
    """
    batch = [FrameDetections() for _ in tasks]
    paths = [_path(task, found, plan, tables) for task, found in zip(tasks, batch)]
    for _ in zip_longest(*paths):  # advances each of them to its next `yield` in turn
        pass
    return batch


def _path(
    task: FrameTask, found: FrameDetections, plan: FramePlan, tables: Tables
) -> Iterator[None]:
    """The path of one image from top to bottom; at each `yield`, the others of a batch catch up."""
    camera, prefix = plan.camera, task.frame.step.prefix
    try:
        image = found.image = read_image(task.frame, camera, plan.working_folder)
        yield

        found.tilt = task.known.tilt
        if plan.lines is not None:
            from detect.lines import detect_lines

            assert tables.verticals is not None
            found.lines = detect_lines(image, tables.verticals, plan.lines)
            found.tilt = tilt_of_lines(prefix, found.lines)
        yield

        if plan.circles is not None:
            from detect.circles import detect_circles
            from detect.discs.outline_tilt import tilt_of_outlines
            from detect.levelling import levelled

            assert tables.discs is not None
            assert camera is not None
            by_frame = found.tilt if plan.levelling == "frame" else None
            level = by_frame is None and plan.levelling != "run"
            settings = plan.circles if level else _without_tilt(plan.circles)
            found.seen = found.discs = detect_circles(image, camera, tables.discs, settings)
            if by_frame is not None:
                found.discs = levelled(found.seen, camera, by_frame)
            if plan.levelling == "run":
                tilt = tilt_of_outlines(image, camera, found.seen.floor_xy, plan.circles.radius_m)
                found.outline_tilt = None if tilt is None else FrameTilt(prefix, *tilt)
        yield

        if plan.markers is not None:
            from detect.markers.detect import detect_markers

            found.markers = detect_markers(image, plan.markers, camera)
    except COSTS_THE_FRAME as error:
        found.error = reason_of(error, task)


def reason_of(error: Exception, task: FrameTask) -> str:
    """Why a frame cannot be worked on, in words."""
    if isinstance(error, FrameError):
        return str(error)
    return f"{task.name}: {type(error).__name__}: {error}"


def tilt_of_lines(prefix: str, lines: LineDetections) -> FrameTilt | None:
    """The tilt that lines show, in the digits of its file: one pass finds what two passes do."""
    tilt = lines.tilt
    if tilt is None:
        return None
    (cpp, cpr), (_, crr) = tilt.covariance.tolist()
    return tilt_as_written(
        FrameTilt(prefix, tilt.pitch_rad, tilt.roll_rad, cpp, cpr, crr, tilt.lines)
    )


@lru_cache(maxsize=4)
def _without_tilt(settings: CircleSettings) -> CircleSettings:
    """The same, but the tilt adds nothing to covariances: levelling does."""
    return dataclasses.replace(settings, tilt_sigma_deg=0.0)


@lru_cache(maxsize=4)
def tables_of(plan: FramePlan) -> Tables:
    """The tables that a plan needs: a process makes them or takes them from the cache once.

    Raises
    ------
    lut.TableError
        If there can be none for the camera and the settings.
    """
    verticals = discs = None
    if plan.camera is not None and plan.lines is not None:
        from lut import cached_vertical_table

        verticals = cached_vertical_table(plan.camera)
    if plan.camera is not None and plan.circles is not None:
        from detect.circles import disc_shape
        from lut import cached_disc_table

        discs = cached_disc_table(plan.camera, disc_shape(plan.circles))
    return Tables(verticals, discs)
