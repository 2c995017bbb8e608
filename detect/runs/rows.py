"""The rows of frames, their JSON and their pictures, from what is detected in them."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.circles import CircleDetections
from detect.discs.identity import ids_of_map, ids_of_rows
from detect.drawing.frame import draw_candidates, draw_response, draw_rows, draw_tracks
from detect.drawing.inputs import SeenRows
from detect.errors import FrameError
from detect.lines import LineDetections
from detect.runs.frame import (
    COSTS_THE_FRAME,
    FrameDetections,
    detect_batch,
    reason_of,
    tables_of,
)
from detect.runs.known import KnownOfFrame
from detect.runs.plan import (
    FramePlan,
    FrameRows,
    FrameTask,
    json_record,
    rows_of_failure,
    time_row,
)
from detect.seen import Sight
from detect.settings import CircleSettings
from detect.verticals.detections import carry_ids
from detect.verticals.response import line_response
from detect.viewing_options import CompareOptions
from redetect.landmarks import (
    format_levelling,
    format_no_tilt,
    format_outline_tilt,
    format_record,
    format_tilt,
    frames_of_rows,
    parse_rows,
)

#: Largest number of pixels that are decoded at once.
PIXELS_AT_ONCE = 1 << 25


def rows_of_frames(tasks: Sequence[FrameTask], plan: FramePlan) -> list[FrameRows]:
    """The rows of frames; as many are worked on at a time as fit in memory."""
    rows: list[FrameRows] = []
    for own, group in groupby(tasks, lambda task: task.plan or plan):
        alike, camera, at_once = list(group), own.camera, 1
        if camera is not None and own.drawing is None and not own.draw_response:
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
        rows = _rows_by_kind(task, found, plan)
        return FrameRows(
            task.frame.step.prefix,
            rows,
            {
                "discs": len(found.discs or ()),
                "lines": len(found.lines or ()),
                "tilts": int(found.lines is not None and found.tilt is not None),
                "markers": len(found.markers or ()),
            },
            {} if found.markers is None else dict(sorted(found.markers.rejected.items())),
            pictures=tuple(
                (
                    f"{Path(task.frame.step.prefix).name}{ending}",
                    cv2.imencode(".png", picture)[1].tobytes(),
                )
                for ending, picture in _drawn(rows, found, plan)
            ),
        )
    except COSTS_THE_FRAME as error:
        return rows_of_failure(task, reason_of(error, task))


def _rows_by_kind(task: FrameTask, found: FrameDetections, plan: FramePlan) -> dict[str, str]:
    step = task.frame.step
    head = f"{format_record(step)}\n"
    rows = {"times": time_row(task)}
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
            rows["json"] = json_record({"frame": step.prefix, "discs": _disc_records(found.discs)})
    if found.markers is not None:
        rows["markers"] = head + "".join(
            f"{format_record(marker)}\n" for marker in found.markers.landmarks()
        )
    return rows


def landmark_rows(
    keyword: str, numbers: NDArray[np.float64], ids: Sequence[tuple[int, ...]]
) -> str:
    """Rows of landmarks, as `landmarks.format_record` formats them, of (N, K) numbers and N IDs."""
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
        ids = [row.ids for row in carry_ids(found.landmarks(), known.lines)]
    no_quality = np.zeros(len(found))
    columns = [found.ends, found.alpha_rad, found.beta_rad, no_quality, found.sigma_rad]
    return landmark_rows("LANDMARK_L", np.column_stack(columns), ids)


def _disc_rows(discs: CircleDetections, seen: CircleDetections, known: KnownOfFrame) -> str:
    """The rows, with the IDs of a known row of the same disc, or of a map's, or -1."""
    numbers = disc_numbers(discs.floor_xy, discs.quality, discs.covariance)
    ids: list[tuple[int, ...]] = [(-1,)] * len(discs)
    if known.discs:
        alike = discs if known.discs_level else seen
        named = ids_of_rows(alike.floor_xy, known.discs)
        by_pixel = dict(zip(map(tuple, alike.pixels.tolist()), named))
        ids = [by_pixel[u, v] or (-1,) for u, v in discs.pixels.tolist()]
    if known.mapped:
        taken = {number for own in ids for number in own}
        left = [disc for disc in known.mapped if disc.id not in taken]
        rows = [k for k, own in enumerate(ids) if own == (-1,)]
        found = ids_of_map(discs.floor_xy[rows], discs.covariance[rows], left, known.slack_m)
        for k, number in zip(rows, found.tolist()):
            ids[k] = (number,)
    return landmark_rows("LANDMARK_C", numbers, ids)


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
    rows: Mapping[str, str], found: FrameDetections, plan: FramePlan
) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """The pictures of a plan, by the endings of their names."""
    if plan.drawing is None and not plan.draw_response:
        return
    image, table = found.pixels, tables_of(plan).verticals
    kind = "circles" if plan.drawing == "discs" else "markers" if plan.markers else "lines"
    content = io.BytesIO(rows[kind].encode("utf-8", "surrogateescape"))
    (frame,) = frames_of_rows(parse_rows(content))
    if plan.drawing == "tracks" and found.lines is not None and table:
        yield ".png", draw_tracks(image, table, found.lines)
    elif plan.drawing is not None:
        settings = plan.circles or CircleSettings()
        sight = Sight(plan.camera, settings.radius_m) if plan.camera else None
        frames: dict[str, Any] = {kind: frame}
        seen = SeenRows(**frames, tilt=found.tilt)
        name = Path(frame.step.prefix).name
        picture = draw_rows(image, sight, seen, settings, CompareOptions(), name)
        if found.markers is not None:
            picture = draw_candidates(picture, found.markers)
        yield ".png", picture
    if plan.draw_response and found.lines is not None and plan.lines and table:
        yield ".response.png", draw_response(line_response(image, table, plan.lines), table)
