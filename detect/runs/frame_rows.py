"""What is written of one frame: rows, JSON and pictures, as bytes.

This is all that a worker sends back, whichever process or machine it runs on: some kilobytes.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from detect.errors import FrameError
from detect.run import RunFrame, read_image
from detect.runs.frame import (
    FrameDetections,
    FramePlan,
    Tables,
    discs_in_image,
    lines_in_image,
    markers_in_image,
    seen_together,
    tilt_of_frame,
)
from detect.sources.times import format_time
from landmarks import (
    CircleLandmark,
    Frame,
    FrameTilt,
    Landmark,
    LineLandmark,
    circle_landmarks,
    format_frame,
    format_levelling,
    format_no_tilt,
    format_record,
    format_tilt,
)

if TYPE_CHECKING:
    from detect.circles import CircleDetections
    from detect.discs.identity import MappedDisc
    from detect.lines import LineDetections
    from detect.markers.detections import MarkerDetections

R = TypeVar("R")

#: So many pixels are decoded before any of them is looked at.
PIXELS_AT_ONCE = 1 << 25

#: What is wrong with one frame, not with the run.
_COSTS_THE_FRAME = (FrameError, ArithmeticError, np.linalg.LinAlgError, MemoryError)


class KnownRows(NamedTuple):
    """What is known of a frame's landmarks beforehand; None is what is not asked for.

    Attributes
    ----------
    lines : tuple of LineLandmark or None
        Its lines with IDs.
    discs : tuple of CircleLandmark or None
        Its discs with IDs.
    mapped : tuple of MappedDisc or None
        The discs that it should see.
    """

    lines: tuple[LineLandmark, ...] | None = None
    discs: tuple[CircleLandmark, ...] | None = None
    mapped: tuple[MappedDisc, ...] | None = None


class FrameTask(NamedTuple):
    """A frame to be worked on, and what is known about it beforehand. Small.

    Attributes
    ----------
    frame : RunFrame
        STEP row and path of the image.
    tilt : FrameTilt or None
        Its tilt, where it is known: the discs are corrected for it.
    known : KnownRows or None
        Rows with IDs, which are carried over.
    """

    frame: RunFrame
    tilt: FrameTilt | None = None
    known: KnownRows | None = None


class FrameRows(NamedTuple):
    """What came of a frame.

    Attributes
    ----------
    circles, lines, tilt, markers, json, times : bytes
        The frame's rows in each of the files.
    pictures : tuple of (name, PNG)
        Drawings.
    disc_count, line_count, marker_count : int
        How many were found.
    rejected : tuple of (cause, int)
        How many candidates for markers were rejected, by cause.
    error : str or None
        Why the frame could not be worked on: its STEP stays, without landmarks.
    """

    circles: bytes = b""
    lines: bytes = b""
    tilt: bytes = b""
    markers: bytes = b""
    json: bytes = b""
    times: bytes = b""
    pictures: tuple[tuple[str, bytes], ...] = ()
    disc_count: int = 0
    line_count: int = 0
    marker_count: int = 0
    has_tilt: bool = False
    rejected: tuple[tuple[str, int], ...] = ()
    error: str | None = None


def rows_of_frames(tasks: Sequence[FrameTask], plan: FramePlan, tables: Tables) -> list[FrameRows]:
    """Work on some frames; an image that cannot be worked on costs its frame only.

    Many images are decoded, then looked at by one detector after the other, then written about: a
    decoder, the detectors and Python drive each other's instructions and tables out of the
    processor's caches.

    Parameters
    ----------
    tasks : sequence of FrameTask
        The frames.
    plan : FramePlan
        What is done with each.
    tables : Tables
        See `detect.runs.frame.tables_of`.

    Returns
    -------
    list of FrameRows
        One for each.
    """
    camera = plan.camera
    at_once = PIXELS_AT_ONCE // (camera.width * camera.height) if camera is not None else 1
    if plan.drawing is not None or plan.draw_response:
        at_once = 1
    rows: list[FrameRows] = []
    source = iter(tasks)
    while some := tuple(islice(source, max(1, at_once))):
        images = [
            _attempt(task, read_image, task.frame, camera, plan.working_folder) for task in some
        ]
        lines = [
            _attempt(task, lines_in_image, image, plan, tables) for task, image in zip(some, images)
        ]
        tilts = [
            _attempt(task, tilt_of_frame, task.frame.step.prefix, seen, task.tilt)
            for task, seen in zip(some, lines)
        ]
        discs = [
            _attempt(task, discs_in_image, image, plan, tables, tilt)
            for task, image, tilt in zip(some, images, tilts)
        ]
        markers: list[MarkerDetections | _Failed | None] = [None] * len(some)
        if plan.markers is not None:
            markers = [
                _attempt(task, markers_in_image, image, plan) for task, image in zip(some, images)
            ]
        found = [
            _attempt(task, seen_together, image, plan, *seen)
            for task, image, *seen in zip(some, images, lines, tilts, discs, markers)
        ]
        rows += [_rows_of(what, task, plan, tables) for what, task in zip(found, some)]
    return rows


class _Failed(NamedTuple):
    """In the place of what could not be done for a frame."""

    reason: str


def _attempt(task: FrameTask, work: Callable[..., R], /, *given: object) -> R | _Failed:
    """The result of something done for a frame, or why it, or what it is given, could not be."""
    if _Failed in map(type, given):
        return next(value for value in given if isinstance(value, _Failed))
    try:
        return work(*given)
    except _COSTS_THE_FRAME as error:
        return _Failed(_reason(error, task))


def _reason(error: Exception, task: FrameTask) -> str:
    if isinstance(error, FrameError):
        return str(error)
    name = task.frame.image or task.frame.step.prefix
    return f"{name}: {type(error).__name__}: {error}"


def _rows_of(
    found: FrameDetections | _Failed, task: FrameTask, plan: FramePlan, tables: Tables
) -> FrameRows:
    if isinstance(found, _Failed):
        return rows_of_failure(task, found.reason)
    step = task.frame.step
    head = _line(format_record(step))
    circles = lines = tilt = markers = record = b""
    if found.lines is not None:
        lines = head + _line_rows(found.lines, None if task.known is None else task.known.lines)
        if found.tilt is None:
            tilt = _line(format_no_tilt(step.prefix, len(found.lines)))
        else:
            tilt = _line(format_tilt(found.tilt))
    if found.discs is not None:
        discs = found.discs
        circles = head + _levelling(discs) + _circle_rows(found, discs, task.known, plan)
        if plan.json:
            record = _json({"frame": step.prefix, "discs": _disc_records(discs)})
    if found.markers is not None:
        markers = head + _rows(found.markers.landmarks())
    return FrameRows(
        circles=circles,
        lines=lines,
        tilt=tilt,
        markers=markers,
        json=record,
        times=_time_row(task),
        pictures=_pictures(step.prefix, found, plan, tables),
        disc_count=0 if found.discs is None else len(found.discs),
        line_count=0 if found.lines is None else len(found.lines),
        marker_count=0 if found.markers is None else len(found.markers),
        rejected=() if found.markers is None else tuple(sorted(found.markers.rejected.items())),
        has_tilt=found.lines is not None and found.tilt is not None,
    )


def rows_of_failure(task: FrameTask, reason: str) -> FrameRows:
    """What is written of a frame that could not be worked on."""
    step = task.frame.step
    rows = format_frame(Frame(step))
    return FrameRows(
        circles=rows,
        lines=rows,
        tilt=_line(format_no_tilt(step.prefix, 0)),
        markers=rows,
        json=_json({"frame": step.prefix, "error": reason}),
        times=_time_row(task),
        error=reason,
    )


def _line_rows(found: LineDetections, reference: tuple[LineLandmark, ...] | None) -> bytes:
    if reference is not None:
        from detect.verticals.identity import carry_ids

        return _rows(carry_ids(found.landmarks(), reference))
    from detect.runs.row_text import unknown_lines

    rows = unknown_lines(found.line_numbers)
    return _rows(found.landmarks()) if rows is None else rows


def _levelling(found: CircleDetections) -> bytes:
    return b"" if found.levelled_by is None else _line(format_levelling(found.levelled_by))


def _circle_rows(
    found: FrameDetections, discs: CircleDetections, known: KnownRows | None, plan: FramePlan
) -> bytes:
    if known is None or (known.discs is None and known.mapped is None):
        from detect.runs.row_text import unknown_circles

        text = unknown_circles(discs.floor_xy, discs.quality, discs.covariance)
        if text is not None:
            return text
    rows = circle_landmarks(
        discs.floor_xy, discs.quality, discs.covariance, np.full(len(discs), -1)
    )
    return _rows(
        dataclasses.replace(row, ids=ids)
        for row, ids in zip(rows, _ids_of_discs(found, discs, known, plan))
    )


def _ids_of_discs(
    found: FrameDetections, discs: CircleDetections, known: KnownRows | None, plan: FramePlan
) -> list[tuple[int, ...]]:
    """The IDs of each row: those of a known row of the same disc, or of a map's, or -1."""
    from detect.discs.identity import ids_of_map, ids_of_rows

    ids: list[tuple[int, ...]] = [()] * len(discs)
    if known is not None and known.discs:
        seen = discs if plan.known_level or found.seen is None else found.seen
        by_pixel = dict(
            zip(map(tuple, seen.pixels.tolist()), ids_of_rows(seen.floor_xy, known.discs))
        )
        ids = [by_pixel[u, v] for u, v in discs.pixels.tolist()]
    if known is not None and known.mapped:
        taken = {number for own in ids for number in own}
        left = [disc for disc in known.mapped if disc.id not in taken]
        open_rows = [k for k, own in enumerate(ids) if own in ((), (-1,))]
        named = ids_of_map(
            discs.floor_xy[open_rows], discs.covariance[open_rows], left, plan.id_slack_m
        )
        for k, number in zip(open_rows, named.tolist()):
            ids[k] = (number,)
    return [own or (-1,) for own in ids]


