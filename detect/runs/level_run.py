"""The second pass over a run: its discs levelled by the tilt of all its frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np

from camera import Camera
from detect.levelling import level_discs
from detect.run_tilt import RunTilt, frame_tilts, tilt_of_run
from detect.runs.outputs import RUN_TILT
from detect.runs.rows import RunSummary, disc_numbers, encoded, landmark_rows
from landmarks import FrameTilt, format_levelling, format_no_tilt, format_tilt, tilt_as_written

#: Prefix, lines and tilt of a frame.
_Tilted = tuple[str, int, FrameTilt | None]


def level_run(
    camera: Camera,
    tilt_sigma_rad: float,
    summary: RunSummary,
    read: Callable[[], Iterable[Mapping[str, bytes]]],
) -> Iterator[Mapping[str, bytes]]:
    """Level the discs of a run, once they are all there.

    Where too few frames have a tilt to learn from (`detect.run_tilt.LEAST_FRAMES`), each frame is
    levelled by its own.

    Parameters
    ----------
    camera : Camera
    tilt_sigma_rad : float
        Standard deviation of pitch and roll of frames whose tilt is unknown.
    summary : RunSummary
        Is given the tilt of the run, if there is one.
    read : callable
        Reads the rows of all frames, by kind: "tilt" has a frame's tilt, "circles" its discs as
        seen. Called twice.

    Yields
    ------
    mapping
        The rows of each frame: those that were read, but with levelled "circles", and `RUN_TILT`.
    """
    frames: list[_Tilted] = []
    outlines: list[FrameTilt | None] = []
    for rows in read():
        own, *by_outlines = map(_tilt_of_row, rows["tilt"].splitlines())
        frames.append(own)
        outlines.append(by_outlines[0][2] if by_outlines else None)
    summary.tilt, applied = _applied(frames, outlines, tilt_sigma_rad)
    for rows, (prefix, lines, _), tilt in zip(read(), frames, applied, strict=True):
        circles = rows["circles"]
        yield {
            **rows,
            "circles": circles if tilt is None else _levelled(circles, tilt, camera),
            RUN_TILT: encoded(format_no_tilt(prefix, lines) if tilt is None else format_tilt(tilt)),
        }


def _applied(
    frames: list[_Tilted], outlines: list[FrameTilt | None], sigma_rad: float
) -> tuple[RunTilt | None, Iterable[FrameTilt | None]]:
    """The tilt of the run, and what each frame's discs are levelled by."""
    run = tilt_of_run(frame_tilts([tilt for _, _, tilt in frames]), frame_tilts(outlines))
    if run is None:
        return None, (_by_itself(prefix, tilt, sigma_rad) for prefix, _, tilt in frames)
    numbers = zip(frames, run.tilt.tolist(), run.variance.tolist())
    return run, (
        tilt_as_written(FrameTilt(prefix, pitch, roll, cpp, 0.0, crr, lines))
        for (prefix, lines, _), (pitch, roll), (cpp, crr) in numbers
    )


def _by_itself(prefix: str, tilt: FrameTilt | None, sigma_rad: float) -> FrameTilt | None:
    if tilt is not None or sigma_rad == 0.0:
        return tilt
    return FrameTilt(prefix, 0.0, 0.0, sigma_rad**2, 0.0, sigma_rad**2, 0)


def _levelled(circles: bytes, tilt: FrameTilt, camera: Camera) -> bytes:
    """A frame's rows, its STEP first."""
    step, *rows = circles.splitlines(keepends=True)
    head = step + encoded(format_levelling((tilt.pitch, tilt.roll)))
    if not rows:
        return head
    words = [row.split() for row in rows]
    numbers = np.array([word[1:7] for word in words], np.float64)
    covariance = numbers[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
    floor_xy, level_covariance, down = level_discs(camera, numbers[:, :2], covariance, tilt)
    level = disc_numbers(floor_xy[down], numbers[down, 2], level_covariance[down])
    ids = [tuple(map(int, words[k][7:])) for k in np.flatnonzero(down)]
    return head + landmark_rows("LANDMARK_C", level, ids)


def _tilt_of_row(row: bytes) -> _Tilted:
    keyword, prefix, *words = row.decode("utf-8", "surrogateescape").split()
    if keyword == "NOTILT":
        return prefix, int(words[0]), None
    pitch, roll, cpp, cpr, crr = map(float, words[:5])
    lines = int(words[5])
    return prefix, lines, FrameTilt(prefix, pitch, roll, cpp, cpr, crr, lines)
