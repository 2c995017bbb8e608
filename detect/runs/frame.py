"""The path of one frame: its image in, its verticals, tilts, discs and markers out.

Workers import this module; a process that delegates the work needs neither the detectors nor the
compiler, and starts without them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import zip_longest
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.circles import CircleDetections, detect_circles, disc_shape
from detect.discs.outline_tilt import tilt_of_outlines
from detect.errors import FrameError
from detect.levelling import levelled
from detect.lines import LineDetections, detect_lines
from detect.markers.detect import MarkerDetections, detect_markers
from detect.run import read_image
from detect.runs.plan import FramePlan, FrameTask
from lut import DiscTable, VerticalTable, cached_disc_table, cached_vertical_table
from redetect.landmarks import FrameTilt, tilt_as_written

#: Errors of one frame, not of the run.
COSTS_THE_FRAME = (FrameError, ArithmeticError, np.linalg.LinAlgError, MemoryError)


@dataclass
class FrameDetections:
    """Detections in one image; None for kinds that were not searched."""

    image: NDArray[np.uint8] | None = None  # (H, W); None where it cannot be read
    lines: LineDetections | None = None
    tilt: FrameTilt | None = None  # by the lines, if enough determine it, or known before
    seen: CircleDetections | None = None  # discs, where they would be on a level robot
    discs: CircleDetections | None = None  # corrected for the tilt, if the plan says so
    outline_tilt: FrameTilt | None = None  # by the discs, if a run is levelled by all frames
    markers: MarkerDetections | None = None
    error: str | None = None  # why the frame cannot be worked on

    @property
    def pixels(self) -> NDArray[np.uint8]:
        """The image, where there is one."""
        assert self.image is not None
        return self.image


class Tables(NamedTuple):
    """The tables by the calibration that a plan needs."""

    verticals: VerticalTable | None
    discs: DiscTable | None


@lru_cache(maxsize=4)
def tables_of(plan: FramePlan) -> Tables:
    """The tables that a plan needs: a process makes them or takes them from the cache once."""
    camera = plan.camera
    return Tables(
        cached_vertical_table(camera) if camera and plan.lines else None,
        cached_disc_table(camera, disc_shape(plan.circles)) if camera and plan.circles else None,
    )


def detect_batch(tasks: Sequence[FrameTask], plan: FramePlan) -> list[FrameDetections]:
    """Detect the landmarks of a plan in the images of some frames.

    Every stage is done with all frames before the next one: a decoder and the detectors drive each
    other's instructions and tables out of the processor's caches. A frame that cannot be worked on
    costs itself only. As many images are in memory at once as there are tasks.
    """
    tables = tables_of(plan)
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
        if plan.lines and tables.verticals:
            found.lines = detect_lines(image, tables.verticals, plan.lines)
            found.tilt = tilt_of_lines(prefix, found.lines)
        yield

        if plan.circles and camera and tables.discs:
            by_frame = found.tilt if plan.levelling == "frame" else None
            settings = plan.circles
            if by_frame is not None or plan.levelling == "run":  # levelling adds the tilt's error
                settings = replace(settings, tilt_sigma_deg=0.0)
            found.seen = found.discs = detect_circles(image, camera, tables.discs, settings)
            if by_frame is not None:
                found.discs = levelled(found.seen, camera, by_frame)
            if plan.levelling == "run":
                tilt = tilt_of_outlines(image, camera, found.seen.floor_xy, settings.radius_m)
                found.outline_tilt = None if tilt is None else FrameTilt(prefix, *tilt)
        yield

        if plan.markers:
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
