"""``python -m tools.reenactment prepare LANDMARKS --camera CAM -o WORLD``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from tyro.conf import Positional, arg

from camera import Camera, read_camera
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import Estimate, Graph, graph_of_recording
from redetect.slam.models.mounting import check_rows_fit_camera
from redetect.slam.recording import read_recording
from redetect.storage import OutputExistsError
from redetect.storage.command_line import exit_code_of
from tools.arrays import FloatArray
from tools.evaluation.tables import Table
from tools.reenactment.prepare import assess, nominal, stages
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
    path: Path | None = None
    """Where to begin: the path as rows x, y, theta, first the start (0, 0, 0). Needs --map."""
    map: Path | None = None
    """Where to begin: the discs as rows ID, x, y. Needs --path. Without both, odometry will do."""
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
        start = None
        if self.path is not None and self.map is not None:
            start = read_start(self.path, self.map, camera, graph)
        elif self.path is not None or self.map is not None:
            raise SlamError("--path and --map belong together: expected both or neither")
        print(f"{len(graph.steps)} steps, {len(graph.disc_pose)} rows with an ID")
        table = Table(
            {"stage": "<28", "chi2": ".2f", "unseen": "d", "rotation x, y, z / rad": "<24",
             "height / m": "z.4f", "tilt / deg": "<12", "discs": "d", "<= 4 sigma": ".4f",
             "whole px": ".4f", "median / px": ".3f"}
        )  # fmt: skip
        for label, mended, found in stages(graph, start):
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


def read_start(path: Path, disc_map: Path, camera: Camera, graph: Graph) -> Estimate:
    """Read where to begin: a path and a map, which fit the recording."""
    poses, discs = _read_table(path), _read_table(disc_map)
    count = len(graph.steps) + 1
    if len(poses) != count or np.any(poses[0] != 0.0):
        raise SlamError(f"{path}: {len(poses)} poses: expected {count}, the first 0, 0, 0")
    place = {int(number): (x, y) for number, x, y in discs}
    if missing := [number for number in graph.disc_ids.tolist() if number not in place]:
        raise SlamError(f"{disc_map}: no disc with ID {missing[0]}, which the landmark file names")
    return nominal(camera, poses, np.array([place[number] for number in graph.disc_ids.tolist()]))


def _read_table(path: Path) -> FloatArray:
    try:
        table = np.loadtxt(path, delimiter=",", ndmin=2)
    except ValueError as error:
        raise SlamError(f"{path}: {error}: expected 3 numbers a row, between commas") from None
    if table.shape[1] != 3 or not np.isfinite(table).all():
        raise SlamError(f"{path}: expected 3 numbers a row, between commas")
    return table


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; errors are one line on stderr and exit code 1."""
    command = tyro.extras.subcommand_cli_from_dict(
        {"prepare": Prepare}, prog="python -m tools.reenactment", args=arguments
    )
    return exit_code_of(command)


if __name__ == "__main__":
    sys.exit(main())