def _rows(landmarks: Iterable[Landmark]) -> bytes:
    return b"".join(_line(format_record(landmark)) for landmark in landmarks)


def _time_row(task: FrameTask) -> bytes:
    frame = task.frame
    return b"" if frame.time_s is None else _line(format_time(frame.step.prefix, frame.time_s))


def _line(text: str) -> bytes:
    return f"{text}\n".encode("utf-8", "surrogateescape")


def _json(record: dict[str, object]) -> bytes:
    """A record as it stands in the list of frames of an indented document."""
    return b"\n" + indent(json.dumps(record, indent=1), "  ").encode()


def _disc_records(found: CircleDetections) -> list[dict[str, object]]:
    return [
        {
            "pixel": [int(u), int(v)],
            "x_m": float(x),
            "y_m": float(y),
            "quality": float(quality),
            "evidence": float(evidence) if np.isfinite(evidence) else None,
            "covariance_m2": [float(c[0, 0]), float(c[0, 1]), float(c[1, 1])],
        }
        for (u, v), (x, y), c, quality, evidence in zip(
            found.pixels, found.floor_xy, found.covariance, found.quality, found.evidence
        )
    ]


def _pictures(
    prefix: str, found: FrameDetections, plan: FramePlan, tables: Tables
) -> tuple[tuple[str, bytes], ...]:
    if plan.drawing is None and not plan.draw_response:
        return ()
    return tuple(_drawn(prefix, found, plan, tables))


