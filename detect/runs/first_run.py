"""What later stages of the detection of discs do where there are none: for their kernels.

A process that has to compile the kernels meets them in the order of a frame's path. Others call
these functions at the same time, and keep on the disk what it would compile last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from detect.circles import candidates_at, scene_of, second_looks_at
from detect.discs.fit import working_space
from detect.discs.outline_tilt import tilt_of_outlines
from detect.discs.placing import place_all
from detect.discs.quality import NO_CENTRES
from detect.discs.search import candidates_of, place_found
from detect.discs.second_look import NO_LOOKS
from detect.run_tilt import smooth_axis
from detect.runs.frame import tables_of
from detect.runs.plan import FramePlan, FrameTask
from detect.sources.interface import read_image


def look_again(plan: FramePlan, tasks: Sequence[FrameTask]) -> None:
    """The second look at the first frame, and the tilt by outlines."""
    camera, settings, table = plan.camera, plan.circles, tables_of(plan).discs
    if camera and table and settings and settings.verify and settings.refine:
        if settings.polarity == "any":
            settings = replace(settings, polarity="light")
        image = read_image(tasks[0].frame, camera, plan.working_folder)
        candidates = candidates_at(image, camera, table, settings, noise=0.0)
        second_looks_at(image, camera, settings, candidates, np.empty((0, 2)), noise=0.0)
        if plan.levelling == "run":
            tilt_of_outlines(image, camera, candidates.floor_xy, settings.radius_m)
            smooth_axis(np.zeros(1), np.ones(1), spread=1.0, memory=0.0)


def place_discs(plan: FramePlan, tasks: Sequence[FrameTask]) -> None:
    """The placing of the discs of both looks."""
    camera, settings, table = plan.camera, plan.circles, tables_of(plan).discs
    if camera and table and settings and settings.verify and settings.refine:
        image = read_image(tasks[0].frame, camera, plan.working_folder)
        scene = scene_of(image, camera, table, settings, noise=0.0)
        fits, space = candidates_of(scene, NO_CENTRES, weakest=0.0), working_space()
        place_found(scene, settings.radius_m, fits, space[0])
        place_all(scene, settings.radius_m, NO_LOOKS, space)
