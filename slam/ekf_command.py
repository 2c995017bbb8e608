"""The command ``slam ekf``."""

from __future__ import annotations

import time
from pathlib import Path

from landmarks.map_file import read_map, write_map, write_path
from slam.ekf import EkfSlam, run_ekf
from slam.errors import SlamError
from slam.filter_association import Associator
from slam.filter_input import default_output, read_reference, read_run
from slam.filter_report import demand_free, map_distance, path_distance, summary, table, write_json
from slam.map_covariance import covariance_file, write_joint_covariance
from slam.options import Ekf
from slam.pictures import draw_errors, draw_map

PATH_NAME, MAP_NAME, JSON_NAME, MAP_PICTURE, ERROR_PICTURE = (
    "path.csv",
    "map.csv",
    "ekf.json",
    "map.png",
    "errors.png",
)


def perform(command: Ekf) -> int:
    """Map a run and localise in it at once; returns the exit code."""
    import slam

    output = command.output or default_output(command.run, "ekf")
    names = (
        *(PATH_NAME, MAP_NAME, covariance_file(Path(MAP_NAME)).name, JSON_NAME, MAP_PICTURE),
        *([ERROR_PICTURE] if command.reference else []),
    )
    associator = Associator(command.association, command.gate_probability)
    recording, camera_xy = read_run(
        command.run,
        circles=command.circles,
        lines=command.lines,
        stem=command.stem,
        camera=command.camera,
    )
    demand_free(output, names, overwrite=command.force)
    ekf = EkfSlam(camera_xy=camera_xy, jacobians=command.jacobians)
    began, began_working = time.perf_counter(), time.thread_time()
    run = run_ekf(recording, ekf, associator)
    seconds, working = time.perf_counter() - began, time.thread_time() - began_working
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
    write_path(output / PATH_NAME, run.path, comments, overwrite=command.force)
    write_map(output / MAP_NAME, landmark_map, comments, overwrite=command.force)
    write_joint_covariance(output / MAP_NAME, ekf.map_covariance(), overwrite=command.force)
    content = summary(run, command, distance)
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
    print(
        f"time              {seconds:.2f} s, {len(recording) / seconds:.0f} steps/s; of processor "
        f"{working:.2f} s, {len(recording) / working:.0f} steps/s"
    )
    title = f"{command.run.name}: EKF-SLAM, poses as they were at the time, map at the end"
    draw_map(
        output / MAP_PICTURE,
        landmark_map,
        run.path,
        reference=reference,
        title=title,
        overwrite=command.force,
        interactive=command.interactive,
    )
    if reference is not None:
        draw_errors(
            output / ERROR_PICTURE,
            run.path,
            reference.poses,
            title=title,
            overwrite=command.force,
            interactive=command.interactive,
        )
    return 0
