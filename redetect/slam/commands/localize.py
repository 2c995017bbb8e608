"""The command ``slam localize``."""

from __future__ import annotations

import numpy as np

from redetect import slam
from redetect.array_types import FloatArray
from redetect.landmarks.map_file import (
    LandmarkMap,
    covariance_file,
    read_joint_covariance,
    read_map,
    write_path,
)
from redetect.slam.association.waking import wake_up
from redetect.slam.commands.files import (
    ERROR_PICTURE,
    MAP_PICTURE,
    PATH_NAME,
    camera_xy_of,
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
from redetect.slam.filters.frames import Associator, FilterRun, run_filter
from redetect.slam.filters.localizer import Localizer, MapErrors
from redetect.slam.filters.report import path_distance, summary, table
from redetect.slam.options import Localize
from redetect.slam.recording import Recording
from redetect.storage.bounds import FINITE, NOT_NEGATIVE, demand

JSON_NAME = "localize.json"


def perform(command: Localize) -> int:
    """Localise in a run; returns the exit code."""
    output = command.output or default_output(command.run, "localize")
    names = (PATH_NAME, JSON_NAME, MAP_PICTURE, *([ERROR_PICTURE] if command.reference else []))
    landmark_map = read_map(command.map)
    map_errors = _map_errors(command)
    considered = map_errors == "considered"
    joint = read_joint_covariance(command.map, landmark_map) if considered else None
    recording, _ = read_run_of(command)
    demand_free([output / name for name in names], overwrite=command.force)
    run, time_line = timed(lambda: localized_run_of(command, recording, landmark_map, joint))
    reference = read_reference(command.reference, run.path) if command.reference else None
    distance = path_distance(run.path, reference.poses) if reference else None
    output.mkdir(parents=True, exist_ok=True)
    write_path(
        output / PATH_NAME,
        run.path,
        [f"slam localize {slam.__version__}: {command.run} in {command.map}"],
        overwrite=command.force,
    )
    content = summary(run, flags_of(command), distance)
    content["map_errors"] = map_errors if joint is None else f"{map_errors}, jointly"
    write_json(output / JSON_NAME, content, overwrite=command.force)
    print("\n".join(table(run, distance)))
    if considered and joint is None:
        print(f"errors of the map taken as independent: no {covariance_file(command.map).name}")
    print(time_line)
    draw_results(
        output, landmark_map, run.path, reference, f"{command.run.name}: localised", command
    )
    return 0


def localized_run_of(
    command: Localize, recording: Recording, landmark_map: LandmarkMap, joint: FloatArray | None
) -> FilterRun:
    """What a command asks for: a run's rows localised in a map, whose joint covariance is `joint`.

    Raises
    ------
    SlamError
        If no row shows a landmark of the map, or a flag is out of its range.
    """
    demand(command, SlamError, start=FINITE, start_sigma=NOT_NEGATIVE)
    start, covariance = np.array(command.start), np.diag(np.square(command.start_sigma))
    if command.lost:
        start, covariance = _woken_up(command, recording, landmark_map)
    localizer = Localizer(
        landmark_map,
        start,
        covariance,
        camera_xy_of(recording, command.run, command.camera),
        map_errors=_map_errors(command),
        joint_covariance=joint,
    )
    associator = Associator(command.association, command.gate_probability)
    run = run_filter(recording, localizer, associator)
    if not run.count.discs and not run.count.lines:
        raise SlamError(
            f"{command.run}: no row shows a landmark of {command.map}: expected identifiers of the "
            "same run, or --association joint"
        )
    return run


def _woken_up(
    command: Localize, recording: Recording, landmark_map: LandmarkMap
) -> tuple[FloatArray, FloatArray]:
    """The pose at the start and its covariance, by the discs of the first frames."""
    if any(command.start) or any(command.start_sigma):
        raise SlamError("--lost and --start: expected one of them")
    woken = wake_up(recording, landmark_map.discs.xy)
    if woken is None:
        raise SlamError(
            f"{command.run}: no place in {command.map} is certain by the discs of the first frames:"
            " expected five or more that no other place has as well; --start says where"
        )
    x, y, heading = woken.pose
    print(
        f"woke up at {x:.2f}, {y:.2f} m, heading {np.degrees(heading):.1f} deg: {woken.agreeing} "
        f"of {woken.discs} discs of the first {woken.frames} frames are in the map"
    )
    return woken.pose, woken.covariance


def _map_errors(command: Localize) -> MapErrors:
    """How the map's errors are treated, where that is not said."""
    if command.map_errors != "auto":
        return command.map_errors
    # Considering them makes the filter slow to pull itself back onto the map, which costs little
    # as long as the pairs are right, and the track if they are to be found.
    return "considered" if command.association == "known" else "ignored"
