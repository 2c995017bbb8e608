"""The commands ``groundtruth network``, ``rig`` and ``poses``: cameras, markers and the robot."""

from __future__ import annotations

import os
import sys
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from camera import camera_file_in, read_camera
from redetect.bounds import ABOVE_0, demand
from redetect.command_line import EXIT_ERROR
from redetect.groundtruth.commands import outputs
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import write_json
from redetect.groundtruth.markers import session
from redetect.groundtruth.markers.boards import BoardView, calibration_of, find_boards, read_boards
from redetect.groundtruth.markers.network_estimation import estimate_network
from redetect.groundtruth.markers.rig_estimation import estimate_rig
from redetect.groundtruth.markers.track import PoseStatus, Track, report_entry, track_by_markers
from redetect.groundtruth.options import Network, Poses, Rig
from redetect.groundtruth.report.pictures import draw_rig
from redetect.groundtruth.trajectories.streams import format_tum, write_planar_poses
from redetect.json_text import json_text
from redetect.storage import write_bytes

#: Share of markers that disagree, or times that have no pose, above which a warning is printed; a
#: marker is wrong if more than a share of its views disagree, and hardly any others do.
_MANY_LEFT_OUT, _MOST_LEFT_OUT, _OF_THE_WRONG = 0.1, 0.5, 0.8
#: Squared residuals per degree of freedom above which a warning is printed.
_MUCH_TOO_LARGE = 9.0


def perform_network(command: Network) -> int:
    """Carry out ``groundtruth network``; returns the exit code."""
    outputs.check_outputs((command.output,), command.force)
    boards = read_boards(command.boards)
    shots: dict[int, list[BoardView]] = {}
    for image in outputs.progress(boards.images, "boards"):
        try:
            view = find_boards(image, boards.boards[image.board], boards.cameras[image.camera])
            shots.setdefault(image.placement, []).append(view)
        except GroundTruthError as error:
            print(f"left out: {error}", file=sys.stderr)
    estimate = estimate_network(boards, list(shots.values()), command.settings)
    folder = command.boards if command.boards.is_dir() else command.boards.parent
    calibrations = tuple(
        Path(os.path.relpath(folder / calibration_of(name), command.output.parent)).as_posix()
        for name in estimate.names
    )
    network = session.Network(
        estimate.names,
        tuple(boards.cameras[name] for name in estimate.names),
        calibrations,
        estimate.world_from_camera,
        estimate.covariance,
    )
    adjusted, table = estimate.adjusted, []
    for name, board in product(estimate.names, sorted({view.board for view in estimate.views})):
        chosen = [i for i, v in enumerate(estimate.views) if (v.camera, v.board) == (name, board)]
        if chosen:
            figures = adjusted.residual_figures(chosen)
            table.append({"camera": name, "board": board, **figures})
    extra = {
        "made_by": outputs.provenance(command.settings),
        "reduced_cost": adjusted.reduced_cost,
        "residuals": table,
    }
    session.write_network(command.output, network, extra, overwrite=command.force)
    outputs.print_table(table)
    outputs.print_sigmas("camera", list(estimate.names), estimate.covariance)
    print(f"{command.output}: {len(estimate.names)} cameras")
    return 0


def perform_rig(command: Rig) -> int:
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


def _input(command: Rig) -> tuple[session.Network, list[tuple[session.MarkerFrame, ...]]]:
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


def perform_poses(command: Poses) -> int:
    """Carry out ``groundtruth poses``; returns the exit code: 1 without a single pose."""
    runs = session.find_runs(command.session)
    network_path = command.network or command.session / "network.json"
    rig_path = command.rig or command.session / "rig.json"
    output = command.output or command.session / "poses.csv"
    settings_path = output.with_suffix(".json")
    outputs.check_outputs((output, settings_path, command.tum, command.report), command.force)
    network = session.read_network(network_path)
    rig = session.read_rig(rig_path)
    frames = session.read_network_frames(runs, network)
    groups = session.group_by_time(frames, command.settings.time_tolerance_s)
    track = track_by_markers(outputs.progress(groups, "poses"), rig, network, command.settings)
    poses = track.planar()
    print(
        f"{len(poses)} poses of {len(track.times)} times: "
        + ", ".join(f"{number} {status}" for status, number in track.counts.items() if number)
    )
    if track.unknown_markers:
        print(f"{track.unknown_markers} markers found are not on the rig: ignored")
        sets = {marker.dictionary for frame in frames for marker in frame.markers}
        if others := sorted(sets - {rig.dictionary}):
            found = f"markers of {', '.join(others)} were found"
            outputs.warn(f"{found}, those in {rig_path} are of {rig.dictionary}")
    print_left_out(track, rig_path, network_path)
    if command.report is not None:
        lines = [f"{json_text(report_entry(t, network), indent=None)}\n" for t in track.times]
        write_bytes(command.report, "".join(lines).encode(), overwrite=command.force)
    if not len(poses):
        print("error: no pose", file=sys.stderr)
        return EXIT_ERROR
    print(f"squared residuals per degree of freedom: {track.reduced_cost:.2f}")
    if track.reduced_cost > _MUCH_TOO_LARGE:
        outputs.warn(
            f"residuals are {track.reduced_cost**0.5:.0f} times as large as expected: the "
            f"widths and poses of markers in {rig_path}, the poses of cameras in {network_path}, "
            "or a lens calibration may be wrong"
        )
    write_planar_poses(output, poses, overwrite=command.force)
    content = {
        **outputs.provenance(command.settings, (rig_path, network_path)),
        "columns": "t x y theta, covariance of x y theta row by row (s, m, rad)",
        "times": dict(track.counts),
        "reduced_cost": track.reduced_cost,
    }
    write_json(settings_path, content, overwrite=command.force)
    if command.tum is not None:
        in_space = np.stack([pose.world_from_robot for _, pose in track.posed])
        text = format_tum(poses.times_s, in_space)
        write_bytes(command.tum, text.encode(), overwrite=command.force)
    print(f"{output}: written")
    return 0


def print_left_out(track: Track, rig_path: Path, network_path: Path) -> None:
    """Say how many markers disagree with others, and what may be wrong if they are many."""
    seen: Counter[int] = Counter()
    left_out: Counter[int] = Counter()
    for tracked in track.times:
        if tracked.pose and tracked.estimate:
            for view, good in zip(tracked.views, tracked.estimate.views):
                seen[view.marker.id] += 1
                left_out[view.marker.id] += not good
    total, failed = left_out.total(), track.counts[PoseStatus.FAILED]
    if total:
        print(f"{total} markers disagree with the others at their time: ignored")
    if total <= _MANY_LEFT_OUT * seen.total() and failed <= _MANY_LEFT_OUT * len(track.times):
        return
    wrong = [m for m, count in sorted(left_out.items()) if count > _MOST_LEFT_OUT * seen[m]]
    named = wrong and sum(left_out[m] for m in wrong) > _OF_THE_WRONG * total
    first = f"the pose of marker {', '.join(map(str, wrong))}, or else " if named else ""
    outputs.warn(
        f"{total} of {seen.total()} markers disagree with others, and {failed} times "
        f"have no pose since they do: {first}poses or widths of markers, in {rig_path}, or poses "
        f"of cameras, in {network_path}, may be wrong"
    )
