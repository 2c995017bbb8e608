"""The command ``groundtruth rig``: reads runs, estimates a rig in the robot's frame, writes it."""

from __future__ import annotations

from typing import Any

import numpy as np

from camera import camera_file_in, read_camera
from redetect.bounds import ABOVE_0, demand
from redetect.groundtruth.commands import outputs
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.markers import session
from redetect.groundtruth.markers.rig_estimation import estimate_rig
from redetect.groundtruth.options import Rig as RigCommand
from redetect.groundtruth.report.pictures import draw_rig
from redetect.storage import write_bytes


def perform(command: RigCommand) -> int:
    """Carry out ``groundtruth rig``; returns the exit code."""
    demand(command, GroundTruthError, width_m=ABOVE_0)
    picture = command.output.with_suffix(".png")
    outputs.check_outputs((command.output, picture), command.force)
    network, groups = _input(command)
    estimate = estimate_rig(
        groups,
        network,
        command.width_m,
        command.settings,
        reference=command.reference,
        known=None if command.robot is None else session.read_rig(command.robot),
    )
    frame = f"marker {estimate.reference}"
    if command.robot is not None:
        frame = f"robot, by {command.robot.name}"
    rig = estimate.rig
    views = [
        [i for i, view in enumerate(estimate.views) if view.rig_index == index]
        for index in range(len(rig.ids))
    ]
    table = [
        {"marker": marker, **estimate.adjusted.residual_figures(own)}
        for marker, own in zip(rig.ids, views)
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
        "made_by": outputs.provenance(command.settings),
        "frame": frame,
        "times": estimate.times,
        "reduced_cost": estimate.adjusted.reduced_cost,
        "residuals": table,
        "pairs": pairs,
    }
    drawn = draw_rig(estimate)
    session.write_rig(command.output, rig, extra, overwrite=command.force)
    write_bytes(picture, drawn, overwrite=command.force)
    for marker, reason in estimate.left_out.items():
        print(f"marker {marker}: left out: {reason}")
    outputs.print_table(table)
    outputs.print_sigmas("marker", [str(marker) for marker in rig.ids], rig.covariance)
    print(
        f"{command.output}: {len(rig.ids)} markers from {estimate.times} times, frame: {frame}, "
        f"squared residuals per degree of freedom {estimate.adjusted.reduced_cost:.2f}"
    )
    return 0


def _input(command: RigCommand) -> tuple[session.Network, list[tuple[session.MarkerFrame, ...]]]:
    """The cameras, and images grouped by time, or separately without a network's file."""
    if command.network is not None:
        network = session.read_network(command.network)
        frames = session.read_network_frames(command.runs, network)
        return network, session.group_by_time(frames, command.settings.time_tolerance_s)
    count, files = len(command.runs), []
    for run in command.runs:
        found = camera_file_in(run)
        if found is None:
            raise GroundTruthError(f"{run}: no calibration: expected a .cam file in it")
        files.append(found)
    network = session.Network(
        tuple(run.name for run in command.runs),
        tuple(map(read_camera, files)),
        tuple(map(str, files)),
        np.tile(np.eye(4), (count, 1, 1)),
        np.zeros((6 * count, 6 * count)),
    )
    return network, [
        (frame,)
        for index, run in enumerate(command.runs)
        for frame in session.read_marker_frames(run, index, timed=False)
    ]
