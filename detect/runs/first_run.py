"""Runs later stages of the detection on empty input, so that their kernels are compiled.

A process compiles kernels in the order of a frame's path. Another process calls this function at
the same time, and stores in the disk cache what the first one would have to compile later.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from detect.circles import scene_of, vote_shape
from detect.discs.fit import working_space
from detect.discs.judgement import NO_CANDIDATES
from detect.discs.outline_tilt import tilt_of_outlines
from detect.discs.placing import place_discs
from detect.run_tilt import smooth_axis
from detect.runs.plan import FramePlan, FrameTask
from detect.sources.interface import read_image
from lut import cached_vote_table


def place_and_level_none(plan: FramePlan, tasks: Sequence[FrameTask]) -> None:
    """Locate zero discs in the first frame; estimate the tilt from their outlines, and of a run."""
    camera, settings = plan.camera, plan.circles
    if not (camera and settings and settings.refine):
        return
    image = read_image(tasks[0].frame, camera, plan.working_folder)
    table = cached_vote_table(camera, vote_shape(settings))
    scene = scene_of(image, camera, table, settings)
    place_discs(scene, NO_CANDIDATES, working_space()[0])
    if plan.levelling == "run":
        tilt_of_outlines(image, camera, np.array([[0.0, -1.0]]), settings.radius_m)
        smooth_axis(np.zeros(1), np.ones(1), spread=1.0, memory=0.0)
