"""The command line: ``python -m tools.reenactment prepare LANDMARKS --camera CAM -o WORLD``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from redetect.storage.command_line import exit_code_of

if TYPE_CHECKING:
    from tools.reenactment.prepare import Quality

_HEADINGS = (
    f"{'stage':30}{'chi2':>12}{'unseen':>8}{'rotation x, y, z / rad':>26}{'height / m':>12}"
    f"{'tilt / deg':>13}{'discs':>7}{'<= 4 sigma':>12}{'whole px':>10}{'median / px':>13}"
)


@dataclass(frozen=True)
class Prepare:
    """Fit a recorded run's path, discs, camera mounting and tilt, for rendering it again.

    Prints one row a stage: chi squared under the file's own covariances, rows whose disc is out of
    the camera's sight, rotation and height of the true mounting against the calibrated one, tilt
    (rms), and the share of rows predicted within 4 sigma of the shipped covariance, also after
    rounding to whole pixels.
    """

    landmarks: tyro.conf.Positional[Path]
    """The run's .circles file, with odometry and IDs."""

    camera: Path
    """Its calibration (.cam), by which the rows were put on the floor."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The .npz to write: poses, prefixes, tilt, disc_ids, disc_xy, robot_from_camera."""

    path: Path | None = None
    """Where to begin: the path as rows x, y, theta, first the start (0, 0, 0). Needs --map."""

    map: Path | None = None
    """Where to begin: the discs as rows ID, x, y. Needs --path. Without both, odometry will do."""

    force: bool = False
    """Overwrite the output."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; errors are one line on stderr and exit code 1."""
    command = tyro.extras.subcommand_cli_from_dict(
        {"prepare": Prepare}, prog="python -m tools.reenactment", args=arguments
    )
    return exit_code_of(lambda: prepare(command))


def prepare(command: Prepare) -> int:
    """Read a run, fit its world and write it; the table goes to stdout as it grows."""
    from camera import read_camera
    from redetect.landmarks import read_frames
    from redetect.storage import OutputExistsError
    from tools.reenactment.prepare import stages, world_of_stage
    from tools.reenactment.recording import (
        RecordingError,
        read_map,
        read_path,
        recording_of_frames,
    )
    from tools.reenactment.world import write_world

    if command.output.exists() and not command.force:
        raise OutputExistsError(command.output)
    camera = read_camera(command.camera)
    recording = recording_of_frames(camera, read_frames(command.landmarks))
    start = None
    if command.path is not None and command.map is not None:
        poses = read_path(command.path, len(recording.steps))
        start = poses, read_map(command.map, recording.disc_ids)
    elif command.path is not None or command.map is not None:
        raise RecordingError("--path and --map belong together: expected both or neither")

    print(f"{len(recording.steps)} steps, {len(recording.frame)} rows with an ID")
    print(_HEADINGS)
    for stage in stages(camera, recording, start):
        print(_table_row(stage.quality), flush=True)
    write_world(command.output, world_of_stage(stage), overwrite=command.force)
    print(f"written to {command.output}")
    return 0


def _table_row(quality: Quality) -> str:
    rotation = ", ".join(f"{angle:z.4f}" for angle in quality.rotation)
    tilt = ", ".join(f"{angle:.3f}" for angle in quality.tilt_deg)
    return (
        f"{quality.label:30}{quality.chi_squared:12.2f}{quality.out_of_sight:8d}{rotation:>26}"
        f"{quality.height:z12.4f}{tilt:>13}{quality.discs:7d}{quality.share:12.4f}"
        f"{quality.share_whole_pixel:10.4f}{quality.median_px:13.3f}"
    )
