"""The second pass over a run, on rows: levels its discs by the tilts of all frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice

import numpy as np

from camera import Camera
from detect.lean import lean_finds_more
from detect.levelling import common_covariance, common_tilt_variance, level_discs, tilt_arrays
from detect.projection import Tilt
from detect.run_tilt import (
    FrameTilts,
    RunTilt,
    camera_pitch_weights,
    frame_tilts,
    tilt_of_run,
    usual_tilt,
)
from detect.runs.outputs import RUN_TILT
from detect.runs.plan import FrameRows, RunSummary
from detect.settings import LEAST_FRAMES, CircleSettings
from redetect.array_types import FloatArray
from redetect.landmarks import (
    FrameTilt,
    circle_landmarks,
    format_levelling,
    format_no_tilt,
    format_record,
    format_tilt,
    tilt_as_written,
)

#: Prefix, lines and tilt of a frame.
_Tilted = tuple[str, int, FrameTilt | None]
#: Least lean that the search for discs considers, degrees: a slight lean does no harm.
_LEAST_LEAN_DEG = 0.5
_ROUNDS = 2  #: How often some frames are searched with a lean.
#: Standard deviation of a tilt that is known exactly: covariances in files are positive definite.
_LEAST_SIGMA_RAD = 1e-6
_LEVELLED_AT_ONCE = 64  #: Number of frames whose discs are levelled at once.


def tilt_of_some(camera: Camera, frames: Iterable[FrameRows]) -> tuple[FloatArray | None, float]:
    """The lean (2,) that some frames show, and the standard deviation of an unknown tilt (rad).

    If few frames have verticals, it is the median of their tilts, None if there are none; and if
    they are at least half of all, an unknown tilt is as large as theirs.
    """
    _, verticals, outlines = _tilts_of(rows.rows for rows in frames)
    common = common_tilt_variance(camera)
    found = tilt_of_run(verticals, outlines, common, camera_pitch_weights(camera))
    if found is not None:
        return found.lean, found.usual_rad
    usual_rad, known = usual_tilt(verticals, outlines), verticals.tilt[verticals.known]
    if not len(known):
        return None, usual_rad
    if 2 * len(known) >= len(verticals.tilt):
        usual_rad = max(usual_rad, math.sqrt(np.mean(known**2)))
    return np.median(known, axis=0), usual_rad


def lean_of_search(
    mean: FloatArray,
    rows: Sequence[FrameRows],
    rows_by: Callable[[Tilt | None], Sequence[FrameRows]],
) -> Tilt | None:
    """The lean for the search for discs (rad); None if without one as much is found.

    `rows` are those of some frames, found without a lean, and `mean` (2,) their mean tilt (rad).
    `rows_by` searches these frames with another lean.
    """
    used, lean, evidence = None, _rounded(mean), sum(each.evidence for each in rows)
    for _ in range(_ROUNDS):
        if lean in (None, used):
            break
        rows, before = rows_by(lean), evidence
        evidence = sum(each.evidence for each in rows)
        if not lean_finds_more(evidence, before):
            break
        # Discs that are found without the lean show less of it.
        used, lean = lean, _lean_of_outlines(rows)
    return used


def _lean_of_outlines(frames: Iterable[FrameRows]) -> Tilt | None:
    """The median pitch and roll that the outlines of discs show, if many frames show any."""
    _, _, outlines = _tilts_of(rows.rows for rows in frames)
    known = outlines.tilt[outlines.known]
    return _rounded(np.median(known, axis=0)) if len(known) >= LEAST_FRAMES else None


def _rounded(lean: FloatArray) -> Tilt | None:
    """A lean (2,), rounded so that runs of a camera share a cached table; None if it hardly makes a
    difference.
    """
    lean_deg = np.degrees(lean).round(1)
    if np.hypot(*lean_deg) < _LEAST_LEAN_DEG:
        return None
    pitch, roll = np.radians(lean_deg).tolist()
    return pitch, roll


def _tilts_of(frames: Iterable[Mapping[str, str]]) -> tuple[list[_Tilted], FrameTilts, FrameTilts]:
    """The tilts in the rows of frames, and as arrays those from verticals and from outlines."""
    own: list[_Tilted] = []
    outlines: list[FrameTilt | None] = []
    for rows in frames:
        by_verticals, *by_outlines = map(_tilt_of_row, _lines(rows["tilt"]))
        own.append(by_verticals)
        outlines.append(by_outlines[0][2] if by_outlines else None)
    return own, frame_tilts([tilt for _, _, tilt in own]), frame_tilts(outlines)


def level_run(
    camera: Camera,
    settings: CircleSettings,
    read: Callable[[], Iterable[Mapping[str, str]]],
    summary: RunSummary,
) -> Iterator[Mapping[str, str]]:
    """The rows of each frame with levelled discs, and `RUN_TILT`.

    If too few frames have a tilt (`detect.settings.LEAST_FRAMES`), each frame is levelled by its
    own; unknown tilts have the standard deviation of the settings, or of the known ones. It or the
    tilt of the run is stored in the summary. `read`, called twice, returns all rows unlevelled.
    """
    frames, verticals, outlines = _tilts_of(read())
    common = common_tilt_variance(camera)
    found = summary.tilt = tilt_of_run(verticals, outlines, common, camera_pitch_weights(camera))
    if found is not None:
        numbers = np.column_stack([found.tilt, found.variance]).tolist()
        tilts: list[FrameTilt | None] = [
            tilt_as_written(FrameTilt(prefix, pitch, roll, cpp, 0.0, crr, lines))
            for (prefix, lines, _), (pitch, roll, cpp, crr) in zip(frames, numbers, strict=True)
        ]
    elif settings.tilt_sigma_rad or settings.calibration_px or common is not None:
        sigma_rad = settings.tilt_sigma_rad
        if settings.tilt_sigma_deg is None:
            sigma_rad = usual_tilt(verticals, outlines)
            summary.unlevelled_deg = round(math.degrees(sigma_rad), 2)
        unknown = max(sigma_rad, _LEAST_SIGMA_RAD) ** 2
        tilts = [t or FrameTilt(name, 0.0, 0.0, unknown, 0.0, unknown, 0) for name, _, t in frames]
    else:
        tilts = [tilt for _, _, tilt in frames]
    run = zip(read(), frames, tilts, strict=True)
    while batch := list(islice(run, _LEVELLED_AT_ONCE)):
        tilted = [(rows["circles"], tilt) for rows, _, tilt in batch if tilt is not None]
        level = iter(_levelled(tilted, camera, settings.calibration_px, found, common))
        for rows, (prefix, lines, _), tilt in batch:
            by = format_no_tilt(prefix, lines) if tilt is None else format_tilt(tilt)
            circles = rows["circles"] if tilt is None else next(level)
            yield {**rows, "circles": circles, RUN_TILT: f"{by}\n"}


def _levelled(
    frames: Sequence[tuple[str, FrameTilt]],
    camera: Camera,
    calibration_px: float,
    run: RunTilt | None,
    common: FloatArray | None,
) -> list[str]:
    """The rows of frames, each with its STEP first, levelled by their tilts.

    The tilts are those of the `run`, if given, with the variances `common` to all frames; else the
    frames' own, or unknown ones, with 0 lines.
    """
    texts: list[str] = []
    words: list[list[str]] = []
    frame_of_row: list[int] = []
    for k, (text, by) in enumerate(frames):
        step, *rows = _lines(text)
        texts.append(f"{step}\n{format_levelling((by.pitch, by.roll))}\n")
        words += map(str.split, rows)
        frame_of_row += [k] * len(rows)
    tilts = [frames[k][1] for k in frame_of_row]
    numbers = np.array([[float(word) for word in row[1:7]] for row in words]).reshape(-1, 6)
    xy, covariance = numbers[:, :2], numbers[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
    tilt, tilt_covariance = tilt_arrays(tilts)
    height_sigma = 0.0
    if run is not None:
        height_sigma = run.height_sigma  # as a share of the camera's height
        if common is not None and run.by_verticals:  # included in the calibration's errors
            tilt_covariance = tilt_covariance - np.diag(common)
    floor_xy, covariance, down = level_discs(camera, xy, covariance, tilt, tilt_covariance)
    from_camera = floor_xy - camera.centre[:2]
    covariance += height_sigma**2 * from_camera[:, :, None] * from_camera[:, None, :]
    by_verticals = np.array(
        [by.lines > 0 if run is None else run.by_verticals for by in tilts], np.bool_
    )
    covariance += common_covariance(camera, xy, calibration_px, by_verticals=by_verticals)
    level = circle_landmarks(floor_xy[down], numbers[down, 2], covariance[down])
    for k, row in zip(np.flatnonzero(down).tolist(), level):
        texts[frame_of_row[k]] += f"{format_record(row)} {' '.join(words[k][7:])}\n"
    return texts


def _lines(text: str) -> list[str]:
    return text.rstrip("\n").split("\n")  # `splitlines` would split names at other characters


def _tilt_of_row(row: str) -> _Tilted:
    keyword, prefix, *words = row.split(" ")  # a prefix may contain other blanks
    if keyword == "NOTILT":
        return prefix, int(words[0]), None
    pitch, roll, cpp, cpr, crr = map(float, words[:5])
    return prefix, int(words[5]), FrameTilt(prefix, pitch, roll, cpp, cpr, crr, int(words[5]))
