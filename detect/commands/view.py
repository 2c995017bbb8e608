"""The command ``detect view``: frames with landmarks, and the floor, over time, in Rerun."""

from __future__ import annotations

import os
import tempfile
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from detect.drawing.frame import draw_rows
from detect.errors import DetectError, FrameError
from detect.options import View
from detect.projection import circle_on_floor, summed_steps
from detect.row_files import ImageRows, open_rows
from detect.sources.grey_images import read_image
from detect.sources.interface import SomeFrames
from detect.sources.opening import demand_recording, open_run
from detect.terminal import progress_bar, report_failures
from redetect.array_types import FloatArray
from redetect.landmarks import Step, circle_arrays
from redetect.landmarks.map_file import read_map, read_path
from redetect.messages import imported_for
from redetect.storage import demand_place, write_bytes

_EDGE, _LINE, _MAP = (255, 170, 0), (60, 220, 60), (80, 140, 220)
# Times from this value on are assumed to be UNIX time: no recording is three years long.
_EARLIEST_DATE_S = 1e8


def perform(options: View) -> int:
    """Execute the command; returns the exit code."""
    os.environ.setdefault("RERUN_ANALYTICS_DISABLED", "1")
    with imported_for("detect view needs the package rerun-sdk", "view", DetectError):
        import rerun as rr
    demand_recording(options.run)
    run = open_run(options.run, options.camera, options.source)
    source = open_rows(run, options.files)
    if options.output is not None:
        demand_place(options.output, overwrite=options.force)
    frames = SomeFrames(run.frames, every=options.every)
    projection = source.projection(run.camera)
    poses, known = _poses(options, [frame.step for frame in run.frames])
    recording = rr.RecordingStream("detect view", recording_id=f"detect-{run.name}")
    failures: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        raw = Path(folder) / "view.rrd"
        if options.output is not None:
            recording.save(str(raw))
        else:
            try:
                recording.spawn()
            except RuntimeError:
                raise DetectError(
                    "Rerun's viewer cannot be started: expected the program `rerun` of the package "
                    "rerun-sdk on the PATH; or write a recording with -o and open it elsewhere"
                ) from None
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        recording.log("world/path", rr.LineStrips3D([poses * [1.0, 1.0, 0.0]]), static=True)
        for name, places in known.items():
            at = rr.Points3D(np.pad(places, ((0, 0), (0, 1))), colors=_MAP)
            recording.log(f"world/map/{name}", at, static=True)
        with progress_bar("frames", frames.expected) as advance:
            for position, frame in zip(count(step=options.every), frames):
                recording.set_time("frame", sequence=position)
                if frame.time_s is not None:
                    kind = "timestamp" if frame.time_s >= _EARLIEST_DATE_S else "duration"
                    recording.set_time("time", **{kind: frame.time_s})
                rows = source.of(frame.step.prefix)
                _log_world(rr, recording, rows, poses[position + 1], projection.settings.radius_m)
                try:
                    image = read_image(frame, run.camera)
                except FrameError as error:
                    failures.append(str(error))
                    recording.log("camera/image", rr.Clear(recursive=False))
                else:
                    picture = draw_rows(image, projection, rows, frame.step.prefix)
                    coloured = np.ascontiguousarray(picture[:, :, ::-1])
                    recording.log("camera/image", rr.Image(coloured).compress(jpeg_quality=85))
                advance()
        try:
            recording.flush()
        except RuntimeError as error:
            raise DetectError(f"{options.output or 'the viewer'}: {error}") from None
        recording.disconnect()
        if options.output is not None:
            write_bytes(options.output, raw.read_bytes(), overwrite=options.force)
            print(f"{options.output}: open it with: rerun {options.output}")
    return report_failures(len(failures), failures)


def _poses(options: View, steps: list[Step]) -> tuple[FloatArray, dict[str, FloatArray]]:
    """The robot's poses, and the positions of the map's landmarks."""
    poses = summed_steps(steps)
    if options.path is not None:
        poses = read_path(options.path).poses
        if len(poses) != len(steps) + 1:
            raise DetectError(
                f"{options.path}: {len(poses)} poses: expected {len(steps) + 1}, the start and one "
                "for each frame of the run"
            )
    if options.map is None:
        return poses, {}
    known = read_map(options.map)
    return poses, {"discs": known.discs.xy, "verticals": known.lines.xy}


def _log_world(rr: Any, recording: Any, rows: ImageRows, pose: FloatArray, radius_m: float) -> None:
    x, y, theta = pose.tolist()
    # As a quaternion: with an axis, Rerun 0.23 needs a newer NumPy than it requires.
    turn = [0.0, 0.0, np.sin(0.5 * theta), np.cos(0.5 * theta)]
    recording.log("world/robot", rr.Transform3D(translation=[x, y, 0.0], quaternion=turn))
    # Forward is -Y.
    arrow = rr.Arrows3D(origins=[[0, 0, 0]], vectors=[[0, -0.5, 0]], colors=_LINE)
    recording.log("world/robot/forward", arrow)
    # Without rows none, instead of those of the frame before.
    discs = () if rows.circles is None else rows.circles.circles
    rings = np.pad(circle_on_floor(circle_arrays(discs).xy, radius_m), ((0, 0), (0, 0), (0, 1)))
    recording.log("world/robot/discs", rr.LineStrips3D(list(rings), colors=_EDGE))
    if rows.tilt is not None:
        recording.log("tilt/pitch_deg", rr.Scalars([float(np.degrees(rows.tilt.pitch))]))
        recording.log("tilt/roll_deg", rr.Scalars([float(np.degrees(rows.tilt.roll))]))
