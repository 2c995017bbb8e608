"""Reads the rows of the run that a command names."""

from __future__ import annotations

import sys

from slam.options import RunFlags
from slam.recording import Recording, read_recording


def recording_of(flags: RunFlags) -> Recording:
    """Read the rows of the run that a command names; assumptions on its odometry are printed."""
    recording = read_recording(
        flags.run,
        circles=flags.circles or not flags.lines,
        lines=flags.lines,
        stem=flags.stem,
        noise=flags.odometry_noise,
    )
    if recording.unstated_steps:
        print(
            f"{recording.unstated_steps} of {len(recording)} steps state no covariance: taken for "
            f"{flags.odometry_noise.sentence()} (--odometry-noise)",
            file=sys.stderr,
        )
    return recording
