"""Processes one frame: image in; verticals, tilts, discs and markers out, and their rows.

Workers import this module; a process that delegates the work does not need the detectors.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby, zip_longest
from typing import TYPE_CHECKING

import numpy as np

from camera import Camera
from camera.kernels import project_floor_points
from detect.circles import CircleDetections, candidates_of, classify, scene_of, vote_shape
from detect.discs.fit import working_space
from detect.discs.hough import HoughCandidates
from detect.discs.outline_tilt import fit_outline, tilt_of_outlines
from detect.discs.placing import place_discs, size_of_disc
from detect.errors import FrameError
from detect.identity import ids_of_rows
from detect.lean import detect_leaning, detect_tilted, search_of, with_exact_tilt
from detect.levelling import common_covariance, levelled
from detect.lines import LineDetections, carry_ids, detect_lines
from detect.run_tilt import smooth_axis
from detect.runs.plan import (
    FramePlan,
    FramePriors,
    FrameRows,
    FrameTask,
    json_record,
    rows_of_failure,
    time_row,
)
from detect.settings import CircleSettings
from detect.sources.grey_images import read_image
from lut import VerticalTable, cached_vertical_table, cached_vote_table
from redetect.array_types import GreyImage
from redetect.interrupts import interrupts_deferred
from redetect.landmarks import (
    CircleLandmark,
    Frame,
    FrameTilt,
    LandmarkError,
    format_frame,
    format_no_tilt,
    format_outline_tilt,
    format_tilt,
    tilt_as_written,
)

if TYPE_CHECKING:
    from detect.markers.detect import MarkerDetections


#: Errors of one frame, not of the run.
FRAME_ERRORS = (FrameError, LandmarkError, ArithmeticError, np.linalg.LinAlgError, MemoryError)

#: Standard deviation of the path of a map, metres, in addition to the covariances of its discs.
_MAP_SIGMA_M = 0.1
#: Least difference of a frame's tilt from the lean of a run with which discs are searched again.
_LEAST_OFF_RAD, _LEAST_OFF_SIGMAS = math.radians(1.5), 5.0
PIXELS_AT_ONCE = 1 << 25  #: Largest number of pixels that are decoded at once.


@dataclass
class FrameDetections:
    """Detections in one image; None for kinds that were not searched."""

    image: GreyImage | None = None  # (H, W); None if it cannot be read
    lines: LineDetections | None = None
    tilt: FrameTilt | None = None  # from the lines, if enough determine it, or prior data
    unlevelled: CircleDetections | None = None  # discs, as if the robot was level
    discs: CircleDetections | None = None  # corrected for the tilt, if planned
    outline_tilt: FrameTilt | None = None  # from the discs, if a run is levelled by all frames
    markers: MarkerDetections | None = None
    error: str | None = None  # why the frame cannot be processed


#: The table of a camera's verticals, one object per process: `detect.lines` prepares more for it.
vertical_table_of = lru_cache(maxsize=16)(cached_vertical_table)


def prepare(plan: FramePlan) -> None:
    """Make the tables that a plan needs, or load them from the cache."""
    if plan.camera and plan.lines:
        vertical_table_of(plan.camera)
    if plan.camera and plan.circles:
        search_of(plan.camera, plan.circles, plan.lean)


def detect_batch(tasks: Sequence[FrameTask], plan: FramePlan) -> list[FrameDetections]:
    """Detect the landmarks of a plan in the images of some frames.

    Each stage processes all frames before the next one starts, because the decoder and the
    detectors evict each other from the processor's caches. A frame that cannot be processed does
    not affect the others. The images of all tasks are in memory at once.
    """
    batch = [FrameDetections() for _ in tasks]
    verticals = vertical_table_of(plan.camera) if plan.camera and plan.lines else None
    pipelines = [_stages(task, found, plan, verticals) for task, found in zip(tasks, batch)]
    with interrupts_deferred():  # an interrupt while Numba unpacks tuples would crash the process
        for _ in zip_longest(*pipelines):  # advances each pipeline to its next `yield` in turn
            pass
    return batch


def _stages(
    task: FrameTask, found: FrameDetections, plan: FramePlan, verticals: VerticalTable | None
) -> Iterator[None]:
    """All stages of one image in order; at each `yield`, the others of a batch catch up."""
    camera, prefix = plan.camera, task.frame.step.prefix
    try:
        image = found.image = read_image(task.frame, camera, plan.working_folder)
        yield

        found.tilt = task.known.tilt
        if plan.lines and verticals:
            found.lines = detect_lines(image, verticals, plan.lines)
            found.tilt = tilt_of_lines(prefix, found.lines)
        yield

        if plan.circles and camera:
            tilt = None if plan.levelling == "none" else found.tilt
            found.unlevelled = found.discs = _search(image, plan, tilt)
            if plan.levelling == "run":  # levels them later
                xy, radius_m = found.unlevelled.floor_xy, plan.circles.radius_m
                if (by_discs := tilt_of_outlines(image, camera, xy, radius_m)) is not None:
                    found.outline_tilt = replace(by_discs, prefix=prefix)
            else:
                found.discs = _levelled(found.unlevelled, camera, plan.circles, tilt)
        yield

        if plan.markers:
            from detect.markers.detect import detect_markers  # rarely needed

            found.markers = detect_markers(image, plan.markers, camera)
    except FRAME_ERRORS as error:
        found.error = reason_of(error, task)


def _search(image: GreyImage, plan: FramePlan, tilt: FrameTilt | None) -> CircleDetections:
    """The discs as a level robot sees them, searched with the lean of the run's camera, or with the
    tilt of the frame if that finds more.
    """
    camera, settings = plan.camera, plan.circles
    assert camera is not None
    assert settings is not None
    if tilt is not None or plan.levelling == "run":  # levelling adds the tilt's error
        settings = with_exact_tilt(settings)
    if tilt is None or not _is_searched(tilt, plan):
        return detect_leaning(image, camera, settings, plan.lean)
    return detect_tilted(image, camera, settings, (tilt.pitch, tilt.roll), plan.lean)[0]


def _is_searched(tilt: FrameTilt, plan: FramePlan) -> bool:
    """Whether discs are also searched with the tilt of their frame.

    In a run it must certainly differ from the lean: the verticals of single frames are often wrong.
    """
    if plan.levelling != "run":
        return True
    pitch, roll = plan.lean or (0.0, 0.0)
    return plan.search_by_frame and any(
        abs(off) > max(_LEAST_OFF_RAD, _LEAST_OFF_SIGMAS * math.sqrt(variance))
        for off, variance in ((tilt.pitch - pitch, tilt.cpp), (tilt.roll - roll, tilt.crr))
    )


def _levelled(
    discs: CircleDetections, camera: Camera, settings: CircleSettings, by_frame: FrameTilt | None
) -> CircleDetections:
    """Discs levelled by the tilt of their frame, if known, with the calibration's errors."""
    discs = discs if by_frame is None else levelled(discs, camera, by_frame)
    if not settings.refine:
        return discs
    xy, by_verticals = discs.floor_xy, by_frame is not None
    common = common_covariance(camera, xy, settings.calibration_px, by_verticals=by_verticals)
    return replace(discs, covariance=discs.covariance + common)


