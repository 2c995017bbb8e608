"""Discs over a whole run: frames in, a ``.circles`` file and its summary out."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.circles import CircleDetections, detect_circles, disc_shape
from detect.errors import FrameError
from detect.levelling import level_covariances, level_positions
from detect.run import Run, RunFrame, read_image
from detect.settings import CircleSettings
from landmarks import Frame, FrameTilt, circle_landmarks, write_frames
from lut import cached_disc_table
from storage import write_whole

#: Called with each frame's image and its detections.
FrameSink = Callable[[RunFrame, NDArray[np.uint8], CircleDetections], None]


@dataclass
class CirclesSummary:
    """What came of a run.

    Attributes
    ----------
    frames, discs : int
        Frames looked at, and discs found in them.
    failures : list of str
        A line for each frame that could not be worked on.
    images_without_step : int
        Images that the odometry does not name.
    """

    frames: int = 0
    discs: int = 0
    failures: list[str] = field(default_factory=list)
    images_without_step: int = 0


def detect_circles_run(
    run: Run,
    settings: CircleSettings,
    output: Path,
    *,
    version: str,
    overwrite: bool = False,
    json_output: Path | None = None,
    tilts: Mapping[str, FrameTilt] | None = None,
    on_frame: FrameSink | None = None,
    on_progress: Callable[[], None] | None = None,
) -> CirclesSummary:
    """Detect the discs of a run and write them.

    Parameters
    ----------
    run : Run
        The run.
    settings : CircleSettings
        What to look for.
    output : path
        The ``.circles`` file.
    version : str
        The program's version, for the file's head.
    overwrite : bool
        Whether existing files may be replaced.
    json_output : path, optional
        Where the rows go as JSON as well.
    tilts : mapping, optional
        Tilts by image prefix: the positions of frames that have one are corrected for it.
    on_frame : callable, optional
        Called with each frame that could be worked on.
    on_progress : callable, optional
        Called once after every frame.

    Returns
    -------
    CirclesSummary

    Raises
    ------
    lut.TableError
        If there can be no table for the camera.
    storage.OutputExistsError
        If an output exists and must not be replaced.
    """
    summary = CirclesSummary(images_without_step=len(run.images_without_step))
    table = cached_disc_table(run.camera, disc_shape(settings))
    records: list[dict[str, object]] = []

    def frames() -> Iterator[Frame]:
        for frame in run.frames:
            summary.frames += 1
            try:
                image = read_image(frame, run.camera)
                found = detect_circles(image, run.camera, table, settings)
                if tilts is not None and frame.step.prefix in tilts:
                    found = levelled(found, run.camera, tilts[frame.step.prefix])
            except FrameError as error:
                summary.failures.append(str(error))
                records.append({"frame": frame.step.prefix, "error": str(error)})
                yield Frame(frame.step)
            else:
                summary.discs += len(found)
                if on_frame is not None:
                    on_frame(frame, image, found)
                if json_output is not None:
                    records.append({"frame": frame.step.prefix, "discs": _disc_records(found)})
                yield Frame(
                    frame.step,
                    circle_landmarks(
                        found.floor_xy, found.quality, found.covariance, np.full(len(found), -1)
                    ),
                )
            if on_progress is not None:
                on_progress()

    # The JSON is opened first: if it cannot be written, nothing is.
    with ExitStack() as outputs:
        stream = None
        if json_output is not None:
            stream = outputs.enter_context(write_whole(json_output, overwrite=overwrite))
        write_frames(output, frames(), head=_head(settings, version, run), overwrite=overwrite)
        if stream is not None:
            document = {
                "version": version,
                "settings": dataclasses.asdict(settings),
                "camera": run.camera.content_hash,
                "frames": records,
            }
            stream.write(json.dumps(document, indent=1).encode() + b"\n")
    return summary


def levelled(found: CircleDetections, camera: Camera, tilt: FrameTilt) -> CircleDetections:
    """The same discs, their positions and covariances corrected for a tilt."""
    tilt_covariance = np.array([[tilt.cpp, tilt.cpr], [tilt.cpr, tilt.crr]])
    floor_xy = level_positions(camera, found.floor_xy, tilt.pitch, tilt.roll)
    covariance = level_covariances(
        camera, found.floor_xy, found.covariance, tilt.pitch, tilt.roll, tilt_covariance
    )
    down = np.all(np.isfinite(floor_xy), axis=-1) & np.all(np.isfinite(covariance), axis=(-1, -2))
    return CircleDetections(
        pixels=found.pixels[down],
        floor_xy=floor_xy[down],
        covariance=covariance[down],
        quality=found.quality[down],
        evidence=found.evidence[down],
    )


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


def _head(settings: CircleSettings, version: str, run: Run) -> str:
    """The comment lines of a ``.circles`` file: what the rows mean and how they were made."""
    odometry = run.odometry.name if run.odometry is not None else "none: the steps are zeros"
    position = "fitted to the grey values" if settings.refine else "that of the pixel in the middle"
    values = " ".join(f"{k}={v}" for k, v in dataclasses.asdict(settings).items())
    lines = [
        f"Discs on the floor, detected by redetect {version}.",
        "Robot frame: origin on the floor, X left, Y backward (forward is -Y), metres, radians.",
        "STEP <image> <dX> <dY> <dPhi> <cXX> <cXY> <cYY> <cXPhi> <cYPhi> <cPhiPhi>",
        f"  odometry: {odometry}; the image was taken after the step",
        "LANDMARK_C <pX> <pY> <quality> <cXX> <cXY> <cYY> <ID>",
        f"  position {position}; quality is Otsu's, 0 to 1; ID -1: unknown",
        f"camera {run.camera}",
        f"settings {values}",
    ]
    return "\n".join(lines)
