"""The second pass over a run: its discs levelled by the tilt of all its frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np

from camera import Camera
from detect.levelling import level_discs
from detect.run_tilt import frame_tilts, tilt_of_run
from detect.runs.outputs import RUN_TILT
from detect.runs.plan import RunSummary
from detect.runs.rows import disc_numbers, landmark_rows
from redetect.landmarks import (
    FrameTilt,
    format_levelling,
    format_no_tilt,
    format_tilt,
    tilt_as_written,
)

#: Prefix, lines and tilt of a frame.
_Tilted = tuple[str, int, FrameTilt | None]


def level_run(
    camera: Camera,
    tilt_sigma_deg: float,
    read: Callable[[], Iterable[Mapping[str, str]]],
    summary: RunSummary,
) -> Iterator[Mapping[str, str]]:
    """The rows of each frame with levelled discs, and `RUN_TILT`.

    Where too few frames have a tilt to learn from (`detect.run_tilt.LEAST_FRAMES`), each frame is
    levelled by its own; `tilt_sigma_deg` is the standard deviation of an unknown one. The summary
    is given the tilt of the run. `read` gives the rows of all frames as seen, and is called twice.
    """
    unknown_variance = math.radians(tilt_sigma_deg) ** 2
    frames: list[_Tilted] = []
    outlines: list[FrameTilt | None] = []
    for rows in read():
        own, *by_outlines = map(_tilt_of_row, _lines(rows["tilt"]))
        frames.append(own)
        outlines.append(by_outlines[0][2] if by_outlines else None)
    summary.tilt = tilt_of_run(frame_tilts([tilt for _, _, tilt in frames]), frame_tilts(outlines))
    for k, (rows, (prefix, lines, tilt)) in enumerate(zip(read(), frames, strict=True)):
        if summary.tilt is not None:
            pitch, roll = summary.tilt.tilt[k].tolist()
            cpp, crr = summary.tilt.variance[k].tolist()
            tilt = tilt_as_written(FrameTilt(prefix, pitch, roll, cpp, 0.0, crr, lines))
        elif tilt is None and unknown_variance > 0.0:
            tilt = FrameTilt(prefix, 0.0, 0.0, unknown_variance, 0.0, unknown_variance, 0)
        circles = rows["circles"]
        yield {
            **rows,
            "circles": circles if tilt is None else _levelled(circles, tilt, camera),
            RUN_TILT: f"{format_no_tilt(prefix, lines) if tilt is None else format_tilt(tilt)}\n",
        }


def _levelled(circles: str, tilt: FrameTilt, camera: Camera) -> str:
    """A frame's rows, its STEP first."""
    step, *rows = _lines(circles)
    head = f"{step}\n{format_levelling((tilt.pitch, tilt.roll))}\n"
    if not rows:
        return head
    words = [row.split() for row in rows]
    numbers = np.array([word[1:7] for word in words], np.float64)
    covariance = numbers[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
    floor_xy, level_covariance, down = level_discs(camera, numbers[:, :2], covariance, tilt)
    level = disc_numbers(floor_xy[down], numbers[down, 2], level_covariance[down])
    ids = [tuple(map(int, words[k][7:])) for k in np.flatnonzero(down)]
    return head + landmark_rows("LANDMARK_C", level, ids)


def _lines(text: str) -> list[str]:
    return text.rstrip("\n").split("\n")  # `splitlines` splits names at other characters, too


def _tilt_of_row(row: str) -> _Tilted:
    keyword, prefix, *words = row.split()
    if keyword == "NOTILT":
        return prefix, int(words[0]), None
    pitch, roll, cpp, cpr, crr = map(float, words[:5])
    lines = int(words[5])
    return prefix, lines, FrameTilt(prefix, pitch, roll, cpp, cpr, crr, lines)
