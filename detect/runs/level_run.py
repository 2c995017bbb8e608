"""The second pass over a run: its discs levelled by the tilt of all its frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import BinaryIO

import numpy as np

from camera import Camera
from detect.discs.levelling import level_discs
from detect.run_tilt import RunTilt, frame_tilts, tilt_of_run
from detect.runs.outputs import LEVEL_CIRCLES, LEVEL_TILT
from detect.runs.rows import RunSummary, disc_numbers, encoded, landmark_rows
from landmarks import FrameTilt, format_levelling, format_no_tilt, format_tilt, tilt_as_written

#: Number of bytes of rows that are collected before they are written.
_AT_ONCE = 1 << 18

#: Prefix, lines and tilt of a frame.
_Tilted = tuple[str, int, FrameTilt | None]


def level_run(
    camera: Camera, tilt_sigma_rad: float, summary: RunSummary, files: Mapping[str, BinaryIO]
) -> Iterator[tuple[str, bytes]]:
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
    files : mapping of str to binary stream
        By kind: "tilt" has the frames' tilts, "circles" their discs as seen.

    Yields
    ------
    (str, bytes)
        `LEVEL_TILT`, or `LEVEL_CIRCLES`, and rows of the file of that kind.
    """
    frames, outlines = _tilts_of_rows(files["tilt"])
    summary.tilt, applied = _applied(frames, outlines, tilt_sigma_rad)
    tilts, circles = bytearray(), bytearray()
    seen = _frames_of(files["circles"])
    for (prefix, lines, _), tilt, rows in zip(frames, applied, seen, strict=True):
        tilts += encoded(format_no_tilt(prefix, lines) if tilt is None else format_tilt(tilt))
        circles += b"".join(rows) if tilt is None else _levelled(rows, tilt, camera)
        if len(circles) > _AT_ONCE:
            yield LEVEL_CIRCLES, bytes(circles)
            yield LEVEL_TILT, bytes(tilts)
            tilts, circles = bytearray(), bytearray()
    yield LEVEL_CIRCLES, bytes(circles)
    yield LEVEL_TILT, bytes(tilts)


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


def _levelled(rows: list[bytes], tilt: FrameTilt, camera: Camera) -> bytes:
    """A frame's rows, its STEP first."""
    head = rows[0] + encoded(format_levelling((tilt.pitch, tilt.roll)))
    if len(rows) == 1:
        return head
    words = [row.split() for row in rows[1:]]
    numbers = np.array([word[1:7] for word in words], np.float64)
    covariance = np.ascontiguousarray(numbers[:, [3, 4, 4, 5]]).reshape(-1, 2, 2)
    floor_xy, level_covariance, down = level_discs(
        np.ascontiguousarray(numbers[:, :2]),
        covariance,
        np.array(camera.centre),
        (tilt.pitch, tilt.roll, tilt.cpp, tilt.cpr, tilt.crr),
    )
    level = disc_numbers(floor_xy[down], numbers[down, 2], level_covariance[down])
    ids = [tuple(map(int, words[k][7:])) for k in np.flatnonzero(down)]
    return head + landmark_rows("LANDMARK_C", level, ids)


def _counts(row: bytes) -> bool:
    return bool(row.strip()) and not row.startswith(b"#")


def _tilts_of_rows(rows: BinaryIO) -> tuple[list[_Tilted], list[FrameTilt | None]]:
    """Prefix, lines and tilt of each frame, and the tilt by the outlines of its discs."""
    frames: list[_Tilted] = []
    outlines: list[FrameTilt | None] = []
    for row in filter(_counts, rows):
        found = _tilt_of_row(row)
        if row.startswith(b"TILT_D"):
            outlines[-1] = found[2]
        else:
            frames.append(found)
            outlines.append(None)
    return frames, outlines


def _tilt_of_row(row: bytes) -> _Tilted:
    keyword, prefix, *words = row.decode("utf-8", "surrogateescape").split()
    if keyword == "NOTILT":
        return prefix, int(words[0]), None
    pitch, roll, cpp, cpr, crr = map(float, words[:5])
    lines = int(words[5])
    return prefix, lines, FrameTilt(prefix, pitch, roll, cpp, cpr, crr, lines)


def _frames_of(rows: BinaryIO) -> Iterator[list[bytes]]:
    """The rows of each frame, comments left out."""
    frame: list[bytes] = []
    for row in rows:
        if row.startswith(b"STEP"):
            if frame:
                yield frame
            frame = [row]
        elif frame and _counts(row):
            frame.append(row)
    if frame:
        yield frame
