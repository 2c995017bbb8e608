"""``camera level``: estimates how a camera is mounted from a run.

The command is one of the program `camera`; it is implemented here because it needs detection.
"""

from __future__ import annotations

import math
import sys

import numpy as np

from camera import write_camera
from camera.options import Level
from detect.discs.outline_tilt import tilt_of_outlines
from detect.errors import DetectError
from detect.line_settings import LineSettings
from detect.mounting import HEIGHT_STEPS, mounting_of_run, remounted
from detect.run_tilt import LEAST_FRAMES, frame_tilts
from detect.runs.frame import detect_batch
from detect.runs.plan import FramePlan, FrameTask
from detect.runs.progress import progress_bar
from detect.settings import CircleSettings
from detect.sources.opening import open_calibrated
from storage import OutputExistsError


def perform(options: Level) -> int:
    """Carry the command out; returns the exit code."""
    if options.output.exists() and not options.force:
        raise OutputExistsError(options.output)
    run = open_calibrated(options.run, options.camera)
    camera, height_m = run.camera, float(run.camera.centre[2])
    plan = FramePlan(
        camera, LineSettings(), CircleSettings(radius_m=options.radius_m), levelling="none"
    )
    tilts, pitches = [], []
    with progress_bar("verticals and outlines", run.frames.expected) as advance:
        for frame in run.frames:
            advance()
            (found,) = detect_batch([FrameTask(frame)], plan)
            if found.error is not None or found.seen is None:
                print(f"left out: {found.error}", file=sys.stderr)
                continue
            outlines = [
                tilt_of_outlines(
                    found.pixels, camera, found.seen.floor_xy, options.radius_m, share * height_m
                )
                for share in HEIGHT_STEPS
            ]
            tilts.append(found.tilt)
            pitches.append([math.nan if one is None else one.pitch for one in outlines])
    mounting = mounting_of_run(
        height_m, frame_tilts(tilts), np.reshape(pitches, (-1, len(HEIGHT_STEPS)))
    )
    if mounting is None:
        raise DetectError(
            f"{options.run}: too few frames with a tilt from verticals: expected {LEAST_FRAMES}; "
            "drive where doors, shelves or walls are in view"
        )
    print("\n".join(mounting.sentences()))
    write_camera(remounted(camera, mounting), options.output, overwrite=options.force)
    print(f"written: {options.output}")
    return 0
