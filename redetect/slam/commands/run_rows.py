"""Reads the rows of the run that a command names."""

from __future__ import annotations

import sys

from redetect.slam.models.odometry_noise import OdometryNoise
from redetect.slam.options import RunFlags
from redetect.slam.recording import Recording, read_recording


def recording_of(flags: RunFlags) -> Recording:
    """Read the rows of the run that a command names; assumptions on its odometry are printed."""
    recording = read_recording(
        flags.run,
        circles=flags.circles or not flags.lines,
        lines=flags.lines,
        stem=flags.stem,
        noise=flags.odometry_noise,
    )
    print_assumed(recording.unstated_steps, len(recording), flags.odometry_noise)
    return recording


def print_assumed(unstated: int, total: int, noise: OdometryNoise) -> None:
    """Print the noise that was assumed of the steps that state none, if there are any."""
    if unstated:
        print(
            f"{unstated} of {total} steps state no covariance: taken for {noise.sentence()} "
            "(--odometry-noise)",
            file=sys.stderr,
        )
