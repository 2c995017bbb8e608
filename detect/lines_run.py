"""Verticals over a whole run: frames in, a ``.lines`` and a ``.tilt`` file out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from detect.errors import FrameError
from detect.line_settings import LineSettings
from detect.lines import LineDetections, detect_lines
from detect.run import Run, RunFrame, read_image
from landmarks import (
    Frame,
    FrameTilt,
    LineLandmark,
    format_no_tilt,
    format_tilt,
    wrap_angle,
    write_frames,
)
from lut import cached_vertical_table
from storage import write_whole

#: Called with each frame's image and its detections.
LineSink = Callable[[RunFrame, NDArray[np.uint8], LineDetections], None]

#: A reference line is the same as a detected one within this bearing, or two standard deviations.
_SAME_LINE_RAD = np.radians(0.5)


@dataclass
class LinesSummary:
    """What came of a run.

    Attributes
    ----------
    frames, lines, tilts : int
        Frames looked at, lines found in them, and frames whose tilt could be told.
    failures : list of str
        A line for each frame that could not be worked on.
    images_without_step : int
        Images that the odometry does not name.
    """

    frames: int = 0
    lines: int = 0
    tilts: int = 0
    failures: list[str] = field(default_factory=list)
    images_without_step: int = 0


def detect_lines_run(
    run: Run,
    settings: LineSettings,
    output: Path,
    tilt_output: Path,
    *,
    version: str,
    overwrite: bool = False,
    reference: Mapping[str, Sequence[LineLandmark]] | None = None,
    on_frame: LineSink | None = None,
    on_progress: Callable[[], None] | None = None,
) -> LinesSummary:
    """Detect the verticals of a run and write them, with the tilt that they show.

    Parameters
    ----------
    run : Run
        The run.
    settings : LineSettings
        What to look for.
    output, tilt_output : path
        The ``.lines`` and the ``.tilt`` file (see `landmarks.tilts`).
    version : str
        The program's version, for the files' heads.
    overwrite : bool
        Whether existing files may be replaced.
    reference : mapping, optional
        Rows with IDs by image prefix: carried over where the match is unambiguous.
    on_frame : callable, optional
        Called with each frame that could be worked on.
    on_progress : callable, optional
        Called once after every frame.

    Returns
    -------
    LinesSummary

    Raises
    ------
    storage.OutputExistsError
        If an output exists and must not be replaced.
    """
    summary = LinesSummary(images_without_step=len(run.images_without_step))
    table = cached_vertical_table(run.camera)
    tilt_rows = [f"# {line}" for line in _tilt_head(version)]

    def frames() -> Iterator[Frame]:
        for frame in run.frames:
            summary.frames += 1
            prefix = frame.step.prefix
            try:
                image = read_image(frame, run.camera)
                found = detect_lines(image, table, settings)
            except FrameError as error:
                summary.failures.append(str(error))
                tilt_rows.append(format_no_tilt(prefix, 0))
                yield Frame(frame.step)
            else:
                if on_frame is not None:
                    on_frame(frame, image, found)
                rows = found.landmarks()
                if reference is not None:
                    rows = carry_ids(rows, reference.get(prefix, ()))
                summary.lines += len(rows)
                if found.tilt is None:
                    tilt_rows.append(format_no_tilt(prefix, len(rows)))
                else:
                    summary.tilts += 1
                    tilt_rows.append(format_tilt(_frame_tilt(prefix, found)))
                yield Frame(frame.step, rows)
            if on_progress is not None:
                on_progress()

    # Both files appear, or neither: the tilts' is opened first and finished last.
    with write_whole(tilt_output, overwrite=overwrite) as stream:
        write_frames(output, frames(), head=_head(settings, version, run), overwrite=overwrite)
        text = "".join(f"{row}\n" for row in tilt_rows)
        stream.write(text.encode("utf-8", "surrogateescape"))
    return summary


def carry_ids(
    rows: Sequence[LineLandmark], reference: Sequence[LineLandmark]
) -> tuple[LineLandmark, ...]:
    """Give detected lines the IDs of the reference rows that are theirs beyond doubt.

    A reference row whose bearing fits exactly one detected line (within half a degree or two
    standard deviations) gives that line its IDs; a joined line can get several.

    Parameters
    ----------
    rows : sequence of LineLandmark
        Detected lines of one frame.
    reference : sequence of LineLandmark
        The same frame's rows with IDs.

    Returns
    -------
    tuple of LineLandmark
        In the order of `rows`; without an ID (-1) where none fits.
    """
    if not rows or not reference:
        return tuple(rows)
    alpha = np.array([row.alpha for row in rows])
    reach = np.maximum(_SAME_LINE_RAD, 2.0 * np.array([row.sigma for row in rows]))
    ids: list[list[int]] = [[] for _ in rows]
    for row in reference:
        fits = np.flatnonzero(np.abs(wrap_angle(alpha - row.alpha)) <= reach)
        if len(fits) == 1:
            ids[fits[0]] += [i for i in row.ids if i >= 0]
    return tuple(
        dataclasses.replace(row, ids=tuple(dict.fromkeys(own)) if own else (-1,))
        for row, own in zip(rows, ids)
    )


def _frame_tilt(prefix: str, found: LineDetections) -> FrameTilt:
    assert found.tilt is not None
    c = found.tilt.covariance
    return FrameTilt(
        prefix,
        found.tilt.pitch_rad,
        found.tilt.roll_rad,
        float(c[0, 0]),
        float(c[0, 1]),
        float(c[1, 1]),
        found.tilt.lines,
    )


def _head(settings: LineSettings, version: str, run: Run) -> str:
    """The comment lines of a ``.lines`` file: what the rows mean and how they were made."""
    odometry = run.odometry.name if run.odometry is not None else "none: the steps are zeros"
    values = " ".join(
        f"{k}={str(v).replace(' ', '')}" for k, v in dataclasses.asdict(settings).items()
    )
    sign = "compensated for the tilt"
    if settings.alpha == "published":
        sign += ", with the data set's own sign"
    lines = [
        f"Verticals of the building, detected by redetect {version}.",
        "Robot frame: origin on the floor, X left, Y backward (forward is -Y), metres, radians.",
        "STEP <image> <dX> <dY> <dPhi> <cXX> <cXY> <cYY> <cXPhi> <cYPhi> <cPhiPhi>",
        f"  odometry: {odometry}; the image was taken after the step",
        "LANDMARK_L <xTop> <yTop> <xBottom> <yBottom> <alpha> <beta> <quality> <sigma> <ID>",
        "  ends: undistorted normalised coordinates; beta: inclination of the plane's normal",
        f"  alpha: bearing (0 forward, positive to the left), {sign}; sigma: its deviation",
        f"camera {run.camera}",
        f"settings {values}",
    ]
    return "\n".join(lines)


def _tilt_head(version: str) -> list[str]:
    return [
        f"Pitch and roll of each frame from the building's verticals, by redetect {version}.",
        "TILT <image> <pitch> <roll> <cPP> <cPR> <cRR> <lines>",
        "  rotation vector (pitch, roll, 0) about the robot's X (left) and Y (backward), radians:",
        "  it turns directions measured with the calibrated mounting level; its covariance;",
        "  and the number of verticals that agree with it",
        "NOTILT <image> <lines>: too few lines agree",
    ]
