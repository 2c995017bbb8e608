"""The command ``groundtruth rig``: reads runs, estimates a rig, puts it into the robot's frame."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from camera import camera_file_in, read_camera
from redetect.groundtruth.commands.options import Rig as RigCommand
from redetect.groundtruth.commands.outputs import (
    check_outputs,
    print_sigmas,
    print_table,
    provenance,
    residual_figures,
)
from redetect.groundtruth.commands.poses import read_all_frames
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.markers.rig_estimation import (
    RigEstimate,
    estimate_rig,
    rig_by_known_markers,
    rig_by_reference_poses,
)
from redetect.groundtruth.markers.session import (
    MarkerFrame,
    Network,
    group_by_time,
    read_marker_frames,
    read_network,
    read_rig,
    write_rig,
)
from redetect.groundtruth.report.pictures import draw_rig
from redetect.groundtruth.trajectories.streams import read_planar_poses
from redetect.storage import write_bytes


def perform(command: RigCommand) -> int:
    """Carry out ``groundtruth rig``; returns the exit code."""
    if command.robot is not None and command.reference_poses is not None:
        raise GroundTruthError("--robot and --reference-poses both define the robot's frame")
    if command.reference_poses is not None and command.network is None:
        raise GroundTruthError("--reference-poses needs --network: where the cameras are")
    picture = command.picture if command.picture is not None else command.output.with_suffix(".png")
    check_outputs((command.output, picture), command.force)
    network, groups = _input(command)
    dictionary, widths = _markers(command, groups)
    estimate = estimate_rig(
        groups, network, dictionary, widths, command.settings, reference=command.reference
    )
    estimate, frame = _in_robot_frame(command, estimate)
    rig = estimate.rig
    table = [
        {
            "marker": marker,
            **residual_figures(
                estimate.adjusted,
                [i for i, view in enumerate(estimate.views) if view.rig_index == index],
            ),
        }
        for index, marker in enumerate(rig.ids)
    ]
    pairs = [
        {
            "markers": [rig.ids[a], rig.ids[b]],
            "times": len(pair.agrees),
            "agree": pair.support,
            "agree_with_second_solution": int((pair.agrees & ~pair.first).sum()),
        }
        for (a, b), pair in sorted(estimate.pairs.items())
    ]
    extra: dict[str, Any] = {
        "made_by": provenance(command.settings),
        "frame": frame,
        "times": estimate.times,
        "reduced_cost": estimate.adjusted.reduced_cost,
        "residuals": table,
        "pairs": pairs,
    }
    drawn = draw_rig(estimate)
    write_rig(command.output, rig, extra, overwrite=command.force)
    write_bytes(picture, drawn, overwrite=command.force)
    for marker, reason in estimate.left_out.items():
        print(f"marker {marker}: left out: {reason}")
    print_table(table)
    print_sigmas("marker", [str(marker) for marker in rig.ids], rig.covariance)
    print(
        f"{command.output}: {len(rig.ids)} markers from {estimate.times} times, frame: {frame}, "
        f"squared residuals per degree of freedom {estimate.adjusted.reduced_cost:.2f}"
    )
    return 0


def _input(command: RigCommand) -> tuple[Network, list[tuple[MarkerFrame, ...]]]:
    """The cameras, and images grouped by time, or each by itself without a network's file."""
    if command.network is not None:
        network = read_network(command.network)
        frames = read_all_frames(command.runs, network)
        return network, group_by_time(frames, command.settings.time_tolerance_s)
    count = len(command.runs)
    files = [_calibration(run) for run in command.runs]
    network = Network(
        tuple(run.name for run in command.runs),
        tuple(map(read_camera, files)),
        tuple(map(str, files)),
        np.tile(np.eye(4), (count, 1, 1)),
        np.zeros((6 * count, 6 * count)),
    )
    return network, [
        (frame,)
        for index, run in enumerate(command.runs)
        for frame in read_marker_frames(run, index, timed=False)
    ]


def _calibration(run: Path) -> Path:
    found = camera_file_in(run)
    if found is None:
        raise GroundTruthError(f"{run}: no calibration: expected a .cam file in it")
    return found


def _markers(
    command: RigCommand, groups: Sequence[Sequence[MarkerFrame]]
) -> tuple[str, dict[int, float]]:
    """The dictionary, and the widths of the markers that may be on the robot."""
    markers = [marker for group in groups for frame in group for marker in frame.markers]
    dictionaries = sorted({marker.dictionary for marker in markers})
    if command.dictionary is None and len(dictionaries) != 1:
        raise GroundTruthError(
            f"markers of the dictionaries {dictionaries}: name the robot's by --dictionary"
        )
    dictionary = command.dictionary if command.dictionary is not None else dictionaries[0]
    found = {marker.id for marker in markers if marker.dictionary == dictionary}
    ids = sorted(found & set(command.ids)) if command.ids else sorted(found)
    if not found:
        raise GroundTruthError(f"no markers of the dictionary {dictionary} in any of the runs")
    if not ids:
        raise GroundTruthError(
            "ids: none of these markers in any of the runs: "
            f"expected some of {_listed(sorted(found))}"
        )
    if missing := sorted(set(command.ids or ()) - found):
        print(f"warning: ids: not in any of the runs: {_listed(missing)}", file=sys.stderr)
    if not (np.isfinite(command.width_m) and command.width_m > 0.0):
        raise GroundTruthError(f"width_m is {command.width_m:g}: expected metres above 0")
    widths = dict.fromkeys(ids, command.width_m)
    named: dict[int, float] = {}
    for word in command.widths:
        marker, _, width = word.partition("=")
        try:
            number, metres = int(marker), float(width)
        except ValueError:
            number, metres = -1, float("nan")
        if number < 0 or not (np.isfinite(metres) and metres > 0.0):
            raise GroundTruthError(f"widths: {word!r}: expected a marker and metres, as 31=0.15")
        if number in named:
            raise GroundTruthError(f"widths: marker {number} twice: expected one width")
        named[number] = metres
    for number, metres in named.items():
        if number in widths:
            widths[number] = metres
        else:
            print(
                f"warning: widths: marker {number} is not among those found ({_listed(ids)}): its "
                "width counts for none",
                file=sys.stderr,
            )
    return dictionary, widths


def _listed(ids: Sequence[int]) -> str:
    return ", ".join(map(str, ids[:10])) + (", ..." if len(ids) > 10 else "")


def _in_robot_frame(command: RigCommand, estimate: RigEstimate) -> tuple[RigEstimate, str]:
    """The estimate in the robot's frame, and what that is."""
    if command.robot is not None:
        known = read_rig(command.robot)
        moved = rig_by_known_markers(estimate, known, command.settings)
        return moved, f"robot, by {command.robot.name}"
    if command.reference_poses is not None:
        reference = read_planar_poses(command.reference_poses)
        moved, used = rig_by_reference_poses(estimate, reference, command.settings)
        return moved, f"robot, by {used} poses of {command.reference_poses.name}"
    return estimate, f"marker {estimate.reference}"
