"""The command ``slam localize``."""

from __future__ import annotations

import numpy as np

from redetect.array_types import FloatArray
from redetect.landmarks.map_file import (
    LandmarkMap,
    covariance_file,
    read_joint_covariance,
    read_map,
)
from redetect.slam.association.waking import wake_up
from redetect.slam.commands.files import (
    FilterResults,
    camera_xy_of,
    filter_output,
    filtered,
    recording_of,
    write_filtered,
)
from redetect.slam.errors import SlamError
from redetect.slam.filters.frames import Associator, FilterRun, run_filter
from redetect.slam.filters.localizer import Localizer, MapErrors
from redetect.slam.options import Localize
from redetect.slam.recording import Recording
from redetect.storage.bounds import FINITE, NOT_NEGATIVE, demand


def perform(command: Localize) -> int:
    """Localise in a run; returns the exit code."""
    landmark_map = read_map(command.map)
    map_errors = _map_errors(command)
    considered = map_errors == "considered"
    joint = read_joint_covariance(command.map, landmark_map) if considered else None
    recording = recording_of(command)
    output = filter_output(command, "localize")
    run, time_line = filtered(lambda: localized_run_of(command, recording, landmark_map, joint))
    said = [time_line]
    if considered and joint is None:
        name = covariance_file(command.map).name
        said.insert(0, f"errors of the map taken as independent: no {name}")
    results = FilterResults(
        "localize",
        run,
        landmark_map,
        f"{command.run} in {command.map}",
        f"{command.run.name}: localised",
        {"map_errors": map_errors if joint is None else f"{map_errors}, jointly"},
        said,
    )
    write_filtered(command, output, results)
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