def reason_of(error: Exception, task: FrameTask) -> str:
    """Why a frame cannot be processed, in words."""
    if isinstance(error, FrameError):
        return str(error)
    return f"{task.name}: {type(error).__name__}: {error}"


def tilt_of_lines(prefix: str, lines: LineDetections) -> FrameTilt | None:
    """The tilt from lines, rounded as in its file, so that one pass and two passes agree."""
    tilt = lines.tilt
    if tilt is None:
        return None
    (cpp, cpr), (_, crr) = tilt.covariance.tolist()
    found = FrameTilt(prefix, tilt.pitch_rad, tilt.roll_rad, cpp, cpr, crr, tilt.lines)
    return tilt_as_written(found)


def rows_of_frames(tasks: Sequence[FrameTask], plan: FramePlan) -> list[FrameRows]:
    """The rows of frames, processed in batches that fit in memory."""
    rows: list[FrameRows] = []
    for own, group in groupby(tasks, lambda task: task.plan or plan):
        alike, camera, at_once = list(group), own.camera, 1
        if camera is not None:
            at_once = max(1, PIXELS_AT_ONCE // (camera.width * camera.height))
        for first in range(0, len(alike), at_once):
            batch = alike[first : first + at_once]
            found = detect_batch(batch, own)
            rows += [_rows_of(task, each, own) for task, each in zip(batch, found)]
    return rows


def _rows_of(task: FrameTask, found: FrameDetections, plan: FramePlan) -> FrameRows:
    if found.error is not None:
        return rows_of_failure(task, found.error)
    try:
        return FrameRows(
            task.frame.step.prefix,
            _rows_by_kind(task, found, plan),
            {
                "discs": len(found.discs or ()),
                "lines": len(found.lines or ()),
                "tilts": int(found.lines is not None and found.tilt is not None),
                "markers": len(found.markers or ()),
            },
            {} if found.markers is None else dict(sorted(found.markers.rejected.items())),
            evidence=0.0 if found.discs is None else float(np.nansum(found.discs.evidence)),
        )
    except FRAME_ERRORS as error:
        return rows_of_failure(task, reason_of(error, task))


def _rows_by_kind(task: FrameTask, found: FrameDetections, plan: FramePlan) -> dict[str, str]:
    step = task.frame.step
    rows = {"times": time_row(task)}
    if found.lines is not None:
        lines = found.lines.landmarks()
        if task.known.lines:
            lines = carry_ids(lines, task.known.lines)
        rows["lines"] = _text(Frame(step, lines))
        tilt = found.tilt
        own = format_no_tilt(step.prefix, len(found.lines)) if tilt is None else format_tilt(tilt)
        rows["tilt"] = f"{own}\n"
        if found.outline_tilt is not None:
            rows["tilt"] += f"{format_outline_tilt(found.outline_tilt)}\n"
    if found.discs is not None and found.unlevelled is not None:
        discs = _disc_rows(found.discs, found.unlevelled, task.known)
        rows["circles"] = _text(Frame(step, discs, found.discs.levelled_by))
        if plan.json:
            values = zip(discs, found.discs.pixels.tolist(), found.discs.evidence.tolist())
            records = [
                {
                    "pixel": pixel,
                    "x_m": row.px,
                    "y_m": row.py,
                    "quality": row.quality,
                    "evidence": evidence,
                    "covariance_m2": [row.cxx, row.cxy, row.cyy],
                }
                for row, pixel, evidence in values
            ]
            rows["json"] = json_record({"frame": step.prefix, "discs": records})
    if found.markers is not None:
        rows["markers"] = _text(Frame(step, found.markers.landmarks()))
    return rows


def _text(frame: Frame) -> str:
    return format_frame(frame).decode("utf-8", "surrogateescape")


def _disc_rows(
    discs: CircleDetections, unlevelled: CircleDetections, known: FramePriors
) -> tuple[CircleLandmark, ...]:
    """The rows, each with the IDs of a known row of the same disc, or of a map's disc, or -1."""
    rows = discs.landmarks()
    if not (known.discs or known.mapped):
        return rows
    ids = [row.ids for row in rows]
    if known.discs:
        alike = discs if known.discs_level else unlevelled
        named = ids_of_rows(alike.floor_xy, known.discs)
        by_pixel = dict(zip(map(tuple, alike.pixels.tolist()), named))
        ids = [by_pixel[u, v] or (-1,) for u, v in discs.pixels.tolist()]
    if known.mapped:
        taken = {number for own in ids for number in own}
        left = [disc for disc in known.mapped if taken.isdisjoint(disc.ids)]
        without = [k for k, own in enumerate(ids) if own == (-1,)]
        xy, spread = discs.floor_xy[without], discs.covariance[without]
        for k, own in zip(without, ids_of_rows(xy, left, spread, _MAP_SIGMA_M)):
            ids[k] = own or (-1,)
    return tuple(replace(row, ids=own) for row, own in zip(rows, ids))


def compile_discs(plan: FramePlan, *, search: bool) -> None:
    """Compile the kernels that find candidates of discs, or those of all stages after that.

    They are stored in the disk cache. Two processes compile one half each at the same time.
    """
    camera, settings = plan.camera, plan.circles
    if not (camera and settings and settings.refine):
        return
    image = np.zeros((camera.height, camera.width), np.uint8)
    table = cached_vote_table(camera, vote_shape(settings))
    scene = scene_of(image, camera, table, settings)
    if search:
        candidates_of(scene, table, settings)
        return
    somewhere = np.array([[0.0, -1.0]])
    none = HoughCandidates(np.empty((0, 2)), np.empty(0), np.empty(0))
    place_discs(scene, classify(scene, settings, none), working_space()[0])
    size_of_disc(settings.radius_m, np.zeros((1, 2)), 0)
    project_floor_points(scene.camera_numbers, somewhere)
    if plan.levelling == "run":
        tilt_of_outlines(image, camera, somewhere, settings.radius_m)
        fit_outline(np.ones((3, 2)), np.ones(3), np.ones(3), 0.0, 0.0, 1.0)
        smooth_axis(np.zeros(1), np.ones(1), spread=1.0, correlation=0.0)
