"""The command ``slam localize``."""

from __future__ import annotations

import time

import numpy as np

from landmarks.map_file import read_map, write_path
from slam.errors import SlamError
from slam.filter_association import Associator
from slam.filter_input import default_output, read_reference, read_run
from slam.filter_report import demand_free, path_distance, summary, table, write_json
from slam.localize import Localizer, MapErrors, run_localizer
from slam.map_covariance import covariance_file, read_joint_covariance
from slam.options import Localize
from slam.pictures import draw_errors, draw_map

PATH_NAME, JSON_NAME, MAP_PICTURE, ERROR_PICTURE = (
    "path.csv",
    "localize.json",
    "map.png",
    "errors.png",
)


def perform(command: Localize) -> int:
    """Localise in a run; returns the exit code."""
    import slam

    output = command.output or default_output(command.run, "localize")
    names = (PATH_NAME, JSON_NAME, MAP_PICTURE, *([ERROR_PICTURE] if command.reference else []))
    associator = Associator(command.association, command.gate_probability)
    if (
        not np.all(np.isfinite([*command.start, *command.start_sigma]))
        or min(command.start_sigma) < 0.0
    ):
        raise SlamError(
            f"start {command.start}, sigma {command.start_sigma}: expected finite numbers, "
            "standard deviations not below 0"
        )
    landmark_map = read_map(command.map)
    map_errors = _map_errors(command)
    considered = map_errors == "considered"
    joint = read_joint_covariance(command.map, landmark_map) if considered else None
    recording, camera_xy = read_run(
        command.run,
        circles=command.circles,
        lines=command.lines,
        stem=command.stem,
        camera=command.camera,
    )
    demand_free(output, names, overwrite=command.force)
    localizer = Localizer(
        landmark_map,
        command.start,
        np.diag(np.square(command.start_sigma)),
        camera_xy,
        map_errors=map_errors,
        joint_covariance=joint,
    )
    began, began_working = time.perf_counter(), time.thread_time()
    run = run_localizer(recording, localizer, associator)
    seconds, working = time.perf_counter() - began, time.thread_time() - began_working
    if not run.count.discs and not run.count.lines:
        raise SlamError(
            f"{command.run}: no row shows a landmark of {command.map}: expected identifiers of the "
            "same run, or --association joint"
        )
    reference = read_reference(command.reference, run.path) if command.reference else None
    distance = path_distance(run.path, reference.poses) if reference else None
    write_path(
        output / PATH_NAME,
        run.path,
        [f"slam localize {slam.__version__}: {command.run} in {command.map}"],
        overwrite=command.force,
    )
    content = summary(run, command, distance)
    content["map_errors"] = map_errors if joint is None else f"{map_errors}, jointly"
    write_json(output / JSON_NAME, content, overwrite=command.force)
    print("\n".join(table(run, distance)))
    if considered and joint is None:
        print(f"errors of the map taken as independent: no {covariance_file(command.map).name}")
    print(
        f"time              {seconds:.2f} s, {len(recording) / seconds:.0f} steps/s; of processor "
        f"{working:.2f} s, {len(recording) / working:.0f} steps/s"
    )
    draw_map(
        output / MAP_PICTURE,
        landmark_map,
        run.path,
        reference=reference,
        title=f"{command.run.name}: localised",
        overwrite=command.force,
        interactive=command.interactive,
    )
    if reference is not None:
        draw_errors(
            output / ERROR_PICTURE,
            run.path,
            reference.poses,
            title=f"{command.run.name}: localised",
            overwrite=command.force,
            interactive=command.interactive,
        )
    return 0


def _map_errors(command: Localize) -> MapErrors:
    """How the map's errors are treated, where that is not said."""
    if command.map_errors != "auto":
        return command.map_errors
    # Considering them makes the filter slow to pull itself back onto the map, which costs little
    # as long as the pairs are right, and the track if they are to be found.
    return "considered" if command.association == "known" else "ignored"
