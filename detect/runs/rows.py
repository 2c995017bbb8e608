"""Output of one frame: rows, JSON and pictures.

This is all that a worker sends back, whichever process or machine it runs on: some kilobytes.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.errors import FrameError
from detect.runs.frame import (
    COSTS_THE_FRAME,
    FrameDetections,
    FramePlan,
    FrameTask,
    Tables,
    detect_batch,
    reason_of,
)
from detect.runs.known import KnownOfFrame
from detect.sources.times import format_time
from landmarks import (
    format_levelling,
    format_no_tilt,
    format_outline_tilt,
    format_record,
    format_tilt,
)

if TYPE_CHECKING:
    from detect.circles import CircleDetections
    from detect.lines import LineDetections
    from detect.run_tilt import RunTilt

#: Largest number of pixels that are decoded at once.
PIXELS_AT_ONCE = 1 << 25

#: Number of failures whose messages a summary keeps.
KEPT_FAILURES = 100

_NONE: Mapping[str, int] = {}


class FrameRows(NamedTuple):
    """Result of a frame.

    Attributes
    ----------
    rows : mapping
        Its rows in files of each kind: "circles", "lines", "tilt", "markers", "json", "times".
    found : mapping
        How many "discs", "lines", "tilts" and "markers" there are.
    rejected : mapping
        How many candidates for markers were rejected, by cause.
    error : str or None
        Why the frame could not be worked on: its STEP stays, without landmarks.
    pictures : tuple of (name, PNG)
    """

    prefix: str
    rows: Mapping[str, str]
    found: Mapping[str, int] = _NONE
    rejected: Mapping[str, int] = _NONE
    error: str | None = None
    pictures: tuple[tuple[str, bytes], ...] = ()


@dataclass
class RunSummary:
    """Summary of a run.

    Attributes
    ----------
    frames, failed : int
        Frames of the run, and those of them that could not be worked on.
    found, rejected : Counter
        Sums of these of `FrameRows`.
    failures : list of str
        A line for each of the first `KEPT_FAILURES` frames that failed.
    images_without_step : int
        Images that are no part of the run: the odometry does not have them.
    tilt : RunTilt or None
        The tilt of the run, if discs were levelled by it.
    """

    frames: int = 0
    found: Counter[str] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    failed: int = 0
    failures: list[str] = field(default_factory=list)
    images_without_step: int = 0
    tilt: RunTilt | None = None

    def add(self, rows: FrameRows) -> None:
        """Count a frame."""
        self.frames += 1
        self.found.update(rows.found)
        self.rejected.update(rows.rejected)
        if rows.error is not None:
            self.failed += 1
            if len(self.failures) < KEPT_FAILURES:
                self.failures.append(rows.error)


def rows_of_frames(tasks: Sequence[FrameTask], plan: FramePlan, tables: Tables) -> list[FrameRows]:
    """The rows of frames; as many are worked on at a time as fit in memory."""
    camera = plan.camera
    at_once = 1
    if camera is not None and plan.drawing is None and not plan.draw_response:
        at_once = max(1, PIXELS_AT_ONCE // (camera.width * camera.height))
    rows: list[FrameRows] = []
    for first in range(0, len(tasks), at_once):
        batch = tasks[first : first + at_once]
        found = detect_batch(batch, plan, tables)
        rows += [_rows_of(task, each, plan, tables) for task, each in zip(batch, found)]
    return rows


def _rows_of(task: FrameTask, found: FrameDetections, plan: FramePlan, tables: Tables) -> FrameRows:
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
            _NONE if found.markers is None else dict(sorted(found.markers.rejected.items())),
            pictures=tuple(_drawn(Path(task.frame.step.prefix).name, found, plan, tables)),
        )
    except COSTS_THE_FRAME as error:
        return rows_of_failure(task, reason_of(error, task))


def _rows_by_kind(task: FrameTask, found: FrameDetections, plan: FramePlan) -> dict[str, str]:
    step = task.frame.step
    head = f"{format_record(step)}\n"
    rows = {"times": _time_row(task)}
    if found.lines is not None:
        rows["lines"] = head + _line_rows(found.lines, task.known)
        tilt = found.tilt
        own = format_no_tilt(step.prefix, len(found.lines)) if tilt is None else format_tilt(tilt)
        rows["tilt"] = f"{own}\n"
        if found.outline_tilt is not None:
            rows["tilt"] += f"{format_outline_tilt(found.outline_tilt)}\n"
    if found.discs is not None and found.seen is not None:
        level = found.discs.levelled_by
        note = "" if level is None else f"{format_levelling(level)}\n"
        rows["circles"] = head + note + _disc_rows(found.discs, found.seen, task.known)
        if plan.json:
            rows["json"] = _json({"frame": step.prefix, "discs": _disc_records(found.discs)})
    if found.markers is not None:
        rows["markers"] = head + "".join(
            f"{format_record(marker)}\n" for marker in found.markers.landmarks()
        )
    return rows


def rows_of_failure(task: FrameTask, reason: str) -> FrameRows:
    """Output of a frame that could not be processed."""
    step = task.frame.step
    rows = dict.fromkeys(("circles", "lines", "markers"), f"{format_record(step)}\n")
    rows["tilt"] = f"{format_no_tilt(step.prefix, 0)}\n"
    rows["json"] = _json({"frame": step.prefix, "error": reason})
    rows["times"] = _time_row(task)
    return FrameRows(step.prefix, rows, error=reason)


def landmark_rows(
    keyword: str, numbers: NDArray[np.float64], ids: Sequence[tuple[int, ...]]
) -> str:
    """Rows of landmarks, as `landmarks.format_record` formats them, of (N, K) numbers and N IDs.

    Raises
    ------
    FrameError
        If a number is not finite.
    """
    if not np.isfinite(numbers).all():
        raise FrameError(f"{keyword}: a number of it is not finite")
    row = keyword + " %g" * numbers.shape[1]
    rows = "".join(" ".join([row, *map(str, own)]) + "\n" for own in ids)
    return rows % tuple(numbers.ravel().tolist())


def disc_numbers(
    floor_xy: NDArray[np.float64], quality: NDArray[np.float64], covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The (N, 6) numbers of rows of discs: x, y, quality, cxx, cxy, cyy."""
    return np.column_stack([floor_xy, quality, covariance[:, 0], covariance[:, 1, 1]])


