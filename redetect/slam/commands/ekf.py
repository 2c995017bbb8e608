"""The command ``slam ekf``."""

from __future__ import annotations

from pathlib import Path

from redetect import slam
from redetect.landmarks.map_file import (
    covariance_file,
    read_map,
    write_joint_covariance,
    write_map,
    write_path,
)
from redetect.slam.commands.files import (
    ERROR_PICTURE,
    MAP_PICTURE,
    PATH_NAME,
    default_output,
    demand_free,
    draw_results,
    flags_of,
    read_reference,
    read_run_of,
    timed,
    write_json,
)
from redetect.slam.errors import SlamError
from redetect.slam.filters.ekf_slam import EkfSlam, run_ekf
from redetect.slam.filters.frames import Associator
from redetect.slam.filters.report import map_distance, path_distance, summary, table
from redetect.slam.options import Ekf
from redetect.storage.bounds import FINITE, demand

MAP_NAME, JSON_NAME = "map.csv", "ekf.json"


def perform(command: Ekf) -> int:
    """Map a run and localise in it at once; returns the exit code."""
    output = command.output or default_output(command.run, "ekf")
    names = (
        *(PATH_NAME, MAP_NAME, covariance_file(Path(MAP_NAME)).name, JSON_NAME, MAP_PICTURE),
        *([ERROR_PICTURE] if command.reference else []),
    )
    demand(command, SlamError, start=FINITE)
    associator = Associator(command.association, command.gate_probability)
    recording, camera_xy = read_run_of(command)
    demand_free([output / name for name in names], overwrite=command.force)
    ekf = EkfSlam(command.start, camera_xy=camera_xy, jacobians=command.jacobians)
    run, time_line = timed(lambda: run_ekf(recording, ekf, associator))
    landmark_map = ekf.landmark_map()
    if not len(landmark_map.discs) and not len(landmark_map.lines):
        raise SlamError(
            f"{command.run}: no landmark in the map: expected rows with identifiers, or "
            "--association joint"
        )
    reference = read_reference(command.reference, run.path) if command.reference else None
    distance = path_distance(run.path, reference.poses) if reference else None
    from_map = (
        map_distance(landmark_map, read_map(command.reference_map))
        if command.reference_map
        else None
    )
    comments = [f"slam ekf {slam.__version__}: {command.run}"]
    output.mkdir(parents=True, exist_ok=True)
    write_path(output / PATH_NAME, run.path, comments, overwrite=command.force)
    write_map(output / MAP_NAME, landmark_map, comments, overwrite=command.force)
    write_joint_covariance(output / MAP_NAME, ekf.map_covariance(), overwrite=command.force)
    content = summary(run, flags_of(command), distance)
    content["landmarks"] = {"discs": len(landmark_map.discs), "lines": len(landmark_map.lines)}
    if from_map is not None:
        content["distance_from_reference_map"] = from_map
    write_json(output / JSON_NAME, content, overwrite=command.force)
    print("\n".join(table(run, distance)))
    print(f"landmarks         {len(landmark_map.discs)} discs, {len(landmark_map.lines)} lines")
    if from_map is not None:
        print(
            "from reference    landmarks rms {rms_m:.3f} m, median {median_m:.3f}, max "
            "{max_m:.3f}; squared, over their covariance and 2: {normalised:.2f}".format(**from_map)
        )
    print(time_line)
    title = f"{command.run.name}: EKF-SLAM, poses as they were at the time, map at the end"
    draw_results(output, landmark_map, run.path, reference, title, command)
    return 0
