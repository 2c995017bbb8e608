"""``python -m tools.reenactment prepare LANDMARKS --camera CAM -o WORLD``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from camera import read_camera
from redetect.landmarks import read_frames
from redetect.storage import OutputExistsError
from redetect.storage.command_line import exit_code_of
from tools.evaluation.tables import Table
from tools.reenactment.prepare import stages, world_of_stage
from tools.reenactment.recording import RecordingError, read_map, read_path, recording_of_frames
from tools.reenactment.world import write_world


@dataclass(frozen=True)
class Prepare:
    """Fit a recorded run's path, discs, camera mounting and tilt, for rendering it again.

    Prints one row a stage: chi squared under the file's own covariances, rows whose disc is out of
    the camera's sight, rotation and height of the true mounting against the calibrated one, tilt
    (rms), and the share of rows predicted within 4 sigma of the shipped covariance, also after
    rounding to whole pixels.
    """

    landmarks: Positional[Path]  # The run's .circles file, with odometry and IDs.
    camera: Path  # Its calibration (.cam), by which the rows were put on the floor.
    output: Annotated[Path, arg(aliases=["-o"])]
    """The .npz to write: poses, prefixes, tilt, disc_ids, disc_xy, robot_from_camera."""
    path: Path | None = None
    """Where to begin: the path as rows x, y, theta, first the start (0, 0, 0). Needs --map."""
    map: Path | None = None
    """Where to begin: the discs as rows ID, x, y. Needs --path. Without both, odometry will do."""
    force: bool = False  # Overwrite the output.

    def __call__(self) -> int:
        if self.output.exists() and not self.force:
            raise OutputExistsError(self.output)
        camera = read_camera(self.camera)
        recording = recording_of_frames(camera, read_frames(self.landmarks))
        start = None
        if self.path is not None and self.map is not None:
            poses = read_path(self.path, len(recording.steps))
            start = poses, read_map(self.map, recording.disc_ids)
        elif self.path is not None or self.map is not None:
            raise RecordingError("--path and --map belong together: expected both or neither")
        print(f"{len(recording.steps)} steps, {len(recording.frame)} rows with an ID")
        table = Table(
            {"stage": "<28", "chi2": ".2f", "unseen": "d", "rotation x, y, z / rad": "<24",
             "height / m": "z.4f", "tilt / deg": "<12", "discs": "d", "<= 4 sigma": ".4f",
             "whole px": ".4f", "median / px": ".3f"}
        )  # fmt: skip
        for stage in stages(camera, recording, start):
            q = stage.quality
            table.row(
                q.label, q.chi_squared, q.out_of_sight, ", ".join(f"{a:z.4f}" for a in q.rotation),
                q.height, ", ".join(f"{a:.3f}" for a in q.tilt_deg), q.discs, q.share,
                q.share_whole_pixel, q.median_px,
            )  # fmt: skip
        write_world(self.output, world_of_stage(stage), overwrite=self.force)
        print(f"written to {self.output}")
        return 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; errors are one line on stderr and exit code 1."""
    command = tyro.extras.subcommand_cli_from_dict(
        {"prepare": Prepare}, prog="python -m tools.reenactment", args=arguments
    )
    return exit_code_of(command)


if __name__ == "__main__":
    sys.exit(main())
