"""``camera level``: how a camera is mounted, by a drive with it.

The command is one of the program `camera`; it is carried out here, for it detects.
"""

from __future__ import annotations

import math

import numpy as np

from camera import write_camera
from camera.options import Level
from detect.circles import detect_circles, disc_shape
from detect.discs.outline_tilt import tilt_of_outlines
from detect.errors import DetectError, FrameError
from detect.lines import detect_lines
from detect.mounting import HEIGHT_STEPS, mounting_of_run, remounted
from detect.run import read_image
from detect.run_tilt import LEAST_FRAMES, FrameTilts
from detect.runs.progress import progress_bar
from detect.settings import CircleSettings
from detect.sources.opening import open_calibrated
from lut import cached_disc_table, cached_vertical_table
from storage import OutputExistsError


def perform(options: Level) -> int:
    """Carry the command out; returns the exit code."""
    if options.output.exists() and not options.force:
        raise OutputExistsError(options.output)
    run = open_calibrated(options.run, options.camera)
    camera, height_m = run.camera, float(run.camera.centre[2])
    settings = CircleSettings(radius_m=options.radius_m)
    table, verticals = (
        cached_disc_table(camera, disc_shape(settings)),
        cached_vertical_table(camera),
    )
    tilts, variances, pitches = [], [], []
    with progress_bar("verticals and outlines", run.frames.expected) as advance:
        for frame in run.frames:
            advance()
            try:
                image = read_image(frame, camera)
            except FrameError:
                continue
            tilt = detect_lines(image, verticals).tilt
            found = (math.nan,) * 4
            if tilt is not None:
                found = (tilt.pitch_rad, tilt.roll_rad, *np.diag(tilt.covariance).tolist())
            tilts.append(found[:2])
            variances.append(found[2:])
            discs = detect_circles(image, camera, table, settings).floor_xy
            outlines = [
                tilt_of_outlines(image, camera, discs, options.radius_m, share * height_m)
                for share in HEIGHT_STEPS
            ]
            pitches.append([math.nan if one is None else one.pitch for one in outlines])
    mounting = mounting_of_run(
        height_m,
        FrameTilts(np.reshape(tilts, (-1, 2)), np.reshape(variances, (-1, 2))),
        np.reshape(pitches, (-1, len(HEIGHT_STEPS))),
    )
    if mounting is None:
        raise DetectError(
            f"{options.run}: too few frames whose verticals tell a tilt: expected {LEAST_FRAMES}; "
            "drive through rooms with doors, shelves or walls in view"
        )
    print("\n".join(mounting.sentences()))
    write_camera(remounted(camera, mounting), options.output, overwrite=options.force)
    print(f"written: {options.output}")
    return 0
