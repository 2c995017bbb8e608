"""``camera level``: a camera's mounting from a run: its constant lean, and its height.

The command is one of the program `camera`; it is implemented here because it needs detection.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from camera import Camera, write_camera
from camera.options import Level
from detect.discs.outline_tilt import tilt_of_outlines
from detect.errors import DetectError
from detect.line_settings import LineSettings
from detect.run_mounting import HEIGHT_STEPS, Mounting, mounting_of_run, remounted
from detect.run_tilt import camera_pitch_weights, frame_tilts
from detect.runs.frame import detect_batch
from detect.runs.plan import FramePlan, FrameTask
from detect.settings import LEAST_FRAMES, CircleSettings
from detect.sources.interface import Run
from detect.sources.opening import open_run
from detect.terminal import progress_bar, report_failures
from redetect.storage import demand_place

_STILL_SEEN = 0.9  #: Share of frames with discs that still has some at the estimated height.
_MOST_SIGMAS = 3.0  #: Largest deviation of the height that is estimated from there, sigmas.


def perform(options: Level) -> int:
    """Execute the command; returns the exit code."""
    demand_place(options.output, overwrite=options.force)
    run = open_run(options.run, options.camera)
    mounting, failures = _mounting(run, run.camera, options.radius_m)
    if abs(mounting.raised_m) > HEIGHT_STEPS[-1] * run.camera.centre[2]:
        # Far from the right height, only things of another size are taken for discs.
        again, _ = _mounting(run, remounted(run.camera, mounting), options.radius_m)
        near = abs(again.raised_m) < _MOST_SIGMAS * again.raised_sigma_m
        if not near or again.frames_with_discs < _STILL_SEEN * mounting.frames_with_discs:
            mounting = replace(mounting, raised_m=math.nan, raised_sigma_m=math.nan)
    print("\n".join(mounting.sentences()))
    write_camera(remounted(run.camera, mounting), options.output, overwrite=options.force)
    print(f"written: {options.output}")
    return report_failures(len(failures), failures)


def _mounting(run: Run, camera: Camera, radius_m: float) -> tuple[Mounting, list[str]]:
    """The mounting of a run's camera, compared with the given one, and why frames failed."""
    height_m = float(camera.centre[2])
    plan = FramePlan(camera, LineSettings(), CircleSettings(radius_m=radius_m), levelling="frame")
    tilts, relative_pitch_rad, failures = [], [], list[str]()
    pitch_weights = camera_pitch_weights(camera)
    with progress_bar("verticals and outlines", run.frames.expected) as advance:
        for frame in run.frames:
            advance()
            (found,) = detect_batch([FrameTask(frame)], plan)
            if found.error is not None or found.unlevelled is None or found.image is None:
                failures.append(str(found.error))
                continue
            of_image = found.image, camera, found.unlevelled.floor_xy, radius_m
            outlines = [tilt_of_outlines(*of_image, share * height_m) for share in HEIGHT_STEPS]
            tilts.append(found.tilt)
            level = [frame_tilts([one]).tilt[0] for one in (found.tilt, *outlines)]
            relative_pitch_rad.append(np.dot(np.subtract(level[1:], level[0]), pitch_weights))
    if not tilts:
        report_failures(len(failures), failures)
        raise DetectError(f"{run.folder}: none of its images could be processed")
    mounting = mounting_of_run(height_m, frame_tilts(tilts), np.array(relative_pitch_rad))
    if mounting is None:
        raise DetectError(
            f"{run.folder}: too few frames with a tilt from verticals: expected {LEAST_FRAMES}; "
            "drive where doors, shelves or walls are visible"
        )
    return mounting, failures
