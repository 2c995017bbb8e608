"""Files of the commands: runs and outputs."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np

from redetect.array_types import FloatArray
from redetect.json_text import json_text
from redetect.slam.options import RunFlags
from redetect.slam.recording import Recording, read_runs
from redetect.storage import write_bytes

MAP_PICTURE = "map.png"


def recordings_of(flags: RunFlags) -> list[Recording]:
    """`read_runs`, and print the assumptions about their odometry."""
    recordings = read_runs(flags)
    for recording in recordings:
        if recording.unstated_steps:
            print(
                f"{recording.unstated_steps} of {len(recording)} steps have no covariance: assumed "
                f"{flags.odometry_noise.sentence()} (--odometry-noise)",
                file=sys.stderr,
            )
        length, reach = lengths_of(recording)
        if len(reach) and length > 2.0 * np.max(reach):
            print(
                f"the steps are {length:.3g} m long (median), and no disc is farther than "
                f"{np.max(reach):.3g} m: is the odometry in metres?",
                file=sys.stderr,
            )
    return recordings


def lengths_of(recording: Recording) -> tuple[float, FloatArray]:
    """Median length of a run's steps, and the distances of its rows of discs (n,) (m)."""
    length = np.hypot(recording.steps[:, 0], recording.steps[:, 1])
    return float(np.median(length)), np.hypot(*recording.circles.xy.T)


def recording_of(flags: RunFlags) -> Recording:
    """`recordings_of` the one run that a command names."""
    (recording,) = recordings_of(flags)
    return recording


def default_output(run: Path, name: str = "") -> Path:
    """Folder for a command's results: `slam/<name>` beside the run's landmarks."""
    return (run if run.is_dir() else run.parent) / "slam" / name


def flags_of(command: object, but: tuple[str, ...] = ()) -> dict[str, Any]:
    """A command's flags for a JSON file."""
    flags: dict[str, Any] = asdict(cast(Any, command))
    return {name: value for name, value in flags.items() if name not in but}


def write_json(path: Path, content: dict[str, Any], *, overwrite: bool) -> None:
    """Write a summary."""
    write_bytes(path, f"{json_text(content)}\n".encode(), overwrite=overwrite)