def _line_rows(found: LineDetections, known: KnownOfFrame) -> str:
    ids: list[tuple[int, ...]] = [(-1,)] * len(found)
    if known.lines:
        from detect.verticals.detections import carry_ids

        ids = [row.ids for row in carry_ids(found.landmarks(), known.lines)]
    no_quality = np.zeros(len(found))
    columns = [found.ends, found.alpha_rad, found.beta_rad, no_quality, found.sigma_rad]
    return landmark_rows("LANDMARK_L", np.column_stack(columns), ids)


def _disc_rows(discs: CircleDetections, seen: CircleDetections, known: KnownOfFrame) -> str:
    """The rows, with the IDs of a known row of the same disc, or of a map's, or -1."""
    numbers = disc_numbers(discs.floor_xy, discs.quality, discs.covariance)
    ids: list[tuple[int, ...]] = [(-1,)] * len(discs)
    if known.discs:
        from detect.discs.identity import ids_of_rows

        alike = discs if known.discs_level else seen
        named = ids_of_rows(alike.floor_xy, known.discs)
        by_pixel = dict(zip(map(tuple, alike.pixels.tolist()), named))
        ids = [by_pixel[u, v] or (-1,) for u, v in discs.pixels.tolist()]
    if known.mapped:
        from detect.discs.identity import ids_of_map

        taken = {number for own in ids for number in own}
        left = [disc for disc in known.mapped if disc.id not in taken]
        rows = [k for k, own in enumerate(ids) if own == (-1,)]
        found = ids_of_map(discs.floor_xy[rows], discs.covariance[rows], left, known.slack_m)
        for k, number in zip(rows, found.tolist()):
            ids[k] = (number,)
    return landmark_rows("LANDMARK_C", numbers, ids)


def _time_row(task: FrameTask) -> str:
    frame = task.frame
    return "" if frame.time_s is None else f"{format_time(frame.step.prefix, frame.time_s)}\n"


def _json(record: dict[str, object]) -> str:
    """A record in the list of frames of an indented document."""
    return "\n" + indent(json.dumps(record, indent=1), "  ")


def _disc_records(found: CircleDetections) -> list[dict[str, object]]:
    rows = disc_numbers(found.floor_xy, found.quality, found.covariance).tolist()
    return [
        {
            "pixel": pixel,
            "x_m": x,
            "y_m": y,
            "quality": quality,
            "evidence": evidence if math.isfinite(evidence) else None,
            "covariance_m2": covariance,
        }
        for pixel, (x, y, quality, *covariance), evidence in zip(
            found.pixels.tolist(), rows, found.evidence.tolist()
        )
    ]


def _drawn(
    name: str, found: FrameDetections, plan: FramePlan, tables: Tables
) -> Iterator[tuple[str, bytes]]:
    """The pictures of a plan, by name."""
    if plan.drawing is None and not plan.draw_response:
        return
    from detect.drawing.frame import draw_circles
    from detect.drawing.lines import draw_lines, draw_response, draw_tracks
    from detect.verticals.response import line_response

    image, camera = found.pixels, plan.camera
    picture: NDArray[np.uint8] | None = None
    if plan.drawing == "markers" and found.markers is not None:
        from detect.markers.drawing import draw_markers

        picture = draw_markers(image, found.markers)
    elif plan.drawing == "discs" and found.discs is not None and camera and plan.circles:
        picture = draw_circles(image, camera, found.discs, plan.circles)
    elif found.lines is not None and camera and tables.verticals:
        if plan.drawing == "lines":
            picture = draw_lines(image, camera, found.lines)
        elif plan.drawing == "tracks":
            picture = draw_tracks(image, tables.verticals, found.lines)
    if picture is not None:
        yield f"{name}.png", _png(picture)
    if plan.draw_response and found.lines is not None and plan.lines and tables.verticals:
        response = line_response(image, tables.verticals, plan.lines)
        yield f"{name}.response.png", _png(draw_response(response, tables.verticals))


def _png(picture: NDArray[np.uint8]) -> bytes:
    import cv2

    return cv2.imencode(".png", picture)[1].tobytes()
