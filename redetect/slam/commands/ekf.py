"""The command ``slam ekf``."""

from __future__ import annotations

from pathlib import Path

from redetect import slam
from redetect.landmarks.map_file import (
    covariance_file,
    read_map,
    write_joint_covariance,
    write_map,
)
from redetect.slam.commands.files import (
    MAP_NAME,
    FilterResults,
    filter_output,
    filtered,
    read_run_of,
    write_filtered,
)
from redetect.slam.errors import SlamError
from redetect.slam.filters.ekf_slam import EkfSlam, run_ekf
from redetect.slam.filters.frames import Associator
from redetect.slam.filters.report import map_distance
from redetect.slam.options import Ekf
from redetect.storage.bounds import FINITE, demand


def perform(command: Ekf) -> int:
    """Map a run and localise in it at once; returns the exit code."""
    demand(command, SlamError, start=FINITE)
    associator = Associator(command.association, command.gate_probability)
    recording, camera_xy = read_run_of(command)
    output = filter_output(command, "ekf", (MAP_NAME, covariance_file(Path(MAP_NAME)).name))
    ekf = EkfSlam(command.start, camera_xy=camera_xy, jacobians=command.jacobians)
    run, time_line = filtered(lambda: run_ekf(recording, ekf, associator))
    landmark_map = ekf.landmark_map()
    discs, lines = len(landmark_map.discs), len(landmark_map.lines)
    if not discs and not lines:
        raise SlamError(
            f"{command.run}: no landmark in the map: expected rows with identifiers, or "
            "--association joint"
        )
    figures: dict[str, object] = {"landmarks": {"discs": discs, "lines": lines}}
    said = [f"landmarks         {discs} discs, {lines} lines"]
    if command.reference_map:
        off = map_distance(landmark_map, read_map(command.reference_map))
        figures["distance_from_reference_map"] = off
        said.append(
            "from reference    landmarks rms {rms_m:.3f} m, median {median_m:.3f}, max "
            "{max_m:.3f}; squared, over their covariance and 2: {normalised:.2f}".format(**off)
        )
    title = f"{command.run.name}: EKF-SLAM, poses as they were at the time, map at the end"
    results = FilterResults(
        "ekf", run, landmark_map, str(command.run), title, figures, [*said, time_line]
    )
    write_filtered(command, output, results)
    head = [f"slam ekf {slam.__version__}: {command.run}"]
    write_map(output / MAP_NAME, landmark_map, head, overwrite=command.force)
    write_joint_covariance(output / MAP_NAME, ekf.map_covariance(), overwrite=command.force)
    return 0