def _drawn(
    prefix: str, found: FrameDetections, plan: FramePlan, tables: Tables
) -> Iterator[tuple[str, bytes]]:
    from detect.drawing.detections import draw_circles
    from detect.drawing.lines import draw_lines, draw_response, draw_tracks
    from detect.verticals.tracks import line_response

    name = Path(prefix).name
    if plan.drawing == "markers" and found.markers is not None:
        from detect.markers.drawing import draw_markers

        yield f"{name}.png", _png(draw_markers(found.image, found.markers))
    if plan.camera is None:
        return
    if plan.drawing == "discs" and found.discs is not None and plan.circles is not None:
        picture = draw_circles(found.image, plan.camera, found.discs, plan.circles)
        yield f"{name}.png", _png(picture)
    if found.lines is None or tables.verticals is None:
        return
    if plan.drawing == "lines":
        picture = draw_lines(found.image, plan.camera, tables.verticals, found.lines)
        yield f"{name}.png", _png(picture)
    elif plan.drawing == "tracks":
        picture = draw_tracks(
            found.image, tables.verticals, found.lines, rejected=True, reasons=True
        )
        yield f"{name}.png", _png(picture)
    if plan.draw_response and plan.lines is not None:
        response = line_response(found.image, tables.verticals, plan.lines)
        yield f"{name}.response.png", _png(draw_response(response, tables.verticals))


def _png(picture: NDArray[np.uint8]) -> bytes:
    import cv2

    _, encoded = cv2.imencode(".png", picture)
    return encoded.tobytes()
