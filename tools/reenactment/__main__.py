"""``python -m tools.reenactment prepare LANDMARKS --camera CAM -o WORLD``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from tyro.conf import Positional, arg

from camera import read_camera
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import graph_of_recording
from redetect.slam.mounting import check_rows_fit_camera
from redetect.slam.recording import read_recording
from redetect.storage import OutputExistsError
from redetect.storage.command_line import exit_code_of
from tools.evaluation.tables import Table
from tools.reenactment.prepare import assess, stages
from tools.reenactment.world import World, write_world


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
    force: bool = False  # Overwrite the output.

    def __call__(self) -> int:
        if self.output.exists() and not self.force:
            raise OutputExistsError(self.output)
        camera = read_camera(self.camera)
        recording = read_recording(self.landmarks)
        graph = graph_of_recording(recording, camera)
        if not len(graph.disc_ids):
            raise SlamError(f"{self.landmarks}: no disc with an ID: expected LANDMARK_C rows")
        check_rows_fit_camera(camera, graph.disc_xy)
        print(f"{len(graph.steps)} steps, {len(graph.disc_pose)} rows with an ID")
        table = Table(
            {"stage": "<32", "chi2": ".2f", "unseen": "d", "rotation x, y, z / rad": "<24",
             "height / m": "z.4f", "tilt / deg": "<12", "discs": "d", "<= 4 sigma": ".4f",
             "whole px": ".4f", "median / px": ".3f"}
        )  # fmt: skip
        for label, mended, found in stages(graph):
            q = assess(mended, found)
            table.row(
                label, q.chi_squared, q.out_of_sight,
                ", ".join(f"{a:z.4f}" for a in q.mounting[:3]), q.mounting[3],
                ", ".join(f"{a:.3f}" for a in q.tilt_deg), len(found.disc_xy), q.share,
                q.share_whole_pixel, q.median_px,
            )  # fmt: skip
        assert found.tilt is not None
        assert found.mounting is not None
        world = World(
            np.array(recording.prefixes), found.poses[1:], found.tilt[1:], mended.disc_ids,
            found.disc_xy, found.mounting,
        )  # fmt: skip
        write_world(self.output, world, overwrite=self.force)
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
