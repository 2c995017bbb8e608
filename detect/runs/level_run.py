"""The second pass over a run: its discs levelled by the tilt of all its frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from camera import Camera
from detect.run_tilt import RunTilt, tilt_of_run
from detect.runs.stream import Output
from landmarks import (
    FrameTilt,
    format_head,
    format_levelling,
    format_no_tilt,
    format_tilt,
    tilt_as_written,
)

#: So many bytes of rows are gathered before they are written.
_AT_ONCE = 1 << 18


@dataclass(frozen=True)
class LevelRun:
    """Levels the rows of a run, once they are all there (`detect.runs.resume.SecondPass`).

    Where too few frames have a tilt to learn from (`detect.run_tilt.LEAST_FRAMES`), each frame is
    levelled by its own.

    Attributes
    ----------
    camera : Camera
    tilt_sigma_rad : float
        What is known of the tilt about level beforehand (`detect.levelling.with_prior`).
    frames_tilt, raw : str
        Names of the files that are read: the frames' tilts, and their discs as seen.
    tilt, circles : str
        Names of those that are written: the tilts applied, and the discs levelled by them.
    crlf : bool
        Whether rows of discs end with CR and LF.
    on_lean : callable or None
        Called with the tilt of the run.
    """

    camera: Camera
    tilt_sigma_rad: float
    frames_tilt: str
    raw: str
    tilt: str
    circles: str
    crlf: bool = False
    on_lean: Callable[[RunTilt], None] | None = None

    def __call__(self, first: Mapping[str, BinaryIO]) -> Iterator[tuple[str, bytes]]:
        """The rows of the files that are written, some at a time."""
        frames = [_tilt_of_row(row) for row in first[self.frames_tilt] if _counts(row)]
        applied = self._applied(frames)
        tilts, circles = bytearray(), bytearray()
        for (prefix, lines, _), tilt, rows in zip(
            frames, applied, _frames_of(first[self.raw]), strict=True
        ):
            text = format_no_tilt(prefix, lines) if tilt is None else format_tilt(tilt)
            tilts += _bytes(text)
            circles += self._levelled(rows, tilt)
            if len(circles) > _AT_ONCE:
                yield self.circles, self._ended(circles)
                yield self.tilt, bytes(tilts)
                tilts, circles = bytearray(), bytearray()
        yield self.circles, self._ended(circles)
        yield self.tilt, bytes(tilts)

    def _applied(
        self, frames: list[tuple[str, int, FrameTilt | None]]
    ) -> Iterator[FrameTilt | None]:
        """What each frame's discs are levelled by."""
        measured = np.array(
            [(math.nan, math.nan) if t is None else (t.pitch, t.roll) for _, _, t in frames]
        ).reshape(-1, 2)
        variance = np.array(
            [(math.nan, math.nan) if t is None else (t.cpp, t.crr) for _, _, t in frames]
        ).reshape(-1, 2)
        run = tilt_of_run(measured, variance)
        if run is None:
            yield from (self._by_itself(prefix, tilt) for prefix, _, tilt in frames)
            return
        if self.on_lean is not None:
            self.on_lean(run)
        for (prefix, lines, _), (pitch, roll), (cpp, crr) in zip(
            frames, run.tilt.tolist(), run.variance.tolist()
        ):
            yield tilt_as_written(FrameTilt(prefix, pitch, roll, cpp, 0.0, crr, lines))

    def _by_itself(self, prefix: str, tilt: FrameTilt | None) -> FrameTilt | None:
        from detect.levelling import with_prior

        if tilt is not None:
            return with_prior(tilt, self.tilt_sigma_rad)
        if self.tilt_sigma_rad == 0.0:
            return None
        variance = self.tilt_sigma_rad**2
        return FrameTilt(prefix, 0.0, 0.0, variance, 0.0, variance, 0)

    def _levelled(self, rows: list[bytes], tilt: FrameTilt | None) -> bytes:
        """A frame's rows, its STEP first."""
        if tilt is None:
            return b"".join(rows)
        out = rows[0] + _bytes(format_levelling((tilt.pitch, tilt.roll)))
        if len(rows) == 1:
            return out
        from detect.discs.levelling_kernels import level_discs

        words = [row.split(maxsplit=7) for row in rows[1:]]
        x, y, quality, cxx, cxy, cyy = np.array([word[1:7] for word in words], np.float64).T
        covariance = np.stack([np.stack([cxx, cxy], -1), np.stack([cxy, cyy], -1)], -2)
        floor_xy, level_covariance = np.empty((len(x), 2)), np.empty((len(x), 2, 2))
        down = np.empty(len(x), np.bool_)
        level_discs(
            np.stack([x, y], -1),
            covariance,
            np.array(self.camera.centre),
            (tilt.pitch, tilt.roll, tilt.cpp, tilt.cpr, tilt.crr),
            floor_xy,
            level_covariance,
            down,
        )
        for k in np.flatnonzero(down):
            (xx, xy), (_, yy) = level_covariance[k].tolist()
            px, py = floor_xy[k].tolist()
            ids = words[k][7].strip().decode() if len(words[k]) > 7 else ""
            out += _bytes(
                f"LANDMARK_C {px:g} {py:g} {quality[k]:g} {xx:g} {xy:g} {yy:g} {ids}".rstrip()
            )
        return out

    def _ended(self, rows: bytearray) -> bytes:
        return bytes(rows).replace(b"\n", b"\r\n") if self.crlf else bytes(rows)


def applied_tilt_file(path: Path, version: str) -> Output:
    """The file of the tilts that discs were levelled by: what the rows mean stands at its head."""
    lines = [
        f"Pitch and roll that the discs of each frame were levelled by, by redetect {version}:",
        "  the constant lean of the run and what the frame is believed to deviate from it",
        "TILT <image> <pitch> <roll> <cPP> <cPR> <cRR> <lines>",
        "  rotation vector (pitch, roll, 0) about the robot's X (left) and Y (backward), radians:",
        "  it turns directions measured with the calibrated mounting level; its covariance;",
        "  and the number of verticals that agree with the tilt of the frame by itself",
        "NOTILT <image> <lines>: its discs are as they were seen",
    ]
    return Output(path, "tilt", format_head("\n".join(lines)))


def _counts(row: bytes) -> bool:
    return bool(row.strip()) and not row.startswith(b"#")


def _tilt_of_row(row: bytes) -> tuple[str, int, FrameTilt | None]:
    """Prefix, lines and tilt of a row that this run wrote."""
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


def _bytes(text: str) -> bytes:
    return f"{text}\n".encode("utf-8", "surrogateescape")
